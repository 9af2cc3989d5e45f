"""TUNED.json: noise settings of filters that `crosscomb tune` found, and how they take the place of others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from crosscomb.checked import FileKind, Record, read_checked
from crosscomb.errors import UsageError
from crosscomb.files import write_json
from crosscomb.filters.catalogue import make_filter
from crosscomb.models.vehicle import load_vehicle
from crosscomb.selection.artefact import FilterSettings

SCHEMA_VERSION = 1


class TunedNoise(Record):
    """Noise settings of one filter, by its name in the catalogue."""

    name: str
    noise: dict[str, Any]


class Tuned(Record):
    """What a tuning found.

    Attributes
    ----------
    by : str
        What was minimised: the error against ground truth, or the surprise of the measurements (``likelihood``).
    filters : list of TunedNoise
        Those whose tuned noise stood the test on recordings it was not tuned on.
    record : dict
        Of the tuning: seeds, data hashes, versions, scores. Nothing of it changes a result.
    """

    schema_version: int = SCHEMA_VERSION
    by: Literal["error", "likelihood"]
    filters: list[TunedNoise]
    record: dict[str, Any] = Field(default={})


def _require_known(tuned: Tuned) -> None:
    names = [entry.name for entry in tuned.filters]
    for entry in tuned.filters:
        if names.count(entry.name) > 1:
            raise UsageError(f"filter {entry.name} is named twice: delete one")
        make_filter(entry.name, load_vehicle("generic_compact"), {"noise": entry.noise})


FILE = FileKind(
    "file of `crosscomb tune`", Tuned, "JSON", "make it with `crosscomb tune`", "tune anew",
    SCHEMA_VERSION, _require_known,
)  # fmt: skip


def load_tuned(path: Path | None, names: Sequence[str]) -> Tuned | None:
    """Read and check a TUNED.json for the filters of a run; none is fine.

    Raises
    ------
    UsageError
        The file is missing, no JSON, of another schema version, names unknown filters or settings, or holds only
        noise of filters that are not among ``names``.
    """
    if path is None:
        return None
    tuned = read_checked(path, FILE)
    if tuned.filters and not any(entry.name in names for entry in tuned.filters):
        given = ", ".join(entry.name for entry in tuned.filters)
        raise UsageError(f"{path}: holds noise of {given}, none of which runs here: name them in `filters`")
    return tuned


def save_tuned(tuned: Tuned, path: Path) -> None:
    """Write a TUNED.json; the numbers come back exactly."""
    write_json(path, tuned.model_dump(mode="json"))


def with_tuned(entries: Sequence[FilterSettings], tuned: Tuned | None) -> list[FilterSettings]:
    """Put tuned noise in the place of the filters' own; filters that were not tuned stay as they are."""
    noise = {entry.name: entry.noise for entry in tuned.filters} if tuned else {}
    return [
        entry.model_copy(update={"settings": {**entry.settings, "noise": noise[entry.name]}})
        if entry.name in noise
        else entry
        for entry in entries
    ]

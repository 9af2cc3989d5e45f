"""TUNED.json: noise settings of filters that `crosscomb tune` found, and how they take the place of others."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from crosscomb.errors import UsageError
from crosscomb.files import write_json
from crosscomb.filters.catalogue import make_filter
from crosscomb.models.vehicle import describe, load_vehicle
from crosscomb.selection.artefact import FilterSettings

SCHEMA_VERSION = 1


class TunedNoise(BaseModel):
    """Noise settings of one filter, by its name in the catalogue."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    noise: dict[str, Any]


class Tuned(BaseModel):
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

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = SCHEMA_VERSION
    by: Literal["error", "likelihood"]
    filters: list[TunedNoise]
    record: dict[str, Any] = {}


def load_tuned(path: Path) -> Tuned:
    """Read and check a TUNED.json.

    Raises
    ------
    UsageError
        The file is missing, no JSON, of another schema version, or names unknown filters or settings.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file: make it with `crosscomb tune`") from None
    except json.JSONDecodeError as error:
        raise UsageError(f"{path}: line {error.lineno}: no valid JSON: tune anew") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read as tuned noise ({error.__class__.__name__})") from None
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        raise UsageError(
            f"{path}: schema version {version!r}, this crosscomb reads {SCHEMA_VERSION} in a file of "
            f"`crosscomb tune`: tune anew with this version"
        )
    try:
        tuned = Tuned(**content)
    except ValidationError as error:
        raise UsageError(f"{path}: {describe(error)}: tune anew") from None
    names = [entry.name for entry in tuned.filters]
    for entry in tuned.filters:
        if names.count(entry.name) > 1:
            raise UsageError(f"{path}: filter {entry.name} is named twice: delete one")
        try:
            make_filter(entry.name, load_vehicle("generic_compact"), {"noise": entry.noise})
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None
    return tuned


def save_tuned(tuned: Tuned, path: Path) -> None:
    """Write a TUNED.json; the numbers come back exactly."""
    write_json(path, tuned.model_dump(mode="json"))


def require_used(tuned: Tuned | None, names: Sequence[str], path: Path | None) -> None:
    """Refuse tuned noise that no filter of a run takes.

    Raises
    ------
    UsageError
    """
    if tuned and tuned.filters and not any(entry.name in names for entry in tuned.filters):
        given = ", ".join(entry.name for entry in tuned.filters)
        raise UsageError(f"{path}: holds noise of {given}, none of which runs here: name them with --filters")


def with_tuned(entries: Sequence[FilterSettings], tuned: Tuned | None) -> list[FilterSettings]:
    """Put tuned noise in the place of the filters' own; filters that were not tuned stay as they are."""
    noise = {entry.name: entry.noise for entry in tuned.filters} if tuned else {}
    return [
        entry.model_copy(update={"settings": {**entry.settings, "noise": noise[entry.name]}})
        if entry.name in noise
        else entry
        for entry in entries
    ]

"""The artefact: a trained selector with all its settings in one JSON file."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from crosscomb.checked import FileKind, Record, parse_checked, read_checked
from crosscomb.errors import UsageError
from crosscomb.files import write_text
from crosscomb.filters.catalogue import make_filter, require_listed
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.selection.choice import Choice
from crosscomb.selection.correction import Correction
from crosscomb.selection.features import layout
from crosscomb.selection.switch import SwitchSettings
from crosscomb.selection.tree import Tree
from crosscomb.selection.trust import Trust
from crosscomb.selection.windows import WindowSettings

SCHEMA_VERSION = 4

SHIPPED = ("tree", "hybrid")
"""Artefacts that come with the package: the default tree, and the learned correction."""


class FilterSettings(Record):
    """One filter that runs: its name in the catalogue and its settings."""

    name: str
    settings: dict[str, Any] = Field(default={})


class Artefact(Record):
    """A trained selector with everything a run needs.

    Attributes
    ----------
    rate : float
        Working rate [Hz].
    filters : list of FilterSettings
        In the order of the tree's classes.
    fallback : str
        Filter that is active before the first decision.
    tree : Tree
        Selects the filter, unless there is a choice.
    tree_sees_all : bool
        The tree looks at all features (`crosscomb.selection.features`) instead of the windows of ay and yaw rate.
    choice : Choice or None
        Boosted trees that select or blend.
    correction : Correction or None
    trust : Trust
    vehicle : Vehicle or None
        The car it was trained for; None when there were several.
    training : dict
        Record of the training: seeds, data hashes, versions, metrics. Nothing of it changes a result.
    """

    schema_version: int = SCHEMA_VERSION
    selector_name: str
    rate: float = Field(default=100.0, ge=10.0, le=10_000.0)
    window: WindowSettings
    filters: list[FilterSettings] = Field(min_length=1)
    fallback: str
    switch: SwitchSettings
    tree: Tree
    tree_sees_all: bool = False
    choice: Choice | None = None
    correction: Correction | None = None
    trust: Trust = Trust()
    vehicle: Vehicle | None = None
    training: dict[str, Any] = Field(default={})

    @model_validator(mode="after")
    def _consistent(self) -> Artefact:
        names = self.filter_names
        for name in names:
            try:
                require_listed(f"filter {name}", name)
            except UsageError as error:
                raise ValueError(str(error)) from None
        if len(set(names)) < len(names):
            raise ValueError("a filter is named twice")
        if self.fallback not in names:
            raise ValueError(f"fallback {self.fallback} is none of the filters {', '.join(names)}")
        if self.tree.n_classes != len(names):
            raise ValueError(f"the tree has {self.tree.n_classes} classes for {len(names)} filters")
        everything = len(layout(names).names)
        seen = everything if self.tree_sees_all else len(self.window.names)
        if len(self.tree.lowest) != seen:
            raise ValueError(f"the tree has {len(self.tree.lowest)} features, its input {seen}")
        if self.choice is not None:
            if len(self.choice.trees.baseline) != len(names):
                raise ValueError(
                    f"the choice has {len(self.choice.trees.baseline)} outputs for {len(names)} filters"
                )
            if self.choice.trees.n_features > everything:
                raise ValueError("the choice asks for features that are not there")
        if self.correction is not None:
            if self.correction.anchor not in names:
                raise ValueError(
                    f"the corrected filter {self.correction.anchor} is none of {', '.join(names)}"
                )
            if len(self.correction.lowest) != everything:
                raise ValueError(f"the correction has {len(self.correction.lowest)} features of {everything}")
        return self

    @property
    def sees_all(self) -> bool:
        """Whether anything looks at all features."""
        return self.tree_sees_all or self.choice is not None or self.correction is not None

    @property
    def filter_names(self) -> list[str]:
        """Names of the filters in the order of the classes."""
        return [entry.name for entry in self.filters]


def _require_filters(artefact: Artefact) -> None:
    car = artefact.vehicle or load_vehicle("generic_compact")
    for entry in artefact.filters:
        make_filter(entry.name, car, entry.settings)


FILE = FileKind(
    "artefact", Artefact, "JSON", "train one with `crosscomb train`", "train the artefact anew",
    SCHEMA_VERSION, _require_filters,
)  # fmt: skip


def load_artefact(path: str | Path | None = None) -> Artefact:
    """Read and check an artefact; without a path the tree that comes with the package.

    Parameters
    ----------
    path : str or Path, optional
        A file, or the name of one that comes with the package: `SHIPPED`.

    Raises
    ------
    UsageError
        The file is missing, no JSON, of another schema version, or unsound.
    """
    path = Path("tree" if path is None else path)
    if str(path) in SHIPPED:
        entry = resources.files("crosscomb") / "data" / f"{path}.json"
        return parse_artefact(entry.read_text(encoding="utf-8"), entry.name)
    return read_checked(path, FILE)


def parse_artefact(text: str, source: str) -> Artefact:
    """Make an artefact from the text of its file; `source` names it in messages."""
    return parse_checked(text, source, FILE)


def save_artefact(artefact: Artefact, path: Path) -> None:
    """Write an artefact as JSON; the numbers come back exactly."""
    write_text(path, json.dumps(artefact.model_dump(mode="json"), indent=1) + "\n")

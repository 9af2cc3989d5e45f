"""What `estimate` writes for each log, and what is said of all of them at the end."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from crosscomb.files import existing_files, run_record, write_json, write_text
from crosscomb.logs.intake import OpenedLog
from crosscomb.run.estimate import LogEstimate
from crosscomb.training.metrics import Score, score_log

OUTPUTS = (
    ".estimate.csv",
    ".estimate.png",
    ".point.csv",
    ".handling.csv",
    ".extras.csv",
    ".extras.png",
    ".run.json",
)
"""Endings of what is written for a log."""


def estimate_files(folder: Path, names: Iterable[str]) -> list[Path]:
    """Files that may be written for logs of these names."""
    return [folder / f"{name}{end}" for name in names for end in OUTPUTS]


@dataclass(frozen=True)
class Sources:
    """Files that estimates were made with, beside the logs."""

    selector_file: Path | None = None
    channel_map: Path | None = None
    tuned: Path | None = None


def write_estimate(
    estimate: LogEstimate,
    log: OpenedLog,
    folder: Path,
    sources: Sources,
    point: tuple[float, float] | None = None,
    handling: bool = False,
    plot: bool = False,
) -> None:
    """Write all that belongs to the estimate of one log, the record of the run too.

    Parameters
    ----------
    estimate : LogEstimate
        Its extras are written where it has some.
    log : OpenedLog
    folder : Path
    sources : Sources
    point : (float, float), optional
        Point of the car [m] whose velocity is wanted too.
    handling, plot : bool
        Whether to write slip angles and words of handling too; whether to draw.
    """
    name, title = log.signals.name, f"{log.signals.name}, {log.vehicle.name}"
    tables = {"estimate": estimate.table()}
    if estimate.extras:
        tables["extras"] = estimate.extras_table()
    if point is not None:
        tables["point"] = estimate.point_table(*point)
    if handling:
        tables["handling"] = estimate.handling_table()
    for kind, table in tables.items():
        write_table(table, folder / f"{name}.{kind}.csv")
    settings = {
        "artefact": str(sources.selector_file or "shipped"), "vehicle": log.vehicle.model_dump(),
        "vehicle_from": log.origin, "filters": list(estimate.filters), "notes": list(estimate.signals.notes),
        "tuned": str(sources.tuned) if sources.tuned else None, "point": point,
    }  # fmt: skip
    beside = existing_files(sources.selector_file, sources.channel_map, sources.tuned, log.origin)
    write_json(folder / f"{name}.run.json", run_record("estimate", settings, [log.path, *beside]))
    if plot:
        from crosscomb.report.pictures import estimate_figure, extras_figure, save_figure

        save_figure(estimate_figure(estimate, title), folder / f"{name}.estimate.png")
        if estimate.extras:
            save_figure(extras_figure(tables["extras"], title), folder / f"{name}.extras.png")


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table of an estimate, whole or not at all; its numbers come back exactly, NaN as an empty cell."""
    # By hand in half the time that pandas takes: no cell holds anything that must be quoted.
    names = [str(name) for name in table.columns]
    columns = [map(_cell if table[name].dtype == float else str, table[name].tolist()) for name in names]
    rows = map(",".join, zip(*columns, strict=True))
    write_text(path, "\n".join([",".join(names), *rows]) + "\n")


def _cell(value: float) -> str:
    return repr(value) if value == value else ""


@dataclass
class Summary:
    """What is said of the estimates of several logs.

    Attributes
    ----------
    scores : dict
        Of each log with ground truth, the error of each estimator.
    shares : dict
        Of each log, the share of the time in each state of handling.
    notes : list of str
    """

    scores: dict[str, dict[str, Score]] = field(default_factory=dict)
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, estimate: LogEstimate) -> None:
        """Take one log in."""
        name = estimate.signals.name
        self.shares[name] = estimate.handling_shares()
        self.notes += [f"{name}: {note}" for note in estimate.signals.notes]
        if estimate.signals.has_reference:
            self.scores[name] = score_log(estimate)
        else:
            self.notes.append(f"{name}: no ground truth, not scored")

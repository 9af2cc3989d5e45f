"""What `estimate` writes for each log, and what is said of all of them at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np
import orjson
import pandas as pd

from crosscomb.files import existing_files, locked, run_record, write_json, writing, writing_together
from crosscomb.logs.ahead import ahead
from crosscomb.logs.intake import OpenedLog
from crosscomb.report.outline import Outline
from crosscomb.run.estimate import LogEstimate, Run, Shares, next_estimate
from crosscomb.training.metrics import LogErrors, Score

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


@dataclass
class Tally:
    """What is said of one log, gathered piece by piece."""

    errors: LogErrors = field(default_factory=LogErrors)
    shares: Shares = field(default_factory=Shares)

    def take(self, estimate: LogEstimate) -> None:
        """Take the next rows."""
        self.errors.take(estimate)
        self.shares.take(estimate)


def write_estimate(
    run: Run,
    log: OpenedLog,
    folder: Path,
    sources: Sources,
    point: tuple[float, float] | None = None,
    handling: bool = False,
    plot: bool = False,
) -> Tally:
    """Estimate one log chunk by chunk and write all that belongs to it, the record of the run too; or nothing of it.

    Parameters
    ----------
    run : Run
        Before the first row; what the filters tell beside beta is written where it gives that.
    log : OpenedLog
    folder : Path
    sources : Sources
    point : (float, float), optional
        Point of the car [m] whose velocity is wanted too.
    handling, plot : bool
        Whether to write slip angles and words of handling too; whether to draw.
    """
    with locked(folder, log.file.name), writing_together(folder) as together:
        return _write_estimate(run, log, together, sources, point, handling, plot)


def _write_estimate(
    run: Run,
    log: OpenedLog,
    folder: Path,
    sources: Sources,
    point: tuple[float, float] | None,
    handling: bool,
    plot: bool,
) -> Tally:
    name, title = log.file.name, f"{log.file.name}, {log.vehicle.name}"
    tally, outline = Tally(), Outline(log.rows)
    with ExitStack() as stack:
        write: dict[str, Callable[[pd.DataFrame], None]] = {}
        for chunk in ahead(log.chunks()):
            estimate = next_estimate(run, chunk)
            for kind, table in _tables(estimate, point, handling).items():
                if kind not in write:
                    write[kind] = stack.enter_context(writing_table(folder / f"{name}.{kind}.csv"))
                write[kind](table)
            tally.take(estimate)
            if plot:
                outline.take(estimate)
    settings = {
        "artefact": str(sources.selector_file or "shipped"), "vehicle": log.vehicle.model_dump(),
        "vehicle_from": log.origin, "filters": run.stream.plan.names, "notes": [*log.file.notes, *run.notes()],
        "tuned": str(sources.tuned) if sources.tuned else None, "point": point,
    }  # fmt: skip
    beside = existing_files(sources.selector_file, sources.channel_map, sources.tuned, log.origin)
    write_json(folder / f"{name}.run.json", run_record("estimate", settings, [log.path, *beside]))
    if plot:
        from crosscomb.report.pictures import estimate_figure, extras_figure, save_figure

        drawn = outline.estimate()
        save_figure(estimate_figure(drawn, title), folder / f"{name}.estimate.png")
        if drawn.extras:
            save_figure(extras_figure(drawn.extras_table(), title), folder / f"{name}.extras.png")
    return tally


def _tables(
    estimate: LogEstimate, point: tuple[float, float] | None, handling: bool
) -> dict[str, pd.DataFrame]:
    """Tables to be written of some rows, by the middle of their files' endings."""
    tables = {"estimate": estimate.table()}
    if estimate.extras:
        tables["extras"] = estimate.extras_table()
    if point is not None:
        tables["point"] = estimate.point_table(*point)
    if handling:
        tables["handling"] = estimate.handling_table()
    return tables


@contextmanager
def writing_table(path: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    """Give what writes the parts of a table, which is there whole at the end or not at all.

    Numbers come back exactly, NaN as an empty cell. No cell may hold anything that must be quoted.
    """
    with writing(path) as temporary, temporary.open("wb") as file:

        def write(table: pd.DataFrame) -> None:
            if file.tell() == 0:
                file.write((",".join(map(str, table.columns)) + "\n").encode())
            file.write(("\n".join(_rows(table)) + "\n").encode())

        yield write


def _rows(table: pd.DataFrame) -> Iterable[str]:
    """Text of each row."""
    parts = []
    for numbers, columns in groupby(table.columns, lambda name: table[name].dtype == float):
        block = [table[name].to_numpy() for name in columns]
        parts += (
            [_number_rows(np.column_stack(block))] if numbers else [list(map(str, words)) for words in block]
        )
    return parts[0] if len(parts) == 1 else map(",".join, zip(*parts, strict=True))


def _number_rows(numbers: np.ndarray) -> list[str]:
    """Text of each row ``(n, columns)``: the shortest that comes back exactly; nothing for NaN."""
    text = orjson.dumps(numbers, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    rows = text.replace("null", "")[2:-2].split("],[")
    for row in np.flatnonzero(np.isinf(numbers).any(axis=1)).tolist():  # JSON has no infinity
        rows[row] = ",".join("" if value != value else repr(value) for value in numbers[row].tolist())
    return rows


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

    def add(self, name: str, tally: Tally, notes: Iterable[str]) -> None:
        """Take one log in."""
        self.shares[name] = tally.shares.of_time()
        self.notes += [f"{name}: {note}" for note in notes]
        if scores := tally.errors.scores():
            self.scores[name] = scores
        else:
            self.notes.append(f"{name}: no ground truth, not scored")

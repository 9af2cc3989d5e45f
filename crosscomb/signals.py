"""One log in SI units and ISO 8855 signs: the names, the units, the table and its validation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.stamps import Stamps

GRAVITY = 9.81
"""Standard gravity [m/s^2]."""

MIN_SPEED = 3.0
"""Below this vx [m/s] the slip references are worthless: status low_speed, nothing is scored."""

UNITS: dict[str, str] = {
    "t": "s",
    "vx": "m/s",
    "ax": "m/s^2",
    "ay": "m/s^2",
    "yaw_rate": "rad/s",
    "steer": "rad",
    "steer_wheel": "rad",
    "steer_rear": "rad",
    "vfl": "m/s",
    "vfr": "m/s",
    "vrl": "m/s",
    "vrr": "m/s",
    "torque_fl": "N m",
    "torque_fr": "N m",
    "torque_rl": "N m",
    "torque_rr": "N m",
    "gnss_speed": "m/s",
    "gnss_course": "rad",
    "heading": "rad",
    "beta_ref": "rad",
    "vx_ref": "m/s",
    "vy_ref": "m/s",
}
"""Every known column with its SI unit; other columns of a log are ignored."""

COLUMN = {name: place for place, name in enumerate(UNITS)}
"""Place of each column in a row of numbers, see `Signals.rows`."""

WHEEL_SPEEDS = ("vfl", "vfr", "vrl", "vrr")
TORQUES = ("torque_fl", "torque_fr", "torque_rl", "torque_rr")
GNSS = ("gnss_speed", "gnss_course", "heading")
"""Rare fixes: each counts once, at its own time. Course and heading count from one fixed axis, to the left."""

REFERENCES = ("beta_ref", "vx_ref", "vy_ref")


@dataclass(frozen=True)
class Signals:
    """One log: a table of known columns, in SI units and ISO 8855 signs.

    Attributes
    ----------
    name : str
        File name without its ending; names the outputs.
    frame : pandas.DataFrame
        ``(n, columns)`` float64, column ``t`` [s] strictly increasing; NaN means "no measurement".
    source : str
        Where it came from, for messages.
    notes : tuple of str
        What was done to the log on the way here, in words for the user.
    """

    name: str
    frame: pd.DataFrame
    source: str = ""
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def t(self) -> np.ndarray:
        """Time ``(n,) [s]``."""
        return self.column("t")

    def column(self, name: str) -> np.ndarray:
        """Values of a column ``(n,)`` in its SI unit; all NaN where the log does not have it."""
        if name in self.frame:
            return self.frame[name].to_numpy(dtype=np.float64)
        return np.full(len(self.frame), np.nan)

    def rows(self) -> np.ndarray:
        """All known columns ``(n, columns)`` in the order of `UNITS`; NaN where the log does not have one."""
        table = np.full((len(self.frame), len(UNITS)), np.nan)
        for name in self.frame.columns:
            table[:, COLUMN[name]] = self.frame[name].to_numpy(dtype=np.float64)
        return table

    def has(self, name: str) -> bool:
        """Tell whether the column holds at least one measurement."""
        return name in self.frame and bool(self.frame[name].notna().any())

    @property
    def beta_ref(self) -> np.ndarray:
        """Ground-truth sideslip angle ``(n,) [rad]``; beta_ref wins over vx_ref and vy_ref."""
        return truth_of(self.column)

    @property
    def has_reference(self) -> bool:
        """Tell whether there is ground truth where it can be scored (vx above `MIN_SPEED`)."""
        return bool(np.any(np.isfinite(self.beta_ref) & (self.column("vx") > MIN_SPEED)))

    def with_columns(self, note: str = "", **columns: np.ndarray) -> Signals:
        """Copy with columns added or replaced, and a note of what was done."""
        notes = (*self.notes, note) if note else self.notes
        return replace(self, frame=self.frame.assign(**columns), notes=notes)


def truth_of(column: Callable[[str], np.ndarray]) -> np.ndarray:
    """Ground-truth sideslip angle ``(n,) [rad]`` from what `column` gives by name."""
    velocity = np.arctan2(column("vy_ref"), column("vx_ref"))
    return np.where(np.isfinite(column("beta_ref")), column("beta_ref"), velocity)


def make_signals(frame: pd.DataFrame, name: str, source: str = "", others: Sequence[str] = ()) -> Signals:
    """Validate a table and take its known columns as one log.

    Parameters
    ----------
    frame : pandas.DataFrame
        Numeric columns named as in `UNITS`; unknown ones are dropped. An index called ``row`` holds the row
        numbers in the file, for messages; without it the rows count from 2 (the header is row 1).
    name, source : str
        Name of the log, and what messages call it.
    others : sequence of str
        Columns of the log that are not known, to be named where a needed one is missing.

    Raises
    ------
    UsageError
        A needed column is missing or empty, fewer than two rows, or t is unordered or starts again. Few rows that
        repeat a time or go back are dropped, with a note.
    """
    intake = Intake(name, source or name, others)
    signals = intake.take(frame)
    return replace(signals, notes=tuple(intake.finish()))


@dataclass
class Intake:
    """A log on its way through the checks of `make_signals`, piece by piece."""

    name: str
    source: str
    others: Sequence[str] = ()
    stamps: Stamps = field(default_factory=Stamps)
    infinite: int = 0
    measured: dict[str, bool] = field(default_factory=dict)  # by column, whether there was a value

    def take(self, frame: pd.DataFrame) -> Signals:
        """Check the next rows; see `make_signals`."""
        rows = (
            frame.index.to_numpy()
            if frame.index.name == "row"
            else np.arange(len(frame)) + self.stamps.rows + 2
        )
        known = [column for column in UNITS if column in frame]
        table = frame[known].astype(np.float64).reset_index(drop=True)
        _require_columns(table, self.source, self.others)
        infinite = int(np.isinf(table.to_numpy()).sum())
        if infinite:
            table = table.replace([np.inf, -np.inf], np.nan)
        later = self.stamps.later(table.to_numpy(), known.index("t"), self.source, rows)
        if not later.all():
            table = table[later].reset_index(drop=True)
        self.infinite += infinite
        for column in known:
            if not self.measured.get(column):
                self.measured[column] = bool(table[column].notna().any())
        return Signals(self.name, table, self.source)

    def finish(self) -> list[str]:
        """Check what only the whole log can tell; gives the notes on it."""
        notes = self.stamps.notes(self.source)
        rows = self.stamps.rows - self.stamps.dropped
        if rows < 2:
            count = "no data rows" if rows == 0 else "one data row"
            raise UsageError(f"{self.source}: has {count}, at least two are needed: record a longer log")
        _require_values(self.measured, self.source)
        return [*notes, f"{self.infinite} infinite values taken as missing"] if self.infinite else notes


def _require_columns(table: pd.DataFrame, source: str, others: Sequence[str]) -> None:
    has = (
        f" (its other columns: {', '.join(others[:12])}{', ...' if len(others) > 12 else ''})"
        if others
        else ""
    )
    mend = "or name the log's own column for it in a channel map (`channel_map`)"
    for column in ("t", "ay", "yaw_rate"):
        if column not in table:
            raise UsageError(f"{source}: column {column} [{UNITS[column]}] is missing{has}: add it, {mend}")
    if "steer" not in table and "steer_wheel" not in table:
        raise UsageError(
            f"{source}: column steer [rad] is missing, and so is steer_wheel{has}: add one of them, {mend}"
        )
    if "vx" not in table and not all(wheel in table for wheel in WHEEL_SPEEDS):
        wheels = ", ".join(WHEEL_SPEEDS)
        raise UsageError(
            f"{source}: column vx [m/s] is missing{has}: add it or all four wheel speeds {wheels}, {mend}"
        )


def _require_values(measured: Mapping[str, bool], source: str) -> None:
    """Refuse a log in which a needed column has no value, by what was `measured` at all."""
    for column in ("ay", "yaw_rate"):
        if not measured[column]:
            raise UsageError(f"{source}: column {column} has no value in any row: log that channel")
    if not any(measured.get(column) for column in ("steer", "steer_wheel")):
        present = " and ".join(column for column in ("steer", "steer_wheel") if column in measured)
        raise UsageError(f"{source}: column {present} has no value in any row: log the steering angle")
    if not measured.get("vx") and not all(measured.get(wheel) for wheel in WHEEL_SPEEDS):
        raise UsageError(
            f"{source}: column vx has no value in any row: log the speed, or all four wheel speeds"
        )

"""The channel map: foreign names, units, signs, offsets, delays and positions become ours."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import BeforeValidator, Field, model_validator

from crosscomb.checked import FileKind, Record, read_checked
from crosscomb.errors import UsageError
from crosscomb.logs.grid import MAX_AGE
from crosscomb.logs.prepare import Line, next_slopes
from crosscomb.signals import GRAVITY, REFERENCES, UNITS, Intake, Signals

DEGREE = np.pi / 180.0

FACTORS: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "m/s": {
        **{"m/s": 1.0, "km/h": 1.0 / 3.6, "kph": 1.0 / 3.6, "mph": 0.44704},
        **{"kn": 1852.0 / 3600.0, "ft/s": 0.3048, "cm/s": 0.01, "mm/s": 0.001},
    },
    "m/s^2": {"m/s^2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY, "ft/s^2": 0.3048},
    "rad": {"rad": 1.0, "deg": DEGREE, "mrad": 1e-3},
    "rad/s": {"rad/s": 1.0, "deg/s": DEGREE, "mrad/s": 1e-3, "rpm": 2.0 * np.pi / 60.0},
    "N m": {"n m": 1.0, "kn m": 1e3, "lb ft": 1.3558179483314004},
}
"""For each SI unit: what one of the other unit is in it."""

_SPELLINGS = {
    **{"sec": "s", "seconds": "s", "kmh": "km/h", "kmph": "km/h", "mps": "m/s", "knots": "kn", "kt": "kn"},
    **{"m/s2": "m/s^2", "m/s/s": "m/s^2", "m/s**2": "m/s^2", "mps2": "m/s^2"},
    **{
        "degree": "deg",
        "degrees": "deg",
        "radians": "rad",
        "deg/sec": "deg/s",
        "dps": "deg/s",
        "rad/sec": "rad/s",
    },
    **{"nm": "n m", "knm": "kn m", "n*m": "n m"},
}

DERIVATIVE_WINDOW = 0.05
"""Length of the line fitted to the yaw rate for the yaw acceleration [s]."""


def _no_truth_value(value: Any) -> Any:
    """Python takes true as 1."""
    if isinstance(value, bool):
        raise ValueError("must be 1 or -1")
    return value


class Channel(Record):
    """How one of our columns is made: ``sign * scale * unit factor * raw - offset``, late by ``delay``."""

    column: str | None = Field(
        default=None, min_length=1, description="its name in the log; None: our own name"
    )
    unit: str | None = Field(default=None, description="unit in the log; None: SI")
    sign: Annotated[Literal[1, -1], BeforeValidator(_no_truth_value)] = 1
    scale: float = Field(default=1.0, gt=0.0)
    offset: float = Field(default=0.0, description="subtracted, in the SI unit and our sign")
    delay: float = Field(default=0.0, ge=0.0, le=1.0, description="how late the channel is [s]")


class Accelerometer(Record):
    """Where the accelerometer sits: ``(x, y) [m]`` from the centre of gravity, x forward, y left."""

    position: tuple[float, float] = Field(strict=False)  # files have lists


class Reader(Record):
    """How the text is laid out; what is not given is recognised."""

    separator: str | None = Field(default=None, pattern=r"^[\t !#$%&'*,/:;<=>?@\\^_`|~]$")
    decimal: Literal[".", ","] | None = None
    header_row: int | None = Field(
        default=None, ge=1, le=10**9, description="row of the column names, counted from 1"
    )
    first_data_row: int | None = Field(
        default=None, ge=2, le=10**9, description="skips what stands below the names"
    )
    comment: str = Field(default="#", max_length=8, description="lines that begin with it are skipped")
    time_from_zero: bool = Field(default=False, description="count t from the first row")

    @model_validator(mode="after")
    def _in_order(self) -> Reader:
        if self.first_data_row is not None and self.first_data_row <= (self.header_row or 1):
            raise ValueError("first_data_row must be below header_row")
        return self


class ChannelMap(Record):
    """A checked channel map.

    Columns that it does not name are taken under their own names, as they are; a column that it gives to one
    channel is not taken for another.
    """

    channels: dict[str, Channel] = Field(default={})
    accelerometer: Accelerometer | None = None
    reader: Reader = Reader()

    @model_validator(mode="after")
    def _known_channels_and_units(self) -> ChannelMap:
        for name, channel in self.channels.items():
            if name not in UNITS:
                near = difflib.get_close_matches(name, UNITS, 1)
                mend = f"did you mean {near[0]}?" if near else f"take one of {', '.join(UNITS)}"
                raise ValueError(f"channels.{name}: unknown channel: {mend}")
            units = FACTORS[UNITS[name]]
            if channel.unit is not None and unit_name(channel.unit) not in units:
                known = ", ".join(units)
                raise ValueError(f"channels.{name}: unit {channel.unit!r} does not fit: take one of {known}")
        t = self.channels.get("t", Channel())
        if t.delay or t.sign != 1:
            raise ValueError("channels.t: time has no delay and no sign: give the delay to the late channels")
        if self.accelerometer and max(abs(value) for value in self.accelerometer.position) > 10.0:
            raise ValueError("accelerometer.position: [x, y] is in metres from the centre of gravity")
        return self

    def columns(self, found: Sequence[str], source: str) -> list[str]:
        """Columns of a log with the columns `found` that are read; `source` names it in messages.

        A column of ground truth may be missing, so that one map serves logs with it and without it.
        """
        wanted = []
        for name in UNITS:
            column = self.column(name)
            if column in found:
                wanted.append(column)
            elif name in self.channels and name not in REFERENCES:
                near = difflib.get_close_matches(column, found, 1)
                mend = f"did you mean {near[0]!r}?" if near else f"the log has {', '.join(found)}"
                raise UsageError(
                    f"{source}: column {column!r}, which the channel map names for {name}, is missing: {mend}"
                )
        return list(dict.fromkeys(wanted))

    def column(self, name: str) -> str:
        """Column of the log that holds our channel `name`; empty where another channel claims that name."""
        if name in self.channels:
            return self.channels[name].column or name
        claimed = any(channel.column == name for channel in self.channels.values())
        return "" if claimed else name


def load_map(path: str | Path | None) -> ChannelMap | None:
    """Read and check a channel map; none is fine.

    Raises
    ------
    UsageError
        The file is missing or no TOML, a key or channel is unknown, or a value is wrong.
    """
    return read_checked(path, FileKind("channel map", ChannelMap, "TOML", "check the name")) if path else None


def unit_name(text: str) -> str:
    """Name of a unit as the keys of `FACTORS` have it; unknown ones come back in lower case."""
    plain = " ".join(text.lower().replace("²", "^2").replace("°", "deg").replace("·", " ").split())
    return _SPELLINGS.get(plain, plain)


def apply_map(
    frame: pd.DataFrame, channel_map: ChannelMap, name: str, source: str = "", others: Sequence[str] = ()
) -> Signals:
    """Make one log of a table with foreign columns.

    Parameters
    ----------
    frame : pandas.DataFrame
        Numeric columns under the names of the log.
    channel_map : ChannelMap
        What they mean.
    name, source, others
        As for `crosscomb.signals.make_signals`.

    Raises
    ------
    UsageError
        As for `crosscomb.signals.make_signals`.
    """
    intake = MapIntake(channel_map, Intake(name, source or name, others))
    signals = intake.take(frame)
    return replace(signals, notes=tuple(intake.finish()))


@dataclass
class MapIntake:
    """A log with foreign columns on its way to ours, in pieces of any length with the same result bit for bit."""

    channel_map: ChannelMap
    intake: Intake
    first: float | None = None  # t of the first row, as it stands in the log
    late: pd.DataFrame | None = None  # rows that later ones look back to
    origin: float = 0.0  # t of the first row [s]
    line: Line | None = None  # of the yaw rate

    def take(self, frame: pd.DataFrame) -> Signals:
        """Take the next rows."""
        columns = {}
        for target in UNITS:
            column = self.channel_map.column(target)
            if column in frame:
                columns[target] = self._to_si(frame[column], target)
        signals = self.intake.take(pd.DataFrame(columns, index=frame.index))
        return self._move_accelerometer(self._align_delays(signals)) if len(signals) else signals

    def finish(self) -> list[str]:
        """As of `Intake`, and what was done to the channels."""
        notes = self.intake.finish()
        if self._latest():
            text = f"a row describes the car {self._latest():g} s before its t"
            notes.append(f"every channel held back to the latest one: {text}")
        if self.channel_map.accelerometer:
            x, y = self.channel_map.accelerometer.position
            where = f"x = {x:g} m, y = {y:g} m"
            notes.append(f"accelerations moved from the sensor at {where} to the centre of gravity")
        return notes

    def _to_si(self, raw: pd.Series, name: str) -> pd.Series:
        channel = self.channel_map.channels.get(name, Channel())
        if name == "t" and self.channel_map.reader.time_from_zero and len(raw):
            self.first = float(raw.iloc[0]) if self.first is None else self.first
            raw = raw - self.first
        factor = channel.sign * channel.scale * FACTORS[UNITS[name]][unit_name(channel.unit or UNITS[name])]
        return raw * factor - channel.offset

    def _latest(self) -> float:
        """Delay of the latest channel [s]."""
        channels = self.channel_map.channels.items()
        return max((channel.delay for name, channel in channels if name in self.intake.measured), default=0.0)

    def _align_delays(self, signals: Signals) -> Signals:
        """Hold every channel back to the latest one, so that a row describes one instant."""
        latest = self._latest()
        if latest == 0.0:
            return signals
        if self.late is None:
            self.origin, self.late = float(signals.t[0]), signals.frame[:0]
        known, new = len(self.late), signals.frame
        frame = pd.concat([self.late, new], ignore_index=True) if known else new
        t = frame["t"].to_numpy()
        held = {}
        for name in signals.frame.columns.drop("t"):
            delay = latest - self.channel_map.channels.get(name, Channel()).delay
            held[name] = _delayed(t, frame[name].to_numpy(), delay, self.origin, known)
        self.late = frame[max(0, int(np.searchsorted(t, t[-1] - latest - MAX_AGE)) - 1) :].copy()
        return signals.with_columns("", **held)

    def _move_accelerometer(self, signals: Signals) -> Signals:
        """Accelerations at the centre of gravity of a rigid body that turns about z."""
        if self.channel_map.accelerometer is None:
            return signals
        x, y = self.channel_map.accelerometer.position
        yaw_rate = signals.column("yaw_rate")
        self.line = self.line or Line(float(signals.t[0]))
        yaw_acceleration = next_slopes(self.line, signals.t, yaw_rate, DERIVATIVE_WINDOW)
        moved = {"ay": signals.column("ay") - x * yaw_acceleration + y * yaw_rate**2}
        if signals.has("ax"):
            moved["ax"] = signals.column("ax") + y * yaw_acceleration + x * yaw_rate**2
        return signals.with_columns("", **moved)


def _delayed(t: np.ndarray, values: np.ndarray, delay: float, origin: float, known: int) -> np.ndarray:
    """Value a while ago ``(n - known,)`` at the rows after the first `known`, on the line between two samples.

    The newer of the two is never later than the row itself, because every row has a sample. Across a silence
    of more than `MAX_AGE`, and beside a missing value, there is none.
    """
    tau = t - origin
    rounding = max(1e-9, 4.0 * float(np.spacing(abs(origin))))
    then = tau[known:] - delay
    newer = np.searchsorted(tau, then - rounding)
    older = np.maximum(newer - 1, 0)
    exact = np.abs(tau[newer] - then) <= rounding
    width = tau[newer] - tau[older]
    share = np.where(width > 0.0, (then - tau[older]) / np.where(width > 0.0, width, 1.0), 0.0)
    between = values[older] + share * (values[newer] - values[older])
    near = (newer > 0) & (width <= MAX_AGE + rounding)
    return np.where(exact, values[newer], np.where(near, between, np.nan))

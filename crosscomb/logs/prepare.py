"""Make the columns that a log lacks from those it has, causally.

Works on rows in pieces of any length, one row or a whole log, with the same result bit for bit.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from crosscomb.logs.watch import CHANNELS, Watch, count_faults, in_words, start_watch, watch_rows
from crosscomb.models.compiled import kernel
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import COLUMN, WHEEL_SPEEDS, Signals

SPEED_SLOPE_WINDOW = 0.15
"""Length of the line fitted to vx for ax [s]: a shorter one is noisy on wheel speeds, a longer one late."""

MOST_WINDOWS = 5.0
"""No sample of a line is older than this many of its windows."""

_T, _STEER, _STEER_WHEEL, _VX, _AX = (COLUMN[name] for name in ("t", "steer", "steer_wheel", "vx", "ax"))
_NAMES = list(COLUMN)


@dataclass
class Line:
    """Newest samples of a channel, as far back as a line through them reaches."""

    origin: float  # t of the first row [s]
    tau: np.ndarray = field(default_factory=lambda: np.empty(0))  # since then [s]
    values: np.ndarray = field(default_factory=lambda: np.empty(0))


_MADE = {
    _STEER: "steer made from steer_wheel and the steering ratio {:g}",
    _VX: "vx made from the wheel speeds, yaw rate and steering angle",
    _AX: f"ax is missing: the slope of vx over the last {SPEED_SLOPE_WINDOW:g} s is taken instead",
}
"""What is said of each column that may be made."""


@dataclass
class Completion:
    """A log on its way through the completion: when columns had their first sample, which were made, and recent vx.

    What is there and what was made is then watched: a bad sample becomes NaN.
    """

    vehicle: Vehicle
    first: dict[int, float] = field(default_factory=dict)  # t of the first sample of each column [s]
    made: set[int] = field(default_factory=set)  # columns with a made value
    line: Line | None = None
    watch: Watch = field(default_factory=start_watch)
    faults: Counter[str] = field(default_factory=Counter)  # rows, by words for what is bad in them

    def notes(self) -> dict[str, str]:
        """What was made of the rows so far, by column."""
        notes = {}
        for column, text in _MADE.items():
            note = text.format(self.vehicle.steering_ratio)
            if column not in self.first:
                notes[_NAMES[column]] = note
            elif column in self.made:
                notes[_NAMES[column]] = f"{note}, until its first sample at t = {self.first[column]:g} s"
        if self.faults:
            notes["faults"] = in_words(dict(self.faults.most_common()))
        return notes


def next_rows(completion: Completion, rows: np.ndarray) -> np.ndarray:
    """Fill steer, vx and ax in the next rows of a log, each until its own first sample, and take out what is bad.

    Parameters
    ----------
    completion : Completion
        Changed in place.
    rows : (n, columns)
        As of `Signals.rows`; changed in place.

    Returns
    -------
    (n,) int64
        Faults of the rows, see `crosscomb.logs.watch.watch_rows`.
    """
    vehicle = completion.vehicle
    for column in _MADE:
        lacking = _before_first(completion, rows, column)
        if not lacking:
            continue
        part, out = rows[:lacking], rows[:lacking, column]
        if column == _STEER:
            out[:] = part[:, _STEER_WHEEL] / vehicle.steering_ratio
        elif column == _VX:
            _wheels_to_speed(part, vehicle.track_front, vehicle.track_rear, out)
        else:
            t = part[:, _T]
            completion.line = completion.line or Line(float(t[0]))
            out[:] = next_slopes(completion.line, t, part[:, _VX], SPEED_SLOPE_WINDOW)
        if np.isfinite(out).any():
            completion.made.add(column)
    codes = watch_rows(completion.watch, rows, vehicle)
    if codes.any():
        completion.faults += count_faults(codes)
    return codes


def _before_first(completion: Completion, rows: np.ndarray, column: int) -> int:
    """Number of rows before the column's first sample in the log."""
    if column in completion.first:
        return 0
    known = np.isfinite(rows[:, column])
    if not known.any():
        return len(rows)
    first = int(np.argmax(known))
    completion.first[column] = float(rows[first, _T])
    return first


def complete(signals: Signals, vehicle: Vehicle) -> Signals:
    """Add the columns steer, vx and ax where the log lacks them, and take out bad samples, with a note for each.

    Row i depends on rows up to i only. A column is made until its first sample comes, and left as it is from
    there on.

    Parameters
    ----------
    signals : Signals
        One log.
    vehicle : Vehicle
        Its steering ratio and tracks are used.

    Returns
    -------
    Signals
        The log with steer [rad], vx [m/s] and ax [m/s^2].
    """
    rows, completion = signals.rows(), Completion(vehicle)
    next_rows(completion, rows)
    notes = completion.notes()
    watched = [name for name in CHANNELS if completion.faults and name in signals.frame]
    names = [*(name for name in notes if name in COLUMN), *watched]
    if not names:
        return signals
    signals = signals.with_columns("", **{name: rows[:, COLUMN[name]].copy() for name in names})
    return replace(signals, notes=(*signals.notes, *notes.values()))


def speed_from_wheels(signals: Signals, vehicle: Vehicle) -> np.ndarray:
    """Longitudinal speed of the centre of gravity ``(n,) [m/s]`` as the mean of the wheels.

    Each wheel's speed is first moved to the centre line: in a left turn (ISO 8855, yaw rate > 0) the left
    wheels are the slower ones. A wheel without a measurement is left out of the mean. Di Biase 2020,
    eq. 61 to 64.
    """
    speed = np.empty(len(signals))
    _wheels_to_speed(signals.rows(), vehicle.track_front, vehicle.track_rear, speed)
    return speed


_YAW_RATE = COLUMN["yaw_rate"]
_VFL, _VFR, _VRL, _VRR = (COLUMN[name] for name in WHEEL_SPEEDS)


@kernel
def _wheels_to_speed(rows, track_front, track_rear, out):
    for k in range(rows.shape[0]):
        ahead, yaw_rate = math.cos(rows[k, _STEER]), rows[k, _YAW_RATE]
        front, rear = 0.5 * track_front * yaw_rate, 0.5 * track_rear * yaw_rate
        total, count = 0.0, 0
        for speed in (
            rows[k, _VFL] * ahead + front,
            rows[k, _VFR] * ahead - front,
            rows[k, _VRL] + rear,
            rows[k, _VRR] - rear,
        ):
            if math.isfinite(speed):
                total += speed
                count += 1
        out[k] = total / count if count > 0 else math.nan


def next_slopes(line: Line, t: np.ndarray, values: np.ndarray, window: float) -> np.ndarray:
    """Slope of the least-squares line through the newest samples at each of the next rows of a log.

    The line goes through the samples of the last `window` seconds and through at least the last three, none
    of them older than five windows. It describes the middle of its samples, about half a window ago.

    Parameters
    ----------
    line : Line
        What the rows before leave behind; changed in place.
    t : ndarray
        Increasing time ``(n,) [s]``, any spacing.
    values : ndarray
        ``(n,)``; NaN where nothing was measured.
    window : float
        [s].

    Returns
    -------
    ndarray
        ``(n,)`` [unit of values per s]; NaN where the value is missing or fewer than three samples are near.
    """
    known = np.isfinite(values)
    slope = np.full(len(values), np.nan)
    if not known.any():
        return slope
    line.tau, before = np.concatenate([line.tau, t[known] - line.origin]), len(line.tau)
    line.values = np.concatenate([line.values, values[known]])
    made = np.empty(len(line.tau) - before)
    _slopes(line.tau, line.values, before, window, made)
    slope[known] = made
    old = int(np.searchsorted(line.tau, line.tau[-1] - (MOST_WINDOWS + 1.0) * window))
    line.tau, line.values = line.tau[old:], line.values[old:]
    return slope


@kernel
def _slopes(tau, values, first, window, out):
    """Slopes at the samples from `first` on."""
    rounding = 1e-6 * window
    for i in range(first, tau.size):
        # Sums relative to sample i: no digits are lost however long the log is.
        count, sum_t, sum_x, sum_tt, sum_tx = 0, 0.0, 0.0, 0.0, 0.0
        for back in range(i + 1):
            dt, dx = tau[i - back] - tau[i], values[i - back] - values[i]
            outside = tau[i - back] < tau[i] - window - rounding
            if (outside and back > 2) or dt < -MOST_WINDOWS * window - rounding:
                break
            count += 1
            sum_t += dt
            sum_x += dx
            sum_tt += dt * dt
            sum_tx += dt * dx
        slope = (
            (count * sum_tx - sum_t * sum_x) / (count * sum_tt - sum_t * sum_t) if count >= 3 else math.nan
        )
        out[i - first] = slope

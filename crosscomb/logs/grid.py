"""Bring a log to the working rate of the filters without looking ahead and without inventing data.

One kernel takes row after row, so a log gives the same grid bit for bit in one piece, in chunks, or row by row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from crosscomb.models.compiled import kernel
from crosscomb.signals import GNSS, REFERENCES, Signals

MAX_GAP = 1.0
"""A longer silence of the log [s] starts a new segment: the filters begin anew after it."""

MAX_AGE = 0.1
"""No sample stands in for later ones longer than this [s]."""

_ROUNDING = 1e-6
"""Share of a step by which a time stamp may miss the grid and still be on it."""

JITTER = 0.45
"""Share of its own step by which a row may miss its place, where rows come at a multiple of half the working rate."""

SAME_RATE = 0.01
"""They do where their mean step misses it by no more than this share."""

PACE_ROWS = 100.0
"""Rows over which the mean step is taken."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a log without a long gap, at the working rate.

    Attributes
    ----------
    start_row, stop_row : int
        Rows ``start_row <= row < stop_row`` of the log are covered (counted from 0).
    signals : Signals
        The stretch with regular t: grid point k is at ``t[start_row] + k / rate``.
    newest : (stop_row - start_row,) int
        The newest grid point at or before each row.
    """

    start_row: int
    stop_row: int
    signals: Signals
    newest: np.ndarray


class GridState(NamedTuple):
    """What is known of each channel at the newest row, changed in place by the kernel."""

    closed: np.ndarray  # (1,) grid points that are closed: no later row changes them
    counts: np.ndarray  # (channels,) samples since the last closed point
    sums: np.ndarray  # (channels,) of these
    seen: np.ndarray  # (channels,) bool, there was a sample
    fresh: np.ndarray  # (channels,) bool, the newest row has a sample
    newest: np.ndarray  # (channels,) newest sample
    times: np.ndarray  # (channels,) and its time since the start [s]
    intervals: np.ndarray  # (channels,) from the sample before it to the newest [s]; 0 for the first
    pace: (
        np.ndarray
    )  # (4,) in grid steps: newest row, mean step, the newest row's own place; and the rows so far


@dataclass(frozen=True)
class Grid:
    """A stretch on its way to the working rate.

    Attributes
    ----------
    t_start : float [s]
        Time of its first row, which is grid point 0.
    rate : float [Hz]
    once : (channels,) bool
        Channels whose samples count once, neither averaged nor held.
    state : GridState
    """

    t_start: float
    rate: float
    once: np.ndarray
    state: GridState


def start_grid(t_start: float, rate: float, channels: Sequence[str]) -> Grid:
    """Make the grid of a stretch before its first row.

    Parameters
    ----------
    t_start : float
        Time of the first row [s].
    rate : float [Hz]
    channels : sequence of str
        Names of the columns that rows will have.
    """
    n = len(channels)
    once = np.array([name in REFERENCES + GNSS for name in channels], dtype=np.bool_)
    state = GridState(
        np.zeros(1, np.int64), np.zeros(n, np.int64), np.zeros(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_),
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(4),
    )  # fmt: skip
    return Grid(t_start, rate, once, state)


def next_points(grid: Grid, t: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take the next rows of a stretch.

    Parameters
    ----------
    grid : Grid
        Its state changes.
    t : (n,) [s]
        Increasing.
    rows : (n, channels)
        NaN means "no measurement".

    Returns
    -------
    points : (m, channels)
        The grid points that these rows close, m may be 0.
    newest : (n,) int
        The newest grid point at or before each row, counted from the start of the stretch.
    """
    tau = t - grid.t_start
    # Unix time stamps have a resolution of 0.24 us, which is more than a millionth of a step.
    tolerance = max(_ROUNDING, 4.0 * grid.rate * math.ulp(abs(grid.t_start)))
    last = math.floor(tau[-1] * grid.rate + tolerance)
    points = np.empty(
        (last + 2 - int(grid.state.closed[0]), rows.shape[1])
    )  # one more, if the last row is early
    newest = np.empty(len(t), dtype=np.int64)
    before = int(grid.state.closed[0])
    _take_rows(grid.state, tau, rows, grid.rate, tolerance, grid.once, points, newest)
    return points[: int(grid.state.closed[0]) - before], newest


@kernel
def _steady(pace, place):
    """Place of a row [grid steps], without the jitter of its stamp where rows come at the grid's rate."""
    step = place - pace[0]
    pace[0] = place
    pace[3] += 1.0
    if pace[3] < 2.0:
        return place
    if pace[3] == 2.0 or step < 1.6 * pace[1]:  # where rows are lost the pace is the same
        pace[1] += (step - pace[1]) / min(pace[3] - 1.0, PACE_ROWS)
    simple = 2.0 / max(math.floor(2.0 / max(pace[1], 1e-9) + 0.5), 1.0)  # twice the step over a whole number
    own, before = simple * math.floor(place / simple + 0.5), pace[2]
    pace[2] = own
    fits = abs(pace[1] - simple) < SAME_RATE * simple and own > before
    return own if fits and pace[3] > PACE_ROWS and abs(place - own) < JITTER * simple else place


@kernel
def _take_rows(state, tau, rows, rate, tolerance, once, points, newest):
    """Take rows one after the other and close the grid points that they reach."""
    before = state.closed[0]
    for i in range(tau.size):
        place = _steady(state.pace, tau[i] * rate)
        # The grid point that the row counts for: not one that a row before it has closed.
        point = max(math.ceil(place - tolerance), state.closed[0])
        reached = max(math.floor(place + tolerance), state.closed[0] - 1)
        while state.closed[0] <= min(point - 1, reached):
            _close_point(state, rate, tolerance, once, points[state.closed[0] - before])
        _add_row(state, tau[i], rows[i])
        if point <= reached:
            _close_point(state, rate, tolerance, once, points[state.closed[0] - before])
        newest[i] = reached


@kernel
def _add_row(state, tau, row):
    for j in range(row.size):
        state.fresh[j] = math.isfinite(row[j])
        if state.fresh[j]:
            state.intervals[j] = tau - state.times[j] if state.seen[j] else 0.0
            state.seen[j] = True
            state.newest[j], state.times[j] = row[j], tau
            state.counts[j] += 1
            state.sums[j] += row[j]


@kernel
def _close_point(state, rate, tolerance, once, out):
    """Write the next grid point."""
    time, slack = state.closed[0] / rate, tolerance / rate
    state.closed[0] += 1
    for j in range(out.size):
        age = time - state.times[j]
        due = state.intervals[j] - slack
        out[j] = math.nan
        if state.counts[j] > 0:
            several = state.counts[j] > 1 and not once[j]
            out[j] = state.sums[j] / state.counts[j] if several else state.newest[j]
        elif state.seen[j] and not once[j] and age <= MAX_AGE + slack and (state.fresh[j] or age < due):
            out[j] = state.newest[j]
        state.counts[j], state.sums[j] = 0, 0.0


def to_grid(signals: Signals, rate: float) -> list[Segment]:
    """Bring a log to a regular working rate, causally.

    A channel's value at grid point t_k is the mean of its samples in (t_{k-1}, t_k] (this damps what a lower
    rate would alias). Where it has none, its newest sample is held while the log is silent, or, in a log
    whose channels come at different rates, until the channel's next sample is due by its last interval; never
    longer than `MAX_AGE`. Else it is NaN, "no measurement". Ground truth and GNSS fixes are the newest
    sample in the step, neither averaged nor held: a late truth would be a false one, and a fix counts once.

    Rows after a time T never change a grid point at or before T. A log at the working rate passes unchanged.

    Parameters
    ----------
    signals : Signals
        One log, any spacing of time.
    rate : float
        Working rate [Hz].

    Returns
    -------
    list of Segment
        In order of time; together they cover every row once.
    """
    starts = stretch_starts(signals.t)
    stops = [*starts[1:], len(signals)]
    return [_stretch_to_grid(signals, start, stop, rate) for start, stop in zip(starts, stops, strict=True)]


def stretch_starts(t: np.ndarray, before: float = -math.inf) -> list[int]:
    """First row of each stretch in rows at times t ``(n,) [s]``; `before` is the time of the row before them."""
    return np.flatnonzero(np.diff(t, prepend=before) > MAX_GAP).tolist()


def _stretch_to_grid(signals: Signals, start: int, stop: int, rate: float) -> Segment:
    names = [str(name) for name in signals.frame.columns if name != "t"]
    rows = np.column_stack([signals.column(name)[start:stop] for name in names])
    grid = start_grid(float(signals.t[start]), rate, names)
    points, newest = next_points(grid, signals.t[start:stop], rows)
    columns = {"t": grid.t_start + np.arange(len(points)) / rate}
    columns |= {name: points[:, place].copy() for place, name in enumerate(names)}
    frame = pd.DataFrame(columns)[list(signals.frame.columns)]
    return Segment(start, stop, replace(signals, frame=frame), newest)

"""Bring a log to the working rate of the filters without looking ahead and without inventing data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from crosscomb.signals import GNSS, REFERENCES, Signals

MAX_GAP = 1.0
"""A longer silence of the log [s] starts a new segment: the filters begin anew after it."""

MAX_AGE = 0.1
"""No sample stands in for later ones longer than this [s]."""

_ROUNDING = 1e-6
"""Share of a step by which a time stamp may miss the grid and still be on it."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a log without a long gap, at the working rate.

    Attributes
    ----------
    start_row, stop_row : int
        Rows ``start_row <= row < stop_row`` of the log are covered (counted from 0).
    signals : Signals
        The stretch with regular t: grid point k is at ``t[start_row] + k / rate``.
    """

    start_row: int
    stop_row: int
    signals: Signals


def resample(signals: Signals, rate: float) -> list[Segment]:
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
    t = signals.t
    starts = [0, *(np.flatnonzero(np.diff(t) > MAX_GAP) + 1).tolist()]
    stops = [*starts[1:], len(t)]
    return [_resample_stretch(signals, start, stop, rate) for start, stop in zip(starts, stops, strict=True)]


def rows_to_grid(t_rows: np.ndarray, segment: Segment, rate: float) -> np.ndarray:
    """Index of the newest grid point at or before each row.

    Parameters
    ----------
    t_rows : ndarray
        Times of the segment's rows ``(n,) [s]``.
    segment : Segment
        As made by `resample` at the same rate.
    rate : float
        Working rate [Hz].

    Returns
    -------
    ndarray
        ``(n,)`` int, indices into the segment's grid.
    """
    t_grid = segment.signals.t
    steps = (t_rows - t_grid[0]) * rate
    newest = np.floor(steps + _tolerance(t_grid[0], rate)).astype(np.int64)
    return np.clip(newest, 0, len(t_grid) - 1)


def _tolerance(t_start: float, rate: float) -> float:
    # Unix time stamps have a resolution of 0.24 us, which is more than a millionth of a step.
    return max(_ROUNDING, 4.0 * rate * float(np.spacing(abs(t_start))))


def _resample_stretch(signals: Signals, start: int, stop: int, rate: float) -> Segment:
    t_start = signals.t[start]
    tau = signals.t[start:stop] - t_start
    tolerance = _tolerance(t_start, rate)
    last = int(np.floor(tau[-1] * rate + tolerance))
    steps = np.ceil(tau * rate - tolerance).astype(np.int64)  # the grid point that each row counts for
    rows = int(np.searchsorted(steps, last, side="right"))  # later rows are past the last grid point
    tau, steps = tau[:rows], steps[:rows]
    grid = np.arange(last + 1) / rate

    columns = {"t": t_start + grid}
    for name in signals.frame.columns.drop("t"):
        values = signals.column(name)[start : start + rows]
        columns[name] = _to_grid(values, tau, steps, grid, tolerance / rate, once=name in REFERENCES + GNSS)
    frame = pd.DataFrame(columns)[list(signals.frame.columns)]
    return Segment(start, stop, replace(signals, frame=frame))


def _to_grid(
    values: np.ndarray, tau: np.ndarray, steps: np.ndarray, grid: np.ndarray, slack: float, *, once: bool
) -> np.ndarray:
    """One channel at the grid times; `steps` is the grid point that each row counts for, `slack` is [s]."""
    measured = np.flatnonzero(np.isfinite(values))
    if measured.size == 0:
        return np.full(grid.size, np.nan)
    points = np.arange(grid.size)
    ends = np.searchsorted(steps[measured], points, side="right")  # samples up to each grid point
    counts = np.diff(ends, prepend=0)
    newest = np.maximum(ends - 1, 0)
    result = np.where(counts > 0, values[measured][newest], np.nan)
    if once:
        return result

    several = counts > 1
    if several.any():
        sums = np.bincount(steps[measured], values[measured], grid.size)
        result[several] = sums[several] / counts[several]

    sample_time = tau[measured]
    age = grid - sample_time[newest]
    interval = sample_time[newest] - sample_time[np.maximum(newest - 1, 0)]
    newest_row = np.searchsorted(steps, points, side="right") - 1
    silent = measured[newest] == newest_row
    held = (counts == 0) & (ends > 0) & (age <= MAX_AGE + slack) & (silent | (age < interval - slack))
    result[held] = values[measured][newest[held]]
    return result

"""Watch the signals that are there: what no sensor of this car can have said is no measurement.

Sample by sample, in order of time and without looking ahead, so that a log and its samples live give the same.
A bad sample becomes NaN; a bad channel does so until it is good again, but for a steering angle that only looks bad
and for a speed of the wrong sign, which is mended.
Nothing is learned from what was refused.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from crosscomb.logs.watch_rules import (
    CHANNELS,
    COUNT,
    FAULTS,
    GOOD,
    LIMITS,
    LONG_STEP,
    MISSING,
    MOVING,
    NOW,
    PLACES,
    REVERSED,
    STEER,
    STUCK,
    VX,
    judge_each,
)
from crosscomb.logs.watch_ties import FACTOR, judge_rest, judge_signs, judge_way, take_means
from crosscomb.models.compiled import kernel
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import COLUMN, MIN_SPEED

BITS = 4
"""Bits of a channel's fault in a row's code."""

_T = COLUMN["t"]


class Watch(NamedTuple):
    """What is known of each channel of a log; changed in place."""

    newest: np.ndarray  # (channels,) newest good sample
    before: np.ndarray  # (channels,) the one before it
    t: np.ndarray  # (channels,) time of the newest good sample [s]; -inf before the first
    noise: np.ndarray  # (channels,) standard deviation
    taken: np.ndarray  # (channels,) int, good samples
    since: np.ndarray  # (channels,) when the newest value came first, or the car began to move [s]
    longest: np.ndarray  # (channels,) longest rest in the moving car so far [s]
    changes: np.ndarray  # (channels,) int, new values in the moving car
    stuck: np.ndarray  # (channels,) int, 1 while it is
    share: np.ndarray  # (channels,) of the newest rows that have a value
    lost: np.ndarray  # (channels,) int, 1 while a value is missed
    moved: np.ndarray  # (channels,) what it is tied to, when it began to rest
    doubt: np.ndarray  # (channels, 2) that its sign is right, see `crosscomb.logs.verdict`
    sample: np.ndarray  # (channels,) of the row, NaN where it is bad
    faults: np.ndarray  # (channels,) int, of the row
    means: np.ndarray  # (13,) see `take_means`
    sliding: np.ndarray  # (1,) int, 1 while the driver counters a slide
    calm: np.ndarray  # (1,) time since the car went straight [s]
    clock: np.ndarray  # (2,) time of the newest row, time in the moving car [s]
    way: (
        np.ndarray
    )  # (5,) factor on vx, 1 where that has no sign or had one, ax over time [m/s] and time since a stop
    backwards: np.ndarray  # (2, 2) that the car reverses and that it does not, see `crosscomb.logs.verdict`


def start_watch() -> Watch:
    """Make the state before the first row of a log."""

    def numbers() -> np.ndarray:
        return np.zeros(COUNT)

    def codes() -> np.ndarray:
        return np.zeros(COUNT, dtype=np.int64)

    return Watch(
        numbers(), numbers(), np.full(COUNT, -math.inf), numbers(), codes(), numbers(), numbers(), codes(), codes(),
        numbers(), codes(),
        numbers(), np.zeros((COUNT, 2)), numbers(), codes(), np.zeros(13), np.zeros(1, dtype=np.int64), np.zeros(1),
        np.array([-math.inf, 0.0]), np.array([1.0, 0.0, 0.0, 0.0, 0.0]), np.array([[0.0, 0.0], [0.0, 1.0]]),
    )  # fmt: skip


def watch_rows(watch: Watch, rows: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """Take the next rows of a log: what is bad in them becomes NaN.

    Parameters
    ----------
    watch : Watch
        Changed in place.
    rows : (n, columns)
        As of `crosscomb.signals.Signals.rows`, completed; changed in place.
    vehicle : Vehicle
        Its wheelbase ties the steering angle to the rest.

    Returns
    -------
    (n,) int64
        `BITS` bits for each of `CHANNELS`: the code of its fault.
    """
    codes = np.zeros(len(rows), dtype=np.int64)
    _watch_run(watch, rows, vehicle.wheelbase, vehicle.cg_to_rear_axle, LIMITS, codes)
    return codes


def faults_in(codes: Any) -> list[tuple[str, Any]]:
    """Fault of each of `CHANNELS`, by the code of a row or by those of rows ``(n,)``."""
    return [(name, codes >> BITS * i & (1 << BITS) - 1) for i, name in enumerate(CHANNELS)]


def reason(code: int) -> str:
    """Words for the code of a row, such as ``ay spike; steer stuck``; empty where all is good."""
    return "; ".join(f"{name} {FAULTS[fault]}" for name, fault in faults_in(code) if fault)


def reasons(codes: np.ndarray) -> np.ndarray:
    """Words for the codes ``(n,)`` of rows ``(n,) str``."""
    each, place = np.unique(codes, return_inverse=True)
    return np.array([reason(code) for code in each.tolist()], dtype=object)[place]


def count_faults(codes: np.ndarray) -> Counter[str]:
    """Count the bad samples in rows of these codes ``(n,)``, by words; a missing one is none."""
    found: Counter[str] = Counter()
    for name, faults in faults_in(codes):
        kinds, counts = np.unique(faults, return_counts=True)
        found.update(
            {
                f"{name} {FAULTS[kind]}": count
                for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True)
                if kind > MISSING
            }
        )
    return found


def in_words(faults: Mapping[str, int]) -> str:
    """Say what became of the bad samples that `count_faults` counted."""
    became: dict[str, list[str]] = {}
    for fault, count in faults.items():
        what = "samples taken as missing"
        if fault == f"{CHANNELS[VX]} {FAULTS[REVERSED]}":
            what = "samples whose sign was mended"
        elif fault in (f"{CHANNELS[STEER]} {FAULTS[kind]}" for kind in (STUCK, REVERSED)):
            what = "samples that look bad"
        became.setdefault(what, []).append(f"{fault} {count}")
    return "; ".join(f"{what}: {', '.join(each)}" for what, each in became.items())


def degrading(codes: np.ndarray, wheels: bool) -> np.ndarray:
    """Tell in which rows of these codes ``(n,)`` something is bad or missed that an estimate needs ``(n,) bool``.

    Every estimate needs the channels up to the steering angle; some look at the `wheels` too.
    """
    return codes != 0 if wheels else codes & (1 << BITS * (STEER + 1)) - 1 != 0


@kernel
def _watch_run(watch, rows, wheelbase, to_rear, limits, codes):
    """All rows."""
    clock = watch.clock
    for k in range(rows.shape[0]):
        row, t = rows[k], rows[k, _T]
        if t - clock[NOW] > LONG_STEP:
            watch.since[:] = t
        dt = min(t - clock[NOW], LONG_STEP)
        moving = watch.newest[VX] > MIN_SPEED
        clock[NOW] = t
        clock[MOVING] += dt if moving else 0.0
        judge_way(watch, row, wheelbase, dt)
        judge_each(watch, row, t, moving, limits)
        judge_rest(watch, t, moving, wheelbase)
        take_means(watch, wheelbase, to_rear, dt)
        judge_signs(watch, to_rear, dt)
        if watch.way[FACTOR] < 0.0 and watch.faults[VX] == GOOD:
            watch.faults[VX] = REVERSED
        for i in range(COUNT):
            fault = watch.faults[i]
            codes[k] |= fault << (BITS * i)
            # Drivers hold the wheel and counter slides: a steering angle that looks stuck or reversed is only told. The
            # sign of vx is mended.
            told = (i == STEER and fault >= STUCK) or (i == VX and fault == REVERSED)
            if fault != GOOD and not told:
                row[PLACES[i]] = math.nan

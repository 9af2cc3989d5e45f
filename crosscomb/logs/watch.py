"""Watch the signals that are there: what no sensor of this car can have said is no measurement.

Sample by sample, in order of time and without looking ahead, so that a log and its samples live give the same.
A bad sample becomes NaN; a bad channel does so until it is good again, but for a steering angle that only looks bad.
Nothing is learned from what was refused.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import COLUMN, MIN_SPEED, WHEEL_SPEEDS

CHANNELS = ("vx", "ax", "ay", "yaw_rate", "steer", *WHEEL_SPEEDS)
"""Channels that are watched, in this order."""

VX, AX, AY, YAW_RATE, STEER = range(5)

FAULTS = ("", "missing", "out of range", "spike", "stuck", "reversed")
"""Word of each kind of fault, by its code; 0 is a good sample."""

GOOD, MISSING, RANGE, SPIKE, STUCK, REVERSED = range(6)

BITS = 4
"""Bits of a channel's fault in a row's code."""

_MASK = (1 << BITS) - 1

_AT = tuple(COLUMN[name] for name in CHANNELS)
_COUNT = len(CHANNELS)
_FLOOR, _CEILING, _STEP, _RATE = range(4)

_LIMITS = np.array(
    # least and largest value, largest step, and what it may grow by per second
    [
        (-40.0, 120.0, 1.0, 20.0),  # vx [m/s]: 20 m/s^2 is more than any car brakes with
        (-80.0, 80.0, 6.0, 150.0),  # ax [m/s^2]: a kerb shakes more than a turn
        (-80.0, 80.0, 6.0, 150.0),  # ay [m/s^2]
        (-12.0, 12.0, 0.3, 30.0),  # yaw_rate [rad/s]: model cars turn at 5 rad/s, and by 25 rad/s^2
        (-1.5, 1.5, 0.15, 20.0),  # steer [rad]
        *[(-60.0, 150.0, 3.0, 150.0)] * len(WHEEL_SPEEDS),  # [m/s]: wheels lock and spin
    ]
)

WIDE = 10.0
"""A step of this many standard deviations of a channel's noise is still noise."""

NOISE_TIME = 1.0
"""Time over which the noise of a channel is learned [s]."""

LEARNING = 30
"""Samples before which a channel's noise is not known well enough to call a step a spike."""

AT_REST = 0.3
"""No channel is stuck before it rests for so long [s]."""

LONGER = 4.0
"""Nor before it rests for so many times as long as it ever did in the moving car before."""

KNOWN_AFTER = 3.0
"""Time in the moving car [s] after which it is known how long a channel rests."""

TIE_TIME = 0.2
"""Time constant of the means that are held against each other [s]."""

LEAST_TIE = 1.2
"""Accelerations with opposite signs contradict each other from this magnitude on [m/s^2]."""

DOUBT_TIME = 0.7
"""Contradictions last longer than this [s] in no transition from one drift to the other."""

STEER_DOUBT_TIME = 1.2
"""For the steering it takes longer: a driver counters a slide."""

MISSED_AFTER = 0.1
"""A channel that was there is missed from then on [s]."""

DENSE, SHARE_ROWS = 0.9, 50.0
"""A channel that has a value in more than this share of so many rows is missed at once."""


MOST_REST = 1.0
"""While a channel rests, what it is tied to moves less than this [m/s^2], or [m/s] of speed."""

MOST_AX = 4.0
"""The same of ay while ax rests [m/s^2], which ties them loosely: on a circle ax may rest."""

LITTLE = 0.02
"""Share of it that is enough where a channel rests far longer than ever."""

MOST_STEER = 0.015
"""While the steering rests, the angle that the turn needs moves less than this [rad]."""

YAW_LAG = 0.4
"""The car follows its steering within this [s]."""

LONG_STEP = 0.5
"""No step of time counts for more than this [s]."""

SLIDE_TIME = 2.0
"""A change of slip is remembered for so long [s]."""

SLIDE = math.radians(8.0)
"""Who changes the slip by so much slides, and may steer against the turn [rad]."""

OF_AY, OF_YAW, OF_STEER, OF_AX, SLIP, MEAN_AX, MEAN_VX, SPEEDING = range(8)
NOW, MOVING = range(2)
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
    doubt: np.ndarray  # (channels,) time for which it contradicted two others, less that it agreed [s]
    reversed: np.ndarray  # (channels,) int, 1 while it contradicts
    sample: np.ndarray  # (channels,) of the row, NaN where it is bad
    faults: np.ndarray  # (channels,) int, of the row
    means: np.ndarray  # (8,) see `_take_means`
    sliding: np.ndarray  # (1,) int, 1 while the driver counters a slide
    clock: np.ndarray  # (2,) time of the newest row, time in the moving car [s]


def start_watch() -> Watch:
    """Make the state before the first row of a log."""

    def numbers() -> np.ndarray:
        return np.zeros(_COUNT)

    def codes() -> np.ndarray:
        return np.zeros(_COUNT, dtype=np.int64)

    return Watch(
        numbers(), numbers(), np.full(_COUNT, -math.inf), numbers(), codes(), numbers(), numbers(), codes(), codes(),
        numbers(), codes(),
        numbers(), numbers(), codes(), numbers(), codes(), np.zeros(8), np.zeros(1, dtype=np.int64),
        np.array([-math.inf, 0.0]),
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
    _watch_run(watch, rows, vehicle.wheelbase, _LIMITS, codes)
    return codes


def reason(code: int) -> str:
    """Words for the code of a row, such as ``ay spike; steer stuck``; empty where all is good."""
    faults = [(name, code >> BITS * i & _MASK) for i, name in enumerate(CHANNELS)]
    return "; ".join(f"{name} {FAULTS[fault]}" for name, fault in faults if fault)


def reasons(codes: np.ndarray) -> np.ndarray:
    """Words for the codes ``(n,)`` of rows ``(n,) str``."""
    each, place = np.unique(codes, return_inverse=True)
    return np.array([reason(code) for code in each.tolist()], dtype=object)[place]


def count_faults(codes: np.ndarray) -> Counter[str]:
    """Count the bad samples in rows of these codes ``(n,)``, by words; a missing one is none."""
    found: Counter[str] = Counter()
    for i, name in enumerate(CHANNELS):
        kinds, counts = np.unique(codes >> BITS * i & _MASK, return_counts=True)
        found.update(
            {
                f"{name} {FAULTS[kind]}": count
                for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True)
                if kind > MISSING
            }
        )
    return found


def degrading(codes: np.ndarray, wheels: bool) -> np.ndarray:
    """Tell in which rows of these codes ``(n,)`` something is bad or missed that an estimate needs ``(n,) bool``.

    Every estimate needs the channels up to the steering angle; some look at the `wheels` too.
    """
    return codes != 0 if wheels else codes & (1 << BITS * (STEER + 1)) - 1 != 0


@inlined
def _is_spike(watch, i, value, t, limits):
    """Tell whether a sample is further from the newest good one than the channel can have moved."""
    if watch.taken[i] < LEARNING:
        return False
    reach = limits[i, _STEP] + WIDE * watch.noise[i] + limits[i, _RATE] * (t - watch.t[i])
    return abs(value - watch.newest[i]) > reach


@inlined
def _learn(watch, i, value, t, moving):
    """Take a good sample: noise from second differences, and how long a value rests."""
    gap = t - watch.t[i]
    if watch.taken[i] >= 2:
        # Of white noise a second difference has sqrt(6) times the standard deviation, its magnitude 0.8 of that.
        seen = abs(value - 2.0 * watch.newest[i] + watch.before[i]) / 1.95
        share = max(1.0 / (watch.taken[i] - 1.0), min(gap / NOISE_TIME, 1.0))
        watch.noise[i] += share * (seen - watch.noise[i])
    if value != watch.newest[i] or watch.taken[i] == 0:
        if moving and watch.taken[i] > 0:
            watch.longest[i] = max(watch.longest[i], watch.t[i] - watch.since[i])
            watch.changes[i] += 1
        watch.since[i] = t
        watch.stuck[i] = 0
        watch.moved[i] = math.nan
    watch.before[i], watch.newest[i], watch.t[i] = watch.newest[i], value, t
    watch.taken[i] += 1


@inlined
def _rests(watch, i, t, moving, tied, most, lag):
    """Tell whether a channel is stuck, by what follows it after a lag.

    That moves on by `most`, or a little while the channel rests far longer than ever; then for accelerations and yaw
    rate, which are never still, it is enough that another of them is alive.
    """
    if not moving:
        watch.since[i] = t
        return False
    rest = t - watch.since[i]
    if math.isnan(watch.moved[i]) or rest < lag:
        watch.moved[i] = tied
    known = (
        watch.changes[i] > LEARNING and watch.clock[MOVING] > KNOWN_AFTER and rest > LONGER * watch.longest[i]
    )
    apart = abs(tied - watch.moved[i])
    if AX <= i <= YAW_RATE:
        newest = max(watch.since[AX], watch.since[AY], watch.since[YAW_RATE])
        known = known and t - newest < MISSED_AFTER
    else:
        known = known and apart > LITTLE * most
    if rest > AT_REST and (apart > most or known):
        watch.stuck[i] = 1
    return watch.stuck[i] == 1


@inlined
def _reversed(watch, i, against, agrees, dt, most):
    """Count for how long a channel contradicts two others, and tell whether that is too long."""
    if against:
        watch.doubt[i] = min(watch.doubt[i] + dt, 2.0 * most)
    elif agrees:
        watch.doubt[i] = max(watch.doubt[i] - dt, 0.0)
    if watch.doubt[i] > most:
        watch.reversed[i] = 1
    elif watch.doubt[i] == 0.0:
        watch.reversed[i] = 0
    return watch.reversed[i] == 1


@inlined
def _opposite(one, other):
    return one * other < 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def _alike(one, other):
    return one * other > 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def _take_means(watch, wheelbase, dt):
    """Means of what is tied: ay, vx yaw_rate, and what the steering asks for."""
    sample, means, share = watch.sample, watch.means, min(dt / TIE_TIME, 1.0)
    ay, by_yaw = sample[AY], sample[VX] * sample[YAW_RATE]
    by_steer = sample[VX] * sample[VX] * sample[STEER] / wheelbase
    # What is missing has nothing to say: its mean fades.
    means[OF_AY] += share * ((ay if math.isfinite(ay) else 0.0) - means[OF_AY])
    means[OF_YAW] += share * ((by_yaw if math.isfinite(by_yaw) else 0.0) - means[OF_YAW])
    means[OF_STEER] += share * ((by_steer if math.isfinite(by_steer) else 0.0) - means[OF_STEER])
    if math.isfinite(sample[AX]):
        means[OF_AX] += dt * sample[AX]
    means[MEAN_AX] += share * ((sample[AX] if math.isfinite(sample[AX]) else 0.0) - means[MEAN_AX])
    if math.isfinite(sample[VX]):
        means[MEAN_VX] += share * (sample[VX] - means[MEAN_VX])
        means[SPEEDING] = (sample[VX] - means[MEAN_VX]) / TIE_TIME
    if math.isfinite(ay) and math.isfinite(by_yaw):
        turned = (ay - by_yaw) / max(sample[VX], MIN_SPEED)
        means[SLIP] += dt * (turned - means[SLIP] / SLIDE_TIME)


@inlined
def _judge_signs(watch, dt):
    """Two of three tell which sign is wrong: of ay, of the yaw rate, or of the steering angle."""
    ay, by_yaw, by_steer = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_STEER]
    apart, together = _opposite(ay, by_yaw), _alike(ay, by_yaw)
    against = apart and _alike(by_steer, by_yaw)
    if _reversed(watch, AY, against, together, dt, DOUBT_TIME):
        watch.faults[AY] = REVERSED
    # In a slide the speed along the car changes without the accelerometer.
    steady = abs(watch.means[SLIP]) < SLIDE
    against = steady and _opposite(watch.means[MEAN_AX], watch.means[SPEEDING])
    agrees = _alike(watch.means[MEAN_AX], watch.means[SPEEDING])
    if _reversed(watch, AX, against, agrees, dt, DOUBT_TIME):
        watch.faults[AX] = REVERSED
    against = apart and _alike(by_steer, ay)
    if _reversed(watch, YAW_RATE, against, together, dt, DOUBT_TIME):
        watch.faults[YAW_RATE] = REVERSED
    against = together and _opposite(by_steer, ay)
    agrees = together and _alike(by_steer, ay)
    # A driver counters a slide: then the slip has changed before, or does while he steers.
    if against and watch.reversed[STEER] == 0 and abs(watch.means[SLIP]) > SLIDE:
        watch.sliding[0] = 1
    elif agrees:
        watch.sliding[0] = 0
    against = against and watch.sliding[0] == 0
    if _reversed(watch, STEER, against, agrees, dt, STEER_DOUBT_TIME):
        watch.faults[STEER] = REVERSED


@inlined
def _judge_each(watch, row, t, moving, limits):
    """Take each channel by itself: is it there, possible, and where it can be after the sample before?"""
    for i in range(_COUNT):
        value, fault = row[_AT[i]], GOOD
        there = math.isfinite(value)
        if there:
            watch.lost[i] = 0
        elif watch.taken[i] > 0 and (watch.share[i] > DENSE or t - watch.t[i] > MISSED_AFTER):
            watch.lost[i] = 1
        watch.share[i] += ((1.0 if there else 0.0) - watch.share[i]) / SHARE_ROWS
        if not there:
            fault = MISSING if watch.lost[i] == 1 else GOOD
        elif not limits[i, _FLOOR] <= value <= limits[i, _CEILING]:
            fault = RANGE
        elif _is_spike(watch, i, value, t, limits):
            fault = SPIKE
        else:
            _learn(watch, i, value, t, moving)
        watch.faults[i] = fault
        watch.sample[i] = value if fault == GOOD else math.nan


@inlined
def _judge_rest(watch, t, moving, wheelbase):
    """Find the channels that are stuck."""
    vx = max(watch.newest[VX], MIN_SPEED)
    ay, by_yaw, by_ax = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_AX]
    for i in range(_COUNT):
        tied, most, lag = by_ax, MOST_REST, 0.0
        if i == STEER:
            tied, most, lag = by_yaw * wheelbase / (vx * vx), MOST_STEER, YAW_LAG
        elif i == AY:
            tied = by_yaw
        elif i == YAW_RATE:
            tied, most = ay / vx, MOST_REST / vx
        elif i == AX:
            tied, most = ay, MOST_AX
        if math.isfinite(watch.sample[i]) and _rests(watch, i, t, moving, tied, most, lag):
            watch.faults[i] = STUCK
            watch.sample[i] = math.nan


@kernel
def _watch_run(watch, rows, wheelbase, limits, codes):
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
        _judge_each(watch, row, t, moving, limits)
        _judge_rest(watch, t, moving, wheelbase)
        _take_means(watch, wheelbase, dt)
        _judge_signs(watch, dt)
        for i in range(_COUNT):
            codes[k] |= watch.faults[i] << (BITS * i)
            # Drivers hold the wheel and counter slides: a steering angle that looks stuck or reversed is only told.
            if watch.faults[i] != GOOD and not (i == STEER and watch.faults[i] >= STUCK):
                row[_AT[i]] = math.nan

"""What no sensor of this car can have said: rules that judge the channels of one row by those before and beside them.

Two and more bounds each: what one sample can be, how far it can be from the one before, how long a value can rest, and
which signs go together.
"""

from __future__ import annotations

import math

import numpy as np

from crosscomb.logs.verdict import weigh
from crosscomb.models.compiled import inlined
from crosscomb.signals import COLUMN, MIN_SPEED, WHEEL_SPEEDS

CHANNELS = ("vx", "ax", "ay", "yaw_rate", "steer", *WHEEL_SPEEDS)
"""Channels that are watched, in this order."""

VX, AX, AY, YAW_RATE, STEER = range(5)

FAULTS = ("", "missing", "out of range", "spike", "stuck", "reversed")
"""Word of each kind of fault, by its code; 0 is a good sample."""

GOOD, MISSING, RANGE, SPIKE, STUCK, REVERSED = range(6)

PLACES = tuple(COLUMN[name] for name in CHANNELS)
COUNT = len(CHANNELS)
_FLOOR, _CEILING, _STEP, _RATE = range(4)

LIMITS = np.array(
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
def _opposite(one, other):
    return one * other < 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def _alike(one, other):
    return one * other > 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def take_means(watch, wheelbase, dt):
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
def judge_signs(watch, dt):
    """Two of three tell which sign is wrong: of ay, of the yaw rate, or of the steering angle."""
    ay, by_yaw, by_steer = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_STEER]
    apart, together = _opposite(ay, by_yaw), _alike(ay, by_yaw)
    against = apart and _alike(by_steer, by_yaw)
    if weigh(watch.doubt[AY], against, together, dt, DOUBT_TIME):
        watch.faults[AY] = REVERSED
    # In a slide the speed along the car changes without the accelerometer.
    steady = abs(watch.means[SLIP]) < SLIDE
    against = steady and _opposite(watch.means[MEAN_AX], watch.means[SPEEDING])
    agrees = _alike(watch.means[MEAN_AX], watch.means[SPEEDING])
    if weigh(watch.doubt[AX], against, agrees, dt, DOUBT_TIME):
        watch.faults[AX] = REVERSED
    against = apart and _alike(by_steer, ay)
    if weigh(watch.doubt[YAW_RATE], against, together, dt, DOUBT_TIME):
        watch.faults[YAW_RATE] = REVERSED
    against = together and _opposite(by_steer, ay)
    agrees = together and _alike(by_steer, ay)
    # A driver counters a slide: then the slip has changed before, or does while he steers.
    if against and watch.doubt[STEER, 1] == 0.0 and abs(watch.means[SLIP]) > SLIDE:
        watch.sliding[0] = 1
    elif agrees:
        watch.sliding[0] = 0
    against = against and watch.sliding[0] == 0
    if weigh(watch.doubt[STEER], against, agrees, dt, STEER_DOUBT_TIME):
        watch.faults[STEER] = REVERSED


@inlined
def judge_each(watch, row, t, moving, limits):
    """Take each channel by itself: is it there, possible, and where it can be after the sample before?"""
    for i in range(COUNT):
        value, fault = row[PLACES[i]], GOOD
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
def judge_rest(watch, t, moving, wheelbase):
    """Find the channels that are stuck."""
    vx = max(watch.newest[VX], MIN_SPEED)
    ay, by_yaw, by_ax = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_AX]
    for i in range(COUNT):
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

"""What one sensor of this car can have said: rules that judge a channel by itself and by its samples before.

What a sample can be, how far it can be from the one before, and when it is missed.
"""

from __future__ import annotations

import math

import numpy as np

from crosscomb.models.compiled import inlined
from crosscomb.signals import COLUMN, WHEEL_SPEEDS

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

MISSED_AFTER = 0.1
"""A channel that was there is missed from then on [s]."""

DENSE, SHARE_ROWS = 0.9, 50.0
"""A channel that has a value in more than this share of so many rows is missed at once."""

LONG_STEP = 0.5
"""No step of time counts for more than this [s]."""

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

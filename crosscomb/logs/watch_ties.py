"""What ties the channels of a car to each other: how long one rests while others move, and which signs go together."""

from __future__ import annotations

import math

from crosscomb.logs.verdict import weigh
from crosscomb.logs.watch_rules import (
    AX,
    AY,
    COUNT,
    LEARNING,
    MISSED_AFTER,
    MOVING,
    PLACES,
    REVERSED,
    STEER,
    STUCK,
    VX,
    YAW_RATE,
)
from crosscomb.models.compiled import inlined
from crosscomb.signals import COLUMN, MIN_SPEED, WHEEL_SPEEDS

AT_REST = 0.3
"""No channel is stuck before it rests for so long [s]."""

LONGER = 3.4
"""Where it rests so many times as long as it ever did in the moving car before, little is enough."""

KNOWN_AFTER = 1.5
"""Time in the moving car [s] after which it is known how long a channel rests."""

TIE_TIME = 0.2
"""Time constant of the means that are held against each other [s]."""

LEAST_TIE = 0.8
"""Accelerations with opposite signs contradict each other from this magnitude on [m/s^2]."""

DOUBT_TIME = 0.7
"""Contradictions last longer than this [s] in no transition from one drift to the other."""

STEER_DOUBT_TIME = 0.8
"""For the steering it takes longer: a driver counters a slide."""

MOST_REST = 1.0
"""While a channel rests, what it is tied to moves less than this [m/s^2], or [m/s] of speed."""

MOST_AX = 4.0
"""The same of ay while ax rests [m/s^2], which ties them loosely: on a circle ax may rest."""

LITTLE = 0.02
"""Share of it that is enough where a channel rests far longer than ever."""

MOST_STEER = 0.01
"""While the steering rests, the angle that the turn needs moves less than this [rad]."""

STEER_SHARE = 0.05
"""And by less than this share of itself."""

LITTLE_STEER = 0.1
"""Share of it that is enough where the steering rests far longer than ever."""

YAW_LAG = 0.3
"""The car follows its steering within this [s]."""

SLIDE_TIME = 2.0
"""A change of slip is remembered for so long [s]."""

SETTLING = 8.0
"""Time constant with which the offset of ay is learned straight ahead [s]."""

SLIDE = math.radians(8.0)
"""Who changes the slip by so much slides, and may steer against the turn [rad]."""

CALM_TIME = 1.0
"""A slide is over once the car went straight for so long [s]; from one drift to the next it takes less."""

OFFSET_TIME = 2.0
"""What parts ax from the slope of vx for longer than this [s] is an offset or a hill."""

LEAST_PUSH, LEAST_CHANGE = 0.7, 0.1
"""Less ax, and less change of it, says nothing of its sign [m/s^2]."""

TURN_SLIP = 0.05
"""In a turn a rear axle has sideslip of this size [rad]."""

FELT_CHANGE = 0.1
"""Share of what ax feels of it that changes as fast as ax does."""

AX_DOUBT_TIME = 0.4
"""ax contradicts the slope of vx for so long altogether [s]."""

STANDS = 0.5
"""No car changes its direction above this speed [m/s]."""

ROLLS = 2.0
"""Above this speed the sign of vx is no matter of noise [m/s]."""

BACKWARDS = 8.0
"""No car reverses faster [m/s]."""

LEAST_YAW = 0.04
"""A lower yaw rate says nothing of the direction [rad/s]."""

LEAST_START = 0.8
"""Who starts with less than this may roll down a hill [m/s^2]."""

WAY_TIME = 0.3
"""The direction after a stop is known after so long [s]."""

OF_AY, OF_YAW, OF_STEER, OF_AX, MEAN_AX, MEAN_VX, SPEEDING, SLOW_AX, SLOW_SPEEDING = range(9)
SLIP, FOLLOWS, SLIDES, OFFSET = range(9, 13)
FACTOR, UNSIGNED, SIGNED, PUSHED, ROLLING = range(5)
BACK, FORTH = range(2)
WHEELS = tuple(COLUMN[name] for name in WHEEL_SPEEDS)


@inlined
def take_means(watch, wheelbase, to_rear, dt):
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
    share = min(dt / OFFSET_TIME, 1.0)
    means[SLOW_AX] += share * (means[MEAN_AX] - means[SLOW_AX])
    means[SLOW_SPEEDING] += share * (means[SPEEDING] - means[SLOW_SPEEDING])
    if math.isfinite(ay) and math.isfinite(by_yaw):
        # Straight ahead what parts them is an offset.
        if max(abs(means[OF_AY]), abs(means[OF_YAW])) < LEAST_TIE:
            means[OFFSET] += min(dt / SETTLING, 1.0) * (ay - by_yaw - means[OFFSET])
        turned = (ay - by_yaw - means[OFFSET]) / max(sample[VX], MIN_SPEED)
        means[SLIP] += dt * (turned - means[SLIP] / SLIDE_TIME)
        # A car that follows its rear wheels has sideslip at its centre of gravity, and slides none.
        follows = to_rear * sample[YAW_RATE] / max(sample[VX], MIN_SPEED)
        means[FOLLOWS] += min(dt / SLIDE_TIME, 1.0) * (follows - means[FOLLOWS])
        means[SLIDES] = means[SLIP] - (follows - means[FOLLOWS])


@inlined
def _rests(watch, i, t, moving, tied, most, little, lag):
    """Tell whether a channel is stuck, by what follows it after a lag.

    That moves on by `most`, or by less the longer the channel rests in comparison with any rest before, down to
    `little`; for accelerations and yaw rate, which are never still, it is then enough that another of them is alive.
    """
    if not moving:
        watch.since[i] = t
        return False
    rest = t - watch.since[i]
    if math.isnan(watch.moved[i]) or rest < lag:
        watch.moved[i] = tied
    if rest > AT_REST:
        enough = most
        if watch.changes[i] > LEARNING and watch.clock[MOVING] > KNOWN_AFTER:
            ever = max(watch.longest[i], 1e-3)
            enough = max(most * min((LONGER - rest / ever) / (LONGER - 1.0), 1.0), little)
        apart = abs(tied - watch.moved[i])
        if AX <= i <= YAW_RATE:
            newest = max(watch.since[AX], watch.since[AY], watch.since[YAW_RATE])
            if enough == little and t - newest < MISSED_AFTER:
                apart = math.inf
        if apart > enough:
            watch.stuck[i] = 1
    return watch.stuck[i] == 1


@inlined
def judge_rest(watch, t, moving, wheelbase):
    """Find the channels that are stuck."""
    vx = max(watch.newest[VX], MIN_SPEED)
    ay, by_yaw, by_ax = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_AX]
    for i in range(COUNT):
        tied, most, little, lag = by_ax, MOST_REST, LITTLE * MOST_REST, 0.0
        if i == STEER:
            tied = by_yaw * wheelbase / (vx * vx)
            most, lag = MOST_STEER + STEER_SHARE * abs(tied), YAW_LAG
            little = LITTLE_STEER * most
        elif i == AY:
            tied = by_yaw
        elif i == YAW_RATE:
            tied, most = ay / vx, MOST_REST / vx
        elif i == AX:
            tied, most = ay, MOST_AX
        if math.isfinite(watch.sample[i]) and _rests(watch, i, t, moving, tied, most, little, lag):
            watch.faults[i] = STUCK
            watch.sample[i] = math.nan


@inlined
def _opposite(one, other):
    return one * other < 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def _alike(one, other):
    return one * other > 0.0 and min(abs(one), abs(other)) > LEAST_TIE


@inlined
def _agreement(one, other, least):
    """How far two signals agree, from -1 to 1; little of both, or much more of one, says nothing."""
    return one * other / (max(one * one, other * other) + least * least)


@inlined
def _ax_reversed(watch, to_rear, dt):
    """Hold ax against the slope of vx, and its changes against that of the slope, which no offset hides."""
    means = watch.means
    if watch.newest[VX] > MIN_SPEED and math.isfinite(watch.sample[AX]) and math.isfinite(watch.sample[VX]):
        # In a turn ax feels yaw_rate vy, too: that of the way to the rear axle, and of the axle's slip.
        turn = abs(means[OF_YAW])
        way, slip = to_rear * (turn / watch.newest[VX]) ** 2, TURN_SLIP * turn
        says = _agreement(means[MEAN_AX], means[SPEEDING], LEAST_PUSH + way + slip)
        changes = means[MEAN_AX] - means[SLOW_AX], means[SPEEDING] - means[SLOW_SPEEDING]
        says += _agreement(changes[0], changes[1], LEAST_CHANGE + way + FELT_CHANGE * slip)
        # In a slide the speed along the car changes without the accelerometer.
        against = says < 0.0 and abs(means[SLIDES]) < SLIDE
        weigh(watch.doubt[AX], against, says > 0.0, dt * min(abs(says), 1.0), AX_DOUBT_TIME)
    return watch.doubt[AX, 1] == 1.0


@inlined
def judge_signs(watch, to_rear, dt):
    """Two of three tell which sign is wrong: of ay, of the yaw rate, or of the steering angle."""
    ay, by_yaw, by_steer = watch.means[OF_AY], watch.means[OF_YAW], watch.means[OF_STEER]
    apart, together = _opposite(ay, by_yaw), _alike(ay, by_yaw)
    watch.calm[0] = watch.calm[0] + dt if max(abs(ay), abs(by_yaw)) < LEAST_TIE else 0.0
    against = apart and _alike(by_steer, by_yaw)
    if weigh(watch.doubt[AY], against, together, dt, DOUBT_TIME):
        watch.faults[AY] = REVERSED
    if _ax_reversed(watch, to_rear, dt):
        watch.faults[AX] = REVERSED
    against = apart and _alike(by_steer, ay)
    if weigh(watch.doubt[YAW_RATE], against, together, dt, DOUBT_TIME):
        watch.faults[YAW_RATE] = REVERSED
    against = together and _opposite(by_steer, ay)
    agrees = together and _alike(by_steer, ay)
    # A driver counters a slide: then the slip has changed before, or does while he steers.
    if against and watch.doubt[STEER, 1] == 0.0 and abs(watch.means[SLIDES]) > SLIDE:
        watch.sliding[0], watch.calm[0] = 1, 0.0
    elif agrees or watch.calm[0] > CALM_TIME:
        watch.sliding[0] = 0
    against = against and watch.sliding[0] == 0
    agrees = agrees and abs(watch.means[SLIDES]) < SLIDE
    if weigh(watch.doubt[STEER], against, agrees, dt, STEER_DOUBT_TIME):
        watch.faults[STEER] = REVERSED


@inlined
def judge_way(watch, row, wheelbase, dt):
    """Mend the sign of vx: of one that changes it at speed, and of one without sign in a car that reverses."""
    way, raw = watch.way, row[PLACES[VX]]
    if not math.isfinite(raw):
        return
    if abs(raw) < STANDS:
        way[PUSHED], way[ROLLING] = 0.0, 0.0
        watch.backwards[:] = 0.0
        if way[UNSIGNED] == 1.0:
            way[FACTOR], way[UNSIGNED] = 1.0, 0.0
        return
    newest = watch.newest[VX]
    if (
        way[FACTOR] * raw * newest < 0.0
        and min(abs(raw), abs(newest)) > ROLLS
        and abs(abs(raw) - abs(newest)) < 1.0
    ):
        way[FACTOR] = -way[FACTOR]
    if raw < 0.0:
        way[SIGNED] = 1.0
    if way[SIGNED] == 0.0:
        reverses = _reverses(watch, raw, wheelbase, dt)
        if reverses != (way[FACTOR] < 0.0):
            way[FACTOR], way[UNSIGNED] = -way[FACTOR], 1.0 if reverses else 0.0
            for known in (watch.newest, watch.before):
                known[VX] = -known[VX]
            watch.means[MEAN_VX] = -watch.means[MEAN_VX]
    row[PLACES[VX]] = way[FACTOR] * raw
    if way[UNSIGNED] == 1.0:
        for place in WHEELS:
            row[place] = -row[place]


@inlined
def _reverses(watch, speed, wheelbase, dt):
    """Tell whether a car that left a stop goes backwards: by steering angle and yaw rate, or by how it started."""
    way, sample = watch.way, watch.sample  # of the row before
    if watch.backwards[FORTH, 1] == 1.0:
        return False
    by_steer = speed * math.tan(sample[STEER]) / wheelbase
    says = _agreement(sample[YAW_RATE], by_steer, LEAST_YAW)
    way[ROLLING] += dt
    if math.isfinite(sample[AX]):
        way[PUSHED] += dt * sample[AX]
    started = speed > max(LEAST_START * way[ROLLING], 2.0 * STANDS) and abs(way[PUSHED] + speed) < 0.3 * speed
    if started:
        says = -1.0
    # A car that slides turns otherwise than it steers, too, but not as if it reversed.
    fits = started or abs(sample[YAW_RATE] + by_steer) < 0.5 * abs(by_steer)
    weight = dt * abs(says) if math.isfinite(says) else 0.0
    forth = weigh(watch.backwards[FORTH], says > 0.0 or speed > BACKWARDS, says < 0.0, weight, WAY_TIME)
    return weigh(watch.backwards[BACK], says < 0.0 and fits, says > 0.0, weight, WAY_TIME) and not forth

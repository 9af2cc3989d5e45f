"""Which filters can be trusted: by what each says of itself, and by what the others say.

A filter is unhealthy while it is not finite, says more than a filter may say, does not move though the car does, or
is astray: alone for long, far from the others, who agree. How far is too far depends: a gently driven car slides
nowhere, so there little is enough; and a filter whose innovations have grown beyond what is usual for it has less to
say for itself. One that is merely less accurate is none of this.

What an unhealthy filter says is replaced by what the healthy ones say, and while none is healthy by dead reckoning
from their last answer. One that stays unhealthy begins anew from there, and must stand a quarantine.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import slip_rate
from crosscomb.signals import MIN_SPEED

WORDS = ("", "not finite", "diverged", "jumped", "frozen", "astray", "restarted")
"""Word of each state of health, by its code; 0 is a healthy filter."""

HEALTHY, LOST, DIVERGED, JUMPED, FROZEN, ASTRAY, RESTARTED = range(7)

MOST_STD = math.radians(12.0)
"""Who doubts more than this [rad] with all signals there has nothing to say: sound filters stay below 7 deg."""

MOST_BETA = MAX_BETA - 1e-3
"""Filters are held inside `MAX_BETA`: who is there runs away [rad]."""

MOST_ALONE = math.radians(15.0)
"""Further from the others than this [rad] no filter is right that is alone: without tyres one may see a slide alone."""

MOST_ALONE_SURPRISED = math.radians(6.0)
"""The same for one whose innovations have grown [rad]."""

MOST_ALONE_GENTLE = math.radians(4.0)
"""The same in a gently driven car [rad], where tyres do what they are known to do."""

GENTLE_AY = 1.5
"""A car is driven gently while the mean of |ay| is below this [m/s^2]."""

GENTLE_TIME = 0.5
"""Time constant of that mean [s]."""

TIE_TIME = 2.0
"""Changes of beta are held against ay / vx - yaw_rate over so long [s]."""

AGREEMENT = 0.5
"""The others agree where they are within this share of their distance to the one that is alone."""

ALONE_TIME, MOST_WEIGHT = 1.0, 10.0
"""Who has been alone for longer than not by so much [s] is astray; time counts more, up to so many times, the further
from the others it is."""

MOST_OFFSET, OFFSET_TIME = math.radians(8.0), 6.0
"""Nor may the mean distance to the others over so long [s] be more than this [rad]: no slide lasts, but biases do."""

FASTEST = 15.0
"""Who changes faster than this [rad/s] has jumped."""

NIS_TIME, USUAL_NIS_TIME = 1.0, 30.0
"""Time constants of the normalised innovation squared as it is, and as it usually is [s]."""

GROWN_NIS = 6.0
"""Innovations have grown where it is so many times what it usually is, or would be in a well tuned filter."""

STILL_TIME = 0.5
"""Who gives the same beta for so long [s] while the yaw rate moves is frozen."""

SETTLE_TIME = 0.5
"""A filter is healthy again when nothing has been wrong with it for so long [s]."""

PATIENCE = 1.0
"""A filter that is unhealthy for so long [s] begins anew; one that is not finite does at once."""

QUARANTINE, LONGEST_QUARANTINE = 1.0, 32.0
"""After a new begin a filter is not trusted for so long [s]; for twice as long with each begin that did not help."""

TRUSTED_AFTER = 60.0
"""A begin helped where the filter stayed healthy for so long [s]."""

MISSING_TIME, MISSING_SHARE = 0.1, 0.85
"""Signals are missing where more than this share of the samples of about so long [s] lack one."""

GRACE = 2.0
"""After that a filter has so long [s] to find back by itself."""

RECKONED_DOUBT = 0.03
"""How fast dead reckoning may go astray [rad/s]: 0.5 m/s^2 of bank or bias at 60 km/h."""

MOST_DOUBT = 0.5
"""More is not doubted [rad]."""

FADE_TIME, FADE_RATE = 0.2, 0.4
"""The step to and from what the healthy ones say fades out as in the switch [s], [rad/s]."""

NOTHING = 1e-6
"""What is left of a step below this [rad] is none."""


class HealthState(NamedTuple):
    """What is known of each filter of a drive, and of all of them; changed in place."""

    last: np.ndarray  # (filters,) newest beta; NaN before the first [rad]
    still: np.ndarray  # (filters,) time without a change while the yaw rate moves [s]
    tied: np.ndarray  # (filters,) what parts changes of beta from those that ay and yaw rate say [rad]
    nis: np.ndarray  # (2, filters) means over `NIS_TIME` and `USUAL_NIS_TIME`
    alone: np.ndarray  # (filters,) time alone less time not [s]
    offset: np.ndarray  # (filters,) mean distance to the others over `OFFSET_TIME` [rad]
    wrong: np.ndarray  # (filters,) for how long something is wrong with it [s]
    wait: np.ndarray  # (filters,) time until it may be healthy [s]
    since: np.ndarray  # (filters,) time since its last begin [s]
    quarantine: np.ndarray  # (filters,) that its last begin asked for [s]
    told: np.ndarray  # (filters,) beta that was given for it [rad]
    step: np.ndarray  # (filters,) that fades out [rad]
    codes: np.ndarray  # (filters,) int64 of the newest sample
    before: np.ndarray  # (filters,) int64 of the sample before it
    restart: np.ndarray  # (filters,) int64, 1 where it is to begin anew after the newest sample
    order: np.ndarray  # (filters,) scratch
    common: np.ndarray  # (8,) see below

    @property
    def answer(self) -> float:
        """What the healthy filters say at the newest sample, or dead reckoning since [rad]."""
        return float(self.common[ANSWER])


ANSWER, DOUBT, LONE, AY, MISSING, LEFT, SAMPLES, LAST_YAW = range(8)
"""What the healthy filters say and doubt [rad], time since there was one [s]; mean of |ay| [m/s^2]; share of samples
that lack a signal, grace left after it [s]; samples so far; newest yaw rate [rad/s]."""


def start_health(filters: int) -> HealthState:
    """Make the state before the first sample of a drive."""
    last, told = np.full((2, filters), np.nan)
    still, tied, alone, offset, wrong, wait, quarantine, step, order = np.zeros((9, filters))
    codes, before, restart = np.zeros((3, filters), dtype=np.int64)
    since, common = np.full(filters, math.inf), np.zeros(8)
    common[DOUBT], common[LAST_YAW] = LOW_SPEED_STD, math.nan
    return HealthState(
        last, still, tied, np.full((2, filters), np.nan), alone, offset, wrong, wait, since, quarantine, told, step,
        codes, before, restart, order, common,
    )  # fmt: skip


def next_health(
    state: HealthState,
    samples: np.ndarray,
    beta: np.ndarray,
    beta_std: np.ndarray,
    nis: np.ndarray,
    codes: np.ndarray,
    alone: np.ndarray,
    dt: float,
) -> int:
    """Judge the next samples of a drive, up to the first after which a filter must begin anew.

    Parameters
    ----------
    state : HealthState
        Changed in place. `restart` names the filters that must begin anew, from `answer`.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    beta, beta_std, nis : (n, filters) [rad], [rad], [-]
        What filters say; in place, what an unhealthy one says is replaced.
    codes : (n, filters) int64
        Gets the places in `WORDS`.
    alone : (n,) [s]
        Gets for how long no filter is healthy.
    dt : float [s]

    Returns
    -------
    int
        Number of the samples that were taken.
    """
    return int(_health_run(state, samples, beta, beta_std, nis, codes, alone, dt))


@inlined
def _take_common(common, sample, dt):
    """Take what concerns all filters; tell whether the yaw rate moved, and whether the sample lacks a signal."""
    ay, yaw_rate = sample[at.AY], sample[at.YAW_RATE]
    held = sample[at.VX_HELD] + sample[at.STEER_HELD] > 0.0
    lacks = held or not math.isfinite(sample[at.AX] + ay + yaw_rate)
    if math.isfinite(ay):
        common[AY] += min(dt / GENTLE_TIME, 1.0) * (abs(ay) - common[AY])
    common[MISSING] += min(dt / MISSING_TIME, 1.0) * ((1.0 if lacks else 0.0) - common[MISSING])
    common[LEFT] = GRACE if common[MISSING] > MISSING_SHARE else max(common[LEFT] - dt, 0.0)
    moved = math.isfinite(yaw_rate) and yaw_rate != common[LAST_YAW]
    if math.isfinite(yaw_rate):
        common[LAST_YAW] = yaw_rate
    common[SAMPLES] += 1.0
    return moved, lacks


@inlined
def _take_nis(state, i, nis, dt):
    """Take the normalised innovation; tell whether it has grown beyond what is usual."""
    now, usual = state.nis[0], state.nis[1]
    if math.isfinite(nis):
        fresh = math.isnan(now[i])
        now[i] = nis if fresh else now[i] + min(dt / NIS_TIME, 1.0) * (nis - now[i])
        usual[i] = (
            nis
            if fresh
            else usual[i] + max(1.0 / state.common[SAMPLES], dt / USUAL_NIS_TIME) * (nis - usual[i])
        )
    return now[i] > GROWN_NIS * max(usual[i], 1.0)


@inlined
def next_tie(tied, change, sample, dt):
    """What parts the changes of a beta from those that ay and yaw rate give [rad], from what did before the sample.

    Parameters
    ----------
    tied : float [rad]
    change : float [rad]
        Of beta since the sample before; not finite where it is not known.
    sample : (17,)
        As in `crosscomb.filters.base.Inputs`.
    dt : float [s]
    """
    if not (sample[at.VX] > MIN_SPEED and math.isfinite(change)):
        return 0.0
    tied -= tied * min(dt / TIE_TIME, 1.0)
    felt = slip_rate(sample[at.VX], sample[at.YAW_RATE], sample[at.AY])
    return tied + (dt * felt - change) if math.isfinite(felt) else tied


@inlined
def _loneliness(state, i, beta, beta_std, surprised, dt):
    """Tell how far a filter is from all the healthy others, of which there are two or more, who agree.

    But for gentle driving one that changes more as the accelerometer says than any of them may be the one that sees
    a slide.

    Returns
    -------
    float
        Distance over what is too far now, at most `MOST_WEIGHT`; 0 where it is not alone.
    """
    least, largest, tied, count = math.inf, -math.inf, math.inf, 0
    for j in range(beta.size):
        if j != i and state.codes[j] == HEALTHY and math.isfinite(beta[j]) and math.isfinite(beta_std[j]):
            least, largest, count = min(least, beta[j]), max(largest, beta[j]), count + 1
            tied = min(tied, abs(state.tied[j]))
    middle = 0.5 * (least + largest) if count >= 2 else beta[i]
    state.offset[i] += min(dt / OFFSET_TIME, 1.0) * (beta[i] - middle - state.offset[i])
    away = max(least - beta[i], beta[i] - largest)
    if count < 2 or largest - least > AGREEMENT * away:
        return 0.0
    most = MOST_ALONE_SURPRISED if surprised else MOST_ALONE
    if state.common[AY] < GENTLE_AY:
        most = MOST_ALONE_GENTLE
    elif abs(state.offset[i]) > MOST_OFFSET:
        most = MOST_OFFSET
    elif abs(state.tied[i]) < tied:
        return 0.0
    return min(away / most, MOST_WEIGHT) if away > most else 0.0


@inlined
def _sign_of(state, i, sample, beta, beta_std, nis, moved, lacks, dt):
    """Tell what is wrong with a filter at this sample."""
    surprised = _take_nis(state, i, nis[i], dt)
    same, jumped = beta[i] == state.last[i], abs(beta[i] - state.last[i]) > FASTEST * dt
    state.still[i] = (state.still[i] + (dt if moved else 0.0)) if same else 0.0
    state.tied[i] = next_tie(state.tied[i], beta[i] - state.last[i], sample, dt)
    state.last[i] = beta[i]
    if not (math.isfinite(beta[i]) and math.isfinite(beta_std[i])):
        return LOST
    if not sample[at.VX] > MIN_SPEED:
        state.alone[i] = state.offset[i] = state.still[i] = 0.0
        return HEALTHY
    excused = lacks or state.common[LEFT] > 0.0
    if abs(beta[i]) > MOST_BETA or (beta_std[i] > MOST_STD and not excused):
        return DIVERGED
    if state.still[i] > STILL_TIME:
        return FROZEN
    lonely = _loneliness(state, i, beta, beta_std, surprised, dt)
    state.alone[i] = min(max(state.alone[i] + (lonely if lonely > 0.0 else -1.0) * dt, 0.0), 2.0 * ALONE_TIME)
    if jumped:
        return JUMPED
    if state.alone[i] > ALONE_TIME or (state.alone[i] > 0.0 and state.codes[i] == ASTRAY):
        return ASTRAY
    return HEALTHY


@inlined
def _begin_anew(state, i):
    """Ask for a new begin of a filter."""
    state.restart[i] = 1
    state.quarantine[i] = min(max(2.0 * state.quarantine[i], QUARANTINE), LONGEST_QUARANTINE)
    state.wait[i] = state.quarantine[i]
    state.last[i] = state.nis[0, i] = state.nis[1, i] = math.nan
    state.since[i] = state.still[i] = state.tied[i] = state.alone[i] = state.offset[i] = state.wrong[i] = 0.0


@inlined
def _judge(state, sample, beta, beta_std, nis, codes, dt):
    """Tell the health of all filters at one sample, and which of them must begin anew."""
    moved, lacks = _take_common(state.common, sample, dt)
    for i in range(beta.size):
        sign = _sign_of(state, i, sample, beta, beta_std, nis, moved, lacks, dt)
        state.since[i] += dt
        state.wait[i] = max(state.wait[i] - dt, 0.0)
        if sign != HEALTHY:
            state.wait[i] = max(state.wait[i], SETTLE_TIME)
            state.wrong[i] += dt
            codes[i] = sign
        elif state.wait[i] > 0.0:
            codes[i] = state.codes[i]
        else:
            codes[i], state.wrong[i] = HEALTHY, 0.0
            if state.since[i] > TRUSTED_AFTER:
                state.quarantine[i] = 0.0
    for i in range(beta.size):
        state.before[i], state.codes[i], state.restart[i] = state.codes[i], codes[i], 0
        late = state.wrong[i] > PATIENCE and state.common[LEFT] == 0.0 and sample[at.VX] > MIN_SPEED
        lost = codes[i] == LOST and not (math.isfinite(beta[i]) and math.isfinite(beta_std[i]))
        if (late or lost) and state.since[i] > state.quarantine[i]:
            _begin_anew(state, i)
            state.codes[i] = RESTARTED


@inlined
def _take_answer(state, beta, beta_std):
    """Take the median of what the healthy filters say, and all that they doubt; False where none is healthy."""
    order, count, doubt = state.order, 0, 0.0
    for i in range(beta.size):
        if state.codes[i] == HEALTHY:
            place = count
            while place > 0 and order[place - 1] > beta[i]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = beta[i]
            count, doubt = count + 1, max(doubt, beta_std[i])
    if count == 0:
        return False
    state.common[ANSWER] = 0.5 * (order[(count - 1) // 2] + order[count // 2])
    state.common[DOUBT] = math.hypot(doubt, order[count - 1] - order[0])
    return True


@inlined
def _reckon(state, sample, beta, beta_std, dt):
    """Take what the healthy filters say, or without any go on from there as ay and yaw rate say."""
    common = state.common
    if _take_answer(state, beta, beta_std):
        common[LONE] = 0.0
        return
    common[LONE] += dt
    common[DOUBT] = min(common[DOUBT] + RECKONED_DOUBT * dt, MOST_DOUBT)
    rate = slip_rate(max(sample[at.VX], MIN_SPEED), sample[at.YAW_RATE], sample[at.AY])
    if math.isfinite(rate):
        common[ANSWER] = min(max(common[ANSWER] + rate * dt, -MAX_BETA), MAX_BETA)


@inlined
def _tell(state, beta, beta_std, nis, dt):
    """Replace what the unhealthy filters say; a filter that changes its health goes on from what was told of it."""
    fading = math.exp(-dt / FADE_TIME)
    for i in range(beta.size):
        healthy = state.codes[i] == HEALTHY
        if not healthy:
            beta[i], beta_std[i], nis[i] = state.common[ANSWER], state.common[DOUBT], math.nan
        if healthy != (state.before[i] == HEALTHY) and math.isfinite(state.told[i]):
            state.step[i] = state.told[i] - beta[i]
        elif state.step[i] != 0.0:
            faded = (1.0 - fading) * state.step[i]
            state.step[i] -= min(max(faded, -FADE_RATE * dt), FADE_RATE * dt)
            if abs(state.step[i]) < NOTHING:
                state.step[i] = 0.0
        if state.step[i] != 0.0:
            beta[i] = min(max(beta[i] + state.step[i], -MAX_BETA), MAX_BETA)
            beta_std[i] = math.hypot(beta_std[i], state.step[i])
        state.told[i] = beta[i]


@kernel
def _health_run(state, samples, beta, beta_std, nis, codes, alone, dt):
    """All samples, or those up to the first after which a filter must begin anew; give how many."""
    for k in range(samples.shape[0]):
        _judge(state, samples[k], beta[k], beta_std[k], nis[k], codes[k], dt)
        _reckon(state, samples[k], beta[k], beta_std[k], dt)
        _tell(state, beta[k], beta_std[k], nis[k], dt)
        alone[k] = state.common[LONE]
        for i in range(beta.shape[1]):
            if state.restart[i] == 1:
                return k + 1
    return samples.shape[0]

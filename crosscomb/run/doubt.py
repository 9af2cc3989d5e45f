"""Doubt that no filter has: what is missing makes an answer worse with time, and so does what contradicts itself.

While something is missing doubt grows, and fades once it is over. What is there must agree: over some seconds the
answer's beta changes as ay / vx - yaw_rate says (Atheupe 2023, eq. 18 and 19). What it does beside that, and beside
what it has always done (offsets, the camber of roads), some sensor or the answer has wrong.
"""

from __future__ import annotations

import math

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.models.compiled import inlined, kernel
from crosscomb.selection.health import MOST_DOUBT, next_tie
from crosscomb.signals import MIN_SPEED

YAW_RATE_DOUBT, AY_DOUBT, STEER_DOUBT, VX_DOUBT = 0.10, 0.06, 0.03, 0.02
"""How fast beta may go astray while yaw rate, ay, steering angle or speed are missing [rad/s]."""

AX_DOUBT, MOST_AX_DOUBT = 0.01, 0.014
"""The same while ax is missing [rad/s], and how far at most [rad]: one filter of several cannot do without."""

FADING = 0.7
"""Time constant with which doubt fades once everything is there again [s]."""

OUTAGE = 0.2
"""Who misses something for longer than this [s] must recover."""

RECOVERED = 1.1
"""Recovered is who doubts at most so many times as much as before the outage."""

SILENCE = 0.5
"""After a silence of the log an answer recovers at least so long [s]."""

USUAL_TIME = 20.0
"""What parts beta from ay and yaw rate for longer than this [s] is usual."""

TIE_SHARE = 0.5
"""Share of what parts them that is a standard deviation of beta."""

DOUBT, BEFORE, MISSED, LEAST, TIED, USUAL, LAST = range(7)


def start_doubt(before: float = math.nan) -> np.ndarray:
    """Make the state before the first sample of a drive.

    Doubt [rad], beta_std before the outage [rad], its length [s], and for how long at least the answer recovers [s];
    what parts beta from ay and yaw rate, and usually does [rad], and the newest beta [rad].
    After a silence of the log `before` is what the doubt was then; the drive begins with having to recover.
    """
    return np.array([0.0, before, 0.0, 0.0 if math.isnan(before) else SILENCE, 0.0, 0.0, math.nan])


def next_doubt(
    state: np.ndarray, samples: np.ndarray, beta: np.ndarray, beta_std: np.ndarray, dt: float
) -> np.ndarray:
    """Widen beta_std by what is missing, and by what contradicts itself.

    Parameters
    ----------
    state : (7,)
        Changed in place.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    beta, beta_std : (n,) [rad]
        Of the answer; beta_std is changed in place.
    dt : float [s]

    Returns
    -------
    (n,) bool
        The answer recovers: all is there again, but beta_std is not yet what it was.
    """
    recovering = np.zeros(len(samples), dtype=np.bool_)
    _doubt_run(state, samples, beta, beta_std, dt, recovering)
    return recovering


@inlined
def _growth(sample):
    """How fast the answer may go astray [rad/s]; 0 where nothing is missing."""
    growth = YAW_RATE_DOUBT if not math.isfinite(sample[at.YAW_RATE]) else 0.0
    growth += AY_DOUBT if not math.isfinite(sample[at.AY]) else 0.0
    growth += AX_DOUBT if not math.isfinite(sample[at.AX]) else 0.0
    return growth + STEER_DOUBT * sample[at.STEER_HELD] + VX_DOUBT * sample[at.VX_HELD]


@inlined
def _tie_doubt(state, sample, beta, dt):
    """Doubt from what parts the changes of beta from those that ay and yaw rate give."""
    change, state[LAST] = beta - state[LAST], beta
    state[TIED] = next_tie(state[TIED], change, sample, dt)
    if not sample[at.VX] > MIN_SPEED or math.isnan(change):
        return 0.0
    state[USUAL] += (state[TIED] - state[USUAL]) * dt / USUAL_TIME
    return TIE_SHARE * abs(state[TIED] - state[USUAL])


@kernel
def _doubt_run(state, samples, beta, beta_std, dt, recovering):
    """All samples. `BEFORE` is NaN while there is nothing to recover from."""
    fading = math.exp(-dt / FADING)
    for k in range(beta_std.size):
        sample, growth = samples[k], _growth(samples[k])
        own = math.hypot(beta_std[k], _tie_doubt(state, sample, beta[k], dt))
        if not sample[at.VX] > MIN_SPEED:
            state[DOUBT], state[MISSED] = 0.0, 0.0
            if state[LEAST] == 0.0:
                state[BEFORE] = math.nan
        elif growth > 0.0:
            if state[MISSED] == 0.0 and math.isnan(state[BEFORE]):
                state[BEFORE] = own
            state[MISSED] += dt
            most = MOST_AX_DOUBT if growth == AX_DOUBT else MOST_DOUBT
            state[DOUBT] = min(state[DOUBT] + growth * dt, max(most, state[DOUBT] * fading))
        else:
            if 0.0 < state[MISSED] <= OUTAGE:
                state[BEFORE] = math.nan
            state[MISSED] = 0.0
            state[DOUBT] *= fading
        beta_std[k] = math.hypot(own, state[DOUBT])
        state[LEAST] = max(state[LEAST] - dt, 0.0)
        if growth == 0.0 and not math.isnan(state[BEFORE]):
            recovering[k] = beta_std[k] > RECOVERED * state[BEFORE] or state[LEAST] > 0.0
            if not recovering[k]:
                state[BEFORE] = math.nan

"""Words that say how far to trust each sample."""

from __future__ import annotations

import math

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.logs.verdict import weigh
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import slip_rate
from crosscomb.signals import MIN_SPEED

STALE = 1.0
"""Without speed, steering, or both yaw rate and ay for this long [s] the estimate is invalid."""

REVERSE_SPEED = -0.3
"""Below this vx [m/s] the car reverses; speed sensors at rest read a little on either side of 0."""

UNCERTAIN_STD = math.radians(1.5)
"""With more doubt than this [rad] the error may well be 3 deg: the estimate is uncertain."""

LOW_SPEED, DEGRADED, EXTRAPOLATING, INVALID, REVERSE, RECOVERING, UNCERTAIN = (1 << bit for bit in range(7))
WORDS = ("low_speed", "degraded", "extrapolating", "invalid", "reverse", "recovering", "uncertain")
"""The word of each bit, in this order."""

TEXTS = np.array(
    ["+".join(word for bit, word in enumerate(WORDS) if code >> bit & 1) or "ok" for code in range(1 << len(WORDS))],
    dtype=object,
)  # fmt: skip
"""Text of each code: its words joined by ``+``, ``ok`` where none holds."""

NEVER = 1e18
"""Age in samples of what was never measured."""


OUTSIDE_TIME = 0.5
"""The input is outside the training data for longer than it is inside by so much [s] before it is said."""

TURN = 2.0
"""Below this lateral acceleration [m/s^2] the car goes straight, and there is nothing to extrapolate."""

TURN_TIME = 0.3
"""Time constant of the mean of ay that tells of it [s]."""

SPUN, CAUGHT = math.radians(40.0), math.radians(20.0)
"""With more sideslip than the first the car spins: no filter is believed until it is less than the second [rad]."""

AHEAD = 0.3
"""Where ay and yaw rate say that beta will be by then [s] counts."""

DOUBT_TIME = 0.03
"""The doubt is above `UNCERTAIN_STD` for longer than it is below by so much [s] before it is said: no word flickers."""

MORE_DOUBT = 1.25
"""So many times as much doubt is said at once."""

OF_VX, OF_STEER, OF_TURN, HAS_AX, MEAN_AY, OUTSIDE, _SAID, SPINS, DOUBTED, _TOLD = range(10)


def start_ages() -> np.ndarray:
    """State before the first sample of a drive ``(10,)``.

    Samples since vx, steer, and yaw rate or ay were measured; 1 once ax was; mean of ay [m/s^2]; whether the input is
    outside the training data, see `crosscomb.logs.verdict`; 1 while the car spins; whether the answer is uncertain.
    """
    return np.array([NEVER, NEVER, NEVER, *7 * [0.0]])


def status_codes(
    ages: np.ndarray,
    samples: np.ndarray,
    outside: np.ndarray,
    recovering: np.ndarray,
    beta: np.ndarray,
    beta_std: np.ndarray,
    dt: float,
) -> np.ndarray:
    """Status of the next samples of a drive.

    Parameters
    ----------
    ages : (10,)
        Changed in place.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    outside : (n,) bool
        The input lies outside the training data.
    recovering : (n,) bool
        See `crosscomb.run.doubt.next_doubt`.
    beta, beta_std : (n,) [rad]
        Of the answer.
    dt : float [s]

    Returns
    -------
    (n,) int
        Places in `TEXTS`.
    """
    codes = np.empty(len(samples), dtype=np.int64)
    _codes_run(ages, samples, outside, beta, beta_std, STALE / dt, dt, codes)
    return codes | RECOVERING * recovering


@inlined
def _turns(ages, sample, dt):
    """Tell whether the car turns, by the yaw rate or by the mean of ay; what is missing tells of a turn."""
    if math.isfinite(sample[at.AY]):
        ages[MEAN_AY] += min(dt / TURN_TIME, 1.0) * (sample[at.AY] - ages[MEAN_AY])
    by_yaw = sample[at.VX] * sample[at.YAW_RATE]
    return not (abs(by_yaw) <= TURN and abs(ages[MEAN_AY]) <= TURN)


@inlined
def _spins(ages, sample, beta):
    """Tell whether the car spins, by the answer and by where ay and yaw rate say that it goes."""
    vx, turned = sample[at.VX], 0.0
    if vx > MIN_SPEED and math.isfinite(sample[at.AY]) and math.isfinite(sample[at.YAW_RATE]):
        turned = AHEAD * slip_rate(vx, sample[at.YAW_RATE], sample[at.AY])
    if not vx > MIN_SPEED or abs(beta) < CAUGHT:
        ages[SPINS] = 0.0
    elif abs(beta) > SPUN or abs(beta + turned) > SPUN:
        ages[SPINS] = 1.0
    return ages[SPINS] == 1.0


@inlined
def _is_uncertain(ages, beta_std, dt):
    """Tell whether the answer is uncertain."""
    if beta_std > MORE_DOUBT * UNCERTAIN_STD:
        ages[DOUBTED], ages[_TOLD] = 2.0 * DOUBT_TIME, 1.0
    doubtful = beta_std > UNCERTAIN_STD
    return weigh(ages[DOUBTED:], doubtful, not doubtful, dt, DOUBT_TIME)


@kernel
def _codes_run(ages, samples, outside, beta, beta_std, stale, dt, codes):
    for k in range(codes.size):
        sample, vx = samples[k], samples[k, at.VX]
        no_ay, no_yaw_rate = not math.isfinite(sample[at.AY]), not math.isfinite(sample[at.YAW_RATE])
        ages[OF_VX] = ages[OF_VX] + 1.0 if sample[at.VX_HELD] == 1.0 else 0.0
        ages[OF_STEER] = ages[OF_STEER] + 1.0 if sample[at.STEER_HELD] == 1.0 else 0.0
        ages[OF_TURN] = ages[OF_TURN] + 1.0 if no_ay and no_yaw_rate else 0.0
        code = 0
        if REVERSE_SPEED <= vx <= MIN_SPEED:
            code |= LOW_SPEED
        # An ax that is made from vx needs a few samples of it: what was never there is not missed.
        no_ax = not math.isfinite(sample[at.AX])
        ages[HAS_AX] = max(ages[HAS_AX], 0.0 if no_ax else 1.0)
        no_ax = no_ax and ages[HAS_AX] == 1.0
        if sample[at.VX_HELD] + sample[at.STEER_HELD] > 0.0 or no_ay or no_yaw_rate or no_ax:
            code |= DEGRADED
        turns = _turns(ages, sample, dt)
        astray = outside[k] and turns and vx > MIN_SPEED
        if weigh(ages[OUTSIDE:], astray, not astray, dt, OUTSIDE_TIME) and vx > MIN_SPEED:
            code |= EXTRAPOLATING
        if _is_uncertain(ages, beta_std[k], dt) and vx > MIN_SPEED:
            code |= UNCERTAIN
        spins = _spins(ages, sample, beta[k])
        if spins or max(ages[OF_VX], ages[OF_STEER], ages[OF_TURN]) > stale:
            code |= INVALID
        if vx < REVERSE_SPEED:
            code |= REVERSE
        codes[k] = code

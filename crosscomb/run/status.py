"""Words that say how far to trust each sample."""

from __future__ import annotations

import math

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.models.compiled import kernel
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

NEVER = 1 << 60
"""Age in samples of what was never measured."""


OUTSIDE_TIME = 0.5
"""The input is outside the training data for longer than it is inside by so much [s] before it is said."""


def start_ages() -> np.ndarray:
    """State before the first sample of a drive ``(5,)``.

    Samples since vx, steer, and yaw rate or ay were measured; samples outside the training data less those inside, and
    1 while that is said.
    """
    return np.array([NEVER, NEVER, NEVER, 0, 0])


def status_codes(
    ages: np.ndarray,
    samples: np.ndarray,
    outside: np.ndarray,
    recovering: np.ndarray,
    beta_std: np.ndarray,
    dt: float,
) -> np.ndarray:
    """Status of the next samples of a drive.

    Parameters
    ----------
    ages : (5,) int
        Changed in place.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    outside : (n,) bool
        The input lies outside the training data.
    recovering : (n,) bool
        See `crosscomb.run.doubt.next_doubt`.
    beta_std : (n,) [rad]
        Of the answer.
    dt : float [s]

    Returns
    -------
    (n,) int
        Places in `TEXTS`.
    """
    codes = np.empty(len(samples), dtype=np.int64)
    _codes_run(ages, samples, outside, STALE / dt, max(round(OUTSIDE_TIME / dt), 1), codes)
    fast = samples[:, at.VX] > MIN_SPEED
    return codes | RECOVERING * recovering | UNCERTAIN * (fast & (beta_std > UNCERTAIN_STD))


@kernel
def _codes_run(ages, samples, outside, stale, often, codes):
    for k in range(codes.size):
        sample, vx = samples[k], samples[k, at.VX]
        no_ay, no_yaw_rate = not math.isfinite(sample[at.AY]), not math.isfinite(sample[at.YAW_RATE])
        ages[0] = min(ages[0] + 1, NEVER) if sample[at.VX_HELD] == 1.0 else 0
        ages[1] = min(ages[1] + 1, NEVER) if sample[at.STEER_HELD] == 1.0 else 0
        ages[2] = min(ages[2] + 1, NEVER) if no_ay and no_yaw_rate else 0
        code = 0
        if REVERSE_SPEED <= vx <= MIN_SPEED:
            code |= LOW_SPEED
        held = sample[at.VX_HELD] + sample[at.STEER_HELD] > 0.0
        if held or no_ay or no_yaw_rate or not math.isfinite(sample[at.AX]):
            code |= DEGRADED
        ages[3] = min(ages[3] + 1, 2 * often) if outside[k] and vx > MIN_SPEED else max(ages[3] - 1, 0)
        if ages[3] >= often:
            ages[4] = 1
        elif ages[3] == 0:
            ages[4] = 0
        if ages[4] == 1 and vx > MIN_SPEED:
            code |= EXTRAPOLATING
        if max(ages[0], ages[1], ages[2]) > stale:
            code |= INVALID
        if vx < REVERSE_SPEED:
            code |= REVERSE
        codes[k] = code

"""Boosted trees that choose among the filters: the likeliest one, or all of them by their probabilities."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from crosscomb.checked import Record
from crosscomb.models.compiled import allocating
from crosscomb.selection.boosted import Boosted


class Choice(Record):
    """Trees whose outputs say how likely each filter is the one to take.

    Attributes
    ----------
    trees : Boosted
        One output per filter.
    temperature : float
        Divides the outputs; fitted on recordings left out, so that the shares are calibrated.
    soft : bool
        Blend the filters by their probabilities instead of switching.
    lag : float
        Time constant that smooths the probabilities of a blend [s].
    """

    trees: Boosted
    temperature: float = Field(default=1.0, gt=0.0)
    soft: bool = False
    lag: float = Field(default=0.05, ge=0.0, le=1.0)

    def probabilities(self, features: np.ndarray) -> np.ndarray:
        """Probability of each filter ``(n, filters)`` for rows of features ``(n, f)``."""
        scores = self.trees.predict(features) / self.temperature
        shares = np.exp(scores - scores.max(axis=1, keepdims=True))
        return shares / shares.sum(axis=1, keepdims=True)


LEAD = 0.05
"""Another filter leads a blend once its share is larger by this much."""

LEAD_TIME = 0.5
"""A filter leads for at least so long [s]: who reads along is not helped by a name that flickers."""


@allocating
def _blend_run(shares, smoothed, leading, beta, beta_std, gain, hold, out_beta, out_std, active):
    """Blend the filters that have an answer; `smoothed` ``(filters,)`` keeps the shares from sample to sample."""
    n, filters = shares.shape
    for k in range(n):
        total, mean, largest, first = 0.0, 0.0, -1.0, 0
        fresh = smoothed[0] < 0.0
        for i in range(filters):
            smoothed[i] += (1.0 if fresh else gain) * (shares[k, i] - smoothed[i])
            if math.isfinite(beta[k, i]) and math.isfinite(beta_std[k, i]):
                total += smoothed[i]
                mean += smoothed[i] * beta[k, i]
                if smoothed[i] > largest:
                    largest, first = smoothed[i], i
        mean /= total
        leader = leading[0]
        lost = not (math.isfinite(beta[k, leader]) and math.isfinite(beta_std[k, leader]))
        leading[1] += 1
        if fresh or lost or (leading[1] >= hold and largest > smoothed[leader] + LEAD):
            leading[1] = 0 if first != leader else leading[1]
            leading[0] = first
        active[k] = leading[0]
        variance = 0.0
        for i in range(filters):
            if math.isfinite(beta[k, i]) and math.isfinite(beta_std[k, i]):
                variance += smoothed[i] / total * (beta_std[k, i] ** 2 + (beta[k, i] - mean) ** 2)
        out_beta[k], out_std[k] = mean, math.sqrt(variance)


def blend(
    shares: np.ndarray,
    smoothed: np.ndarray,
    leading: np.ndarray,
    beta: np.ndarray,
    beta_std: np.ndarray,
    gain: float,
    hold: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blend the filters by their shares.

    Parameters
    ----------
    shares : (n, filters)
    smoothed : (filters,)
        Shares of the sample before, changed in place; negative before the first.
    leading : (2,) int
        The filter that leads, and samples since it does; changed in place.
    beta, beta_std : (n, filters) [rad]
    gain : float
        Share of a new sample in the smoothed shares.
    hold : int
        Samples for which a filter leads at least.

    Returns
    -------
    beta, beta_std : (n,) [rad]
    active : (n,) int
        Filter that leads: with the largest share, where that is `LEAD` more than the former leader's.
    """
    n = len(shares)
    out_beta, out_std, active = np.empty(n), np.empty(n), np.zeros(n, dtype=np.int64)
    _blend_run(shares, smoothed, leading, beta, beta_std, gain, hold, out_beta, out_std, active)
    return out_beta, out_std, active

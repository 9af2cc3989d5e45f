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


@allocating
def _blend_run(shares, smoothed, beta, beta_std, gain, out_beta, out_std, active):
    """Blend the filters that have an answer; `smoothed` ``(filters,)`` keeps the shares from sample to sample."""
    n, filters = shares.shape
    for k in range(n):
        total, mean, largest = 0.0, 0.0, -1.0
        fresh = smoothed[0] < 0.0
        for i in range(filters):
            smoothed[i] += (1.0 if fresh else gain) * (shares[k, i] - smoothed[i])
            if math.isfinite(beta[k, i]) and math.isfinite(beta_std[k, i]):
                total += smoothed[i]
                mean += smoothed[i] * beta[k, i]
                if smoothed[i] > largest:
                    largest = smoothed[i]
                    active[k] = i
        mean /= total
        variance = 0.0
        for i in range(filters):
            if math.isfinite(beta[k, i]) and math.isfinite(beta_std[k, i]):
                variance += smoothed[i] / total * (beta_std[k, i] ** 2 + (beta[k, i] - mean) ** 2)
        out_beta[k], out_std[k] = mean, math.sqrt(variance)


def blend(
    shares: np.ndarray, smoothed: np.ndarray, beta: np.ndarray, beta_std: np.ndarray, gain: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blend the filters by their shares.

    Parameters
    ----------
    shares : (n, filters)
    smoothed : (filters,)
        Shares of the sample before, changed in place; negative before the first.
    beta, beta_std : (n, filters) [rad]
    gain : float
        Share of a new sample in the smoothed shares.

    Returns
    -------
    beta, beta_std : (n,) [rad]
    active : (n,) int
        Filter with the largest share.
    """
    n = len(shares)
    out_beta, out_std, active = np.empty(n), np.empty(n), np.zeros(n, dtype=np.int64)
    _blend_run(shares, smoothed, beta, beta_std, gain, out_beta, out_std, active)
    return out_beta, out_std, active

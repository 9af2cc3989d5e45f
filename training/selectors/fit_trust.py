"""Calibrate how far an answer is trusted, on recordings that it was not fitted on."""

from __future__ import annotations

import numpy as np

from crosscomb.selection.trust import Trust

DISAGREEMENTS = (0.0, 0.25, 0.5, 1.0)
"""Shares of the filters' disagreement to choose the doubt from."""

FLOOR = np.radians(0.1)
"""No estimate is called better than this before calibration [rad]."""


def fit_trust(error: np.ndarray, beta_std: np.ndarray, beta: np.ndarray) -> Trust:
    """Find the doubt that covers 95 % of the errors with the narrowest bands.

    Parameters
    ----------
    error, beta_std : (n,) [rad]
        Of samples the estimate was not fitted on.
    beta : (n, filters) [rad]
        What the filters said there.
    """
    trusts = []
    for disagreement in DISAGREEMENTS:
        trust = Trust(disagreement=disagreement, floor=FLOOR)
        scale = conformal_scale(error, trust.widen(beta_std, beta))
        trusts.append(trust.model_copy(update={"scale": scale}))

    def interval_score(trust: Trust) -> float:
        half = 1.96 * trust.widen(beta_std, beta)
        return float(np.mean(2.0 * half + 2.0 / 0.05 * np.maximum(np.abs(error) - half, 0.0)))

    return min(trusts, key=interval_score)


def conformal_scale(error: np.ndarray, beta_std: np.ndarray) -> float:
    """Factor on beta_std that makes +- 1.96 beta_std hold 95 % of the errors (split conformal).

    Parameters
    ----------
    error, beta_std : (n,) [rad]
        Of samples the estimate was not fitted on.
    """
    rank = min(1.0, 0.95 * (1.0 + 1.0 / len(error)))
    return float(np.quantile(np.abs(error) / beta_std, rank) / 1.96)

"""How far estimates are from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crosscomb.run.estimate import LogEstimate
from crosscomb.signals import MIN_SPEED


@dataclass(frozen=True)
class Score:
    """Error of one estimate.

    Attributes
    ----------
    rmse, max_error : float [rad]
    samples : int
        Number of samples that count.
    """

    rmse: float
    max_error: float
    samples: int


def countable(beta_ref: np.ndarray, vx: np.ndarray) -> np.ndarray:
    """Tell which samples ``(n,)`` count: truth is there and vx above `crosscomb.signals.MIN_SPEED`."""
    return np.isfinite(beta_ref) & (vx > MIN_SPEED)


def rms(error: np.ndarray) -> float:
    """Root of the mean square of errors ``(n,)``."""
    return float(np.sqrt(np.mean(error**2)))


def score(beta: np.ndarray, beta_ref: np.ndarray, counted: np.ndarray) -> Score:
    """Error of an estimate over the counted samples.

    Parameters
    ----------
    beta, beta_ref : (n,) [rad]
    counted : (n,) bool
    """
    error = beta[counted] - beta_ref[counted]
    if error.size == 0:
        return Score(float("nan"), float("nan"), 0)
    return Score(rms(error), float(np.max(np.abs(error))), int(error.size))


def coverage(beta: np.ndarray, beta_std: np.ndarray, beta_ref: np.ndarray, counted: np.ndarray) -> float:
    """Share of the counted samples whose truth lies within 1.96 standard deviations."""
    inside = np.abs(beta - beta_ref)[counted] <= 1.96 * beta_std[counted]
    return float(np.mean(inside)) if inside.size else float("nan")


def score_log(estimate: LogEstimate) -> dict[str, Score]:
    """Score each filter and the switch of one log against its ground truth, with beta = 0 beside them."""
    beta_ref = estimate.signals.beta_ref
    counted = countable(beta_ref, estimate.signals.column("vx"))
    estimates = {"zero": np.zeros(len(beta_ref)), **estimate.filters, "crosscomb": estimate.beta}
    return {name: score(beta, beta_ref, counted) for name, beta in estimates.items()}

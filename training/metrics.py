"""How far estimates are from the truth."""

from __future__ import annotations

from dataclasses import dataclass, field

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


@dataclass
class Errors:
    """Errors of an estimate, gathered piece by piece."""

    samples: int = 0
    squares: float = 0.0
    largest: float = 0.0

    def take(self, beta: np.ndarray, beta_ref: np.ndarray, counted: np.ndarray) -> None:
        """Take the next samples; see `score`."""
        error = beta[counted] - beta_ref[counted]
        if error.size:
            self.samples += error.size
            self.squares += float(np.sum(error**2))
            self.largest = max(self.largest, float(np.max(np.abs(error))))

    def score(self) -> Score:
        """Error of the samples so far, NaN where there are none."""
        if not self.samples:
            return Score(float("nan"), float("nan"), 0)
        return Score(float(np.sqrt(self.squares / self.samples)), self.largest, self.samples)


def score(beta: np.ndarray, beta_ref: np.ndarray, counted: np.ndarray) -> Score:
    """Error of an estimate over the counted samples.

    Parameters
    ----------
    beta, beta_ref : (n,) [rad]
    counted : (n,) bool
    """
    errors = Errors()
    errors.take(beta, beta_ref, counted)
    return errors.score()


def coverage(beta: np.ndarray, beta_std: np.ndarray, beta_ref: np.ndarray, counted: np.ndarray) -> float:
    """Share of the counted samples whose truth lies within 1.96 standard deviations."""
    inside = np.abs(beta - beta_ref)[counted] <= 1.96 * beta_std[counted]
    return float(np.mean(inside)) if inside.size else float("nan")


@dataclass
class LogErrors:
    """Errors of each filter and of the switch on one log, with beta = 0 beside them, gathered piece by piece."""

    of: dict[str, Errors] = field(default_factory=dict)

    def take(self, estimate: LogEstimate) -> None:
        """Take the next rows."""
        beta_ref = estimate.signals.beta_ref
        counted = countable(beta_ref, estimate.signals.column("vx"))
        estimates = {"zero": np.zeros(len(beta_ref)), **estimate.filters, "crosscomb": estimate.beta}
        for name, beta in estimates.items():
            self.of.setdefault(name, Errors()).take(beta, beta_ref, counted)

    def scores(self) -> dict[str, Score]:
        """Score of each; empty where the log has no ground truth that counts."""
        return {name: errors.score() for name, errors in self.of.items() if errors.samples}


def score_log(estimate: LogEstimate) -> dict[str, Score]:
    """Score each filter and the switch of one log against its ground truth; empty where there is none."""
    errors = LogErrors()
    errors.take(estimate)
    return errors.scores()

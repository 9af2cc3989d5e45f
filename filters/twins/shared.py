"""What the twins share: the walk over the samples, and filterpy's EKF with a nonlinear prediction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.models.single_track import SingleTrack


class GivenPrediction(ExtendedKalmanFilter):
    """filterpy's filter with a nonlinear prediction: `predict(u)` takes the predicted state itself."""

    x: np.ndarray
    P: np.ndarray

    def predict_x(self, u: np.ndarray) -> None:
        self.x = u


def walk_samples(
    inputs: Inputs,
    car: SingleTrack,
    start: Callable[[np.ndarray, float, float], None],
    step: Callable[[np.ndarray], tuple[float, ...]],
    rest: Callable[[], None] = lambda: None,
    extras: tuple[str, ...] = (),
) -> Estimate:
    """Give the rolling answer until a sample above the gate starts the filter, then the filter's own.

    `rest` is called at each sample that gets the rolling answer; `extras` names what a step gives behind the NIS.
    """
    out = np.full((len(inputs.samples), 3 + len(extras)), np.nan)
    running = False
    for sample, answer in zip(inputs.samples, out, strict=True):
        if running and not base.below_gate(sample):
            answer[:] = step(sample)
            continue
        base.low_speed_answer(sample, car, answer)
        rest()
        running = not base.below_gate(sample)
        if running:
            start(sample, answer[at.BETA], answer[at.BETA_STD])
    beta, beta_std, nis, *extra = out.T
    return Estimate(beta, beta_std, nis, dict(zip(extras, extra, strict=True)))


def nis_of(kf: Any) -> float:
    """Normalised innovation squared of the last update of any of filterpy's filters."""
    innovation = kf.y.ravel()
    return float(innovation @ kf.SI @ innovation)

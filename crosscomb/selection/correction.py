"""A learned correction on top of the filters: bounded, and faded out outside the training data.

Learning can correct what no filter has right, but must not be trusted where nothing was learned: there the answer
fades to that of the blend or switch. The correction is exactly odd: a mirrored drive gets the mirrored answer.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from crosscomb.checked import Finite, Record
from crosscomb.models.compiled import allocating
from crosscomb.selection.network import Network, Scratch, Weights, make_scratch, network_at
from crosscomb.selection.trust import Trust

FADE = 0.25
"""Beyond the training range by this share of it, nothing is left of the correction."""


LEAST_DOUBT, MOST_DOUBT = math.log(math.radians(0.05)), math.log(math.radians(30.0))
"""Logarithm of the least and largest standard deviation [rad] that the networks may foretell."""


class Correction(Record):
    """Networks that correct one filter, and one that says how far off the corrected answer is.

    Attributes
    ----------
    anchor : str
        Filter that is corrected: the best single one in training.
    network : Network
        Truth less anchor [rad].
    doubt : Network
        Logarithm of the standard deviation [rad] of what is left, before calibration.
    trust : Trust
        Calibrates it.
    share : float
        Share of the corrected filter where nothing is faded; the rest stays with the switch, whose errors differ.
    bound : float
        Largest correction [rad].
    lag : float
        Time constant that smooths the correction [s].
    fade : float
        Time constant of its fading in and out [s]: a large correction must not come or go in a jump.
    odd : list of bool
        Features that change sign in a mirrored drive.
    lowest, highest : list of float
        Range of each feature in training, mirrored drives included.
    """

    anchor: str
    network: Network
    doubt: Network
    trust: Trust = Trust()
    share: float = Field(default=1.0, gt=0.0, le=1.0)
    bound: float = Field(gt=0.0, le=1.5)
    lag: float = Field(default=0.02, ge=0.0, le=1.0)
    fade: float = Field(default=0.2, ge=0.0, le=10.0)
    odd: list[bool]
    lowest: list[Finite]
    highest: list[Finite]

    @model_validator(mode="after")
    def _sound(self) -> Correction:
        if not len(self.odd) == len(self.lowest) == len(self.highest):
            raise ValueError("the feature ranges of the correction are of uneven length")
        if max(self.network.n_features, self.doubt.n_features) > len(self.odd):
            raise ValueError("the correction asks for more features than it has ranges of")
        return self

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Corrections ``(n,) [rad]`` for rows of features ``(n, f) float32``, neither smoothed nor faded."""
        out = np.empty(len(features))
        _predict(self.kernel, make_correction_state(self), np.ascontiguousarray(features, np.float32), out)
        return out

    @cached_property
    def kernel(self) -> CorrectionKernel:
        """The correction as kernels take it."""
        lowest, highest = np.array(self.lowest), np.array(self.highest)
        return CorrectionKernel(
            self.network.weights,
            self.doubt.weights,
            self.bound,
            np.where(np.array(self.odd), -1.0, 1.0).astype(np.float32),
            lowest,
            highest,
            np.maximum(FADE * (highest - lowest), 1e-9),
        )


class CorrectionKernel(NamedTuple):
    """What the kernel needs of a `Correction`."""

    network: Weights
    doubt: Weights
    bound: float
    signs: np.ndarray  # (features,) float32
    lowest: np.ndarray  # (features,)
    highest: np.ndarray  # (features,)
    slack: np.ndarray  # (features,)


class CorrectionState(NamedTuple):
    """Smoothed correction and weight, changed in place, and room for the networks."""

    values: np.ndarray  # (3,) correction [rad], weight, 1 after the first sample
    mirrored: np.ndarray  # (features,) float32
    network: Scratch
    doubt: Scratch


def make_correction_state(correction: Correction) -> CorrectionState:
    """Make the state before the first sample."""
    return CorrectionState(
        np.zeros(3),
        np.zeros(len(correction.odd), dtype=np.float32),
        make_scratch(correction.network.weights),
        make_scratch(correction.doubt.weights),
    )


@allocating
def inside_weight(features, columns, lowest, highest, slack):
    """Weight of what was learned: 1 inside the training range, 0 from `FADE` of it outside."""
    most = 0.0
    for i in columns:
        beyond = max(lowest[i] - features[i], features[i] - highest[i]) / slack[i]
        most = max(most, beyond)
    return max(1.0 - most, 0.0)


@allocating
def odd_correction(model, state, features):
    """Correction [rad] of one sample, as it stands; leaves the mirrored features in the state."""
    mirrored = state.mirrored
    for i in range(mirrored.size):
        mirrored[i] = features[i] * model.signs[i]
    correction = network_at(model.network, state.network, features)
    correction -= network_at(model.network, state.network, mirrored)
    return min(max(0.5 * correction, -model.bound), model.bound)


@allocating
def _predict(model, state, features, out):
    for row in range(features.shape[0]):
        out[row] = odd_correction(model, state, features[row])


@allocating
def correction_at(model, state, features, gains, answer):
    """Write correction [rad], its raw standard deviation [rad] and its weight of one sample to `answer` ``(3,)``.

    Parameters
    ----------
    model : CorrectionKernel
    state : CorrectionState
        Changed in place.
    features : (f,) float32
    gains : (float, float)
        Share of the new sample in the smoothed correction, and in the weight.
    answer : (3,)
    """
    values, mirrored = state.values, state.mirrored
    correction = odd_correction(model, state, features)
    doubt = network_at(model.doubt, state.doubt, features) + network_at(model.doubt, state.doubt, mirrored)
    doubt = min(max(0.5 * doubt, LEAST_DOUBT), MOST_DOUBT)
    weight = inside_weight(features, model.network.columns, model.lowest, model.highest, model.slack)
    fresh = values[2] == 0.0
    values[0] += (1.0 if fresh else gains[0]) * (correction - values[0])
    values[1] += (1.0 if fresh else gains[1]) * (weight - values[1])
    values[2] = 1.0
    answer[0], answer[1], answer[2] = values[0], math.exp(doubt), values[1]


@allocating
def _run(model, state, features, gains, answers):
    for k in range(features.shape[0]):
        correction_at(model, state, features[k], gains, answers[k])


def lag_gain(lag: float, dt: float) -> float:
    """Share of a new sample in a mean with time constant `lag` [s], for samples dt [s] apart."""
    return -math.expm1(-dt / lag) if lag > 0.0 else 1.0


def correct(
    correction: Correction,
    state: CorrectionState,
    features: np.ndarray,
    anchor: int,
    beta: np.ndarray,
    switched: np.ndarray,
    switched_std: np.ndarray,
    dt: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Answer of the corrected filter, faded to that of the switch outside the training data.

    Parameters
    ----------
    correction : Correction
    state : CorrectionState
        Changed in place.
    features : (n, f) float32
    anchor : int
        Index of the filter that is corrected.
    beta : (n, filters) [rad]
    switched, switched_std : (n,) [rad]
        Answer of the switch.
    dt : float [s]

    Returns
    -------
    beta, beta_std : (n,) [rad]
    weight : (n,)
        1 where nothing is faded, 0 where only the switch is left.
    """
    answers = np.empty((len(switched), 3))
    gains = (lag_gain(correction.lag, dt), lag_gain(correction.fade, dt))
    _run(correction.kernel, state, features, gains, answers)
    missing, raw_std, weight = answers.T
    beta_std = correction.trust.widen(raw_std, beta)
    return (
        switched + correction.share * weight * (beta[:, anchor] + missing - switched),
        switched_std + weight * (beta_std - switched_std),
        weight,
    )

"""Combinations of a kinematic and a dynamic filter: both run, and a rule weighs their answers.

- `FuzzyBlend` (Cheli et al. 2007; Chindamo 2018, section 2.2): a steady-state index from fuzzy sets on how
  fast steering angle, ay and yaw rate have lately changed, the yaw rate counting most; dynamic in steady
  states, kinematic in transients.
- `CovarianceFusion`: weights inverse to the variances. The members share their sensors, so their errors are
  correlated in an unknown way; the variance is that of covariance intersection with equal shares (Julier
  and Uhlmann 1997), 1 / P = (1 / P1 + 1 / P2) / 2, and their disagreement is added.

The spread of a blend counts both members' spread and their disagreement, as that of a mixture does: one of
them may be wrong, and it is not known which. Where both are right that is too much: the squared error of the
mean is the mean of theirs less the disagreement, not more, and on drives of both models the normalised
errors squared average 0.2 to 0.4 instead of 1 (0.1 to 0.3 in `crosscomb.filters.combined.cross_combined`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into
from crosscomb.filters.base import Gaussian, KernelFilter, below_gate, gaussian
from crosscomb.filters.kinematic.kf import (
    Kinematic,
    KinematicKF,
    KinematicNoise,
    kinematic_state,
    kinematic_step,
)
from crosscomb.filters.single_track.ekf import DynamicNoise, dynamic_step
from crosscomb.models.compiled import inlined, kernel


class Members(NamedTuple):
    """State of a blend, changed in place by its kernel."""

    kinematic: Kinematic  # vx, vy and biases
    dynamic: Gaussian  # yaw_rate, beta
    kinematic_out: np.ndarray  # (3,)
    dynamic_out: np.ndarray  # (3,)
    slow: np.ndarray  # (3,) low-passed steer [rad], ay [m/s^2], yaw_rate [rad/s]; NaN before the first


class FuzzyNoise(NamedTuple):
    """Settings of the fuzzy blend: a rate below `..._calm` is steady, one above `..._lively` transient."""

    memory: float = 0.3  # time over which rates are taken [s]
    steer_calm: float = 0.05  # [rad/s]
    steer_lively: float = 0.25
    ay_calm: float = 2.0  # [m/s^3]
    ay_lively: float = 10.0
    yaw_calm: float = 0.15  # [rad/s^2]
    yaw_lively: float = 0.8
    yaw_weight: float = 0.5  # of the yaw rate in the index; the two others share the rest
    kinematic: KinematicNoise = KinematicNoise()
    dynamic: DynamicNoise = DynamicNoise()


class FusionNoise(NamedTuple):
    """Settings of the fusion: those of its members."""

    kinematic: KinematicNoise = KinematicNoise()
    dynamic: DynamicNoise = DynamicNoise()


@inlined
def run_members(state, sample, car, noise, dt, out):
    """Run both members on a sample; True where both give the answer of rolling, which is then written."""
    resting = state.kinematic.running[0] == 0 or below_gate(sample)
    kinematic_step(state.kinematic, sample, car, noise.kinematic, dt, state.kinematic_out)
    dynamic_step(state.dynamic, sample, car, noise.dynamic, dt, state.dynamic_out)
    if resting:
        copy_into(out, state.dynamic_out)
    return resting


@inlined
def mix(first, second, share, out):
    """Write the mixture of two estimates ``(>=3,)``, `share` of it the first."""
    apart = first[at.BETA] - second[at.BETA]
    variance = share * first[at.BETA_STD] ** 2 + (1.0 - share) * second[at.BETA_STD] ** 2
    out[at.BETA] = second[at.BETA] + share * apart
    out[at.BETA_STD] = math.sqrt(variance + share * (1.0 - share) * apart * apart)
    out[at.NIS] = math.nan


@inlined
def calmness(slow, i, value, calm, lively, noise, dt):
    """Membership of "steady" of one signal, 0 to 1, from its distance to its own low-passed past."""
    if not math.isfinite(value):
        return 0.5
    if not math.isfinite(slow[i]):
        slow[i] = value
    rate = abs(value - slow[i]) / noise.memory
    slow[i] += (1.0 - math.exp(-dt / noise.memory)) * (value - slow[i])
    return min(max((lively - rate) / (lively - calm), 0.0), 1.0)


@inlined
def fuzzy_step(state, sample, car, noise, dt, out):
    """One sample of the fuzzy blend; `out` ``(4,)`` gets beta, its standard deviation, NaN and the index."""
    steer = calmness(state.slow, 0, sample[at.STEER], noise.steer_calm, noise.steer_lively, noise, dt)
    ay = calmness(state.slow, 1, sample[at.AY], noise.ay_calm, noise.ay_lively, noise, dt)
    yaw = calmness(state.slow, 2, sample[at.YAW_RATE], noise.yaw_calm, noise.yaw_lively, noise, dt)
    index = noise.yaw_weight * yaw + 0.5 * (1.0 - noise.yaw_weight) * (steer + ay)
    out[3] = index
    if not run_members(state, sample, car, noise, dt, out):
        mix(state.kinematic_out, state.dynamic_out, 1.0 - index, out)


@inlined
def fusion_step(state, sample, car, noise, dt, out):
    """One sample of the fusion; `out` ``(3,)`` gets beta, its spread and NaN."""
    if run_members(state, sample, car, noise, dt, out):
        return
    first, second = 1.0 / state.kinematic_out[at.BETA_STD] ** 2, 1.0 / state.dynamic_out[at.BETA_STD] ** 2
    share = first / (first + second)
    apart = state.kinematic_out[at.BETA] - state.dynamic_out[at.BETA]
    out[at.BETA] = state.dynamic_out[at.BETA] + share * apart
    out[at.BETA_STD] = math.sqrt(2.0 / (first + second) + share * (1.0 - share) * apart * apart)
    out[at.NIS] = math.nan


@kernel
def fuzzy_run(state, samples, car, noise, dt, out):
    """All samples of the fuzzy blend."""
    for k in range(samples.shape[0]):
        fuzzy_step(state, samples[k], car, noise, dt, out[k])


@kernel
def fusion_run(state, samples, car, noise, dt, out):
    """All samples of the fusion."""
    for k in range(samples.shape[0]):
        fusion_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class _Blend(KernelFilter):
    def make_state(self) -> Any:
        """Make both members before the first sample."""
        kinematic = kinematic_state(self.noise.kinematic)
        return Members(kinematic, gaussian(), np.zeros(3), np.zeros(3), np.full(3, np.nan))


@dataclass(frozen=True)
class FuzzyBlend(_Blend):
    """Fuzzy blend of a kinematic and a dynamic filter."""

    noise: FuzzyNoise = FuzzyNoise()

    divisors = (*KinematicKF.divisors, "memory")
    run_kernel = staticmethod(fuzzy_run)
    extras = ("steady_state_index [-]",)


@dataclass(frozen=True)
class CovarianceFusion(_Blend):
    """Covariance-weighted fusion of a kinematic and a dynamic filter."""

    noise: FusionNoise = FusionNoise()

    divisors = KinematicKF.divisors
    run_kernel = staticmethod(fusion_run)

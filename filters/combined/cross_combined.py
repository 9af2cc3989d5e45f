"""Cross-combination of a kinematic Kalman filter and an unscented filter on the planar model.

The kinematic filter has the say where speed and yaw rate are far from zero, as only there its vy is
observable; else the unscented filter has it (Villano et al. 2021; Atheupe 2023, section 1). The weight is a
product of two smooth steps, one over the yaw rate and one over the speed. Where the kinematic filter is
unobservable, the unscented filter's beta also corrects it, so that it enters the next turn from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into
from crosscomb.filters.base import below_gate
from crosscomb.filters.combined.blends import mix
from crosscomb.filters.kinematic.kf import (
    Kinematic,
    KinematicKF,
    KinematicNoise,
    kinematic_state,
    kinematic_step,
    velocity_update,
)
from crosscomb.filters.planar.shared import PlanarFilter, PlanarNoise
from crosscomb.filters.planar.ukf import SigmaPointState, SimpleUKF, sigma_point_step
from crosscomb.models.compiled import inlined, kernel


class CrossNoise(NamedTuple):
    """Settings of the cross-combination."""

    turning: float = 0.12  # yaw rate at which the weight of the kinematic filter is a half [rad/s]
    turning_width: float = 0.03  # [rad/s]
    moving: float = 6.0  # speed at which it is a half [m/s]
    moving_width: float = 1.0  # [m/s]
    support: float = 0.01  # error of the unscented beta as a measurement, counted once per second [rad]
    kinematic: KinematicNoise = KinematicNoise()
    dynamic: PlanarNoise = PlanarNoise()


class Crossed(NamedTuple):
    """State of the cross-combination, changed in place by its kernel."""

    kinematic: Kinematic  # vx, vy and biases
    dynamic: SigmaPointState  # u, v, r
    kinematic_out: np.ndarray  # (3,)
    dynamic_out: np.ndarray  # (3,)


@inlined
def smooth_step(value):
    """Smooth step from 0 to 1."""
    return 1.0 / (1.0 + math.exp(-min(max(value, -60.0), 60.0)))


@inlined
def kinematic_share(sample, noise):
    """Weight of the kinematic filter; 0 where the yaw rate is not known."""
    if not math.isfinite(sample[at.YAW_RATE]):
        return 0.0
    turning = smooth_step((abs(sample[at.YAW_RATE]) - noise.turning) / noise.turning_width)
    return turning * smooth_step((sample[at.VX] - noise.moving) / noise.moving_width)


@inlined
def cross_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(4,)`` gets beta, its standard deviation, NaN and the kinematic share."""
    resting = state.kinematic.running[0] == 0 or below_gate(sample)
    kinematic_step(state.kinematic, sample, car, noise.kinematic, dt, state.kinematic_out)
    sigma_point_step(state.dynamic, sample, car, noise.dynamic, dt, state.dynamic_out)
    if resting:
        copy_into(out, state.dynamic_out)
        out[3] = 0.0
        return
    share = kinematic_share(sample, noise)
    mix(state.kinematic_out, state.dynamic_out, share, out)
    out[3] = share
    # The correction counts from the next sample on; its error lasts, so it counts once per second.
    mean = state.kinematic.mean
    variance = (noise.support * mean[0]) ** 2 / (dt * (1.0 - share + 1e-9))
    innovation = mean[0] * math.tan(state.dynamic_out[at.BETA]) - mean[1]
    velocity_update(state.kinematic, 0.0, 1.0, innovation, variance)


@kernel
def cross_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        cross_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class CrossCombinedUKF(PlanarFilter):
    """Kinematic Kalman filter and simple unscented filter, weighted by speed and yaw rate."""

    noise: CrossNoise = CrossNoise()  # type: ignore[assignment]

    divisors = (*KinematicKF.divisors, "turning", "turning_width", "moving_width")
    run_kernel = staticmethod(cross_run)
    extras = ("kinematic_share [-]",)

    def make_state(self) -> Any:
        """Make both members before the first sample."""
        return Crossed(
            kinematic_state(self.noise.kinematic),
            SimpleUKF(self.vehicle).make_state(),
            np.zeros(3),
            np.zeros(3),
        )

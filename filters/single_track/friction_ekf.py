"""Friction-adaptive extended Kalman filter: single track on Dugoff tyres, the friction a slow state.

State [yaw_rate, beta, friction]; measurements yaw rate and ay (Atheupe 2023, eq. 22 and 23, corrected;
adaptation as reviewed in Chindamo 2018, section 2). Dugoff's force does not depend on the friction until the
tyre leaves the linear part of its curve, so only hard cornering tells about it; below that the friction keeps
its value and its doubt. Friction is never below the lateral acceleration plainly in use (Atheupe 2023, eq.
30).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.leading import consider_update, propagate_leading
from crosscomb.filters.base import KernelFilter, bounded_slip, joined_nis, starting
from crosscomb.filters.single_track.adaptation import TyreCar, excited, growth
from crosscomb.filters.single_track.shared import (
    ay_variance,
    motion_noise,
    parameter_rates_at,
    start_doubt,
    start_motion,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.parameter_track import BY_BETA, BY_PARAMETER, BY_YAW_RATE, LATERAL, LAWS, SLOPES_SHAPE
from crosscomb.models.single_track import single_track, stable_substeps
from crosscomb.signals import GRAVITY

BY_STATE = (BY_YAW_RATE, BY_BETA, BY_PARAMETER)
"""Columns of the slopes in the order of the state."""

LEAST_FRICTION, MOST_FRICTION = 0.08, 1.5
"""Wet ice and a racing slick: the friction stays between them; a file may say more."""


class FrictionNoise(NamedTuple):
    """Noise settings of the friction-adaptive filter; process densities, so that they hold at every rate."""

    yaw_acceleration: float = 0.6  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.02  # model error [rad/s per sqrt(Hz)]
    friction_walk: float = 0.03  # change of the friction while cornering [per sqrt(s)]
    friction_spread: float = 0.2  # standard deviation of the vehicle file's friction, and the largest
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 2.0  # measured ay, with bank and what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]
    adapt_ay: float = 1.0  # friction adapts above this measured |ay| [m/s^2]
    adapt_speed: float = 6.0  # and above this speed [m/s]


class FrictionState(NamedTuple):
    """Estimate and scratch, changed in place by the kernels."""

    mean: np.ndarray  # (3,) yaw rate, beta, friction
    cov: np.ndarray  # (3, 3)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    slopes: np.ndarray  # (3, 7)
    by: np.ndarray  # (4, 2)
    rows: np.ndarray  # (2, 3)
    work: np.ndarray  # (2, 3)
    vectors: np.ndarray  # (3, 3) measurement row and scratch


@inlined
def friction_predict(state, sample, car, noise, dt, adapting):
    """Predict over dt by Euler steps."""
    mean, cov, slopes, rows = state.mean, state.cov, state.slopes, state.rows
    of_yaw, of_both, of_slip = motion_noise(sample, car.track, noise)
    steps = stable_substeps(sample[at.VX], dt, car.track)
    h = dt / steps
    for _ in range(steps):
        yaw_acceleration, beta_rate, _ = parameter_rates_at(mean[0], mean[1], sample, car, mean[2:], state)
        for i in range(2):
            for j in range(3):
                rows[i, j] = h * slopes[i, BY_STATE[j]]
            rows[i, i] += 1.0
        propagate_leading(cov, rows, state.work)
        cov[0, 0] += of_yaw * h
        cov[1, 1] += of_slip * h
        cov[0, 1] += of_both * h
        cov[1, 0] = cov[0, 1]
        mean[0] += h * yaw_acceleration
        mean[1] = bounded_slip(mean[1] + h * beta_rate)
    if adapting:
        cov[2, 2] += growth(cov[2, 2], noise.friction_walk, noise.friction_spread, dt)


@inlined
def friction_update(state, sample, car, noise, free):
    """Update the first `free` states with yaw rate and ay, as far as they are there; give the NIS."""
    mean, cov, slopes = state.mean, state.cov, state.slopes
    row, gain, crossed = state.vectors[0], state.vectors[1], state.vectors[2]
    yaw_rate, beta, friction = mean[0], mean[1], mean[2]
    _, _, expected = parameter_rates_at(yaw_rate, beta, sample, car, mean[2:], state)
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        row[0], row[1], row[2] = 1.0, 0.0, 0.0
        nis = consider_update(
            mean, cov, row, sample[at.YAW_RATE] - yaw_rate, noise.yaw_rate**2, free, gain, crossed
        )
    if math.isfinite(sample[at.AY]):
        for j in range(3):
            row[j] = slopes[LATERAL, BY_STATE[j]]
        expected += row[0] * (mean[0] - yaw_rate) + row[1] * (mean[1] - beta) + row[2] * (mean[2] - friction)
        variance = ay_variance(sample, car.track, noise)
        part = consider_update(mean, cov, row, sample[at.AY] - expected, variance, free, gain, crossed)
        nis = joined_nis(nis, part)
    mean[1] = bounded_slip(mean[1])
    return nis


@inlined
def friction_bounds(state, sample, car, adapting):
    """Keep the friction in its bounds; gyro and accelerometer must agree before the least friction rises."""
    used = min(abs(sample[at.AY]), abs(sample[at.YAW_RATE]) * sample[at.VX]) / GRAVITY if adapting else 0.0
    most = max(MOST_FRICTION, car.track.friction)
    state.mean[2] = min(max(state.mean[2], used, LEAST_FRICTION), most)


@inlined
def friction_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(4,)`` gets beta, its standard deviation, the NIS and the friction."""
    mean, cov = state.mean, state.cov
    if starting(state.running, sample, car.track, out):
        start_motion(mean, sample, out)
        start_doubt(cov, noise, out)
    else:
        adapting = excited(sample, noise)
        friction_predict(state, sample, car, noise, dt, adapting)
        out[at.NIS] = friction_update(state, sample, car, noise, 3 if adapting else 2)
        friction_bounds(state, sample, car, adapting)
        out[at.BETA] = mean[1]
        out[at.BETA_STD] = math.sqrt(cov[1, 1])
    out[3] = mean[2]


@kernel
def friction_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        friction_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class FrictionAdaptiveEKF(KernelFilter):
    """Extended Kalman filter that learns the friction."""

    noise: FrictionNoise = FrictionNoise()

    run_kernel = staticmethod(friction_run)
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": ("dugoff",)}
    extras: ClassVar[tuple[str, ...]] = ("friction [-]",)

    @cached_property
    def car(self) -> Any:
        """The car and its tyre law."""
        return TyreCar(single_track(self.vehicle, self.tyre), LAWS[self.tyre])

    def make_state(self) -> FrictionState:
        """Make the kernels' state before the first sample."""
        return FrictionState(
            mean=np.array([0.0, 0.0, self.vehicle.friction]),
            cov=np.diag([0.0, 0.0, self.noise.friction_spread**2]),
            running=np.zeros(1, dtype=np.int64),
            slopes=np.zeros(SLOPES_SHAPE),
            by=np.zeros((4, 2)),
            rows=np.zeros((2, 3)),
            work=np.zeros((2, 3)),
            vectors=np.zeros((3, 3)),
        )

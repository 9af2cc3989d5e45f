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
from crosscomb.filters.base import MAX_BETA, KernelFilter, below_gate, low_speed_answer
from crosscomb.filters.single_track.adaptation import TyreCar, excited, growth
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.parameter_track import (
    BETA_RATE,
    BY_BETA,
    BY_PARAMETER,
    BY_YAW_RATE,
    LATERAL,
    LAWS,
    SLOPES_SHAPE,
    YAW_ACCELERATION,
    parameter_track_rates,
)
from crosscomb.models.single_track import single_track, stable_substeps
from crosscomb.signals import GRAVITY

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
def friction_rates(state, sample, car):
    """Rates and ay at the estimate; fills `state.slopes`."""
    ax = sample[at.AX] if math.isfinite(sample[at.AX]) else 0.0
    ay = sample[at.AY] if math.isfinite(sample[at.AY]) else 0.0
    return parameter_track_rates(
        state.mean[0], state.mean[1], sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], sample[at.FXF],
        sample[at.FXR], ax, ay, car.law, state.mean[2:], car.track, state.by, state.slopes,
    )  # fmt: skip


@inlined
def friction_predict(state, sample, car, noise, dt, adapting):
    """Predict over dt by Euler steps."""
    mean, cov, slopes, rows = state.mean, state.cov, state.slopes, state.rows
    wrong_force = noise.missing_steer * sample[at.STEER_HELD] * car.track.stiffness_front
    wrong_yaw = wrong_force * car.track.a / car.track.yaw_inertia
    wrong_slip = wrong_force / (car.track.mass * sample[at.VX])
    steps = stable_substeps(sample[at.VX], dt, car.track)
    h = dt / steps
    for _ in range(steps):
        beta_rate, yaw_acceleration, _ = friction_rates(state, sample, car)
        rows[0, 0], rows[0, 1] = (
            1.0 + h * slopes[YAW_ACCELERATION, BY_YAW_RATE],
            h * slopes[YAW_ACCELERATION, BY_BETA],
        )
        rows[1, 0], rows[1, 1] = h * slopes[BETA_RATE, BY_YAW_RATE], 1.0 + h * slopes[BETA_RATE, BY_BETA]
        rows[0, 2] = h * slopes[YAW_ACCELERATION, BY_PARAMETER]
        rows[1, 2] = h * slopes[BETA_RATE, BY_PARAMETER]
        propagate_leading(cov, rows, state.work)
        cov[0, 0] += (noise.yaw_acceleration**2 + wrong_yaw**2) * h
        cov[1, 1] += (noise.slip_rate**2 + wrong_slip**2) * h
        cov[0, 1] += wrong_yaw * wrong_slip * h
        cov[1, 0] = cov[0, 1]
        mean[0] += h * yaw_acceleration
        mean[1] = min(max(mean[1] + h * beta_rate, -MAX_BETA), MAX_BETA)
    if adapting:
        cov[2, 2] += growth(cov[2, 2], noise.friction_walk, noise.friction_spread, dt)


@inlined
def friction_update(state, sample, car, noise, free):
    """Update the first `free` states with yaw rate and ay, as far as they are there; give the NIS."""
    mean, cov, slopes = state.mean, state.cov, state.slopes
    row, gain, crossed = state.vectors[0], state.vectors[1], state.vectors[2]
    yaw_rate, beta, friction = mean[0], mean[1], mean[2]
    _, _, expected = friction_rates(state, sample, car)
    wrong_ay = noise.missing_steer * sample[at.STEER_HELD] * car.track.stiffness_front / car.track.mass
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        row[0], row[1], row[2] = 1.0, 0.0, 0.0
        nis = consider_update(
            mean, cov, row, sample[at.YAW_RATE] - yaw_rate, noise.yaw_rate**2, free, gain, crossed
        )
    if math.isfinite(sample[at.AY]):
        row[0], row[1] = slopes[LATERAL, BY_YAW_RATE], slopes[LATERAL, BY_BETA]
        row[2] = slopes[LATERAL, BY_PARAMETER]
        expected += row[0] * (mean[0] - yaw_rate) + row[1] * (mean[1] - beta) + row[2] * (mean[2] - friction)
        variance = noise.ay**2 + wrong_ay**2
        part = consider_update(mean, cov, row, sample[at.AY] - expected, variance, free, gain, crossed)
        nis = part if math.isnan(nis) else nis + part
    mean[1] = min(max(mean[1], -MAX_BETA), MAX_BETA)
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
    if below_gate(sample) or state.running[0] == 0:
        low_speed_answer(sample, car.track, out)
        mean[0] = sample[at.YAW_RATE] if math.isfinite(sample[at.YAW_RATE]) else 0.0
        mean[1] = out[at.BETA]
        cov[:2, :] = 0.0
        cov[:, :2] = 0.0
        cov[0, 0], cov[1, 1] = noise.yaw_rate**2, out[at.BETA_STD] ** 2
        state.running[0] = 0 if below_gate(sample) else 1
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

    step_kernel = staticmethod(friction_step)
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

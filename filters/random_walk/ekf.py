"""Random-walk extended Kalman filter on the single track: the axle forces are states that only noise drives.

State [yaw_rate, beta, fxf, fxr, fyf, fyr]; measurements yaw rate, ax and ay (Atheupe 2023, eq. 29 and 23,
corrected). Needs neither friction nor tyre law for the forces, which it gives as further outputs.

What the measurements cannot tell is settled softly. beta enters none of them, so alone it drifts: a
pseudo-measurement `slip_from` ties it to the linear rear tyre, beta = steer_rear - fyr / stiffness + b
yaw_rate / vx, or to rolling without tyre slip; doubt about it grows with the friction in use, where tyres are
no longer linear. And ax tells only the sum of fxf and fxr: their difference is taken from the wheel torques
or from the axle loads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into
from crosscomb.filters.algebra.leading import consider_update, propagate_leading
from crosscomb.filters.base import (
    KernelFilter,
    bounded_slip,
    joined_nis,
    or_zero,
    starting,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.random_walk import random_walk_jacobian
from crosscomb.models.single_track import SingleTrack, single_track
from crosscomb.signals import GRAVITY

FREE = 0
LINEAR = 1
GEOMETRIC = 2

SLIP_SOURCES = {"linear": LINEAR, "geometric": GEOMETRIC, "free": FREE}
"""What beta is softly tied to: the linear rear tyre, rolling without slip, or nothing."""

LATERAL_FORCE, YAW_MOMENT, FRICTION_USE = range(3, 6)
"""Columns of the further outputs."""

FORCE_EXTRAS = ("lateral_force [N]", "yaw_moment [N m]", "friction_use [-]")

MAX_FORCE = 3.0
"""Axle forces stay within this many weights of the car."""


class WalkNoise(NamedTuple):
    """Noise settings of the random-walk filter; process densities, so that they hold at every rate."""

    force: float = 3.0  # random walk of an axle force over the mass [m/s^2 per sqrt(s)]
    yaw_acceleration: float = 0.3  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.015  # model error, sensor bias and bank included [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    accel: float = 0.5  # measured ax and ay [m/s^2]
    split: float = 1.0  # difference of the longitudinal axle forces over the mass [m/s^2]
    slip: float = 0.01  # pseudo-measurement of beta, counted once per second [rad]


class WalkCar(NamedTuple):
    """The car and what its beta is tied to."""

    track: SingleTrack
    slip_source: int


class WalkState(NamedTuple):
    """Estimate and scratch, changed in place by the kernels."""

    mean: np.ndarray  # (6,)
    cov: np.ndarray  # (6, 6)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    jacobian: np.ndarray  # (4, 6)
    rows: np.ndarray  # (2, 6)
    work: np.ndarray  # (2, 6)
    vectors: np.ndarray  # (3, 6) measurement row and scratch


@inlined
def walk_start(state, sample, beta, beta_std, car, noise):
    """Start from the rolling answer, with the forces that the accelerations ask for."""
    mean, cov, track = state.mean, state.cov, car.track
    ay = or_zero(sample[at.AY])
    mean[0] = or_zero(sample[at.YAW_RATE])
    mean[1] = beta
    mean[2], mean[3] = sample[at.FXF], sample[at.FXR]
    share = track.b / (track.a + track.b)
    mean[4], mean[5] = share * track.mass * ay, (1.0 - share) * track.mass * ay
    cov[:] = 0.0
    cov[0, 0], cov[1, 1] = noise.yaw_rate**2, beta_std**2
    for i in range(2, 6):
        cov[i, i] = track.mass**2
    # Its rows of yaw acceleration, ax and ay do not depend on the speed, which may be 0 here.
    random_walk_jacobian(mean, 1.0, sample[at.STEER], sample[at.STEER_REAR], track, state.jacobian)


@inlined
def walk_predict(state, sample, car, noise, dt):
    """Predict yaw rate and beta over dt in one Euler step: without tyres nothing is stiff."""
    mean, cov, jacobian, rows = state.mean, state.cov, state.jacobian, state.rows
    vx, steer, steer_rear = sample[at.VX], sample[at.STEER], sample[at.STEER_REAR]
    yaw_acceleration, beta_rate, _, _ = random_walk_jacobian(mean, vx, steer, steer_rear, car.track, jacobian)
    for i in range(2):
        for j in range(6):
            rows[i, j] = dt * jacobian[i, j]
        rows[i, i] += 1.0
    propagate_leading(cov, rows, state.work)
    cov[0, 0] += noise.yaw_acceleration**2 * dt
    cov[1, 1] += noise.slip_rate**2 * dt
    for i in range(2, 6):
        cov[i, i] += (noise.force * car.track.mass) ** 2 * dt
    mean[0] += dt * yaw_acceleration
    mean[1] += dt * beta_rate
    walk_bounds(mean, car)


@inlined
def walk_bounds(mean, car):
    """Hold the states in what a car can do."""
    most = MAX_FORCE * car.track.mass * GRAVITY
    mean[0] = min(max(mean[0], -10.0), 10.0)
    mean[1] = bounded_slip(mean[1])
    for i in range(2, 6):
        mean[i] = min(max(mean[i], -most), most)


@inlined
def walk_measure(state, measured, variance):
    """Update with a measurement that is linear in the state, its row in `state.vectors`; give the NIS."""
    mean, row = state.mean, state.vectors[0]
    innovation = measured
    for j in range(6):
        innovation -= row[j] * mean[j]
    return consider_update(mean, state.cov, row, innovation, variance, 6, state.vectors[1], state.vectors[2])


@inlined
def walk_update(state, sample, car, noise, dt):
    """Update with the measurements that are there, then with the soft ties; give the NIS of the former."""
    row, jacobian, mass = state.vectors[0], state.jacobian, car.track.mass
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        row[:] = 0.0
        row[0] = 1.0
        nis = walk_measure(state, sample[at.YAW_RATE], noise.yaw_rate**2)
    # ax and ay are linear in the forces, so their rows do not depend on the estimate.
    for measured, i in ((sample[at.AX], 2), (sample[at.AY], 3)):
        if math.isfinite(measured):
            copy_into(row, jacobian[i])
            part = walk_measure(state, measured, noise.accel**2)
            nis = joined_nis(nis, part)
    row[:] = 0.0
    row[2], row[3] = 1.0, -1.0
    walk_measure(state, sample[at.FXF] - sample[at.FXR], (noise.split * mass) ** 2)
    tie_slip(state, sample, car, noise, dt)
    walk_bounds(state.mean, car)
    return nis


@inlined
def tie_slip(state, sample, car, noise, dt):
    """Update beta with its pseudo-measurement; its error lasts, so it counts once per second."""
    mean, row, track = state.mean, state.vectors[0], car.track
    if car.slip_source == FREE:
        return
    row[:] = 0.0
    row[1] = 1.0
    if car.slip_source == GEOMETRIC:
        rolling = slip_of_rolling_rear(sample[at.STEER], sample[at.STEER_REAR], track.a, track.b)
        walk_measure(state, rolling, noise.slip**2 / dt)
        return
    doubt = noise.slip + abs(mean[5]) / track.stiffness_rear * friction_use(mean[0], sample[at.VX], track)
    row[0], row[5] = -track.b / sample[at.VX], 1.0 / track.stiffness_rear
    walk_measure(state, sample[at.STEER_REAR], doubt**2 / dt)


@inlined
def friction_use(yaw_rate, vx, track):
    """Lateral acceleration over its bound, Atheupe 2023, eq. 30; above 1 the friction is not the file's."""
    return abs(yaw_rate) * vx / (track.friction * GRAVITY)


@inlined
def walk_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(6,)`` gets beta, its standard deviation, the NIS and the further outputs."""
    mean, cov, track = state.mean, state.cov, car.track
    if starting(state.running, sample, track, out):
        walk_start(state, sample, out[at.BETA], out[at.BETA_STD], car, noise)
    else:
        walk_predict(state, sample, car, noise, dt)
        out[at.NIS] = walk_update(state, sample, car, noise, dt)
        out[at.BETA] = mean[1]
        out[at.BETA_STD] = math.sqrt(cov[1, 1])
    yaw_acceleration, ay = 0.0, 0.0
    for j in range(2, 6):
        yaw_acceleration += state.jacobian[0, j] * mean[j]
        ay += state.jacobian[3, j] * mean[j]
    out[LATERAL_FORCE] = track.mass * ay
    out[YAW_MOMENT] = track.yaw_inertia * yaw_acceleration
    out[FRICTION_USE] = friction_use(mean[0], max(sample[at.VX], 0.0), track)


@kernel
def walk_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        walk_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class RandomWalkEKF(KernelFilter):
    """Random-walk extended Kalman filter of one vehicle; `slip_from` is a key of `SLIP_SOURCES`."""

    noise: WalkNoise = WalkNoise()
    tyre: str = "linear"
    slip_from: str = "linear"

    divisors = (*KernelFilter.divisors, "slip", "split")
    run_kernel = staticmethod(walk_run)
    choices: ClassVar = {"tyre": ("linear",), "slip_from": tuple(SLIP_SOURCES)}
    extras = FORCE_EXTRAS

    @cached_property
    def car(self) -> Any:
        """The car and what its beta is tied to."""
        return WalkCar(single_track(self.vehicle, self.tyre), SLIP_SOURCES[self.slip_from])

    def make_state(self) -> WalkState:
        """Make the kernels' state before the first sample."""
        return WalkState(
            mean=np.zeros(6),
            cov=np.eye(6),
            running=np.zeros(1, dtype=np.int64),
            jacobian=np.zeros((4, 6)),
            rows=np.zeros((2, 6)),
            work=np.zeros((2, 6)),
            vectors=np.zeros((3, 6)),
        )

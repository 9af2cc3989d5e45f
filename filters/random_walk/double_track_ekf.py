"""Random-walk extended Kalman filter on the double track: EKF+RW of Pieralice 2018.

State [u, v, r, Y11, Y12, Y21, Y22]: velocity along and across the car, yaw rate, and the lateral forces of
the front left, front right, rear left and rear right wheel, which only noise drives (eq. 1 with Y_dot = 0).
Measured are u and r as in the paper (`measured` = u_r), and ay as well unless that is chosen. `yaw_moment` =
zero adds the paper's pseudo-measurement of no yaw moment, right in slow manoeuvres only.

What the measurements cannot tell is settled softly: beta by `slip_from`, as in
`crosscomb.filters.random_walk.ekf`; left against right by giving the two wheels of an axle one noise, shared
like their grip. The longitudinal forces are known, from the wheel torques or from ax, with even shares left
and right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.leading import consider_update, propagate_leading
from crosscomb.filters.base import (
    MAX_BETA,
    KernelFilter,
    joined_nis,
    or_zero,
    starting,
)
from crosscomb.filters.random_walk.ekf import (
    FORCE_EXTRAS,
    FREE,
    FRICTION_USE,
    GEOMETRIC,
    LATERAL_FORCE,
    MAX_FORCE,
    SLIP_SOURCES,
    YAW_MOMENT,
    friction_use,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.planar import (
    COS,
    PEAK,
    SIDE_ARM,
    SIN,
    Contacts,
    PlanarCar,
    contacts,
    planar_car,
    set_contacts,
)
from crosscomb.models.single_track import SingleTrack, single_track
from crosscomb.signals import GRAVITY, MIN_SPEED

FREELY, ZERO = range(2)
YAW_MOMENTS = {"free": FREELY, "zero": ZERO}

U_R, U_R_AY = range(2)
MEASURED = {"u_r_ay": U_R_AY, "u_r": U_R}

MAX_RATIO = math.tan(MAX_BETA)


class DoubleWalkNoise(NamedTuple):
    """Noise settings of the double-track filter; process densities, so that they hold at every rate."""

    force: float = 3.0  # random walk of the lateral force of an axle over the mass [m/s^2 per sqrt(s)]
    accel: float = 0.4  # error of the known forces, bank and slope included [m/s^2 per sqrt(Hz)]
    yaw_acceleration: float = 0.3  # model error [rad/s^2 per sqrt(Hz)]
    speed: float = 0.1  # measured u [m/s]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 0.5  # measured ay [m/s^2]
    yaw_moment: float = 0.1  # yaw acceleration that the zero moment leaves, counted once per second [rad/s^2]
    slip: float = 0.01  # pseudo-measurement of beta, counted once per second [rad]


class DoubleWalkCar(NamedTuple):
    """The car, what its beta is tied to, and what is measured."""

    planar: PlanarCar
    track: SingleTrack
    slip_source: int
    yaw_moment: int
    measured: int


class DoubleWalkState(NamedTuple):
    """Estimate and scratch, changed in place by the kernels."""

    mean: np.ndarray  # (7,)
    cov: np.ndarray  # (7, 7)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    contact: Contacts
    rows: np.ndarray  # (3, 7)
    work: np.ndarray  # (3, 7)
    vectors: np.ndarray  # (3, 7) measurement row and scratch


@inlined
def double_walk_forces(mean, contact):
    """Sum of the forces along and across the car [N] and their moment [N m]."""
    x, y, moment = contact.known[0], contact.known[1], contact.known[2]
    for i in range(4):
        force = mean[3 + i]
        x -= force * contact.wheels[i, SIN]
        y += force * contact.wheels[i, COS]
        moment += force * contact.wheels[i, SIDE_ARM]
    return x, y, moment


@inlined
def double_walk_start(state, sample, beta, beta_std, car, noise):
    """Start from the rolling answer without lateral forces."""
    mean, cov = state.mean, state.cov
    mean[:] = 0.0
    mean[0] = max(sample[at.VX], MIN_SPEED)
    mean[1] = mean[0] * math.tan(beta)
    mean[2] = or_zero(sample[at.YAW_RATE])
    cov[:] = 0.0
    cov[0, 0], cov[1, 1], cov[2, 2] = noise.speed**2, (mean[0] * beta_std) ** 2, noise.yaw_rate**2
    share_axle_noise(cov, state.contact.wheels, car.planar.mass**2)


@inlined
def share_axle_noise(cov, wheels, variance):
    """Add noise of this variance [N^2] to the force of each axle, shared by its wheels like their grip."""
    for left in (0, 2):
        share = wheels[left, PEAK] / (wheels[left, PEAK] + wheels[left + 1, PEAK])
        i, j = 3 + left, 4 + left
        cov[i, i] += share * share * variance
        cov[j, j] += (1.0 - share) * (1.0 - share) * variance
        cov[i, j] += share * (1.0 - share) * variance
        cov[j, i] = cov[i, j]


@inlined
def double_walk_predict(state, car, noise, dt):
    """Predict u, v and r over dt in one Euler step: without tyres nothing is stiff."""
    mean, cov, rows, wheels = state.mean, state.cov, state.rows, state.contact.wheels
    mass, inertia = car.planar.mass, car.planar.yaw_inertia
    u, v, r = mean[0], mean[1], mean[2]
    x, y, moment = double_walk_forces(mean, state.contact)
    rows[0, 0], rows[0, 1], rows[0, 2] = 1.0, dt * r, dt * v
    rows[1, 0], rows[1, 1], rows[1, 2] = -dt * r, 1.0, -dt * u
    rows[2, 2] = 1.0
    for i in range(4):
        rows[0, 3 + i] = -dt * wheels[i, SIN] / mass
        rows[1, 3 + i] = dt * wheels[i, COS] / mass
        rows[2, 3 + i] = dt * wheels[i, SIDE_ARM] / inertia
    propagate_leading(cov, rows, state.work)
    cov[0, 0] += noise.accel**2 * dt
    cov[1, 1] += noise.accel**2 * dt
    cov[2, 2] += noise.yaw_acceleration**2 * dt
    share_axle_noise(cov, wheels, (noise.force * mass) ** 2 * dt)
    mean[0] += dt * (v * r + x / mass)
    mean[1] += dt * (-u * r + y / mass)
    mean[2] += dt * moment / inertia
    double_walk_bounds(mean, car)


@inlined
def double_walk_bounds(mean, car):
    """Hold the states in what a car can do."""
    most = MAX_FORCE * car.planar.mass * GRAVITY
    mean[0] = max(mean[0], MIN_SPEED)
    mean[1] = min(max(mean[1], -MAX_RATIO * mean[0]), MAX_RATIO * mean[0])
    mean[2] = min(max(mean[2], -10.0), 10.0)
    for i in range(3, 7):
        mean[i] = min(max(mean[i], -most), most)


@inlined
def double_walk_measure(state, innovation, variance):
    """Update with a measurement whose row is in `state.vectors`; give the NIS."""
    vectors = state.vectors
    return consider_update(state.mean, state.cov, vectors[0], innovation, variance, 7, vectors[1], vectors[2])


@inlined
def double_walk_update(state, sample, car, noise, dt):
    """Update with the measurements that are there, then with the soft ties; give the NIS of the former."""
    mean, row, wheels = state.mean, state.vectors[0], state.contact.wheels
    nis = math.nan
    if sample[at.VX_HELD] == 0.0:
        row[:] = 0.0
        row[0] = 1.0
        nis = double_walk_measure(state, sample[at.VX] - mean[0], noise.speed**2)
    if math.isfinite(sample[at.YAW_RATE]):
        row[:] = 0.0
        row[2] = 1.0
        part = double_walk_measure(state, sample[at.YAW_RATE] - mean[2], noise.yaw_rate**2)
        nis = joined_nis(nis, part)
    if car.measured == U_R_AY and math.isfinite(sample[at.AY]):
        row[:] = 0.0
        for i in range(4):
            row[3 + i] = wheels[i, COS] / car.planar.mass
        _, y, _ = double_walk_forces(mean, state.contact)
        part = double_walk_measure(state, sample[at.AY] - y / car.planar.mass, noise.ay**2)
        nis = joined_nis(nis, part)
    if car.yaw_moment == ZERO:
        row[:] = 0.0
        for i in range(4):
            row[3 + i] = wheels[i, SIDE_ARM] / car.planar.yaw_inertia
        _, _, moment = double_walk_forces(mean, state.contact)
        double_walk_measure(state, -moment / car.planar.yaw_inertia, noise.yaw_moment**2 / dt)
    tie_velocity(state, sample, car, noise, dt)
    double_walk_bounds(mean, car)
    return nis


@inlined
def tie_velocity(state, sample, car, noise, dt):
    """Update v / u with its pseudo-measurement; its error lasts, so it counts once per second."""
    mean, row, track = state.mean, state.vectors[0], car.track
    if car.slip_source == FREE:
        return
    u, v, r = mean[0], mean[1], mean[2]
    row[:] = 0.0
    row[1] = 1.0 / u
    if car.slip_source == GEOMETRIC:
        row[0] = -v / (u * u)
        rolling = slip_of_rolling_rear(sample[at.STEER], sample[at.STEER_REAR], track.a, track.b)
        double_walk_measure(state, math.tan(rolling) - v / u, noise.slip**2 / dt)
        return
    slip = (mean[5] + mean[6]) / track.stiffness_rear
    doubt = noise.slip + abs(slip) * friction_use(r, u, track)
    row[0], row[2] = (track.b * r - v) / (u * u), -track.b / u
    row[5] = row[6] = 1.0 / track.stiffness_rear
    double_walk_measure(state, sample[at.STEER_REAR] - slip + (track.b * r - v) / u, doubt**2 / dt)


@inlined
def double_walk_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(6,)`` gets beta, its standard deviation, the NIS and the further outputs."""
    mean, cov = state.mean, state.cov
    ax = or_zero(sample[at.AX])
    ay = or_zero(sample[at.AY])
    set_contacts(
        state.contact,
        sample[at.STEER],
        sample[at.STEER_REAR],
        sample[at.FXF],
        sample[at.FXR],
        ax,
        ay,
        car.planar,
    )
    if starting(state.running, sample, car.track, out):
        double_walk_start(state, sample, out[at.BETA], out[at.BETA_STD], car, noise)
    else:
        double_walk_predict(state, car, noise, dt)
        out[at.NIS] = double_walk_update(state, sample, car, noise, dt)
        u, v = mean[0], mean[1]
        out[at.BETA] = math.atan2(v, u)
        spread = v * v * cov[0, 0] - 2.0 * u * v * cov[0, 1] + u * u * cov[1, 1]
        out[at.BETA_STD] = math.sqrt(spread) / (u * u + v * v)
    _, y, moment = double_walk_forces(mean, state.contact)
    out[LATERAL_FORCE], out[YAW_MOMENT] = y, moment
    out[FRICTION_USE] = friction_use(mean[2], mean[0], car.track)


@kernel
def double_walk_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        double_walk_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class DoubleTrackRandomWalkEKF(KernelFilter):
    """EKF+RW of one vehicle; settings as keys of `SLIP_SOURCES`, `YAW_MOMENTS` and `MEASURED`."""

    noise: DoubleWalkNoise = DoubleWalkNoise()
    tyre: str = "linear"
    slip_from: str = "linear"
    yaw_moment: str = "free"
    measured: str = "u_r_ay"

    divisors = (*KernelFilter.divisors, "slip", "yaw_moment")
    run_kernel = staticmethod(double_walk_run)
    choices: ClassVar = {
        "tyre": ("linear",),
        "slip_from": tuple(SLIP_SOURCES),
        "yaw_moment": tuple(YAW_MOMENTS),
        "measured": tuple(MEASURED),
    }
    extras = FORCE_EXTRAS

    @cached_property
    def car(self) -> Any:
        """The car and the settings as the kernels take them."""
        return DoubleWalkCar(
            planar_car(self.vehicle, "double"),
            single_track(self.vehicle, self.tyre),
            SLIP_SOURCES[self.slip_from],
            YAW_MOMENTS[self.yaw_moment],
            MEASURED[self.measured],
        )

    def make_state(self) -> DoubleWalkState:
        """Make the kernels' state before the first sample."""
        return DoubleWalkState(
            mean=np.zeros(7),
            cov=np.eye(7),
            running=np.zeros(1, dtype=np.int64),
            contact=contacts(),
            rows=np.zeros((3, 7)),
            work=np.zeros((3, 7)),
            vectors=np.zeros((3, 7)),
        )

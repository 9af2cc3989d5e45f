"""What all filters on the planar model share: state [u, v, r], measurements, noise, start and answer.

Measurements, each skipped where missing (D'Inverno 2021, eq. 13 and 16, corrected):

    rolling speed of the front left and right wheel   u cos d + v sin d + r (a sin d -/+ t/2 cos d)
    yaw rate, ay, ax                                  r, Y / m, X / m
    vx, only where there is no wheel speed            u

The log holds wheel speeds in m/s, so the printed rolling radius drops out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

from crosscomb.filters import columns as at
from crosscomb.filters.base import MAX_BETA, KernelFilter, or_zero, starting
from crosscomb.filters.single_track.shared import ay_variance, wrong_front_force
from crosscomb.models.compiled import inlined
from crosscomb.models.planar import TRACKS, PlanarCar, planar_car, planar_rates, set_contacts
from crosscomb.models.single_track import stable_substeps
from crosscomb.signals import MIN_SPEED

MEASUREMENTS = 6
Z_LEFT, Z_RIGHT, Z_YAW_RATE, Z_AX, Z_AY, Z_U = range(MEASUREMENTS)
"""Measurements of a sample; ax and ay have the numbers of the answers of `planar_rates`."""

MAX_TANGENT = math.tan(MAX_BETA)
MAX_U = 150.0
"""Largest longitudinal speed of a state [m/s]."""
MAX_R = 10.0
"""Largest yaw rate of a state [rad/s]."""


class PlanarNoise(NamedTuple):
    """Noise of the planar filters; process densities, so that they hold at every rate."""

    u_rate: float = 0.5  # model error [m/s^2 per sqrt(Hz)]
    v_rate: float = 0.5  # model error [m/s^2 per sqrt(Hz)]
    yaw_acceleration: float = 0.6  # model error [rad/s^2 per sqrt(Hz)]
    wheel_speed: float = 0.3  # measured wheel speed, with its slip [m/s]
    speed: float = 0.3  # measured vx [m/s]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ax: float = 1.0  # measured ax, with what drive and brake forces get wrong [m/s^2]
    ay: float = 2.0  # measured ay, with what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]


@dataclass(frozen=True)
class PlanarFilter(KernelFilter):
    """A filter on the planar model of one vehicle, with `track` "single" or "double"."""

    noise: PlanarNoise = PlanarNoise()
    tyre: str = "pacejka"
    track: str = "single"

    choices: ClassVar = {"tyre": ("pacejka",), "track": TRACKS}

    @cached_property
    def car(self) -> PlanarCar:  # type: ignore[override]
        """Parameters as the kernels take them."""
        return planar_car(self.vehicle, self.track)


@inlined
def known_accelerations(sample):
    """Measured ax and ay [m/s^2], 0 where missing."""
    ax = or_zero(sample[at.AX])
    ay = or_zero(sample[at.AY])
    return ax, ay


@inlined
def set_sample(contact, sample, car):
    """Set the contacts (`crosscomb.models.planar.Contacts`) from a sample."""
    ax, ay = known_accelerations(sample)
    set_contacts(
        contact, sample[at.STEER], sample[at.STEER_REAR], sample[at.FXF], sample[at.FXR], ax, ay, car
    )


@inlined
def clip_state(mean):
    """Hold [u, v, r] where the model has a meaning."""
    mean[0] = min(max(mean[0], MIN_SPEED), MAX_U)
    limit = MAX_TANGENT * mean[0]
    mean[1] = min(max(mean[1], -limit), limit)
    mean[2] = min(max(mean[2], -MAX_R), MAX_R)


@inlined
def substeps(mean, dt, car):
    """Number of Euler steps that keep the stiff low-speed modes stable over dt."""
    return stable_substeps(max(mean[0], MIN_SPEED), dt, car)


@inlined
def planar_move(mean, contact, steps, dt, car):
    """Move one state ``(3,)`` over dt in place, by Euler steps."""
    h = dt / steps
    for _ in range(steps):
        u_dot, v_dot, r_dot, _, _ = planar_rates(mean[0], mean[1], mean[2], contact, car)
        mean[0] += h * u_dot
        mean[1] += h * v_dot
        mean[2] += h * r_dot
        clip_state(mean)


@inlined
def expect(state, ax, ay, contact, z):
    """Write what a state ``(3,)`` with accelerations ax and ay would measure into z ``(6,)``."""
    rows = contact.speed_rows
    for i in range(2):
        z[i] = rows[i, 0] * state[0] + rows[i, 1] * state[1] + rows[i, 2] * state[2]
    z[Z_YAW_RATE], z[Z_AX], z[Z_AY], z[Z_U] = state[2], ax, ay, state[0]


@inlined
def read_measurements(sample, car, noise, z, variance):
    """Write the sample's measurements into z ``(6,)``, NaN for a missing one, and their noise variances."""
    z[Z_LEFT], z[Z_RIGHT] = sample[at.VFL], sample[at.VFL + 1]
    z[Z_YAW_RATE], z[Z_AX], z[Z_AY], z[Z_U] = sample[at.YAW_RATE], sample[at.AX], sample[at.AY], math.nan
    if sample[at.VX_HELD] == 0.0 and not (math.isfinite(z[Z_LEFT]) or math.isfinite(z[Z_RIGHT])):
        z[Z_U] = sample[at.VX]
    variance[Z_LEFT] = variance[Z_RIGHT] = noise.wheel_speed**2
    variance[Z_YAW_RATE] = noise.yaw_rate**2
    variance[Z_AX] = noise.ax**2
    variance[Z_AY] = ay_variance(sample, car, noise)
    variance[Z_U] = noise.speed**2


@inlined
def set_process_noise(q, sample, car, noise, dt):
    """Write the process noise of dt into q ``(3, 3)``, with the error of a held steering angle."""
    wrong_force = wrong_front_force(sample, car, noise)
    wrong_v, wrong_r = wrong_force / car.mass, wrong_force * car.a / car.yaw_inertia
    q[:] = 0.0
    q[0, 0] = noise.u_rate**2 * dt
    q[1, 1] = (noise.v_rate**2 + wrong_v * wrong_v) * dt
    q[2, 2] = (noise.yaw_acceleration**2 + wrong_r * wrong_r) * dt
    q[1, 2] = q[2, 1] = wrong_v * wrong_r * dt


@inlined
def begin(mean, cov, running, sample, car, noise, out):
    """Answer below the gate, and start the filter at the first sample above it; tell whether that was all."""
    if not starting(running, sample, car, out):
        return False
    start(mean, cov, sample, out[at.BETA], out[at.BETA_STD], noise)
    return True


@inlined
def start(mean, cov, sample, beta, beta_std, noise):
    """Set mean and covariance from one sample and a sideslip angle [rad] with its standard deviation."""
    mean[0], mean[1] = sample[at.VX], sample[at.VX] * math.tan(beta)
    mean[2] = or_zero(sample[at.YAW_RATE])
    cov[:] = 0.0
    cov[0, 0], cov[1, 1], cov[2, 2] = noise.speed**2, (sample[at.VX] * beta_std) ** 2, noise.yaw_rate**2


@inlined
def answer(mean, cov, out):
    """Write the sideslip angle of a state and its standard deviation."""
    u, v = mean[0], mean[1]
    out[at.BETA] = math.atan2(v, u)
    # beta = atan2(v, u): its gradient is [-v, u] / V^2
    spread = v * v * cov[0, 0] - 2.0 * u * v * cov[0, 1] + u * u * cov[1, 1]
    out[at.BETA_STD] = math.sqrt(max(spread, 0.0)) / (u * u + v * v)

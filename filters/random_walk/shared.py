"""What both random-walk particle filters share: noise, first guess and the EKF's beta as pseudo-measurement."""

from __future__ import annotations

import math
from typing import NamedTuple

from crosscomb.filters import columns as at
from crosscomb.filters.base import or_zero
from crosscomb.filters.single_track.ekf import DynamicNoise
from crosscomb.models.compiled import kernel


class ParticleNoise(NamedTuple):
    """Noise settings of the particle filter; process densities, so that they hold at every rate."""

    force: float = 2.0  # random walk of an axle force over the mass [m/s^2 per sqrt(s)]
    yaw_acceleration: float = 0.3  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.04  # model error, sensor bias and bank included [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.04  # measured yaw rate [rad/s]
    accel: float = 1.0  # measured ax and ay [m/s^2]
    pseudo: float = 0.012  # error of the EKF's beta beside the one it states, counted once per second [rad]
    ekf: DynamicNoise = DynamicNoise()  # of the EKF that gives the pseudo-measurement


FIRST_SPREAD = (0.2, math.radians(8.0), 2.0, 2.0, 2.0, 2.0)
"""Half width of the uniform first particles: yaw rate [rad/s], beta [rad], forces over the mass [m/s^2]."""

MOST_DOUBT = math.radians(1.5)
"""More of the EKF's own doubt does not count [rad]: in a gap of all channels nothing else holds the particles."""


@kernel
def sin_cos(angle):
    """Sine and cosine for |angle| <= `MAX_BETA`, by power series to 1e-11: inlines into vector instructions."""
    y = angle * angle
    sine = 1 - y * (1 / 156) * (1 - y * (1 / 210) * (1 - y * (1 / 272)))
    sine = 1 - y * (1 / 42) * (1 - y * (1 / 72) * (1 - y * (1 / 110) * sine))
    sine = 1 - y * (1 / 6) * (1 - y * (1 / 20) * sine)
    cosine = 1 - y * (1 / 132) * (1 - y * (1 / 182) * (1 - y * (1 / 240)))
    cosine = 1 - y * (1 / 30) * (1 - y * (1 / 56) * (1 - y * (1 / 90) * cosine))
    cosine = 1 - y * (1 / 2) * (1 - y * (1 / 12) * cosine)
    return angle * sine, cosine


@kernel
def first_guess(sample, beta, car):
    """State that beta and a sample's yaw rate, ay and longitudinal forces suggest."""
    yaw_rate = or_zero(sample[at.YAW_RATE])
    side = car.mass * or_zero(sample[at.AY])
    front = car.b / (car.a + car.b)
    return yaw_rate, beta, sample[at.FXF], sample[at.FXR], front * side, (1.0 - front) * side


@kernel
def slip_precision(beta_std, noise, dt):
    """Half the precision of the EKF's beta as a pseudo-measurement, with the EKF's own doubt beta_std [rad].

    The EKF's error lasts long, so its beta counts as one measurement per second, spread over the steps.
    """
    doubt = min(beta_std, MOST_DOUBT)
    return 0.5 * dt / (noise.pseudo**2 + doubt * doubt)

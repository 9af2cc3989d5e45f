"""Motion of the car as a rigid body: from the centre of gravity to any point of it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.models.compiled import kernel
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import MIN_SPEED

YAW_DRIFT = 0.5
"""How fast the yaw rate may move away from its last measured value while it is missing [rad/s^2]."""

MOST_YAW_DOUBT = 0.5
"""Doubt about a yaw rate that was never measured or not for long [rad/s]."""


class Motion(NamedTuple):
    """What turns beta into the velocity of any point of the car.

    Attributes
    ----------
    vx : (n,) or float [m/s]
        Of the centre of gravity; the last one while it is missing, 0 before the first.
    curvature : (n,) or float [1/m]
        Yaw rate over vx; the last yaw rate while it is missing. At low speed that of rolling without slip.
    curvature_std : (n,) or float [1/m]
        More than 0 while the yaw rate is missing.
    """

    vx: Any
    curvature: Any
    curvature_std: Any


class PointVelocity(NamedTuple):
    """Velocity of a point of the car, in the car's axes.

    Attributes
    ----------
    vx, vy : (n,) or float [m/s]
    beta, beta_std : (n,) or float [rad]
        Direction of the velocity and its standard deviation.
    """

    vx: Any
    vy: Any
    beta: Any
    beta_std: Any


def start_motion() -> np.ndarray:
    """Last yaw rate [rad/s] and the doubt about it [rad/s] ``(2,)``, before the first sample of a drive."""
    return np.array([0.0, MOST_YAW_DOUBT])


def motion_of(last: np.ndarray, samples: np.ndarray, vehicle: Vehicle, dt: float) -> Motion:
    """Motion at the next samples of a drive.

    Parameters
    ----------
    last : (2,)
        Changed in place.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    vehicle : Vehicle
    dt : float [s]
    """
    out = np.empty((3, len(samples)))
    _motion_run(last, samples, vehicle.wheelbase, dt, out)
    return Motion(*out)


@kernel
def _motion_run(last, samples, wheelbase, dt, out):
    for k in range(samples.shape[0]):
        sample, vx = samples[k], samples[k, at.VX]
        if math.isfinite(sample[at.YAW_RATE]):
            last[0], last[1] = sample[at.YAW_RATE], 0.0
        else:
            last[1] = min(last[1] + YAW_DRIFT * dt, MOST_YAW_DOUBT)
        out[0, k] = vx
        if vx > MIN_SPEED:
            out[1, k], out[2, k] = last[0] / vx, last[1] / vx
        else:
            # Finite at standstill; together with beta of rolling without slip this is exact for every point.
            out[1, k] = (math.tan(sample[at.STEER]) - math.tan(sample[at.STEER_REAR])) / wheelbase
            out[2, k] = 0.0


@kernel
def point_velocity(beta, beta_std, vx, curvature, curvature_std, x, y):
    """Velocity of a point: vx_p = vx - y r and vy_p = vy + x r, all over vx so that a standing car has an answer.

    Parameters
    ----------
    beta, beta_std : float [rad]
        Of the centre of gravity.
    vx : float [m/s]
    curvature, curvature_std : float [1/m]
    x, y : float [m]
        Place of the point ahead and to the left of the centre of gravity.

    Returns
    -------
    vx, vy : float [m/s]
    beta, beta_std : float [rad]
        The doubts about beta and about the yaw rate are independent and small.
    """
    tangent = math.tan(beta)
    along, across = 1.0 - y * curvature, tangent + x * curvature
    square = along * along + across * across
    by_beta = along * (1.0 + tangent * tangent) / square
    by_curvature = (x * along + y * across) / square
    doubt = math.hypot(by_beta * beta_std, by_curvature * curvature_std)
    return vx * along, vx * across, math.atan2(across, along), doubt


@kernel
def _points_run(beta, beta_std, vx, curvature, curvature_std, x, y, out):
    for k in range(beta.size):
        out[0, k], out[1, k], out[2, k], out[3, k] = point_velocity(
            beta[k], beta_std[k], vx[k], curvature[k], curvature_std[k], x, y
        )


def velocity_at(beta: np.ndarray, beta_std: np.ndarray, motion: Motion, x: float, y: float) -> PointVelocity:
    """Velocity of the point (x, y) [m] at each sample, see `point_velocity`.

    Parameters
    ----------
    beta, beta_std : (n,) [rad]
        Of the centre of gravity.
    motion : Motion
    x, y : float [m]
        Ahead and to the left of the centre of gravity.
    """
    out = np.empty((4, len(beta)))
    along, curvature, curvature_std = map(np.ascontiguousarray, motion)
    beta, beta_std = np.ascontiguousarray(beta), np.ascontiguousarray(beta_std)
    _points_run(beta, beta_std, along, curvature, curvature_std, float(x), float(y), out)
    return PointVelocity(*out)

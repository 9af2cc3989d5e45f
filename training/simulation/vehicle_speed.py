"""Vehicle speed as brake electronics make it from wheel speeds and the longitudinal acceleration."""

from __future__ import annotations

import numpy as np
from numba import njit

from crosscomb.models.vehicle import Vehicle
from crosscomb.training.simulation.schedule import CONTROL_PERIOD


def vehicle_speed(
    wheels: np.ndarray, ax: np.ndarray, yaw_rate: np.ndarray, steer: np.ndarray, vehicle: Vehicle
) -> np.ndarray:
    """Speed ``(n,)`` [m/s] from wheel speeds ``(n, 4)``, ax [m/s^2], yaw rate [rad/s] and steering [rad]."""
    half_tracks = 0.5 * np.outer([vehicle.track_front, vehicle.track_rear], [-1.0, 1.0]).ravel()
    speed = np.empty(len(ax))
    _follow(wheels, ax, yaw_rate, steer, half_tracks, CONTROL_PERIOD, speed)
    return speed


@njit(cache=True)
def _follow(wheels, ax, yaw_rate, steer, half_tracks, dt, speed):
    """Write the vehicle speed [m/s] as brake electronics make it from wheel speeds and ax.

    Wheel speeds are taken to the car's middle. The two nearest to dead reckoning by ax are believed where
    their mean is within 0.2 m/s of it; else they pull at 4 m/s^2. Slip of all wheels leaks in.
    """
    held = 0.25 * (wheels[0, 0] + wheels[0, 1] + wheels[0, 2] + wheels[0, 3])
    middle = np.empty(4)
    for k in range(wheels.shape[0]):
        held = held + ax[k] * dt
        for i in range(4):
            value = wheels[k, i] * (np.cos(steer[k]) if i < 2 else 1.0) - half_tracks[i] * yaw_rate[k]
            middle[i] = value - held
        first, second = 0, 1
        for i in range(4):
            if abs(middle[i]) < abs(middle[first]):
                first = i
        second = (first + 1) % 4
        for i in range(4):
            if i != first and abs(middle[i]) < abs(middle[second]):
                second = i
        error = 0.5 * (middle[first] + middle[second])
        if abs(error) < 0.2:
            held = held + 0.3 * error
        else:
            held = held + min(max(error, -4.0 * dt), 4.0 * dt)
        if abs(wheels[k, 0] + wheels[k, 1] + wheels[k, 2] + wheels[k, 3]) < 0.2:
            held = 0.0
        speed[k] = held

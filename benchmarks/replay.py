"""Drive the simulation plant, or the linear single track, with the steering and speed of a log."""

from __future__ import annotations

from math import atan2, ceil

import numpy as np
from numba import njit

from crosscomb.models.linear_single_track import linear_single_track_rates
from crosscomb.models.plant import (
    BRAKE,
    DRIVE,
    DRIVE_COMMAND,
    FRICTION,
    INPUTS,
    STATES,
    STEER,
    STEER_COMMAND,
    STEER_REAR_COMMAND,
    VX,
    VY,
    YAW_RATE,
    make_plant,
)
from crosscomb.models.plant_motion import step
from crosscomb.models.single_track import single_track
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import Signals
from crosscomb.training.simulation.driver import start

LONGEST_STEP = 0.001  # [s]
SPEED_RATE = 20.0
"""How fast the car takes on the logged speed [1/s]."""
DIRECT_LAG = 0.005
"""Lag [s] behind a steering angle that was measured at the road wheels."""


def replay_plant(log: Signals, vehicle: Vehicle, steer_offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Yaw rate ``(n,)`` [rad/s] and sideslip angle ``(n,)`` [rad] of the plant in a log's driving.

    Parameters
    ----------
    log : Signals
        Its steer (or steer_wheel), steer_rear and speed are used; vx_ref before vx.
    vehicle : Vehicle
        Its friction is that of the road.
    steer_offset : float
        What the road-wheel angle of the log reads straight ahead [rad].
    """
    speed, steer, rear = _inputs(log, vehicle, steer_offset)
    p = make_plant(vehicle)._replace(power=1e9, traction_control=1.0)
    if not log.has("steer_wheel"):
        p = p._replace(steer_lag=DIRECT_LAG)
    x = start(max(float(speed[0]), 0.0), p)
    x[STEER] = steer[0]
    yaw_rate, beta = np.empty((2, len(speed)))
    _run(x, log.t, speed, steer, rear, vehicle.friction, p, yaw_rate, beta)
    return yaw_rate, beta


def replay_linear(log: Signals, vehicle: Vehicle, steer_offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The same of the linear single track: constant axle stiffness, small angles."""
    speed, steer, rear = _inputs(log, vehicle, steer_offset)
    yaw_rate, beta = np.empty((2, len(speed)))
    _run_linear(log.t, np.maximum(speed, 1.0), steer, rear, single_track(vehicle), yaw_rate, beta)
    return yaw_rate, beta


def _inputs(log: Signals, vehicle: Vehicle, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Speed [m/s] and steering angles [rad] of both axles ``(n,)``, gaps bridged."""
    speed = log.column("vx_ref") if log.has("vx_ref") else log.column("vx")
    steer = log.column("steer") if log.has("steer") else log.column("steer_wheel") / vehicle.steering_ratio
    rear = log.column("steer_rear") if log.has("steer_rear") else np.zeros(len(log))
    whole = [np.interp(log.t, log.t[np.isfinite(v)], v[np.isfinite(v)]) for v in (speed, steer, rear)]
    return whole[0], whole[1] - offset, whole[2]


@njit(cache=True)
def _run(x, t, speed, steer, rear, friction, p, yaw_rate, beta):
    """Write yaw rate and sideslip angle; steering and speed go from row to row along straight lines."""
    work, u = np.zeros((4, STATES)), np.zeros(INPUTS)
    u[FRICTION : FRICTION + 4] = friction
    for k in range(t.size):
        yaw_rate[k] = x[YAW_RATE]
        beta[k] = atan2(x[VY], max(x[VX], 0.1))
        if k + 1 == t.size:
            break
        # A gap in the log is bridged by the last inputs for a quarter of a second, not for minutes.
        length = min(t[k + 1] - t[k], 0.25)
        steps = ceil(length / LONGEST_STEP - 1e-9)
        for i in range(steps):
            share = (i + 0.5) / steps
            target = speed[k] + share * (speed[k + 1] - speed[k])
            u[STEER_COMMAND] = steer[k] + share * (steer[k + 1] - steer[k])
            u[STEER_REAR_COMMAND] = rear[k] + share * (rear[k + 1] - rear[k])
            wish = SPEED_RATE * (target - x[VX])
            force = p.mass * min(max(wish, -15.0), 15.0) + p.drag * x[VX] * abs(x[VX])
            u[DRIVE_COMMAND] = max(force, 0.0) * p.wheel_radius
            u[BRAKE] = max(-force, 0.0) * p.wheel_radius
            x[DRIVE] = u[DRIVE_COMMAND]
            step(x, u, p, length / steps, work)


@njit(cache=True)
def _run_linear(t, speed, steer, rear, car, yaw_rate, beta):
    """Write yaw rate and sideslip angle of the linear single track in implicit Euler steps of 1 ms."""
    r, slip = 0.0, 0.0
    for k in range(t.size):
        yaw_rate[k], beta[k] = r, slip
        if k + 1 == t.size:
            break
        length = min(t[k + 1] - t[k], 0.25)
        steps = ceil(length / LONGEST_STEP - 1e-9)
        h = length / steps
        for i in range(steps):
            share = (i + 0.5) / steps
            v = speed[k] + share * (speed[k + 1] - speed[k])
            delta = steer[k] + share * (steer[k + 1] - steer[k])
            delta_rear = rear[k] + share * (rear[k + 1] - rear[k])
            forced, _, (a11, a21, _, a12, a22, _) = linear_single_track_rates(
                0.0, 0.0, v, delta, delta_rear, car
            )
            r_next, slip_next = r + h * forced[0], slip + h * forced[1]
            whole = (1.0 - h * a11) * (1.0 - h * a22) - h * h * a12 * a21
            r, slip = (
                ((1.0 - h * a22) * r_next + h * a12 * slip_next) / whole,
                ((1.0 - h * a11) * slip_next + h * a21 * r_next) / whole,
            )

"""The driver in the loop: speed control, path following, counter-steered drifts; and the run of a manoeuvre.

The driver knows the car's true motion and the friction, as a skilled test driver would feel them. Front
wheels are steered by the slip angle they should have: steering angle = direction of travel of the front axle
plus that slip angle. This counter-steers by itself when the car slides.
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from crosscomb.models.plant import (
    BRAKE,
    DRIVE_COMMAND,
    FRICTION,
    HANDBRAKE,
    HEADING,
    INPUTS,
    SPIN,
    STATES,
    STEER_COMMAND,
    VX,
    VY,
    YAW_RATE,
    PlantParameters,
    X,
    Y,
    derivatives,
    step,
)
from crosscomb.signals import GRAVITY

# Columns of the schedule, one row per control interval.
SPEED = 0  # speed to hold [m/s]; NaN: neither drive nor brake
PROFILE = 1  # road-wheel angle in the mode OPEN_LOOP [rad]
MODE = 2
SLIDE = 3  # sideslip to hold in the mode DRIFT [rad]
EXTRA_DRIVE = 4  # drive force asked for beside the speed controller [g]
EXTRA_BRAKE = 5  # braking asked for beside the speed controller [g]
EXTRA_HANDBRAKE = 6  # handbrake [g of the rear axle's load]
SURFACE = 7  # friction coefficient
COLUMNS = 8

OPEN_LOOP, FOLLOW_PATH, DRIFT, STRAIGHTEN = 0.0, 1.0, 2.0, 3.0

# Columns of the path, one row per metre.
PATH_X, PATH_Y, PATH_SPEED = 0, 1, 2

CONTROL_PERIOD = 0.01  # [s], also the rate of the log
SPUN = 1.2  # sideslip [rad] from which the driver gives up, brakes and waits for the car to stop
RESTART_SPEED = 0.5  # [m/s]

# Columns of the recorded truth behind the states.
AX, AY, ASKED_STEER = STATES, STATES + 1, STATES + 2
RECORD = STATES + 3


class Driver(NamedTuple):
    """How one driver drives.

    Attributes
    ----------
    preview : float
        Time ahead at which the driver aims on a path [s].
    steer_rate : float
        Fastest turn of the road wheels [rad/s].
    acceleration, deceleration : float
        What the speed controller takes at most [m/s^2].
    wheel_spin : float
        Rear slip the driver takes to hold a drift, over its sideslip [1/rad].
    """

    preview: float
    steer_rate: float
    acceleration: float
    deceleration: float
    wheel_spin: float


@njit(cache=True)
def _front_slip(force, friction, p):
    """Front slip angle [rad] that gives the lateral force [N]: the inverse of the tyre's curve, roughly."""
    limit = 2.0 * friction * p.tyre_front.load
    share = min(max(force / limit, -0.95), 0.95)
    return share / (1.0 - 0.62 * abs(share)) * limit / (2.0 * p.tyre_front.stiffness)


@njit(cache=True)
def _path_curvature(x, path, near, preview):
    """Curvature [1/m] of the arc from the direction of travel to the point ahead (pure pursuit)."""
    speed = hypot(x[VX], x[VY])
    ahead = min(near + int(max(6.0, preview * speed)), path.shape[0] - 1)
    east, north = path[ahead, PATH_X] - x[X], path[ahead, PATH_Y] - x[Y]
    distance = max(hypot(east, north), 3.0)
    beta = atan2(x[VY], x[VX]) if speed > 1.0 else 0.0
    course = x[HEADING] + beta
    return 2.0 * (north * cos(course) - east * sin(course)) / (distance * distance)


@njit(cache=True)
def _nearest(x, path, near):
    """Index of the path point nearest to the car, searched forward from the last one."""
    best = near
    least = (path[near, PATH_X] - x[X]) ** 2 + (path[near, PATH_Y] - x[Y]) ** 2
    for i in range(near + 1, min(near + 30, path.shape[0])):
        square = (path[i, PATH_X] - x[X]) ** 2 + (path[i, PATH_Y] - x[Y]) ** 2
        if square < least:
            best, least = i, square
    return best


@njit(cache=True)
def _steer(x, ay, row, curvature, p):
    """Road-wheel angle [rad] the driver wants, before limits of angle and rate."""
    mode, speed = row[MODE], hypot(x[VX], x[VY])
    if mode == OPEN_LOOP:
        return row[PROFILE]
    wheelbase = p.front + p.rear
    if speed < 3.0 and mode == FOLLOW_PATH:
        return curvature * wheelbase
    if speed < 1.0:
        return 0.0
    travel = atan2(x[VY] + p.front * x[YAW_RATE], max(x[VX], 0.1))
    if mode == DRIFT:
        beta = atan2(x[VY], x[VX])
        # The less grip, the less yaw acceleration there is to stop a swing: turn in more gently.
        calm = sqrt(min(row[SURFACE], 1.0))
        swing = calm * min(max(2.0 * (row[SLIDE] - beta), -0.6), 0.6)
        wanted = ay / max(speed, 3.0) - swing
        # The moment wanted beside the rear axle's, which is what of m ay the front does not give.
        force = (p.yaw_inertia * 6.0 * calm * (wanted - x[YAW_RATE]) + p.mass * ay * p.rear) / wheelbase
    else:
        # The yaw-rate error takes force from the front of a car that oversteers.
        force = p.mass * curvature * speed * speed * p.rear / wheelbase
        force += p.yaw_inertia * 2.0 * (curvature * speed - x[YAW_RATE]) / p.front
    return travel + _front_slip(force, row[SURFACE], p)


@njit(cache=True)
def _lift(x, p):
    """Share of the drive the driver keeps when driven wheels race: all below 3 m/s of spin, none above 8."""
    front, rear = x[SPIN] + x[SPIN + 1], x[SPIN + 2] + x[SPIN + 3]
    rim = 0.5 * p.wheel_radius * (p.share_front * front + (1.0 - p.share_front) * rear)
    return min(max((8.0 - (rim - abs(x[VX]))) / 5.0, 0.0), 1.0)


@njit(cache=True)
def _pedals(x, ay, row, target, d, p, u):
    """Write drive and brake torques: hold the target speed within the driver's limits and the grip."""
    weight = p.mass * GRAVITY * p.wheel_radius
    grip = row[SURFACE]
    u[HANDBRAKE] = row[EXTRA_HANDBRAKE] * 2.0 * p.tyre_rear.load * p.wheel_radius
    u[BRAKE] = row[EXTRA_BRAKE] * weight
    u[DRIVE_COMMAND] = row[EXTRA_DRIVE] * weight * _lift(x, p)
    if not np.isfinite(target):
        return
    wish = 2.5 * (target - x[VX])
    if target < 0.3 and x[VX] < 1.0:
        wish = -1.0
    driven = 2.0 * (p.share_front * p.tyre_front.load + (1.0 - p.share_front) * p.tyre_rear.load)
    # The friction circle: what cornering leaves of the grip.
    room = sqrt(max(1.0 - (ay / (grip * GRAVITY)) ** 2, 0.04))
    limit = min(d.acceleration, 0.7 * room * grip * driven / p.mass)
    resistance = (p.drag * x[VX] * x[VX]) / p.mass + 0.12
    if wish > -0.3:
        u[DRIVE_COMMAND] += max(min(wish, limit) * _lift(x, p) + resistance, 0.0) * p.mass * p.wheel_radius
    else:
        u[BRAKE] += min(-wish, min(d.deceleration, 0.85 * room * grip * GRAVITY)) * p.mass * p.wheel_radius


@njit(cache=True)
def _drift_pedals(x, ay, row, d, p, u):
    """Write the torques that hold the rear wheels sliding: by drive, or by handbrake."""
    beta = atan2(x[VY], x[VX])
    grip = row[SURFACE] * 2.0 * p.tyre_rear.load * p.wheel_radius
    spin = 0.5 * (x[SPIN + 2] + x[SPIN + 3]) * p.wheel_radius
    slip = spin / max(x[VX], 1.0) - 1.0
    side = 1.0 if row[SLIDE] > 0.0 else -1.0
    rate = ay / max(hypot(x[VX], x[VY]), 3.0) - x[YAW_RATE]
    wanted = d.wheel_spin * abs(row[SLIDE]) + side * (0.5 * (row[SLIDE] - beta) - 0.9 * rate)
    if p.share_front < 1.0:
        wanted -= min(max(0.03 * (x[VX] - row[SPEED]), -0.1), 0.1)
    wanted = min(max(wanted, 0.0), 0.8)
    if p.share_front < 1.0:
        share = min(max(0.5 + 4.0 * (wanted - slip), 0.0), 1.4) if wanted > 0.02 else 0.0
        u[DRIVE_COMMAND] = share * grip / (1.0 - p.share_front)
        u[HANDBRAKE] = 0.0
        u[BRAKE] = 0.0
    else:
        _pedals(x, ay, row, row[SPEED], d, p, u)
        u[BRAKE] = 0.0
        u[HANDBRAKE] = min(max(0.3 + 6.0 * (wanted + slip), 0.0), 1.2) * grip if wanted > 0.02 else 0.0


@njit(cache=True)
def run_manoeuvre(x, schedule, path, d, p, dt, record):
    """Simulate a manoeuvre with the driver in the loop.

    Parameters
    ----------
    x : ndarray
        ``(STATES,)`` initial states, SI; holds the final ones afterwards.
    schedule : ndarray
        ``(n, COLUMNS)``, one row per `CONTROL_PERIOD`.
    path : ndarray
        ``(m, 3)`` x, y [m] and speed [m/s] at every metre; ``(1, 3)`` where no path is followed.
    d : Driver
    p : PlantParameters
    dt : float
        Integration step [s], a whole part of `CONTROL_PERIOD`.
    record : ndarray
        ``(n, RECORD)``, receives states, ax, ay [m/s^2] and steering asked for [rad] before each interval.
    """
    work = np.zeros((4, STATES))
    u = np.zeros(INPUTS)
    substeps = round(CONTROL_PERIOD / dt)
    near, spun, ay = 0, False, 0.0
    for k in range(schedule.shape[0]):
        row = schedule[k]
        u[FRICTION] = row[SURFACE]
        speed = hypot(x[VX], x[VY])
        target, curvature = row[SPEED], 0.0
        if row[MODE] == FOLLOW_PATH:
            near = _nearest(x, path, near)
            curvature = _path_curvature(x, path, near, d.preview)
            target = min(target, path[min(near + int(0.4 * speed), path.shape[0] - 1), PATH_SPEED])
        if speed > 3.0 and abs(atan2(x[VY], x[VX])) > SPUN:
            spun = True
        if spun and speed < RESTART_SPEED:
            spun = False
        if spun:
            u[DRIVE_COMMAND], u[HANDBRAKE] = 0.0, 0.0
            u[BRAKE] = 0.8 * row[SURFACE] * p.mass * GRAVITY * p.wheel_radius
            wish = 0.0
        else:
            if row[MODE] == DRIFT:
                _drift_pedals(x, ay, row, d, p, u)
            else:
                _pedals(x, ay, row, target, d, p, u)
            wish = _steer(x, ay, row, curvature, p)
        wish = min(max(wish, -p.max_steer), p.max_steer)
        turn = d.steer_rate * CONTROL_PERIOD
        u[STEER_COMMAND] += min(max(wish - u[STEER_COMMAND], -turn), turn)

        derivatives(x, u, p, work[0])
        ay = work[0, VY] + x[VX] * x[YAW_RATE]
        for i in range(STATES):
            record[k, i] = x[i]
        record[k, AX] = work[0, VX] - x[VY] * x[YAW_RATE]
        record[k, AY] = ay
        record[k, ASKED_STEER] = u[STEER_COMMAND]
        for _ in range(substeps):
            step(x, u, p, dt, work)


def start(speed: float, p: PlantParameters) -> np.ndarray:
    """States ``(STATES,)`` of the car rolling straight ahead at a speed [m/s]."""
    x = np.zeros(STATES)
    x[VX] = speed
    x[SPIN : SPIN + 4] = speed / p.wheel_radius
    return x


def critical_speed(p: PlantParameters) -> float:
    """Speed [m/s] above which an oversteering car is unstable; infinite for an understeering one."""
    gradient = understeer(p)
    return sqrt((p.front + p.rear) / -gradient) if gradient < 0.0 else float("inf")


def understeer(p: PlantParameters) -> float:
    """Understeer gradient [rad per m/s^2] of the linear single track."""
    front, rear = 2.0 * p.tyre_front.stiffness, 2.0 * p.tyre_rear.stiffness
    return p.mass / (p.front + p.rear) * (p.rear / front - p.front / rear)

"""The driver's hands and feet: kernels for steering and pedals.

The driver knows the car's true motion and the friction, as a skilled test driver would feel them. Front
wheels are steered by the slip angle they should have: steering angle = direction of travel of the front axle
plus that slip angle. This counter-steers by itself when the car slides.
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from numba import njit

from crosscomb.models.plant import (
    BRAKE,
    DRIVE_COMMAND,
    HANDBRAKE,
    HEADING,
    SPIN,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
)
from crosscomb.models.tyres_combined import FIRM_GROUND
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.schedule import (
    DRIFT,
    EXTRA_BRAKE,
    EXTRA_DRIVE,
    EXTRA_HANDBRAKE,
    FOLLOW_PATH,
    FRICTION_LEFT,
    FRICTION_RIGHT,
    MODE,
    OPEN_LOOP,
    PATH_X,
    PATH_Y,
    PROFILE,
    SLIDE,
    SPEED,
)

RESISTANCE = 0.12
"""Deceleration by rolling resistance [m/s^2] that the driver makes up for."""


@njit(cache=True)
def grip_of(row):
    """Friction coefficient as the whole car has it."""
    return 0.5 * (row[FRICTION_LEFT] + row[FRICTION_RIGHT])


@njit(cache=True)
def _front_slip(force, friction, p):
    """Front slip angle [rad] that gives the lateral force [N]: the inverse of the tyre's curve, roughly."""
    limit = 2.0 * friction * p.tyre_front.load
    share = min(max(force / limit, -0.95), 0.95)
    stiffness = p.tyre_front.stiffness * sqrt(min(friction / FIRM_GROUND, 1.0))
    return share / (1.0 - 0.62 * abs(share)) * limit / (2.0 * stiffness)


@njit(cache=True)
def path_curvature(x, path, near, preview, grip):
    """Curvature [1/m] of the arc from the direction of travel to the point ahead (pure pursuit)."""
    speed = hypot(x[VX], x[VY])
    ahead = min(near + int(max(6.0, preview * speed)), path.shape[0] - 1)
    east, north = path[ahead, PATH_X] - x[X], path[ahead, PATH_Y] - x[Y]
    distance = max(hypot(east, north), 3.0)
    beta = atan2(x[VY], x[VX]) if speed > 1.0 else 0.0
    course = x[HEADING] + beta
    wanted = 2.0 * (north * cos(course) - east * sin(course)) / (distance * distance)
    # A driver who has left the course does not ask for more than there is, and catches the slide first.
    most = grip * GRAVITY / max(speed * speed, 9.0) * min(max(1.5 - 3.0 * abs(beta), 0.2), 1.05)
    return min(max(wanted, -most), most)


@njit(cache=True)
def nearest(x, path, near):
    """Index of the path point nearest to the car, searched forward from the last one."""
    best = near
    least = (path[near, PATH_X] - x[X]) ** 2 + (path[near, PATH_Y] - x[Y]) ** 2
    for i in range(near + 1, min(near + 30, path.shape[0])):
        square = (path[i, PATH_X] - x[X]) ** 2 + (path[i, PATH_Y] - x[Y]) ** 2
        if square < least:
            best, least = i, square
    return best


@njit(cache=True)
def steer(x, ay, row, curvature, p):
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
        calm = sqrt(min(grip_of(row), 1.0))
        swing = calm * min(max(2.0 * (row[SLIDE] - beta), -0.6), 0.6)
        wanted = ay / max(speed, 3.0) - swing
        # The moment wanted beside the rear axle's, which is what of m ay the front does not give.
        force = (p.yaw_inertia * 6.0 * calm * (wanted - x[YAW_RATE]) + p.mass * ay * p.rear) / wheelbase
    else:
        # The yaw-rate error takes force from the front of a car that oversteers.
        force = p.mass * curvature * speed * speed * p.rear / wheelbase
        force += p.yaw_inertia * 2.0 * (curvature * speed - x[YAW_RATE]) / p.front
    return travel + _front_slip(force, grip_of(row), p)


@njit(cache=True)
def lift(x, p):
    """Share of the drive the driver keeps.

    All of it below 3 m/s of wheel spin and 9 deg of sideslip, none above 8 m/s or 17 deg.
    """
    front, rear = x[SPIN] + x[SPIN + 1], x[SPIN + 2] + x[SPIN + 3]
    rim = 0.5 * p.wheel_radius * (p.share_front * front + (1.0 - p.share_front) * rear)
    spinning = min(max((8.0 - abs(rim - x[VX])) / 5.0, 0.0), 1.0)
    slide = abs(x[VY]) / max(abs(x[VX]), 3.0)
    return spinning * min(max((0.30 - slide) / 0.15, 0.0), 1.0)


@njit(cache=True)
def pedals(x, ay, row, target, d, p, u):
    """Write drive and brake torques: hold the target speed within the driver's limits and the grip."""
    weight = p.mass * GRAVITY * p.wheel_radius
    grip = grip_of(row)
    kept = lift(x, p)
    u[HANDBRAKE] = row[EXTRA_HANDBRAKE] * 2.0 * p.tyre_rear.load * p.wheel_radius
    if row[MODE] == FOLLOW_PATH:
        u[HANDBRAKE] *= kept
    u[BRAKE] = row[EXTRA_BRAKE] * weight
    u[DRIVE_COMMAND] = row[EXTRA_DRIVE] * weight * kept
    if not np.isfinite(target):
        return
    way = -1.0 if target < 0.0 else 1.0
    target, speed = way * target, way * x[VX]
    wish = 2.5 * (target - speed)
    if target < 0.3 and speed < 1.0:
        wish = -1.0
    driven = 2.0 * (p.share_front * p.tyre_front.load + (1.0 - p.share_front) * p.tyre_rear.load)
    # The friction circle: what cornering leaves of the grip.
    room = sqrt(max(1.0 - (ay / (grip * GRAVITY)) ** 2, 0.04))
    limit = min(d.acceleration, 0.7 * room * grip * driven / p.mass)
    resistance = (p.drag * speed * abs(speed)) / p.mass + RESISTANCE
    if wish > -0.3 and speed > -0.3:
        force = max(min(wish, limit) * kept + resistance, 0.0) * p.mass
        u[DRIVE_COMMAND] += way * force * p.wheel_radius
    else:
        most = min(d.deceleration, 0.85 * room * grip * GRAVITY * _brake_share(p))
        u[BRAKE] += min(abs(wish), most) * p.mass * p.wheel_radius


@njit(cache=True)
def _brake_share(p):
    """Share of the grip at which the first axle would lock, without anti-lock."""
    if p.anti_lock > 0.0:
        return 1.0
    front = p.tyre_front.load / (p.tyre_front.load + p.tyre_rear.load)
    first_front = front / max(p.brake_share_front, 0.01)
    # Braking takes load from the rear axle.
    first_rear = 0.75 * (1.0 - front) / max(1.0 - p.brake_share_front, 0.01)
    return min(min(first_front, first_rear), 1.0)


@njit(cache=True)
def drift_pedals(x, ay, row, d, p, u):
    """Write the torques that hold the rear wheels sliding: by drive, or by handbrake."""
    beta = atan2(x[VY], x[VX])
    grip = grip_of(row) * 2.0 * p.tyre_rear.load * p.wheel_radius
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
        pedals(x, ay, row, row[SPEED], d, p, u)
        u[BRAKE] = 0.0
        u[HANDBRAKE] = min(max(0.3 + 6.0 * (wanted + slip), 0.0), 1.2) * grip if wanted > 0.02 else 0.0

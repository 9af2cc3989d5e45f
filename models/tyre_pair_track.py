"""Single track with both tyres of each axle: what sensors should show of a car that corners below the limit.

Unlike the filters' single track it knows what the simulation plant knows there: load transfer across the car and tyres
that give less under it, compliance of the steering, the drive that keeps the speed, the relaxation of the tyres and the
roll of the body. What is left out would be found in stiffness, ratio and latencies.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import kernel
from crosscomb.models.plant_motion import ROLLING_RESISTANCE, TOE_LAG
from crosscomb.models.single_track import body_rates
from crosscomb.models.tyres_combined import SLIP_STIFFNESS_RATIO, combined_forces
from crosscomb.signals import GRAVITY

FASTEST = 150.0
"""Slip follows no faster than this [1/s]: the steps bear no more."""
MOST_LONGITUDINAL = 0.7
"""Share of its grip that an axle uses along at most, as far as the model goes."""


R, BETA, SLIP_F, SLIP_R, TOE_F, TOE_R, ROLL, ROLL_RATE = range(8)
STATES = 8
"""Yaw rate, beta, relaxed lateral slips, what side force takes from the wheels' angles, and ay as the body carries it
with its rate; SI."""


@kernel
def _axle_force(slip, apart, along, load, across, friction, tyre):
    """Lateral force of both tyres of an axle, and that of the right less that of the left one [N].

    Parameters
    ----------
    slip : float
        Relaxed lateral slip [-].
    apart : float
        What the left tyre has more, and the right one less.
    along : float
        Longitudinal force of the axle [N].
    load, across : float
        Load of the axle, and what moves from the left to the right tyre [N].
    tyre : CombinedTyre
    """
    grip = MOST_LONGITUDINAL * friction * load
    # The longitudinal slip that gives this force when the tyre does nothing else.
    slip_x = min(max(along, -grip), grip) / (2.0 * SLIP_STIFFNESS_RATIO * tyre.stiffness)
    across = min(max(across, -0.5 * load), 0.5 * load)
    _, left = combined_forces(slip_x, slip + apart, 0.5 * load - across, friction, tyre)
    _, right = combined_forces(slip_x, slip - apart, 0.5 * load + across, friction, tyre)
    return left + right, right - left


@kernel
def differential_damping(car):
    """Yaw moment over yaw rate [N m s/rad] by which the differentials' friction resists turning."""
    damping = 0.0
    if car.share_front > 0.0:
        damping += (2.0 * car.half_track_front / car.wheel_radius) ** 2
    if car.share_front < 1.0:
        damping += (2.0 * car.half_track_rear / car.wheel_radius) ** 2
    return car.differential_lock * damping


@kernel
def rates(x, u, car, friction, dx):
    """Write the time derivative of the states `R` to `ROLL_RATE`; gives ay.

    Inputs u: vx, steer, steer_rear, d(vx)/dt, measured yaw rate.
    """
    r, beta, rolled = x[R], x[BETA], x[ROLL]
    vx = u[0]
    steer = u[1] - x[TOE_F] - car.roll_steer_front * rolled
    rear = u[2] - x[TOE_R] + car.roll_steer_rear * rolled
    sin_b, cos_b = math.sin(beta), math.cos(beta)
    vy = vx * sin_b / cos_b
    wheelbase = car.front + car.rear
    weight, drag = car.mass * GRAVITY - car.lift * vx * vx, car.drag * vx * vx
    along = car.mass * (u[3] - vy * r) + drag
    transfer = along * car.cg_height / wheelbase
    load_f, load_r = weight * car.rear / wheelbase - transfer, weight * car.front / wheelbase + transfer
    # From the left to the right tyre, by springs and dampers of the body (docs/plant.md, section 3).
    carried = rolled + 2.0 * car.body_damping / car.body_rate * x[ROLL_RATE]
    roll = 0.5 * car.mass * car.cg_height * carried
    across_f = roll * car.roll_share_front / car.half_track_front
    across_r = roll * (1.0 - car.roll_share_front) / car.half_track_rear
    # What drives the car: inertia, drag, and the front tyres' force against the motion.
    side_f = 2.0 * car.tyre_front.stiffness * x[SLIP_F]
    needed = along + side_f * math.sin(steer) + ROLLING_RESISTANCE * weight
    share = car.share_front if needed > 0.0 else car.brake_share_front
    fxf = share * needed - ROLLING_RESISTANCE * load_f
    fxr = (1.0 - share) * needed - ROLLING_RESISTANCE * load_r
    # The inner wheel of an axle travels slower and turns further (docs/plant.md, section 1).
    course_f, course_r = math.atan((vy + car.front * r) / vx), math.atan((vy - car.rear * r) / vx)
    apart_f = car.half_track_front * (steer * steer / wheelbase - course_f * r / vx)
    apart_r = -car.half_track_rear * course_r * r / vx
    fyf, uneven = _axle_force(x[SLIP_F], apart_f, fxf, load_f, across_f, friction, car.tyre_front)
    fyr, _ = _axle_force(x[SLIP_R], apart_r, fxr, load_r, across_r, friction, car.tyre_rear)
    turning, sliding, _, ay = body_rates(
        fxf, fxr, fyf, fyr, vx, r, math.cos(steer), math.sin(steer), math.cos(rear), math.sin(rear),
        cos_b, sin_b, car.mass, car.yaw_inertia, car.front, car.rear,
    )  # fmt: skip
    # The outer front wheel holds the car back more; and the differentials do.
    held = car.half_track_front * uneven * math.sin(steer) + differential_damping(car) * r
    held += 2.0 * ROLLING_RESISTANCE * (car.half_track_front * across_f + car.half_track_rear * across_r)
    quick = min(vx / car.relaxation_y, FASTEST)
    dx[R] = turning - held / car.yaw_inertia
    dx[BETA] = sliding
    dx[SLIP_F] = quick * (math.tan(steer - course_f) - x[SLIP_F])
    dx[SLIP_R] = quick * (math.tan(rear - course_r) - x[SLIP_R])
    dx[TOE_F] = (car.compliance_front * fyf - x[TOE_F]) / TOE_LAG
    dx[TOE_R] = (car.compliance_rear * fyr - x[TOE_R]) / TOE_LAG
    dx[ROLL] = x[ROLL_RATE]
    dx[ROLL_RATE] = car.body_rate * (car.body_rate * (ay - rolled) - 2.0 * car.body_damping * x[ROLL_RATE])
    return ay


@kernel
def steady_cornering(x, u, car):
    """Write the states of steady cornering at the measured yaw rate."""
    vx, r = u[0], u[4]
    side = car.mass * vx * r / (car.front + car.rear)
    x[R], x[ROLL], x[ROLL_RATE] = r, vx * r, 0.0
    x[SLIP_F] = 0.5 * side * car.rear / car.tyre_front.stiffness
    x[SLIP_R] = 0.5 * side * car.front / car.tyre_rear.stiffness
    x[TOE_F] = car.compliance_front * side * car.rear
    x[TOE_R] = car.compliance_rear * side * car.front
    x[BETA] = r * car.rear / vx - x[SLIP_R]

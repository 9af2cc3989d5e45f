"""A single track with both tyres of each axle, driven by a log's steering and speed: what sensors should have shown.

Unlike the filters' single track it knows what the simulation plant knows below the limit: load transfer across the
car and tyres that give less under it, compliance of the steering, the drive that keeps the speed, the relaxation of the
tyres and the lag of the steering system. What is left out would be found in stiffness, ratio and latencies.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.signal import bilinear, lfilter

from crosscomb.filters.base import MAX_BETA
from crosscomb.models.plant import PlantParameters
from crosscomb.models.plant_motion import ROLLING_RESISTANCE, TOE_LAG
from crosscomb.models.single_track import body_rates
from crosscomb.models.tyres_combined import SLIP_STIFFNESS_RATIO, combined_forces
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.identification.trace import RATE, Trace

HOLD = 1.0
"""How strongly the model's yaw rate is drawn to the measured one [1/s].

Enough to keep a model that oversteers, as a first guess may, from running away; weak against the one to ten per
second with which a car answers its steering. With the right parameters there is nothing left to draw.
"""


FASTEST = 150.0
"""Slip follows no faster than this [1/s]: the steps bear no more."""
MAX_SLIP, MAX_YAW_RATE = 2.0, 5.0  # [-], [rad/s]
MOST_LONGITUDINAL = 0.7
"""Share of its grip that an axle uses along at most, as far as the model goes."""


R, BETA, SLIP_F, SLIP_R, TOE_F, TOE_R, ROLL, ROLL_RATE = range(8)
STATES = 8
"""Yaw rate, beta, relaxed lateral slips, what side force takes from the wheels' angles, and ay as the body carries it
with its rate; SI."""


class Sensing(NamedTuple):
    """How the sensors of one log see the car."""

    ratio: float = 1.0  # hand-wheel angle over road-wheel angle
    steer_scale: float = 1.0  # the same of a road-wheel angle as measured
    steer_offset: float = 0.0  # road-wheel angle read straight ahead [rad]
    yaw_bias: float = 0.0  # [rad/s]
    ay_bias: float = 0.0  # [m/s^2]
    beta_bias: float = 0.0  # of the ground truth [rad]
    yaw_delay: float = 0.0  # behind the steering angle [s]
    ay_delay: float = 0.0  # [s]
    beta_delay: float = 0.0  # [s]
    roll_gradient: float = 0.0  # [rad per m/s^2]
    position: float = 0.0  # of the accelerometer ahead of the centre of gravity [m]


class Response(NamedTuple):
    """Response of the model to steering and speed; arrays ``(n,)``, NaN where it is not run."""

    yaw_rate: np.ndarray  # [rad/s]
    beta: np.ndarray  # [rad]
    ay: np.ndarray  # [m/s^2]
    yaw_acceleration: np.ndarray  # [rad/s^2]


def run_model(
    trace: Trace, running: np.ndarray, car: PlantParameters, friction: float, sensing: Sensing
) -> Response:
    """Run the single track through a log.

    It starts anew, in steady cornering at the measured yaw rate, at the begin of every stretch.

    Parameters
    ----------
    trace : Trace
    running : ndarray
        ``(n,)`` bool: rows of the stretches in which it is run.
    car : PlantParameters
    friction : float
    sensing : Sensing
        What concerns steering and yaw rate is used.
    """
    inputs = np.column_stack(
        [
            trace.vx,
            road_wheel_angle(trace, sensing, car.steer_lag),
            trace.steer_rear,
            np.gradient(trace.vx, trace.t),
            np.interp(trace.t + sensing.yaw_delay, trace.t, trace.yaw_rate) - sensing.yaw_bias,
        ]
    )
    out = np.full((len(trace.t), 4), np.nan)
    _run(inputs, running, car, friction, 1.0 / RATE, out)
    return Response(*out.T)


def road_wheel_angle(trace: Trace, sensing: Sensing, lag: float) -> np.ndarray:
    """Road-wheel angle ``(n,) [rad]`` of the front axle, as it would be without the delay that its lag [s] is.

    The lag takes from quick steering only; its delay is found together with those of the sensors.
    """
    hand = follow(trace.hand, *_first_order(lag))
    hand = np.interp(trace.t + lag, trace.t, hand)
    return hand / (sensing.ratio if trace.ratio_open else sensing.steer_scale) - sensing.steer_offset


def sensed(
    response: Response, trace: Trace, sensing: Sensing, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the yaw-rate sensor, the accelerometer and the reference show of a response.

    Returns
    -------
    yaw_rate, ay, beta : ndarray
        ``(n,)`` [rad/s], [m/s^2], [rad]; NaN where the model is not run.
    """
    known = np.where(np.isfinite(response.ay), response.ay, trace.ay)
    felt = response.ay + GRAVITY * sensing.roll_gradient * lean(known, vehicle)
    t = trace.t
    # The lever arm acts with the turning that was measured: no model is needed for it.
    felt = felt + sensing.position * np.interp(t + sensing.yaw_delay, t, np.gradient(trace.yaw_rate, t))
    return (
        np.interp(t - sensing.yaw_delay, t, response.yaw_rate) + sensing.yaw_bias,
        np.interp(t - sensing.ay_delay, t, felt) + sensing.ay_bias,
        np.interp(t - sensing.beta_delay, t, response.beta) + sensing.beta_bias,
    )


def lean(ay: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """Lateral acceleration ``(n,) [m/s^2]`` as the body follows it in roll, at `RATE`.

    Parameters
    ----------
    ay : ndarray
        ``(n,) [m/s^2]``, finite.
    vehicle : Vehicle
        Frequency and damping of its body.
    """
    plant = vehicle.plant
    return follow(ay, *_second_order(2.0 * math.pi * plant.body_frequency, plant.body_damping))


def follow(values: np.ndarray, top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    """Values ``(n,)`` through a digital filter that has been at the first of them for long."""
    return lfilter(top, bottom, values - values[0]) + values[0]


@lru_cache
def _second_order(rate: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Digital filter of a spring and damper with a natural frequency [rad/s] and a damping ratio."""
    return bilinear([rate**2], [1.0, 2.0 * damping * rate, rate**2], RATE)


@lru_cache
def _first_order(lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Digital filter of a lag [s]."""
    return bilinear([1.0], [lag, 1.0], RATE)


@njit(cache=True)
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


@njit(cache=True)
def yaw_damping(car):
    """Yaw moment over yaw rate [N m s/rad] by which the differentials' friction resists turning."""
    damping = 0.0
    if car.share_front > 0.0:
        damping += (2.0 * car.half_track_front / car.wheel_radius) ** 2
    if car.share_front < 1.0:
        damping += (2.0 * car.half_track_rear / car.wheel_radius) ** 2
    return car.differential_lock * damping


@njit(cache=True)
def _rates(x, u, car, friction, dx):
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
    held = car.half_track_front * uneven * math.sin(steer) + yaw_damping(car) * r
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


@njit(cache=True)
def _begin(x, u, car):
    """Write the states of steady cornering at the measured yaw rate."""
    vx, r = u[0], u[4]
    side = car.mass * vx * r / (car.front + car.rear)
    x[R], x[ROLL], x[ROLL_RATE] = r, vx * r, 0.0
    x[SLIP_F] = 0.5 * side * car.rear / car.tyre_front.stiffness
    x[SLIP_R] = 0.5 * side * car.front / car.tyre_rear.stiffness
    x[TOE_F] = car.compliance_front * side * car.rear
    x[TOE_R] = car.compliance_rear * side * car.front
    x[BETA] = r * car.rear / vx - x[SLIP_R]


@njit(cache=True)
def _run(inputs, running, car, friction, dt, out):
    """Write yaw rate, beta, ay and yaw acceleration of every running row, by the midpoint rule."""
    x, middle, dx, on = np.zeros(STATES), np.zeros(STATES), np.zeros(STATES), False
    for k in range(len(running)):
        if not running[k]:
            on = False
            continue
        now = inputs[k]
        if not on:
            _begin(x, now, car)
            on = True
        ay = _rates(x, now, car, friction, dx)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = x[R], x[BETA], ay, dx[R]
        if k + 1 == len(running) or not running[k + 1]:
            continue
        dx[R] += HOLD * (now[4] - x[R])
        for i in range(STATES):
            middle[i] = x[i] + 0.5 * dt * dx[i]
        between = 0.5 * (now + inputs[k + 1])
        _rates(middle, between, car, friction, dx)
        dx[R] += HOLD * (between[4] - middle[R])
        for i in range(STATES):
            x[i] += dt * dx[i]
        x[R] = min(max(x[R], -MAX_YAW_RATE), MAX_YAW_RATE)
        x[BETA] = min(max(x[BETA], -MAX_BETA), MAX_BETA)
        x[SLIP_F] = min(max(x[SLIP_F], -MAX_SLIP), MAX_SLIP)
        x[SLIP_R] = min(max(x[SLIP_R], -MAX_SLIP), MAX_SLIP)

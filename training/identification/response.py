"""Response of the single track with both tyres of each axle to a log's steering and speed, and what sensors see of it.

Beside the model's equations stand the lag of the steering system, the delays, offsets and places of the sensors.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.signal import bilinear, lfilter

from crosscomb.filters.base import MAX_BETA
from crosscomb.models import tyre_pair_track as track
from crosscomb.models.plant import PlantParameters
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.identification.trace import RATE, Trace

HOLD = 1.0
"""How strongly the model's yaw rate is drawn to the measured one [1/s].

Enough to keep a model that oversteers, as a first guess may, from running away; weak against the one to ten per
second with which a car answers its steering. With the right parameters there is nothing left to draw.
"""


MAX_SLIP, MAX_YAW_RATE = 2.0, 5.0  # [-], [rad/s]


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
def _run(inputs, running, car, friction, dt, out):
    """Write yaw rate, beta, ay and yaw acceleration of every running row, by the midpoint rule."""
    x, middle, dx, on = np.zeros(track.STATES), np.zeros(track.STATES), np.zeros(track.STATES), False
    for k in range(len(running)):
        if not running[k]:
            on = False
            continue
        now = inputs[k]
        if not on:
            track.steady_cornering(x, now, car)
            on = True
        ay = track.rates(x, now, car, friction, dx)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = x[track.R], x[track.BETA], ay, dx[track.R]
        if k + 1 == len(running) or not running[k + 1]:
            continue
        dx[track.R] += HOLD * (now[4] - x[track.R])
        for i in range(track.STATES):
            middle[i] = x[i] + 0.5 * dt * dx[i]
        between = 0.5 * (now + inputs[k + 1])
        track.rates(middle, between, car, friction, dx)
        dx[track.R] += HOLD * (between[4] - middle[track.R])
        for i in range(track.STATES):
            x[i] += dt * dx[i]
        x[track.R] = min(max(x[track.R], -MAX_YAW_RATE), MAX_YAW_RATE)
        x[track.BETA] = min(max(x[track.BETA], -MAX_BETA), MAX_BETA)
        x[track.SLIP_F] = min(max(x[track.SLIP_F], -MAX_SLIP), MAX_SLIP)
        x[track.SLIP_R] = min(max(x[track.SLIP_R], -MAX_SLIP), MAX_SLIP)

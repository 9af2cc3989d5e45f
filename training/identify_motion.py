"""The nonlinear single track driven by a log's steering and speed: what its sensors should have shown.

Unlike the filters' single track it knows the relaxation of the tyres, and the accelerometer leans with a body that
follows ay like a spring: both are delays of some ten milliseconds, which else would be found in the latencies.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.signal import bilinear, lfilter

from crosscomb.filters.base import MAX_BETA
from crosscomb.models.single_track import SingleTrack, axle_loads, body_rates, slip_angles
from crosscomb.models.tyres import axle_tyre, lateral_capacity
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.identify_drive import RATE, Drive

HOLD = 1.0
"""How strongly the model's yaw rate is drawn to the measured one [1/s].

Enough to keep a model that oversteers, as a first guess may, from running away; weak against the one to ten per
second with which a car answers its steering. With the right parameters there is nothing left to draw.
"""


SUBSTEPS = 2
FASTEST = 150.0
"""Forces follow no faster than this [1/s]: the steps bear no more."""


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


class Motion(NamedTuple):
    """Motion of the model; arrays ``(n,)``, NaN where it is not run."""

    yaw_rate: np.ndarray  # [rad/s]
    beta: np.ndarray  # [rad]
    ay: np.ndarray  # [m/s^2]
    yaw_acceleration: np.ndarray  # [rad/s^2]


def run_model(
    drive: Drive, running: np.ndarray, car: SingleTrack, relaxation: float, sensing: Sensing
) -> Motion:
    """Run the single track through a log.

    It starts anew, in steady cornering at the measured yaw rate, at the begin of every stretch.

    Parameters
    ----------
    drive : Drive
    running : ndarray
        ``(n,)`` bool: rows of the stretches in which it is run.
    car : SingleTrack
        With the tyre law to use.
    relaxation : float
        Relaxation length of the tyres [m].
    sensing : Sensing
        What concerns steering and yaw rate is used.
    """
    inputs = np.column_stack(
        [
            drive.vx,
            road_wheel_angle(drive, sensing),
            drive.steer_rear,
            np.gradient(drive.vx, drive.t),
            np.interp(drive.t + sensing.yaw_delay, drive.t, drive.yaw_rate) - sensing.yaw_bias,
        ]
    )
    out = np.full((len(drive.t), 4), np.nan)
    _run(inputs, running, car, relaxation, 1.0 / RATE, out)
    return Motion(*out.T)


def road_wheel_angle(drive: Drive, sensing: Sensing) -> np.ndarray:
    """Road-wheel angle ``(n,) [rad]`` of the front axle."""
    return drive.hand / (sensing.ratio if drive.ratio_open else sensing.steer_scale) - sensing.steer_offset


def sensed(
    motion: Motion, drive: Drive, sensing: Sensing, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the yaw-rate sensor, the accelerometer and the reference show of a motion.

    Returns
    -------
    yaw_rate, ay, beta : ndarray
        ``(n,)`` [rad/s], [m/s^2], [rad]; NaN where the model is not run.
    """
    known = np.where(np.isfinite(motion.ay), motion.ay, drive.ay)
    felt = motion.ay + GRAVITY * sensing.roll_gradient * lean(known, vehicle)
    t = drive.t
    # The lever arm acts with the turning that was measured: no model is needed for it.
    felt = felt + sensing.position * np.interp(t + sensing.yaw_delay, t, np.gradient(drive.yaw_rate, t))
    return (
        np.interp(t - sensing.yaw_delay, t, motion.yaw_rate) + sensing.yaw_bias,
        np.interp(t - sensing.ay_delay, t, felt) + sensing.ay_bias,
        np.interp(t - sensing.beta_delay, t, motion.beta) + sensing.beta_bias,
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
    top, bottom = _body(vehicle.plant.body_frequency, vehicle.plant.body_damping)
    return lfilter(top, bottom, ay - ay[0]) + ay[0]


@lru_cache
def _body(frequency: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Digital filter of a body that follows ay with a frequency [Hz] and a damping ratio."""
    rate = 2.0 * math.pi * frequency
    top, bottom = bilinear([rate**2], [1.0, 2.0 * damping * rate, rate**2], RATE)
    return top, bottom


@njit(cache=True)
def _force_rates(r, slip, fyf, fyr, vx, steer, rear, pull, car, relaxation):
    """Rates of yaw rate, beta and both axle forces, and ay. The forces follow their tyre law over a distance."""
    share = car.b / (car.a + car.b)
    fxf, fxr = share * car.mass * pull, (1.0 - share) * car.mass * pull
    load_f, load_r = axle_loads(pull, car)
    alpha_f, alpha_r, _, _, _, _ = slip_angles(r, slip, vx, steer, rear, car.a, car.b)
    steady_f, _ = axle_tyre(
        car.tyre_law, alpha_f, car.stiffness_front, lateral_capacity(car.friction, load_f, fxf), car.friction
    )
    steady_r, _ = axle_tyre(
        car.tyre_law, alpha_r, car.stiffness_rear, lateral_capacity(car.friction, load_r, fxr), car.friction
    )
    turning, sliding, _, ay = body_rates(
        fxf, fxr, fyf, fyr, vx, r, math.cos(steer), math.sin(steer), math.cos(rear), math.sin(rear),
        math.cos(slip), math.sin(slip), car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    follow = min(vx / relaxation, FASTEST)
    return turning, sliding, follow * (steady_f - fyf), follow * (steady_r - fyr), ay


@njit(cache=True)
def _run(inputs, running, car, relaxation, dt, out):
    """Write yaw rate, beta, ay and yaw acceleration of every running row, by the midpoint rule.

    Inputs: vx, steer, steer_rear, d(vx)/dt, measured yaw rate.
    """
    r, slip, fyf, fyr, on = 0.0, 0.0, 0.0, 0.0, False
    h = dt / SUBSTEPS
    for k in range(len(running)):
        if not running[k]:
            on = False
            continue
        now = inputs[k]
        if not on:
            r = now[4]
            fyr = car.mass * car.a / (car.a + car.b) * now[0] * r
            fyf = car.mass * now[0] * r - fyr
            slip = r * car.b / now[0] - fyr / car.stiffness_rear
            on = True
        rates = _force_rates(r, slip, fyf, fyr, now[0], now[1], now[2], now[3], car, relaxation)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = r, slip, rates[4], rates[0]
        if k + 1 == len(running) or not running[k + 1]:
            continue
        change = inputs[k + 1] - now
        for i in range(SUBSTEPS):
            u = now + (i / SUBSTEPS) * change
            if i > 0:
                rates = _force_rates(r, slip, fyf, fyr, u[0], u[1], u[2], u[3], car, relaxation)
            turning = rates[0] + HOLD * (u[4] - r)
            r_mid, slip_mid = r + 0.5 * h * turning, slip + 0.5 * h * rates[1]
            f_mid, b_mid = fyf + 0.5 * h * rates[2], fyr + 0.5 * h * rates[3]
            u = now + ((i + 0.5) / SUBSTEPS) * change
            rates = _force_rates(r_mid, slip_mid, f_mid, b_mid, u[0], u[1], u[2], u[3], car, relaxation)
            r = min(max(r + h * (rates[0] + HOLD * (u[4] - r_mid)), -5.0), 5.0)
            slip = min(max(slip + h * rates[1], -MAX_BETA), MAX_BETA)
            fyf += h * rates[2]
            fyr += h * rates[3]

"""Kinematic Kalman filter aided by GNSS fixes, which learns the errors of its sensors.

State [vx, vy, heading, gyro bias, ax bias, ay bias, scale of the wheel speed] (Bevly 2004, Ryu and Gerdes
2004; Chindamo 2018, section 2.3). Gyro and accelerometers drive the kinematic model; wheel speed, GNSS speed
(hypot(vx, vy)), course (heading + beta) and, with two antennas, the heading itself correct it whenever one is
there. The errors learnt stay through outages and stops. With one antenna the heading is observable only while
the car accelerates, so vy goes on to forget, which holds heading and course together on straights.

Fixes count at the sample they stand in: a receiver's delay belongs into the channel map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_update, propagate_cov
from crosscomb.filters.base import KernelFilter, below_gate, low_speed_answer
from crosscomb.filters.kinematic.kf import MOST_BIAS, inertial_known, limit_slip, velocity_answer
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import input_gain, rotation

PSI, BIAS_YAW, BIAS_AX, BIAS_AY, SCALE = range(2, 7)
"""States behind vx and vy: heading [rad], gyro bias [rad/s], accelerometer biases [m/s^2], and the share by
which the wheels read too much. Without the last one a speed that reads 1 % low looks like 8 deg of slip."""

UNKNOWN_HEADING = 10.0
"""Variance of a heading that is not known [rad^2]."""


class GnssKinematicNoise(NamedTuple):
    """Noise settings of the kinematic filter; densities, so that they hold at every rate."""

    accel: float = 0.3  # accelerometer error beside the bias [m/s^2 per sqrt(Hz)]
    gyro: float = 0.005  # gyro error beside the bias [rad/s per sqrt(Hz)]
    missing_accel: float = 3.0  # accelerometer error while a channel is missing [m/s^2 per sqrt(Hz)]
    missing_gyro: float = 0.5  # gyro error while a channel is missing [rad/s per sqrt(Hz)]
    speed: float = 0.3  # measured vx [m/s]
    gnss_velocity: float = 0.1  # GNSS velocity, along and across [m/s]
    heading: float = 0.01  # two-antenna heading [rad]
    gyro_bias: float = 0.01  # size of the gyro bias [rad/s]
    accel_bias: float = 0.3  # size of the accelerometer biases, lasting bank and slope included [m/s^2]
    scale: float = 0.01  # size of the share by which the wheel speed is off
    bias_time: float = 100.0  # time in which biases change [s]
    relaxation: float = 0.3  # rate at which vy forgets without fixes of course and heading [1/s]
    outage: float = 3.0  # time without fixes from which on vy forgets in full [s]


class GnssKinematic(NamedTuple):
    """State of the kinematic filter, changed in place by its kernel."""

    mean: np.ndarray  # (7,)
    cov: np.ndarray  # (7, 7)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below, -1 before the first sample above it
    age: np.ndarray  # (1,) time since the last fix with course and heading [s]
    transition: np.ndarray  # (7, 7) scratch
    added: np.ndarray  # (7, 7) scratch: process noise
    row: np.ndarray  # (7,) scratch: row of the measurement matrix
    work: np.ndarray  # (7, 7) scratch


@inlined
def wrap(angle):
    """Bring an angle into -pi to pi [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@inlined
def gnss_predict(state, sample, noise, dt):
    """Predict the seven states over dt; a missing inertial channel keeps the motion and widens it."""
    mean, cov, f, q = state.mean, state.cov, state.transition, state.added
    known = inertial_known(sample[at.AX], sample[at.AY], sample[at.YAW_RATE])
    ax = sample[at.AX] - mean[BIAS_AX] if known else 0.0
    ay = sample[at.AY] - mean[BIAS_AY] if known else 0.0
    yaw_rate = sample[at.YAW_RATE] - mean[BIAS_YAW] if known else 0.0
    f00, f01, f10, f11 = rotation(yaw_rate, dt)
    g00, g01, g10, g11 = input_gain(yaw_rate, dt)
    decay = math.exp(-noise.relaxation * min(state.age[0] / noise.outage, 1.0) * dt)
    keep = math.exp(-dt / noise.bias_time)
    vx, vy = mean[0], decay * mean[1]
    mean[0] = f00 * vx + f01 * vy + g00 * ax + g01 * ay
    mean[1] = f10 * vx + f11 * vy + g10 * ax + g11 * ay
    mean[PSI] = wrap(mean[PSI] + dt * yaw_rate)
    for i in range(3, 7):
        mean[i] *= keep
    f[:, :] = 0.0
    f[0, 0], f[0, 1], f[1, 0], f[1, 1] = f00, f01 * decay, f10, f11 * decay
    f[PSI, PSI] = 1.0
    f[BIAS_YAW, BIAS_YAW] = f[BIAS_AX, BIAS_AX] = f[BIAS_AY, BIAS_AY] = f[SCALE, SCALE] = keep
    if known:
        # A gyro that reads too much turns the frame too far; turning it changes the velocity by (vy, -vx).
        f[0, BIAS_YAW], f[1, BIAS_YAW], f[PSI, BIAS_YAW] = -dt * mean[1], dt * mean[0], -dt
        f[0, BIAS_AX], f[0, BIAS_AY], f[1, BIAS_AX], f[1, BIAS_AY] = -g00, -g01, -g10, -g11
    q[:, :] = 0.0
    accel = noise.accel if known else noise.missing_accel
    gyro = noise.gyro if known else noise.missing_gyro
    q[0, 0] = q[1, 1] = accel * accel * dt
    q[PSI, PSI] = gyro * gyro * dt
    q[BIAS_YAW, BIAS_YAW] = noise.gyro_bias**2 * (1.0 - keep * keep)
    q[BIAS_AX, BIAS_AX] = q[BIAS_AY, BIAS_AY] = noise.accel_bias**2 * (1.0 - keep * keep)
    q[SCALE, SCALE] = noise.scale**2 * (1.0 - keep * keep)
    propagate_cov(cov, f, q, state.work)
    if cov[PSI, PSI] > UNKNOWN_HEADING:
        forget_heading(cov)
    state.age[0] += dt


@inlined
def forget_heading(cov):
    """Make the heading unknown."""
    cov[PSI, :] = 0.0
    cov[:, PSI] = 0.0
    cov[PSI, PSI] = UNKNOWN_HEADING


@inlined
def gnss_update(state, sample, noise):
    """Update with the speed, fix and heading that are there; give the NIS, NaN without any."""
    mean, cov, row, work = state.mean, state.cov, state.row, state.work
    nis, count = 0.0, 0
    if sample[at.VX_HELD] == 0.0:
        row[:] = 0.0
        row[0], row[SCALE] = 1.0 + mean[SCALE], mean[0]
        nis += joseph_update(mean, cov, row, sample[at.VX] - row[0] * mean[0], noise.speed**2, work)
        count += 1
    if math.isfinite(sample[at.HEADING]):
        row[:] = 0.0
        row[PSI] = 1.0
        nis += joseph_update(mean, cov, row, wrap(sample[at.HEADING] - mean[PSI]), noise.heading**2, work)
        count += 1
    if math.isfinite(sample[at.GNSS_SPEED]):
        speed = math.hypot(mean[0], mean[1])
        row[:] = 0.0
        row[0], row[1] = mean[0] / speed, mean[1] / speed
        nis += joseph_update(mean, cov, row, sample[at.GNSS_SPEED] - speed, noise.gnss_velocity**2, work)
        count += 1
    if math.isfinite(sample[at.GNSS_COURSE]):
        speed2 = mean[0] * mean[0] + mean[1] * mean[1]
        row[:] = 0.0
        row[0], row[1], row[PSI] = -mean[1] / speed2, mean[0] / speed2, 1.0
        innovation = wrap(sample[at.GNSS_COURSE] - mean[PSI] - math.atan2(mean[1], mean[0]))
        nis += joseph_update(mean, cov, row, innovation, noise.gnss_velocity**2 / speed2, work)
        count += 1
        if math.isfinite(sample[at.HEADING]):
            state.age[0] = 0.0
    return nis if count > 0 else math.nan


@inlined
def gnss_start(state, sample, car, noise, out):
    """Answer where the car is slow and start on the first sample above the gate; True where it did either.

    A stop makes the filter forget its motion, not what it knows of its sensors.
    """
    mean, cov = state.mean, state.cov
    slow = below_gate(sample)
    if not slow and state.running[0] == 1:
        return False
    low_speed_answer(sample, car, out)
    if slow:
        state.running[0] = min(state.running[0], 0)
        return True
    if state.running[0] < 0:
        cov[:, :] = 0.0
        cov[BIAS_YAW, BIAS_YAW] = noise.gyro_bias**2
        cov[BIAS_AX, BIAS_AX] = cov[BIAS_AY, BIAS_AY] = noise.accel_bias**2
        cov[SCALE, SCALE] = noise.scale**2
    cov[:3, :] = 0.0
    cov[:, :3] = 0.0
    mean[0], mean[PSI] = sample[at.VX] / (1.0 + mean[SCALE]), 0.0
    mean[1] = mean[0] * math.tan(out[at.BETA])
    cov[0, 0], cov[1, 1], cov[PSI, PSI] = (
        noise.speed**2,
        (sample[at.VX] * out[at.BETA_STD]) ** 2,
        UNKNOWN_HEADING,
    )
    state.running[0] = 1
    state.age[0] = noise.outage
    return True


@inlined
def limit_errors(mean, noise):
    """Hold the sensor errors inside `MOST_BIAS` times their size."""
    sizes = (noise.gyro_bias, noise.accel_bias, noise.accel_bias, noise.scale)
    for i in range(4):
        most = MOST_BIAS * sizes[i]
        mean[BIAS_YAW + i] = min(max(mean[BIAS_YAW + i], -most), most)


@inlined
def gnss_kinematic_step(state, sample, car, noise, dt, out):
    """One sample of the kinematic filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    if gnss_start(state, sample, car, noise, out):
        return
    gnss_predict(state, sample, noise, dt)
    limit_slip(state.mean)
    out[at.NIS] = gnss_update(state, sample, noise)
    limit_slip(state.mean)
    limit_errors(state.mean, noise)
    velocity_answer(state, out)


@kernel
def gnss_kinematic_run(state, samples, car, noise, dt, out):
    """All samples of the kinematic filter."""
    for k in range(samples.shape[0]):
        gnss_kinematic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class GnssKinematicKF(KernelFilter):
    """Kinematic Kalman filter with sensor biases, aided by GNSS fixes; `tyre` is not used."""

    noise: GnssKinematicNoise = GnssKinematicNoise()

    divisors = (*KernelFilter.divisors, "bias_time", "outage")
    run_kernel = staticmethod(gnss_kinematic_run)

    def make_state(self) -> Any:
        """Make an unstarted filter."""
        f, q, work = np.zeros((3, 7, 7))
        running = np.full(1, -1, dtype=np.int64)
        return GnssKinematic(np.zeros(7), np.eye(7), running, np.zeros(1), f, q, np.zeros(7), work)

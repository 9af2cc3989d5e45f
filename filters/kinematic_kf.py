"""Kinematic Kalman filter: integrates the accelerometers, corrected by the speed.

State [vx, vy]; inputs ax, ay and yaw rate; measurement vx (Atheupe 2023, eq. 18 to 21). Needs no tyre, so slides
do not hurt it. Its vy is observable only while the car turns; in straight driving it would drift with the sensor
errors, so there vy relaxes towards 0, with the share exp(-(yaw_rate / turning)^2) of driving that counts as
straight. In turns nothing is forgotten.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from crosscomb.filters.base import (
    AX,
    AY,
    BETA,
    BETA_STD,
    NIS,
    VX,
    VX_HELD,
    YAW_RATE,
    KernelFilter,
    below_gate,
    low_speed_answer,
    propagate,
    scalar_update,
)  # fmt: skip
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.signals import MIN_SPEED


class KinematicNoise(NamedTuple):
    """Noise settings of the kinematic filter; densities, so that they hold at every rate."""

    accel: float = 0.5  # accelerometer error, bank and slope included [m/s^2 per sqrt(Hz)]
    speed: float = 0.3  # measured vx [m/s]
    relaxation: float = 3.0  # rate at which vy forgets in straight driving [1/s]
    missing_accel: float = 3.0  # accelerometer error while a channel is missing [m/s^2 per sqrt(Hz)]
    turning: float = 0.1  # yaw rate from which on the car turns [rad/s]


BLIND_RELAXATION = 0.3
"""Rate at which vy forgets while the yaw rate is missing [1/s]: it may be a slide or a straight."""

LEAST_SHARE = 1e-3
"""A smaller share of straight driving than this is none."""


@inlined
def straight_share(yaw_rate, turning):
    """Share in which driving counts as straight, 1 at zero yaw rate; 0 where the yaw rate is not known."""
    if not math.isfinite(yaw_rate):
        return 0.0
    ratio = yaw_rate / turning
    share = math.exp(-ratio * ratio)
    return share if share > LEAST_SHARE else 0.0


@inlined
def forgetting(yaw_rate, noise, dt):
    """Share of vy that is kept over dt."""
    rate = noise.relaxation * straight_share(yaw_rate, noise.turning)
    return math.exp(-dt * (rate if math.isfinite(yaw_rate) else min(noise.relaxation, BLIND_RELAXATION)))


@inlined
def kinematic_predict(state, ax, ay, yaw_rate, noise, dt):
    """Predict [vx, vy] over dt with held accelerations; a missing one keeps the velocity and widens it."""
    mean, cov = state.mean, state.cov
    density, decay = noise.accel, forgetting(yaw_rate, noise, dt)
    if not (math.isfinite(ax) and math.isfinite(ay) and math.isfinite(yaw_rate)):
        ax, ay, yaw_rate, density = 0.0, 0.0, 0.0, noise.missing_accel
    f00, f01, f10, f11 = rotation(yaw_rate, dt)
    g00, g01, g10, g11 = input_gain(yaw_rate, dt)
    vx, vy = mean[0], mean[1]
    mean[0] = f00 * vx + f01 * decay * vy + g00 * ax + g01 * ay
    mean[1] = f10 * vx + f11 * decay * vy + g10 * ax + g11 * ay
    variance = density * density * dt
    propagate(cov, f00, f01 * decay, f10, f11 * decay, variance, 0.0, variance)


@inlined
def kinematic_start(state, sample, car, noise, out):
    """Answer where the car is slow and start on the first sample above the gate; True where it did either."""
    mean, cov = state.mean, state.cov
    slow = below_gate(sample)
    if not slow and state.running[0] == 1:
        return False
    low_speed_answer(sample, car, out)
    state.running[0] = 0
    if slow:
        return True
    vx = sample[VX]
    mean[0], mean[1] = vx, vx * math.tan(out[BETA])
    cov[0, 0], cov[0, 1], cov[1, 0] = noise.speed**2, 0.0, 0.0
    cov[1, 1] = (vx * out[BETA_STD]) ** 2
    state.running[0] = 1
    return True


@inlined
def kinematic_update(state, sample, noise):
    """Update with the measured vx; give the NIS, NaN where vx is only held."""
    mean = state.mean
    if sample[VX_HELD] == 0.0:
        return scalar_update(state, 1.0, 0.0, sample[VX] - mean[0], noise.speed**2)
    mean[0] = max(mean[0], MIN_SPEED)  # the gate cannot see the car stop
    return math.nan


@inlined
def velocity_answer(state, out):
    """Write beta of the state [vx, vy] and its standard deviation."""
    mean, cov = state.mean, state.cov
    speed2 = mean[0] * mean[0] + mean[1] * mean[1]
    out[BETA] = math.atan2(mean[1], mean[0])
    # beta = atan2(vy, vx): its gradient is [-vy, vx] / V^2
    spread = mean[1] ** 2 * cov[0, 0] - 2.0 * mean[0] * mean[1] * cov[0, 1] + mean[0] ** 2 * cov[1, 1]
    out[BETA_STD] = math.sqrt(spread) / speed2


@inlined
def kinematic_step(state, sample, car, noise, dt, out):
    """One sample of the kinematic filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    if kinematic_start(state, sample, car, noise, out):
        return
    kinematic_predict(state, sample[AX], sample[AY], sample[YAW_RATE], noise, dt)
    out[NIS] = kinematic_update(state, sample, noise)
    velocity_answer(state, out)


@kernel
def kinematic_run(state, samples, car, noise, dt, out):
    """All samples of the kinematic filter."""
    for k in range(samples.shape[0]):
        kinematic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class KinematicKF(KernelFilter):
    """Kinematic Kalman filter of one vehicle."""

    noise: KinematicNoise = KinematicNoise()

    told_by_likelihood = ("accel", "speed", "relaxation")
    step_kernel = staticmethod(kinematic_step)
    run_kernel = staticmethod(kinematic_run)

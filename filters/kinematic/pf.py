"""Particle filter on the kinematic model.

State [vx, vy, ax bias, ay bias]; inputs ax, ay and yaw rate; weights from vx and from a rolling rear axle (Atheupe
2023, eq. 18 to 21 and section 7.2). Model and noise are those of `crosscomb.filters.kinematic.kf`, which solves this
linear problem exactly: with many particles both give the same answer. It is here because the paper compares them, not
because it can be better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.particles import LEAST_STD, RESAMPLE_BELOW, cloud, draw_uniform, normalise
from crosscomb.filters.algebra.resampling import RESAMPLING, resample
from crosscomb.filters.base import KernelFilter, starting
from crosscomb.filters.kinematic.kf import (
    BIAS_AX,
    BIAS_AY,
    KinematicKF,
    KinematicNoise,
    inertial_known,
    rolling_measurement,
)
from crosscomb.models.compiled import allocating, kernel
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.signals import MIN_SPEED


class Velocities(NamedTuple):
    """State of the filter, changed in place by its kernel."""

    x: np.ndarray  # (4, n) vx, vy and the biases of ax and ay
    log_weights: np.ndarray  # (n,) up to a constant
    weights: np.ndarray  # (n,) sum to one
    scratch: np.ndarray  # (4, n)
    source: np.ndarray  # (n,) int64, which particle each new one copied last
    scheme: int  # of resampling
    rng: np.random.Generator
    running: np.ndarray  # (1,) 1 above the low-speed gate


@kernel
def first_velocities(state, vx, beta, beta_std, noise):
    """Spread the particles' velocities as the Kalman filter's first covariance; what they know of biases stays.

    Normally distributed: with little noise on the motion the shape of the start lasts.
    """
    resample(state)
    x, vy = state.x, vx * math.tan(beta)
    for i in range(x.shape[1]):
        x[0, i] = vx + noise.speed * state.rng.standard_normal()
        x[1, i] = vy + vx * beta_std * state.rng.standard_normal()


@allocating
def drift_particles(state, noise, dt):
    """Let the biases change over dt."""
    x, draws = state.x, state.scratch
    keep = math.exp(-dt / noise.bias_time)
    shake = noise.accel_bias * math.sqrt(1.0 - keep * keep)
    for row in range(2, 4):
        for i in range(x.shape[1]):
            x[row, i] = keep * x[row, i] + shake * draws[row, i]


@kernel
def move_velocities(state, ax, ay, yaw_rate, noise, dt):
    """Predict every particle with held accelerations; missing ones keep the velocity and widen it."""
    x, draws, density, felt = state.x, state.scratch, noise.accel, 1.0
    if not inertial_known(ax, ay, yaw_rate):
        ax, ay, yaw_rate, density, felt = 0.0, 0.0, 0.0, noise.missing_accel, 0.0
    f00, f01, f10, f11 = rotation(yaw_rate, dt)
    g00, g01, g10, g11 = input_gain(yaw_rate, dt)
    shake_x, shake_y = density * math.sqrt(dt), math.hypot(density, noise.ay_scale * ay) * math.sqrt(dt)
    for i in range(x.shape[1]):
        vx, vy = x[0, i], x[1, i]
        along, across = ax - felt * x[BIAS_AX, i], ay - felt * x[BIAS_AY, i]
        # A speed that is only held cannot tell that the car stops: no particle may reverse.
        x[0, i] = max(f00 * vx + f01 * vy + g00 * along + g01 * across + shake_x * draws[0, i], MIN_SPEED)
        x[1, i] = f10 * vx + f11 * vy + g10 * along + g11 * across + shake_y * draws[1, i]


@kernel
def weigh_velocities(state, sample, car, noise, dt):
    """Add the log likelihood of the measured vx and of a rolling rear axle to the log weights."""
    x, weights = state.x, state.weights
    vx, bias_ay = 0.0, 0.0
    for i in range(weights.size):
        vx += weights[i] * x[0, i]
        bias_ay += weights[i] * x[BIAS_AY, i]
    h, rest, variance = rolling_measurement(sample, vx, bias_ay, car, noise, dt)
    of_speed = 0.5 / noise.speed**2 if sample[at.VX_HELD] == 0.0 else 0.0
    of_rear = 0.5 / variance
    for i in range(weights.size):
        state.log_weights[i] -= of_speed * (sample[at.VX] - x[0, i]) ** 2
        state.log_weights[i] -= of_rear * (rest - h * x[0, i] - x[1, i]) ** 2


@kernel
def weighted_slip(state):
    """Beta of the mean velocity, and its standard deviation to first order [rad]."""
    x, weights = state.x, state.weights
    vx, vy = 0.0, 0.0
    for i in range(weights.size):
        vx += weights[i] * x[0, i]
        vy += weights[i] * x[1, i]
    # beta = atan2(vy, vx): its gradient is [-vy, vx] / V^2
    variance, speed2 = 0.0, vx * vx + vy * vy
    for i in range(weights.size):
        variance += weights[i] * (vx * (x[1, i] - vy) - vy * (x[0, i] - vx)) ** 2
    return math.atan2(vy, vx), max(math.sqrt(variance) / speed2, LEAST_STD)


@allocating
def kinematic_particle_step(state, sample, car, noise, dt, out):
    """One sample of the filter; `out` ``(3,)`` gets beta, its standard deviation and NaN."""
    draw_uniform(state.rng, state.scratch)
    if starting(state.running, sample, car, out):
        drift_particles(state, noise, dt)
        if state.running[0] == 1:
            first_velocities(state, sample[at.VX], out[at.BETA], out[at.BETA_STD], noise)
        return
    move_velocities(state, sample[at.AX], sample[at.AY], sample[at.YAW_RATE], noise, dt)
    drift_particles(state, noise, dt)
    weigh_velocities(state, sample, car, noise, dt)
    effective = normalise(state.log_weights, state.weights)
    out[at.BETA], out[at.BETA_STD] = weighted_slip(state)
    out[at.NIS] = math.nan
    if effective < RESAMPLE_BELOW * state.weights.size:
        resample(state)


@allocating
def kinematic_particle_run(state, samples, car, noise, dt, out):
    """All samples of the filter."""
    for k in range(samples.shape[0]):
        kinematic_particle_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class KinematicPF(KernelFilter):
    """Kinematic particle filter of one vehicle."""

    noise: KinematicNoise = KinematicNoise()
    particles: int = 1000
    resampling: str = "systematic"
    seed: int = 0

    divisors = KinematicKF.divisors
    choices: ClassVar = {**KernelFilter.choices, "resampling": tuple(RESAMPLING)}
    run_kernel = staticmethod(kinematic_particle_run)

    def make_state(self) -> Any:
        """Make the particles before the first sample."""
        state = Velocities(
            **cloud(4, self.particles, self.resampling, self.seed), running=np.zeros(1, dtype=np.int64)
        )
        state.x[2:] = self.noise.accel_bias * state.rng.standard_normal((2, self.particles))
        return state

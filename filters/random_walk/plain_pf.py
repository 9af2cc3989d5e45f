"""Random-walk particle filter whose particles carry the whole state [yaw_rate, beta, fxf, fxr, fyf, fyr].

Uniform first particles and uniform process noise as in Atheupe 2023, section 4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.particles import (
    RESAMPLE_BELOW,
    cloud,
    draw_uniform,
    log_sum,
    normalise,
    weighted_beta,
    weighted_sum,
)
from crosscomb.filters.algebra.resampling import resample
from crosscomb.filters.base import LOG_2_PI, Gaussian, bounded_slip, gaussian, starting
from crosscomb.filters.random_walk.shared import FIRST_SPREAD, first_guess, sin_cos, slip_precision
from crosscomb.filters.single_track.ekf import dynamic_step
from crosscomb.models.compiled import allocating, kernel
from crosscomb.models.single_track import body_rates


class Particles(NamedTuple):
    """State of the particle filter, changed in place by its kernel."""

    x: np.ndarray  # (6, n) yaw_rate, beta, fxf, fxr, fyf, fyr
    log_weights: np.ndarray  # (n,) up to a constant
    weights: np.ndarray  # (n,) sum to one
    scratch: np.ndarray  # (6, n) random numbers, then resampled particles before they are copied back
    running: np.ndarray  # (1,) 1 above the low-speed gate
    ekf: Gaussian
    ekf_out: np.ndarray  # (3,)
    rng: np.random.Generator
    source: np.ndarray  # (n,) int64, which particle each new one copied last
    scheme: int  # of resampling
    evidence: np.ndarray  # (1,) sum of the measurements' log densities; (0,) where nobody asks for it


FAR_OFF = 0.5 * 5.0**2
"""No measurement counts as further off than five standard deviations: a wild one would leave one particle."""


@kernel
def first_particles(particles, sample, beta, car):
    """Spread the particles uniformly around the first guess."""
    x, rng = particles.x, particles.rng
    centre = first_guess(sample, beta, car)
    for row in range(6):
        half = FIRST_SPREAD[row] * (car.mass if row > 1 else 1.0)
        for i in range(x.shape[1]):
            x[row, i] = centre[row] + half * (2.0 * rng.random() - 1.0)
    particles.log_weights[:] = 0.0


@kernel
def move_and_weigh(particles, sample, beta_ekf, std_ekf, car, noise, dt):
    """Predict every particle over dt and add its log likelihood to its log weight."""
    x, log_weights, draws = particles.x, particles.log_weights, particles.scratch
    draw_uniform(particles.rng, draws)
    vx = sample[at.VX]
    cos_f, sin_f = math.cos(sample[at.STEER]), math.sin(sample[at.STEER])
    cos_r, sin_r = math.cos(sample[at.STEER_REAR]), math.sin(sample[at.STEER_REAR])
    root = math.sqrt(dt)
    force, yaw, slip = root * noise.force * car.mass, root * noise.yaw_acceleration, root * noise.slip_rate
    # A missing measurement gets no say: its precision is zero.
    p_yaw = 0.5 / noise.yaw_rate**2 if math.isfinite(sample[at.YAW_RATE]) else 0.0
    p_ax = 0.5 / noise.accel**2 if math.isfinite(sample[at.AX]) else 0.0
    p_ay = 0.5 / noise.accel**2 if math.isfinite(sample[at.AY]) else 0.0
    p_beta = slip_precision(std_ekf, noise, dt)
    z_yaw = sample[at.YAW_RATE] if p_yaw > 0.0 else 0.0
    z_ax = sample[at.AX] if p_ax > 0.0 else 0.0
    z_ay = sample[at.AY] if p_ay > 0.0 else 0.0
    for i in range(x.shape[1]):
        fxf, fxr = x[2, i] + force * draws[2, i], x[3, i] + force * draws[3, i]
        fyf, fyr = x[4, i] + force * draws[4, i], x[5, i] + force * draws[5, i]
        sin_b, cos_b = sin_cos(x[1, i])
        yaw_acceleration, beta_rate, ax, ay = body_rates(
            fxf, fxr, fyf, fyr, vx, x[0, i], cos_f, sin_f, cos_r, sin_r,
            cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b,
        )  # fmt: skip
        yaw_rate = x[0, i] + dt * yaw_acceleration + yaw * draws[0, i]
        beta = bounded_slip(x[1, i] + dt * beta_rate + slip * draws[1, i])
        x[0, i], x[1, i], x[2, i], x[3, i], x[4, i], x[5, i] = yaw_rate, beta, fxf, fxr, fyf, fyr
        log_weights[i] -= (
            min(p_yaw * (z_yaw - yaw_rate) ** 2, FAR_OFF)
            + min(p_ax * (z_ax - ax) ** 2, FAR_OFF)
            + min(p_ay * (z_ay - ay) ** 2, FAR_OFF)
            + p_beta * (beta_ekf - beta) ** 2
        )


@kernel
def log_scale(sample, noise):
    """Log of what the densities of the measurements that are there are divided by."""
    total = 0.0
    if math.isfinite(sample[at.YAW_RATE]):
        total += 0.5 * LOG_2_PI + math.log(noise.yaw_rate)
    for column in (at.AX, at.AY):
        if math.isfinite(sample[column]):
            total += 0.5 * LOG_2_PI + math.log(noise.accel)
    return total


@kernel
def particle_answer(particles, sample, car, noise, dt, out):
    """One sample of the particle filter without resampling; give the effective sample size, inf at low speed."""
    dynamic_step(particles.ekf, sample, car, noise.ekf, dt, particles.ekf_out)
    beta_ekf, std_ekf = particles.ekf_out[at.BETA], particles.ekf_out[at.BETA_STD]
    if starting(particles.running, sample, car, out):
        if particles.running[0] == 1:
            first_particles(particles, sample, beta_ekf, car)
        return math.inf
    if particles.evidence.size > 0:
        particles.evidence[0] -= log_sum(particles.log_weights)
    move_and_weigh(particles, sample, beta_ekf, std_ekf, car, noise, dt)
    if particles.evidence.size > 0:
        particles.evidence[0] += log_sum(particles.log_weights) - log_scale(sample, noise)
    effective = normalise(particles.log_weights, particles.weights)
    out[at.BETA], out[at.BETA_STD] = weighted_beta(particles)
    out[at.NIS] = math.nan
    return effective


@allocating
def particle_step(particles, sample, car, noise, dt, out):
    """One sample; `out` ``(5,)`` gets beta, its standard deviation, NaN and the lateral axle forces."""
    effective = particle_answer(particles, sample, car, noise, dt, out)
    for row in range(4, 6):
        known = effective < math.inf
        out[row - 1] = weighted_sum(particles.weights, particles.x[row]) if known else math.nan
    if effective < RESAMPLE_BELOW * particles.weights.size:
        resample(particles)


@allocating
def particle_run(particles, samples, car, noise, dt, out):
    """All samples of the particle filter."""
    for k in range(samples.shape[0]):
        particle_step(particles, samples[k], car, noise, dt, out[k])


def plain_state(particles: int, resampling: str, seed: int) -> Particles:
    """Make the particles before the first sample."""
    return Particles(
        **cloud(6, particles, resampling, seed),
        running=np.zeros(1, dtype=np.int64),
        ekf=gaussian(),
        ekf_out=np.empty(3),
        evidence=np.empty(0),
    )

"""Particle filter on the nonlinear single-track model.

State [yaw_rate, beta]; weights from yaw rate and ay (Atheupe 2023, eq. 22 and 23, corrected, and section 7.3;
D'Inverno 2021, section 2.2 and eq. 3, with the three resampling schemes compared there). Model and noise are those of
`crosscomb.filters.single_track.ekf`, which is right where this one is; it does not linearise the tyres, which helps
where the spread of beta is as wide as their bend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.particles import (
    RESAMPLE_BELOW,
    UNIFORM,
    cloud,
    draw_uniform,
    normalise,
    weighted_beta,
)
from crosscomb.filters.algebra.resampling import RESAMPLING, resample
from crosscomb.filters.base import KernelFilter, bounded_slip, or_zero, starting
from crosscomb.filters.single_track.ekf import DynamicNoise
from crosscomb.filters.single_track.shared import ay_variance, rates_at, wrong_front_force
from crosscomb.models.compiled import allocating, kernel
from crosscomb.models.single_track import stable_substeps


class SingleTrackParticles(NamedTuple):
    """State of the filter, changed in place by its kernel."""

    x: np.ndarray  # (2, n) yaw_rate, beta
    log_weights: np.ndarray  # (n,) up to a constant
    weights: np.ndarray  # (n,) sum to one
    scratch: np.ndarray  # (2, n)
    source: np.ndarray  # (n,) int64, which particle each new one copied last
    scheme: int  # of resampling
    rng: np.random.Generator
    running: np.ndarray  # (1,) 1 above the low-speed gate


@kernel
def first_slips(state, yaw_rate, beta, beta_std, noise):
    """Spread the particles uniformly, as wide as the Kalman filter's first covariance."""
    x, wide_yaw, wide_beta = state.x, UNIFORM * noise.yaw_rate, UNIFORM * beta_std
    for i in range(x.shape[1]):
        x[0, i] = yaw_rate + wide_yaw * (state.rng.random() - 0.5)
        x[1, i] = beta + wide_beta * (state.rng.random() - 0.5)
    state.log_weights[:] = 0.0


@kernel
def move_slips(state, sample, car, noise, dt):
    """Predict every particle over dt by Euler steps, as many as keep the stiff low-speed modes stable."""
    x, draws, rng = state.x, state.scratch, state.rng
    draw_uniform(rng, draws)
    vx, root, force = sample[at.VX], math.sqrt(dt), wrong_front_force(sample, car, noise)
    yaw_by_force, slip_by_force = car.a / car.yaw_inertia, 1.0 / (car.mass * vx)
    steps = stable_substeps(vx, dt, car)
    for i in range(x.shape[1]):
        yaw_rate, beta = x[0, i], x[1, i]
        for _ in range(steps):
            rates, _, _ = rates_at(yaw_rate, beta, sample, car)
            yaw_rate += dt / steps * rates[0]
            beta = bounded_slip(beta + dt / steps * rates[1])
        wrong = force * UNIFORM * (rng.random() - 0.5) if force > 0.0 else 0.0
        yaw_rate += root * (noise.yaw_acceleration * draws[0, i] + yaw_by_force * wrong)
        beta += root * (noise.slip_rate * draws[1, i] + slip_by_force * wrong)
        x[0, i], x[1, i] = yaw_rate, bounded_slip(beta)


@kernel
def weigh_slips(state, sample, car, noise):
    """Add the log likelihood of the yaw rate and ay that are there to the log weights."""
    x, log_weights = state.x, state.log_weights
    if math.isfinite(sample[at.YAW_RATE]):
        precision = 0.5 / noise.yaw_rate**2
        for i in range(log_weights.size):
            log_weights[i] -= precision * (sample[at.YAW_RATE] - x[0, i]) ** 2
    if math.isfinite(sample[at.AY]):
        precision = 0.5 / ay_variance(sample, car, noise)
        for i in range(log_weights.size):
            _, measured, _ = rates_at(x[0, i], x[1, i], sample, car)
            log_weights[i] -= precision * (sample[at.AY] - measured[1]) ** 2


@allocating
def dynamic_particle_step(state, sample, car, noise, dt, out):
    """One sample of the filter; `out` ``(3,)`` gets beta, its standard deviation and NaN."""
    if starting(state.running, sample, car, out):
        if state.running[0] == 1:
            first_slips(state, or_zero(sample[at.YAW_RATE]), out[at.BETA], out[at.BETA_STD], noise)
        return
    move_slips(state, sample, car, noise, dt)
    weigh_slips(state, sample, car, noise)
    effective = normalise(state.log_weights, state.weights)
    out[at.BETA], out[at.BETA_STD] = weighted_beta(state)
    out[at.NIS] = math.nan
    if effective < RESAMPLE_BELOW * state.weights.size:
        resample(state)


@allocating
def dynamic_particle_run(state, samples, car, noise, dt, out):
    """All samples of the filter."""
    for k in range(samples.shape[0]):
        dynamic_particle_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class DynamicPF(KernelFilter):
    """Single-track particle filter of one vehicle."""

    noise: DynamicNoise = DynamicNoise()
    particles: int = 1000
    resampling: str = "systematic"
    seed: int = 0

    choices: ClassVar = {**KernelFilter.choices, "resampling": tuple(RESAMPLING)}
    run_kernel = staticmethod(dynamic_particle_run)

    def make_state(self) -> Any:
        """Make the particles before the first sample."""
        return SingleTrackParticles(
            **cloud(2, self.particles, self.resampling, self.seed), running=np.zeros(1, dtype=np.int64)
        )

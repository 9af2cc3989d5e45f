"""The random-walk particle filter once more, as one writes it well in numpy: no loop over particles.

Particles are resampled by filterpy, which loops over them in Python, or by numpy's `searchsorted`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from filterpy.monte_carlo import systematic_resample

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.plain_pf import FAR_OFF
from crosscomb.filters.random_walk.shared import FIRST_SPREAD, MOST_DOUBT
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.filters.twins.basic import twin_dynamic_ekf
from crosscomb.filters.twins.shared import walk_samples
from crosscomb.models.single_track import body_rates

array_rates = body_rates.py_func
"""Uncompiled it takes all particles at once."""

Resample = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def twin_random_walk_pf(estimator: RandomWalkPF, inputs: Inputs) -> Estimate:
    """Estimate a log as a `RandomWalkPF` whose forces are drawn, with filterpy's EKF and filterpy's resampling.

    The random numbers are others than the kernel's, so the two agree within the scatter of their seeds.
    filterpy draws from numpy's global generator, which is seeded here.

    Parameters
    ----------
    estimator : RandomWalkPF
    inputs : Inputs
    """
    np.random.seed(estimator.seed)  # noqa: NPY002
    ekf = twin_dynamic_ekf(_ekf_of(estimator), inputs)
    return _particle_filter(estimator, inputs, ekf, lambda weights, _: systematic_resample(weights))


def numpy_random_walk_pf(estimator: RandomWalkPF, inputs: Inputs) -> Estimate:
    """The same filter all in numpy; the EKF's answer, which costs little beside the particles, is the kernel's."""
    return _particle_filter(estimator, inputs, _ekf_of(estimator).run(inputs), _systematic)


def _ekf_of(estimator: RandomWalkPF) -> DynamicEKF:
    return DynamicEKF(estimator.vehicle, estimator.noise.ekf, estimator.tyre)


def _systematic(weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    positions = (np.arange(len(weights)) + rng.random()) / len(weights)
    return np.searchsorted(np.cumsum(weights), positions)


def _particle_filter(estimator: RandomWalkPF, inputs: Inputs, ekf: Estimate, resample: Resample) -> Estimate:
    noise, car, dt, n = estimator.noise, estimator.car, inputs.dt, estimator.particles
    inputs = Inputs(dt, np.column_stack([inputs.samples, ekf.beta, ekf.beta_std]))
    rng = np.random.Generator(np.random.SFC64(estimator.seed))
    scale = np.array([1.0, 1.0, *[car.mass] * 4])[:, None]
    # Uniform noise of unit variance is sqrt(12) wide.
    width = np.array([noise.yaw_acceleration, noise.slip_rate, *[noise.force] * 4])[:, None]
    width = np.sqrt(12.0 * dt) * scale * width
    half = scale * np.array(FIRST_SPREAD)[:, None]
    precisions = 0.5 / np.square([noise.yaw_rate, noise.accel, noise.accel])
    x, random, log_weights = np.empty((6, n)), np.empty((6, n)), np.empty(n)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        yaw_rate, side = np.nan_to_num(sample[[at.YAW_RATE, at.AY]])
        axles = car.mass * side * np.array([car.b, car.a]) / (car.a + car.b)
        centre = np.array([yaw_rate, beta, sample[at.FXF], sample[at.FXR], *axles])
        x[:] = centre[:, None] + half * rng.uniform(-1.0, 1.0, (6, n))
        log_weights[:] = 0.0

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        nonlocal x, random
        vx, z_ax, z_ay, z_yaw, steer, steer_rear = sample[:6].tolist()
        beta_ekf, std_ekf = sample[at.SAMPLE_WIDTH :].tolist()
        rng.random(out=random)
        random -= 0.5
        random *= width
        x[2:] += random[2:]
        yaw_acceleration, beta_rate, ax, ay = array_rates(
            x[2], x[3], x[4], x[5], vx, x[0],
            np.cos(steer), np.sin(steer), np.cos(steer_rear), np.sin(steer_rear), np.cos(x[1]), np.sin(x[1]),
            car.mass, car.yaw_inertia, car.a, car.b,
        )  # fmt: skip
        x[0] += dt * yaw_acceleration + random[0]
        x[1] += dt * beta_rate + random[1]
        np.clip(x[1], -base.MAX_BETA, base.MAX_BETA, out=x[1])
        for predicted, z, precision in zip((x[0], ax, ay), (z_yaw, z_ax, z_ay), precisions, strict=True):
            if np.isfinite(z):
                log_weights[:] -= np.minimum(precision * (predicted - z) ** 2, FAR_OFF)
        doubt = noise.pseudo**2 + min(std_ekf, MOST_DOUBT) ** 2
        log_weights[:] -= 0.5 * dt / doubt * (x[1] - beta_ekf) ** 2
        log_weights[:] -= log_weights.max()
        weights = np.exp(log_weights)
        weights /= weights.sum()
        beta = weights @ x[1]
        beta_std = np.sqrt(weights @ (x[1] - beta) ** 2)
        if 1.0 / (weights @ weights) < 0.5 * n:
            np.take(x, resample(weights, rng), axis=1, mode="clip", out=random)
            x, random = random, x
            log_weights[:] = 0.0
        return beta, beta_std, np.nan

    return walk_samples(inputs, car, start, step)

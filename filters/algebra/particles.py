"""What all particle filters share: random numbers, weights and the answer they give.

A kernel's state holds its particles as ``x`` ``(states, n)`` with ``log_weights`` and ``weights`` ``(n,)``,
``scratch`` ``(states, n)`` and the generator ``rng``. Where row 1 is beta, `weighted_beta` reads the answer.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from crosscomb.filters.algebra.resampling import RESAMPLING
from crosscomb.models.compiled import kernel, summing

UNIFORM = math.sqrt(12.0)  # width of a uniform distribution of unit variance

RESAMPLE_BELOW = 0.5
"""Share of effective particles below which they are drawn anew."""

LEAST_STD = 1e-5
"""Least standard deviation of beta [rad]: also copies of one particle are not certain."""


def cloud(states: int, particles: int, resampling: str, seed: int) -> dict[str, Any]:
    """Make the fields that the states of all particle filters have.

    Parameters
    ----------
    states : int
        At least 2.
    particles : int
    resampling : str
        Key of `RESAMPLING`.
    seed : int
        The same seed gives the same estimate bit for bit.
    """
    return {
        "x": np.zeros((states, particles)),
        "log_weights": np.zeros(particles),
        "weights": np.full(particles, 1.0 / particles),
        "scratch": np.empty((states, particles)),
        "source": np.zeros(particles, dtype=np.int64),
        "scheme": RESAMPLING[resampling],
        "rng": np.random.Generator(np.random.SFC64(seed)),
    }


@kernel
def draw_uniform(rng, noise):
    """Fill ``(states, n)``, an even number of states, with uniform noise of zero mean and unit variance.

    A random double holds 53 bits; it serves two states with 26 each, as drawing is what costs the time.
    """
    half = 2.0**26
    pairs = noise.shape[0] // 2
    for row in range(pairs):
        for i in range(noise.shape[1]):
            noise[row, i] = rng.random()
    for row in range(pairs):
        for i in range(noise.shape[1]):
            scaled = noise[row, i] * half
            whole = math.floor(scaled)
            noise[row, i] = UNIFORM * (whole / half - 0.5)
            noise[row + pairs, i] = UNIFORM * (scaled - whole - 0.5)


@kernel
def largest(values):
    """Largest of some numbers ``(n,)``."""
    best = -math.inf
    for i in range(values.size):
        best = max(best, values[i])
    return best


@kernel
def normalise(log_weights, weights):
    """Turn log weights into weights that sum to one; give the effective sample size."""
    best, total, squares = largest(log_weights), 0.0, 0.0
    for i in range(weights.size):
        log_weights[i] -= best
        weights[i] = math.exp(log_weights[i])
        total += weights[i]
        squares += weights[i] * weights[i]
    for i in range(weights.size):
        weights[i] /= total
    return total * total / squares


@kernel
def log_sum(log_weights):
    """Log of the sum of the weights."""
    best, total = largest(log_weights), 0.0
    for i in range(log_weights.size):
        total += math.exp(log_weights[i] - best)
    return best + math.log(total)


@summing
def weighted_sum(weights, values):
    """Sum of values ``(n,)`` times their weights."""
    total = 0.0
    for i in range(weights.size):
        total += weights[i] * values[i]
    return total


@summing
def weighted_square(weights, values, centre):
    """Sum of squared distances from a centre times their weights."""
    total = 0.0
    for i in range(weights.size):
        total += weights[i] * (values[i] - centre) ** 2
    return total


@kernel
def weighted_beta(particles):
    """Mean and standard deviation of beta over the weighted particles [rad] (Atheupe 2023, eq. 16)."""
    beta, weights = particles.x[1], particles.weights
    mean = 0.0
    for i in range(weights.size):
        mean += weights[i] * beta[i]
    variance = 0.0
    for i in range(weights.size):
        variance += weights[i] * (beta[i] - mean) ** 2
    return mean, max(math.sqrt(variance), LEAST_STD)

"""Find the minimum of a costly function in few evaluations, by a Gaussian-process surrogate.

Each evaluation is made where the surrogate expects the largest improvement (Jones, Schonlau and Welch 1998); the
search is then repeated around the best point, as D'Inverno 2021, section 5, does.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Kernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

CANDIDATES = 256
"""Points at which the expected improvement is looked at, in the whole box and once more near the best; a power of 2."""

NEAR = 0.15
"""Half width of the neighbourhood of the best point, over that of the box."""

FIRST_BOX = 0.5
"""The first points are drawn from this share of the box: far out, functions like ours are bad everywhere."""

REPEAT_BOX = 0.3
"""Half width of the box of each repeat, over that of the one before."""

REFIT_EVERY = 5
"""The surrogate's own parameters are fitted anew after so many evaluations."""

LEAST_PROGRESS = 1e-3
"""An improvement by less does not count as one."""


@dataclass(frozen=True)
class Found:
    """Outcome of a search.

    Attributes
    ----------
    point : (d,)
        Best point, in [-1, 1].
    value : float
        Of the function there.
    evaluations : int
        How many were made.
    """

    point: np.ndarray
    value: float
    evaluations: int


def minimise(
    function: Callable[[np.ndarray], float], dimensions: int, evaluations: int, seed: int, rounds: int = 2
) -> Found:
    """Minimise a function over the box [-1, 1]^d, beginning in its middle.

    Parameters
    ----------
    function : callable
        Takes a point ``(d,)``, gives a finite number.
    dimensions : int
    evaluations : int
        At most so many in each round; a round ends early when a third of them brought nothing.
    seed : int
        The same seed gives the same answer bit for bit.
    rounds : int
        The second and later ones search a smaller box around the best point of the one before.
    """
    rng = np.random.default_rng(seed)
    start = np.zeros(dimensions)
    points, values = [start], [function(start)]
    # Sums in another order would change the last bits, and with them the whole search.
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        low, high = np.full(dimensions, -1.0), np.full(dimensions, 1.0)
        for turn in range(rounds):
            if turn > 0:
                half = REPEAT_BOX * (high - low) / 2.0
                best = points[int(np.argmin(values))]
                low, high = np.maximum(best - half, -1.0), np.minimum(best + half, 1.0)
            _search(function, points, values, low, high, evaluations, rng, first=turn == 0)
    best_index = int(np.argmin(values))
    return Found(points[best_index], values[best_index], len(values))


def _search(
    function: Callable[[np.ndarray], float],
    points: list[np.ndarray],
    values: list[float],
    low: np.ndarray,
    high: np.ndarray,
    evaluations: int,
    rng: np.random.Generator,
    first: bool,
) -> None:
    """One round: append up to `evaluations` points of the box, and their values."""
    queue: list[np.ndarray] = []
    if first:
        number = min(2 * len(low) + 1, evaluations // 3)
        queue = list(_spread(number, FIRST_BOX * low, FIRST_BOX * high, rng))
    patience = max(5, evaluations // 3)
    kernel: Kernel | None = None
    best, idle = min(values), 0
    for made in range(evaluations - (1 if first else 0)):
        if queue:
            point = queue.pop(0)
        else:
            surrogate = _fit(points, values, kernel, refit=kernel is None or made % REFIT_EVERY == 0)
            kernel = surrogate.kernel_
            point = _most_promising(surrogate, points[int(np.argmin(values))], min(values), low, high, rng)
        points.append(point)
        values.append(function(point))
        improved = values[-1] < best - LEAST_PROGRESS
        best, idle = (values[-1], 0) if improved else (best, idle if queue else idle + 1)
        if idle >= patience:
            return


def _fit(
    points: list[np.ndarray], values: list[float], kernel: Kernel | None, refit: bool
) -> GaussianProcessRegressor:
    """Fit the surrogate; each direction has a length of its own, and the noise covers what is jagged."""
    if kernel is None:
        lengths = Matern(np.ones(len(points[0])), (0.1, 20.0), nu=2.5)
        kernel = ConstantKernel(1.0, (0.05, 50.0)) * lengths + WhiteKernel(1e-3, (1e-6, 0.1))
    surrogate = GaussianProcessRegressor(
        kernel, normalize_y=True, optimizer="fmin_l_bfgs_b" if refit else None, random_state=0
    )
    return surrogate.fit(np.array(points), np.array(values))


def _most_promising(
    surrogate: GaussianProcessRegressor,
    best_point: np.ndarray,
    best_value: float,
    low: np.ndarray,
    high: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Point of the box with the largest expected improvement, of those looked at."""
    half = NEAR * (high - low) / 2.0
    near = _spread(CANDIDATES, np.maximum(best_point - half, low), np.minimum(best_point + half, high), rng)
    candidates = np.vstack([_spread(CANDIDATES, low, high, rng), near])
    mean, std = surrogate.predict(candidates, return_std=True)
    gain = best_value - mean
    ratio = gain / np.maximum(std, 1e-12)
    expected = gain * norm.cdf(ratio) + std * norm.pdf(ratio)
    return candidates[int(np.argmax(expected))]


def _spread(number: int, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points ``(number, d)`` spread evenly over a box (a scrambled Sobol sequence)."""
    if number == 0:
        return np.empty((0, len(low)))
    sequence = qmc.Sobol(len(low), seed=rng)
    power = max(0, int(np.ceil(np.log2(number))))
    return low + (high - low) * sequence.random_base2(power)[:number]

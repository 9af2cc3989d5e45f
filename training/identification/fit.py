"""Robust least squares with prior beliefs, and intervals for errors that last.

scipy's solver takes a singular-value decomposition of all rows in every step, which costs ten times the rest:
here there are many rows and few parameters, so the normal equations do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

CORRELATED = 3.0
"""Rows that count as one against the beliefs: errors of models and roads last some tenths of a second."""
OUTLIER = 2.0
"""Residuals, in standard deviations, from which on they count linearly."""
STEPS = 40

Rows = tuple[np.ndarray, np.ndarray]
"""Residuals ``(n,)`` in standard deviations and their slopes ``(n, p)``."""


class Dependence(NamedTuple):
    """How the rows of the residuals depend on each other."""

    blocks: np.ndarray  # (n,) number of the block whose rows may err together
    series: list[slice]  # rows in order of time of one sensor on one log


def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], Rows],
    beliefs: Callable[[np.ndarray], Rows],
    x: np.ndarray,
) -> np.ndarray:
    """Minimise the robust sum of squares by Levenberg's and Marquardt's method.

    Parameters
    ----------
    residuals : callable
        Residuals ``(n,)`` at x, in standard deviations.
    slopes : callable
        The same with their slopes.
    beliefs : callable
        Residuals and slopes of what is believed beforehand; never taken as outliers.
    x : ndarray
        ``(p,)`` where to begin.
    """
    damping = 1e-3
    z, jacobian = slopes(x)
    best = cost(z, beliefs(x)[0])
    for _ in range(STEPS):
        gradient, hessian = _normal(z, jacobian, *beliefs(x))
        improved = False
        while damping < 1e8:
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), -gradient)
            there = residuals(x + step)
            value = cost(there, beliefs(x + step)[0])
            if value < best:
                improved = True
                break
            damping = max(damping, 1e-4) * 6.0
        if not improved:
            break
        gain, best, x = best - value, value, x + step
        damping = max(damping / 6.0, 1e-9)
        if gain < 1e-4 * (1.0 + 1e-2 * best):
            break
        z, jacobian = slopes(x)
    return x


def cost(z: np.ndarray, believed: np.ndarray) -> float:
    """Robust sum of squares of residuals and beliefs."""
    robust = 2.0 * OUTLIER**2 * (np.sqrt(1.0 + (z / OUTLIER) ** 2) - 1.0)
    return float(robust.sum() / CORRELATED + (believed**2).sum())


def covariance(z: np.ndarray, jacobian: np.ndarray, belief: np.ndarray, dependence: Dependence) -> np.ndarray:
    """Covariance of the solution ``(p, p)``, where rows err together.

    The larger, parameter by parameter, of two estimates: the sum over blocks (a sandwich; few blocks make it
    too small) and the one for independent errors, blown up by the time that residuals stay alike.

    Parameters
    ----------
    z, jacobian : ndarray
        At the solution.
    belief : ndarray
        Slopes of the beliefs.
    dependence : Dependence
    """
    size = jacobian.shape[1]
    held = belief.T @ belief
    if len(z) == 0:
        return np.linalg.inv(held)
    _, hessian = _normal(z, jacobian, np.zeros(len(belief)), belief)
    pulled = _weight(z) * z / CORRELATED
    order = np.argsort(dependence.blocks, kind="stable")
    starts = np.flatnonzero(np.diff(dependence.blocks[order], prepend=-1))
    scores = np.add.reduceat(jacobian[order] * pulled[order, None], starts, axis=0)
    few = len(starts) / max(len(starts) - size, 0.5 * len(starts))
    by_blocks = few * scores.T @ scores
    by_time = np.zeros((size, size))
    for rows in dependence.series:
        if rows.stop - rows.start > 10:
            size_2 = float(np.mean(pulled[rows] ** 2)) * lasting(pulled[rows])
            by_time += size_2 * jacobian[rows].T @ jacobian[rows]
    inverse = np.linalg.inv(hessian)
    first, second = (inverse @ (meat + held) @ inverse for meat in (by_blocks, by_time))
    raised = np.sqrt(np.maximum(np.diag(second) / np.maximum(np.diag(first), 1e-300), 1.0))
    return first * np.outer(raised, raised)


def lasting(z: np.ndarray) -> float:
    """Rows that residuals stay alike: the sum of their autocorrelation up to its first zero."""
    z = z - z.mean()
    spectrum = np.fft.rfft(z, 2 * len(z))
    correlation = np.fft.irfft(spectrum * np.conj(spectrum))[: len(z)]
    correlation = correlation / max(correlation[0], 1e-300)
    end = int(np.argmax(correlation <= 0.0)) or len(z)
    return float(max(2.0 * correlation[:end].sum() - 1.0, 1.0))


def _weight(z: np.ndarray) -> np.ndarray:
    return 1.0 / np.sqrt(1.0 + (z / OUTLIER) ** 2)


def _normal(z: np.ndarray, jacobian: np.ndarray, zb: np.ndarray, belief: np.ndarray) -> Rows:
    """Gradient ``(p,)`` and Hessian ``(p, p)`` of half the cost."""
    weighted = jacobian * (_weight(z) / CORRELATED)[:, None]
    return weighted.T @ z + belief.T @ zb, weighted.T @ jacobian + belief.T @ belief

"""Unscented Kalman filters on the planar model: simple, general, simplex and spherical simplex.

State [u, v, r] and measurements as in `crosscomb.filters.planar.shared`; Magic Formula tyres (D'Inverno 2021,
algorithms 4 to 6 and eq. 2). The four differ only in the sigma points: unit vectors s_i with weights, so
that x_i = x + L s_i, L L' = P, have the mean x and the covariance P.

    predict   x = sum w_i f(x_i)          P   = sum c_i (f(x_i) - x) (f(x_i) - x)' + Q
    update    z = sum w_i h(x_i)          Pzz = sum c_i (h(x_i) - z) (h(x_i) - z)' + R
              K = Pxz Pzz^-1              x += K (y - z),  P -= K Pzz K'

Printed is P -= K P_prior K' (algorithm 4, line 16). Also as printed the update reuses the predicted points;
they lack the process noise, and the filter would not be the Kalman filter on a linear model, so points are
drawn anew from the predicted P. The Cholesky factor L is guarded: a pivot lost to rounding is replaced by a
small one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import guarded_cholesky, joint_update
from crosscomb.filters.planar.shared import (
    MEASUREMENTS,
    PlanarFilter,
    answer,
    begin,
    clip_state,
    expect,
    planar_move,
    read_measurements,
    set_process_noise,
    set_sample,
    substeps,
)  # fmt: skip
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.planar import Contacts, contacts, planar_rates


class SigmaPoints(NamedTuple):
    """Sigma points of a distribution with mean 0 and covariance 1."""

    unit: np.ndarray  # (k, n)
    mean_weights: np.ndarray  # (k,)
    cov_weights: np.ndarray  # (k,)


def simple_points(n: int) -> SigmaPoints:
    """Points of the simple filter, both ways along each axis, weights 1 / 2n (D'Inverno 2021, algorithm 4)."""
    weights = np.full(2 * n, 0.5 / n)
    return SigmaPoints(math.sqrt(n) * np.vstack([np.eye(n), -np.eye(n)]), weights, weights)


def general_points(n: int, alpha: float, kappa: float, kurtosis: float) -> SigmaPoints:
    """Points of the general filter, centre and both ways along each axis (D'Inverno 2021, eq. 2, appendix A).

    Parameters
    ----------
    n : int
    alpha, kappa : float
        Spread: the points lie at alpha sqrt(n + kappa).
    kurtosis : float
        beta of the paper; 2 suits a Gaussian.
    """
    square = alpha * alpha * (n + kappa)
    unit = math.sqrt(square) * np.vstack([np.zeros(n), np.eye(n), -np.eye(n)])
    mean_weights = np.full(2 * n + 1, 0.5 / square)
    mean_weights[0] = 1.0 - n / square
    cov_weights = mean_weights.copy()
    cov_weights[0] += 1.0 - alpha * alpha + kurtosis
    return SigmaPoints(unit, mean_weights, cov_weights)


def simplex_points(n: int, centre_weight: float) -> SigmaPoints:
    """Points of the simplex filter, a centre and n + 1 others (D'Inverno 2021, algorithm 6)."""
    first = (1.0 - centre_weight) * 2.0**-n
    weights = np.array([centre_weight, first, *(first * 2.0 ** (i - 2) for i in range(2, n + 2))])
    unit = np.zeros((n + 2, n))
    for j in range(n):
        reach = 1.0 / math.sqrt(2.0 * weights[j + 2])
        unit[1 : j + 2, j] = -reach
        unit[j + 2, j] = reach
    return SigmaPoints(unit, weights, weights)


def spherical_points(n: int, centre_weight: float) -> SigmaPoints:
    """Points of the spherical simplex filter, n + 1 of them on a sphere (D'Inverno 2021, algorithm 5)."""
    weights = np.full(n + 2, (1.0 - centre_weight) / (n + 1))
    weights[0] = centre_weight
    unit = np.zeros((n + 2, n))
    for j in range(1, n + 1):
        reach = 1.0 / math.sqrt(j * (j + 1) * weights[1])
        unit[1 : j + 1, j - 1] = -reach
        unit[j + 1, j - 1] = j * reach
    return SigmaPoints(unit, weights, weights)


class SigmaPointState(NamedTuple):
    """Mean, covariance and scratch of an unscented filter, changed in place."""

    mean: np.ndarray  # (3,)
    cov: np.ndarray  # (3, 3)
    running: np.ndarray  # (1,)
    contact: Contacts
    sigma: SigmaPoints
    points: np.ndarray  # (k, 3)
    images: np.ndarray  # (k, 6) expected measurements of each point
    factor: np.ndarray  # (6, 6)
    q: np.ndarray  # (3, 3)
    z: np.ndarray  # (2, 6) measured, its variance
    s: np.ndarray  # (6, 6)
    cross: np.ndarray  # (6, 3)
    innovation: np.ndarray  # (6,)


@inlined
def draw(mean, cov, sigma, factor, points):
    """Write the sigma points of a distribution into points ``(k, n)``."""
    n = mean.size
    guarded_cholesky(cov, n, factor)
    for p in range(points.shape[0]):
        for i in range(n):
            total = mean[i]
            for j in range(i + 1):
                total += factor[i, j] * sigma.unit[p, j]
            points[p, i] = total


@inlined
def moments(points, sigma, q, mean, cov):
    """Write the weighted mean of points ``(k, n)`` and their covariance plus q ``(n, n)``."""
    n = mean.size
    for i in range(n):
        total = 0.0
        for p in range(points.shape[0]):
            total += sigma.mean_weights[p] * points[p, i]
        mean[i] = total
    for i in range(n):
        for j in range(i + 1):
            total = q[i, j]
            for p in range(points.shape[0]):
                total += sigma.cov_weights[p] * (points[p, i] - mean[i]) * (points[p, j] - mean[j])
            cov[i, j] = cov[j, i] = total


@inlined
def update_by_points(mean, cov, points, images, sigma, z, s, cross, innovation, factor):
    """Update with the measurements that are not NaN; the arrays as in `SigmaPointState`; give the NIS."""
    n, m = mean.size, 0
    for k in range(images.shape[1]):
        if not math.isfinite(z[0, k]):
            continue
        expected = 0.0
        for p in range(images.shape[0]):
            images[p, m] = images[p, k]
            expected += sigma.mean_weights[p] * images[p, k]
        innovation[m] = z[0, k] - expected
        for p in range(images.shape[0]):
            images[p, m] -= expected
        for j in range(m + 1):
            total = z[1, k] if j == m else 0.0
            for p in range(images.shape[0]):
                total += sigma.cov_weights[p] * images[p, m] * images[p, j]
            s[m, j] = total
        for i in range(n):
            total = 0.0
            for p in range(images.shape[0]):
                total += sigma.cov_weights[p] * images[p, m] * (points[p, i] - mean[i])
            cross[m, i] = total
        m += 1
    if m == 0:
        return math.nan
    return joint_update(mean, cov, cross, s, innovation, m, factor)


@inlined
def sigma_point_step(state, sample, car, noise, dt, out):
    """One sample of an unscented filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    mean, cov, points, images = state.mean, state.cov, state.points, state.images
    contact, z = state.contact, state.z
    if begin(mean, cov, state.running, sample, car, noise, out):
        return
    set_sample(contact, sample, car)
    set_process_noise(state.q, sample, car, noise, dt)
    steps = substeps(mean, dt, car)
    draw(mean, cov, state.sigma, state.factor, points)
    for p in range(points.shape[0]):
        planar_move(points[p], contact, steps, dt, car)
    moments(points, state.sigma, state.q, mean, cov)
    clip_state(mean)
    read_measurements(sample, car, noise, z[0], z[1])
    draw(mean, cov, state.sigma, state.factor, points)
    for p in range(points.shape[0]):
        _, _, _, ax, ay = planar_rates(points[p, 0], points[p, 1], points[p, 2], contact, car)
        expect(points[p], ax, ay, contact, images[p])
    out[at.NIS] = update_by_points(
        mean, cov, points, images, state.sigma, z, state.s, state.cross, state.innovation, state.factor
    )
    clip_state(mean)
    answer(mean, cov, out)


@kernel
def sigma_point_run(state, samples, car, noise, dt, out):
    """All samples of an unscented filter."""
    for k in range(samples.shape[0]):
        sigma_point_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class SimpleUKF(PlanarFilter):
    """Simple unscented Kalman filter (D'Inverno 2021, algorithm 4, corrected)."""

    run_kernel = staticmethod(sigma_point_run)

    def sigma_points(self) -> SigmaPoints:
        """Sigma points of three states."""
        return simple_points(3)

    def make_state(self) -> SigmaPointState:
        """Make the kernels' state before the first sample."""
        sigma = self.sigma_points()
        k, m = len(sigma.unit), MEASUREMENTS
        shapes = ((k, 3), (k, m), (m, m), (3, 3), (2, m), (m, m), (m, 3), (m,))
        scratch = (np.zeros(shape) for shape in shapes)
        return SigmaPointState(
            np.zeros(3), np.eye(3), np.zeros(1, dtype=np.int64), contacts(), sigma, *scratch
        )


@dataclass(frozen=True)
class GeneralUKF(SimpleUKF):
    """General unscented Kalman filter with a centre point (D'Inverno 2021, eq. 2)."""

    alpha: float = 1.0
    kappa: float = 0.0
    kurtosis: float = 2.0

    def sigma_points(self) -> SigmaPoints:
        """Sigma points of three states."""
        if not self.alpha > 0.0:
            raise UsageError(f"filter general_ukf: alpha: {self.alpha:g} must be more than 0")
        return general_points(3, self.alpha, self.kappa, self.kurtosis)


@dataclass(frozen=True)
class SimplexUKF(SimpleUKF):
    """Simplex unscented Kalman filter (D'Inverno 2021, algorithm 6)."""

    centre_weight: float = 0.25

    def sigma_points(self) -> SigmaPoints:
        """Sigma points of three states."""
        return simplex_points(3, checked_weight("simplex_ukf", self.centre_weight))


@dataclass(frozen=True)
class SphericalUKF(SimpleUKF):
    """Spherical simplex unscented Kalman filter (D'Inverno 2021, algorithm 5)."""

    centre_weight: float = 0.25

    def sigma_points(self) -> SigmaPoints:
        """Sigma points of three states."""
        return spherical_points(3, checked_weight("spherical_ukf", self.centre_weight))


def checked_weight(name: str, weight: float) -> float:
    """The weight of the centre point, if it is below 1.

    Raises
    ------
    UsageError
        It leaves no weight for the other points.
    """
    if not 0.0 <= weight < 1.0:
        raise UsageError(f"filter {name}: centre_weight: {weight:g} must be at least 0 and less than 1")
    return weight

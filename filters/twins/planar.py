"""The planar filters once more, slow and plain.

First-order, unscented and cubature filters stand on filterpy's classes; it has no iterated or second-order
filter, these are written in numpy as the textbooks have them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import CubatureKalmanFilter, UnscentedKalmanFilter
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.planar.ckf import HORIZON_PRIOR, CubatureRecedingHorizonKF, SqrtCubatureKF
from crosscomb.filters.planar.ekf import FirstOrderEKF, IteratedEKF
from crosscomb.filters.planar.second_order_ekf import SecondOrderEKF
from crosscomb.filters.planar.shared import (
    PlanarFilter,
    clip_state,
    expect,
    planar_move,
    read_measurements,
    set_process_noise,
    set_sample,
    start,
    substeps,
)
from crosscomb.filters.planar.ukf import SigmaPoints, SimpleUKF
from crosscomb.filters.twins.shared import GivenPrediction, nis_of, walk_samples
from crosscomb.models.planar import contacts, planar_hessian, planar_jacobian, planar_rates

Belief = tuple[np.ndarray, np.ndarray]  # mean (3,) and covariance (3, 3)
Predict = Callable[["_Model", np.ndarray, np.ndarray], Belief]
Update = Callable[["_Model", np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, float]]


class _Model:
    """The planar model at one sample, in numpy's terms."""

    def __init__(self, estimator: PlanarFilter, dt: float) -> None:
        self.car, self.noise, self.dt = estimator.car, estimator.noise, dt
        self.contact = contacts()

    def set(self, sample: np.ndarray) -> None:
        self.sample = sample
        set_sample(self.contact, sample, self.car)
        z, variance = np.empty(6), np.empty(6)
        read_measurements(sample, self.car, self.noise, z, variance)
        self.there = np.isfinite(z)
        self.z, self.r = z[self.there], np.diag(variance[self.there])

    def process_noise(self, dt: float) -> np.ndarray:
        q = np.zeros((3, 3))
        set_process_noise(q, self.sample, self.car, self.noise, dt)
        return q

    def substeps(self, x: np.ndarray) -> tuple[int, float]:
        steps = substeps(x, self.dt, self.car)
        return steps, self.dt / steps

    def rates(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """u_dot, v_dot, r_dot, ax, ay, and their Jacobian (5, 3)."""
        jacobian, (u, v, r) = np.empty((5, 3)), x.tolist()
        return np.array(planar_jacobian(u, v, r, self.contact, self.car, jacobian)), jacobian

    def hessians(self, x: np.ndarray) -> np.ndarray:
        hessian, (u, v, r) = np.empty((5, 3, 3)), x.tolist()
        planar_hessian(u, v, r, self.contact, self.car, hessian)
        return hessian

    def move(self, x: np.ndarray, steps: int) -> np.ndarray:
        moved = np.array(x)
        planar_move(moved, self.contact, steps, self.dt, self.car)
        return moved

    def expected(self, x: np.ndarray) -> np.ndarray:
        z, (u, v, r) = np.empty(6), x.tolist()
        _, _, _, ax, ay = planar_rates(u, v, r, self.contact, self.car)
        expect(x, ax, ay, self.contact, z)
        return z[self.there]

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Jacobian of `expected`."""
        _, jacobian = self.rates(x)
        return np.vstack([self.contact.speed_rows, [[0.0, 0.0, 1.0]], jacobian[3:], [[1.0, 0.0, 0.0]]])[
            self.there
        ]


def twin_first_order_ekf(estimator: FirstOrderEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `FirstOrderEKF.run` does, with filterpy's ExtendedKalmanFilter."""
    ekf = GivenPrediction(dim_x=3, dim_z=6)

    def predict(model: _Model, x: np.ndarray, p: np.ndarray) -> Belief:
        ekf.x, ekf.P = x, p
        steps, h = model.substeps(x)
        ekf.Q = model.process_noise(h)
        for _ in range(steps):
            rates, jacobian = model.rates(ekf.x)
            ekf.F = np.eye(3) + h * jacobian[:3]
            ekf.predict(_clipped(ekf.x + h * rates[:3]))
        return ekf.x, ekf.P

    def update(model: _Model, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        if not len(model.z):
            return x, p, math.nan
        ekf.update(model.z, model.rows, model.expected, R=model.r)
        return ekf.x, ekf.P, nis_of(ekf)

    return _run(estimator, inputs, predict, update)


def twin_iterated_ekf(estimator: IteratedEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `IteratedEKF.run` does, in plain numpy."""

    def predict(model: _Model, x: np.ndarray, p: np.ndarray) -> Belief:
        steps, h = model.substeps(x)
        for _ in range(steps):
            rates, jacobian = model.rates(x)
            f = np.eye(3) + h * jacobian[:3]
            x, p = _clipped(x + h * rates[:3]), f @ p @ f.T + model.process_noise(h)
        return x, p

    def update(model: _Model, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        if not len(model.z):
            return x, p, math.nan
        point = x
        for _ in range(estimator.iterations):
            h = model.rows(point)
            s = h @ p @ h.T + model.r
            k = p @ h.T @ np.linalg.inv(s)
            innovation = model.z - model.expected(point) - h @ (x - point)
            point = _clipped(x + k @ innovation)
        keep = np.eye(3) - k @ h
        posterior = keep @ p @ keep.T + k @ model.r @ k.T
        return point, posterior, float(innovation @ np.linalg.solve(s, innovation))

    return _run(estimator, inputs, predict, update)


def twin_second_order_ekf(estimator: SecondOrderEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `SecondOrderEKF.run` does, in plain numpy (Simon 2006, section 13.3.2)."""

    def terms(hessians: np.ndarray, p: np.ndarray) -> Belief:
        products = hessians @ p
        mean = 0.5 * np.trace(products, axis1=1, axis2=2)
        return mean, 0.5 * np.einsum("aij,bji->ab", products, products)

    def predict(model: _Model, x: np.ndarray, p: np.ndarray) -> Belief:
        steps, h = model.substeps(x)
        for _ in range(steps):
            rates, jacobian = model.rates(x)
            f = np.eye(3) + h * jacobian[:3]
            mean, cov = terms(h * model.hessians(x)[:3], p)
            x, p = _clipped(x + h * rates[:3] + mean), f @ p @ f.T + model.process_noise(h) + cov
        return x, p

    def update(model: _Model, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        if not len(model.z):
            return x, p, math.nan
        curvature = np.zeros((6, 3, 3))
        curvature[3:5] = model.hessians(x)[3:]
        mean, cov = terms(curvature[model.there], p)
        h = model.rows(x)
        s = h @ p @ h.T + model.r + cov
        k = p @ h.T @ np.linalg.inv(s)
        innovation = model.z - model.expected(x) - mean
        return (
            _clipped(x + k @ innovation),
            p - k @ s @ k.T,
            float(innovation @ np.linalg.solve(s, innovation)),
        )

    return _run(estimator, inputs, predict, update)


class _Points:
    """Our sigma points in filterpy's clothes."""

    def __init__(self, sigma: SigmaPoints) -> None:
        self.unit, self.Wm, self.Wc = sigma

    def num_sigmas(self) -> int:
        return len(self.unit)

    def sigma_points(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        return x + self.unit @ np.linalg.cholesky(p).T


def twin_ukf(estimator: SimpleUKF, inputs: Inputs) -> Estimate:
    """Estimate a log as an unscented filter's `run` does, with filterpy's UnscentedKalmanFilter."""
    points = _Points(estimator.sigma_points())
    ukf = UnscentedKalmanFilter(3, 6, inputs.dt, None, None, points)

    def predict(model: _Model, x: np.ndarray, p: np.ndarray) -> Belief:
        ukf.x, ukf.P, ukf.Q = x, p, model.process_noise(model.dt)
        steps, _ = model.substeps(x)
        ukf.predict(fx=lambda point, _: model.move(point, steps))
        return _clipped(ukf.x), ukf.P

    def update(model: _Model, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        if not len(model.z):
            return x, p, math.nan
        ukf.update(model.z, R=model.r, hx=model.expected)
        return _clipped(ukf.x), ukf.P, nis_of(ukf)

    return _run(estimator, inputs, predict, update)


def twin_cubature_kf(estimator: SqrtCubatureKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `SqrtCubatureKF.run` does, with filterpy's CubatureKalmanFilter.

    filterpy keeps the predicted points for the update; here they are drawn anew, as Arasaratnam and Haykin
    do.
    """
    return _run(estimator, inputs, *_cubature(inputs.dt))


def twin_receding_horizon(estimator: CubatureRecedingHorizonKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `CubatureRecedingHorizonKF.run` does, with filterpy's CubatureKalmanFilter."""
    predict, update = _cubature(inputs.dt)
    model = _Model(estimator, inputs.dt)
    length = max(round(estimator.horizon / inputs.dt), 1) + 1
    out = np.empty((len(inputs.samples), 3))
    first = 0
    for k, sample in enumerate(inputs.samples):
        base.low_speed_answer(sample, model.car, out[k])
        if base.below_gate(sample):
            first = k + 1
        first = max(first, k + 1 - length)
        if first >= k:
            continue
        opening, answer, x, p = inputs.samples[first], np.empty(3), np.zeros(3), np.zeros((3, 3))
        base.low_speed_answer(opening, model.car, answer)
        start(x, p, opening, answer[at.BETA], HORIZON_PRIOR, estimator.noise)
        for later in inputs.samples[first + 1 : k + 1]:
            model.set(later)
            x, p, nis = update(model, *predict(model, x, p))
        out[k] = *_beta(x, p), nis
    return Estimate(*out.T)


def _cubature(dt: float) -> tuple[Predict, Update]:
    ckf = CubatureKalmanFilter(3, 6, dt, None, None)

    def predict(model: _Model, x: np.ndarray, p: np.ndarray) -> Belief:
        ckf.x, ckf.P, ckf.Q = x[:, None], p, model.process_noise(model.dt)
        steps, _ = model.substeps(x)
        ckf.fx = lambda point, _: model.move(point, steps)
        ckf.predict()
        return _clipped(ckf.x.ravel()), ckf.P

    def update(model: _Model, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        if not len(model.z):
            return x, p, math.nan
        ckf.sigmas_f = spherical_radial_sigmas(x[:, None], p)
        ckf.sigmas_h = np.zeros((len(ckf.sigmas_f), len(model.z)))
        ckf.hx = model.expected
        ckf.update(model.z[:, None], R=model.r)
        return _clipped(ckf.x.ravel()), ckf.P, nis_of(ckf)

    return predict, update


def _clipped(x: np.ndarray) -> np.ndarray:
    clipped = np.array(x)
    clip_state(clipped)
    return clipped


def _beta(x: np.ndarray, p: np.ndarray) -> tuple[float, float]:
    gradient = np.array([-x[1], x[0], 0.0]) / (x[0] ** 2 + x[1] ** 2)
    return math.atan2(x[1], x[0]), math.sqrt(gradient @ p @ gradient)


def _run(estimator: PlanarFilter, inputs: Inputs, predict: Predict, update: Update) -> Estimate:
    """Run one filter over a log: the rolling answer at low speed, else predict and update."""
    model = _Model(estimator, inputs.dt)
    x, p = np.zeros(3), np.zeros((3, 3))

    def begin(sample: np.ndarray, beta: float, beta_std: float) -> None:
        nonlocal x, p
        x, p = np.zeros(3), np.zeros((3, 3))
        start(x, p, sample, beta, beta_std, estimator.noise)

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        nonlocal x, p
        model.set(sample)
        x, p, nis = update(model, *predict(model, x, p))
        x = _clipped(x)
        return *_beta(x, p), nis

    car: Any = estimator.car  # has the wheelbase that `walk_samples` needs
    return walk_samples(inputs, car, begin, step)

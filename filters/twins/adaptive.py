"""The adaptive filters once more, slow and plain, on filterpy's ExtendedKalmanFilter.

All measurements of a sample update at once here, one after the other in the kernels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.single_track.adaptation import Limits, excited, growth
from crosscomb.filters.single_track.dual_ekf import DualEKF
from crosscomb.filters.single_track.friction_ekf import FrictionAdaptiveEKF, friction_bounds
from crosscomb.filters.single_track.tyre_ekf import FIRST_RATES_STD, RATES, RATT, hold_rates
from crosscomb.filters.twins.shared import GivenPrediction, nis_of, walk_samples
from crosscomb.models.parameter_track import SLOPES_SHAPE, lateral_acceleration, parameter_track_rates
from crosscomb.models.single_track import stable_substeps


class PlainEKF(GivenPrediction):
    """filterpy's filter with updates that leave out what is missing."""

    def measure(
        self,
        z: np.ndarray,
        expected: np.ndarray,
        h: np.ndarray,
        variance: np.ndarray,
        free: int | None = None,
    ) -> float:
        """Update with the finite ones of z; give the NIS. States behind `free` are left alone."""
        there = np.isfinite(z)
        if not there.any():
            return math.nan
        rows, r = h[there], np.diag(variance[there])
        if free is None:
            self.update(z[there], lambda _: rows, lambda _: expected[there], R=r)
            return nis_of(self)
        # One after the other: with states left alone the order matters.
        nis, prior, left_alone = 0.0, self.x, np.arange(len(self.x)) >= free
        for row, innovation, noise in zip(rows, (z - expected)[there], variance[there], strict=True):
            y = innovation - row @ (self.x - prior)
            s = row @ self.P @ row + noise
            gain = np.where(left_alone, 0.0, self.P @ row / s)
            left = np.eye(len(self.x)) - np.outer(gain, row)
            self.x = self.x + gain * y
            self.P = left @ self.P @ left.T + noise * np.outer(gain, gain)
            nis += y * y / s
        return float(nis)


def _track(sample: np.ndarray, motion: np.ndarray, parameters: np.ndarray, car: Any) -> tuple:
    """Rates, ay and slopes of the single track under given tyre parameters."""
    slopes, by = np.zeros(SLOPES_SHAPE), np.zeros((4, 2))
    vx, ax, ay, _, steer, steer_rear, fxf, fxr, *_ = sample.tolist()
    ax, ay = (value if math.isfinite(value) else 0.0 for value in (ax, ay))
    yaw_rate, beta = motion.tolist()
    rates = parameter_track_rates(
        yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay, car.law, parameters, car.track, by, slopes
    )  # fmt: skip
    return *rates, slopes


def _growth(variance: np.ndarray, limits: Limits, dt: float) -> np.ndarray:
    """Variance that the walk of the parameters ``(p,)`` adds over dt."""
    return np.clip(limits.spread**2 - variance, 0.0, limits.walk**2 * dt)


def twin_tyre_ekf(estimator: RATT, inputs: Inputs) -> Estimate:
    """Estimate a log as LINT, RATT or RATTE do.

    Parameters
    ----------
    estimator : RATT
    inputs : Inputs
    """
    noise, car, first = estimator.noise, estimator.car, estimator.make_state()
    n, fixed, limits = len(first.cov), first.mean[RATES:], first.limits
    ekf = PlainEKF(dim_x=n, dim_z=2)
    ekf.x, ekf.P = first.mean[:n].copy(), first.cov.copy()

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        ekf.x[:RATES] = beta, np.nan_to_num(sample[at.YAW_RATE]), 0.0, 0.0
        ekf.P[:RATES], ekf.P[:, :RATES] = 0.0, 0.0
        ekf.P[range(4), range(4)] = np.square([beta_std, noise.yaw_rate, *FIRST_RATES_STD])

    def predict(sample: np.ndarray, h: float) -> None:
        tyres = ekf.x[RATES:] if n > RATES else fixed
        yaw_acceleration, beta_rate, _, slopes = _track(sample, ekf.x[[1, 0]], tyres, car)
        slopes, columns = slopes[[1, 0]], [1, 0, *range(3, 3 + n - RATES)]  # the state has beta first
        ekf.F = np.eye(n)
        ekf.F[2:4] = 0.0
        ekf.F[0, 2] = ekf.F[1, 3] = h
        ekf.F[2:4, [0, 1, *range(RATES, n)]] = slopes[:2, columns]
        angle = noise.steer**2 + (noise.missing_steer * sample[at.STEER_HELD]) ** 2
        ekf.Q = np.zeros((n, n))
        ekf.Q[2:4, 2:4] = angle * np.outer(slopes[:2, 2], slopes[:2, 2])
        ekf.Q[2:4, 2:4] += np.diag([noise.slip_rate**2, noise.yaw_acceleration**2])
        ekf.Q /= h
        move = h * ekf.x[2:4]
        ekf.predict(np.array([*(ekf.x[:2] + move), beta_rate, yaw_acceleration, *ekf.x[RATES:]]))
        hold_rates(ekf.x)

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        adapting = excited(sample, noise)
        steps = stable_substeps(sample[at.VX], 2.0 * inputs.dt, car.track)
        for _ in range(steps):
            predict(sample, inputs.dt / steps)
        if adapting and n > RATES:
            ekf.P[range(RATES, n), range(RATES, n)] += _growth(np.diag(ekf.P)[RATES:], limits, inputs.dt)
        ax = np.nan_to_num(sample[at.AX])
        beta, yaw_rate, beta_rate = ekf.x[:3].tolist()
        ay, by_beta, by_rate = lateral_acceleration(beta, yaw_rate, beta_rate, sample[at.VX], ax)
        h = np.zeros((2, n))
        h[0, 1] = 1.0
        h[1, :3] = by_beta, by_rate, by_rate
        variance = np.square([noise.yaw_rate, noise.ay])
        z = sample[[at.YAW_RATE, at.AY]]
        nis = ekf.measure(z, np.array([ekf.x[1], ay]), h, variance, None if adapting or n == RATES else RATES)
        hold_rates(ekf.x)
        if adapting and n > RATES:
            ekf.x[RATES:] = np.clip(ekf.x[RATES:], limits.least, limits.most)
        return ekf.x[0], math.sqrt(ekf.P[0, 0]), nis

    return walk_samples(inputs, car.track, start, step)


def twin_dual_ekf(estimator: DualEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `DualEKF.run` does, with two filters of filterpy, both measurements at once.

    Parameters
    ----------
    estimator : DualEKF
    inputs : Inputs
    """
    noise, car, dt, first = estimator.noise, estimator.car, inputs.dt, estimator.make_state()
    limits, sensitivity = first.limits, np.zeros((2, 4))
    motion, tyres = PlainEKF(dim_x=2, dim_z=2), PlainEKF(dim_x=4, dim_z=2)
    tyres.x, tyres.P = first.tyres.copy(), first.tyre_cov.copy()

    def hold_beta() -> None:
        motion.x[1] = np.clip(motion.x[1], -base.MAX_BETA, base.MAX_BETA)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        motion.x = np.array([np.nan_to_num(sample[at.YAW_RATE]), beta])
        motion.P = np.diag([noise.yaw_rate**2, beta_std**2])
        sensitivity[:] = 0.0

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        wrong = noise.missing_steer * sample[at.STEER_HELD] * car.track.stiffness_front
        aside = wrong * np.array(
            [car.track.a / car.track.yaw_inertia, 1.0 / (car.track.mass * sample[at.VX])]
        )
        steps = stable_substeps(sample[at.VX], dt, car.track)
        for _ in range(steps):
            h = dt / steps
            yaw_acceleration, beta_rate, _, slopes = _track(sample, motion.x, tyres.x, car)
            motion.F = np.eye(2) + h * slopes[:2, :2]
            motion.Q = h * (
                np.diag(np.square([noise.yaw_acceleration, noise.slip_rate])) + np.outer(aside, aside)
            )
            motion.predict(motion.x + h * np.array([yaw_acceleration, beta_rate]))
            hold_beta()
            sensitivity[:] = motion.F @ sensitivity + h * slopes[:2, 3:]
        _, _, ay, slopes = _track(sample, motion.x, tyres.x, car)
        z, there = sample[[at.YAW_RATE, at.AY]], np.isfinite(sample[[at.YAW_RATE, at.AY]])
        h_matrix = np.array([[1.0, 0.0], slopes[2, :2]])
        by_tyres = (h_matrix @ sensitivity + np.array([np.zeros(4), slopes[2, 3:]]))[there]
        expected = np.array([motion.x[0], ay])
        variance = np.array([noise.yaw_rate**2, noise.ay**2 + (wrong / car.track.mass) ** 2])
        nis = motion.measure(z, expected, h_matrix, variance)
        if math.isnan(nis):
            sensitivity[:] = 0.0
        else:
            sensitivity[:] -= motion.K @ by_tyres
        if excited(sample, noise):
            tyres.P[range(4), range(4)] += _growth(np.diag(tyres.P), limits, dt)
            before = tyres.x.copy()
            innovation = (z - expected)[there] + by_tyres @ before
            tyres.update(innovation, lambda _: by_tyres, lambda x: by_tyres @ x, R=motion.S)
        hold_beta()
        tyres.x = np.clip(tyres.x, limits.least, limits.most)
        doubt = sensitivity[1] @ tyres.P @ sensitivity[1]
        return motion.x[1], math.sqrt(motion.P[1, 1] + doubt), nis

    return walk_samples(inputs, car.track, start, step)


def twin_friction_adaptive_ekf(estimator: FrictionAdaptiveEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `FrictionAdaptiveEKF.run` does.

    Parameters
    ----------
    estimator : FrictionAdaptiveEKF
    inputs : Inputs
    """
    noise, car, dt, state = estimator.noise, estimator.car, inputs.dt, estimator.make_state()
    order = [0, 1, 3]  # columns of the slopes
    ekf = PlainEKF(dim_x=3, dim_z=2)
    ekf.x, ekf.P = state.mean.copy(), state.cov.copy()

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        ekf.x[:2] = np.nan_to_num(sample[at.YAW_RATE]), beta
        ekf.P[:2], ekf.P[:, :2] = 0.0, 0.0
        ekf.P[0, 0], ekf.P[1, 1] = noise.yaw_rate**2, beta_std**2

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        adapting = excited(sample, noise)
        wrong = noise.missing_steer * sample[at.STEER_HELD] * car.track.stiffness_front
        aside = wrong * np.array(
            [car.track.a / car.track.yaw_inertia, 1.0 / (car.track.mass * sample[at.VX]), 0.0]
        )
        steps = stable_substeps(sample[at.VX], dt, car.track)
        for _ in range(steps):
            h = dt / steps
            yaw_acceleration, beta_rate, _, slopes = _track(sample, ekf.x[:2], ekf.x[2:], car)
            ekf.F = np.eye(3)
            ekf.F[:2] += h * slopes[:2, order]
            ekf.Q = h * (
                np.diag([noise.yaw_acceleration**2, noise.slip_rate**2, 0.0]) + np.outer(aside, aside)
            )
            ekf.predict(ekf.x + h * np.array([yaw_acceleration, beta_rate, 0.0]))
            ekf.x[1] = np.clip(ekf.x[1], -base.MAX_BETA, base.MAX_BETA)
        if adapting:
            ekf.P[2, 2] += growth(ekf.P[2, 2], noise.friction_walk, noise.friction_spread, dt)
        _, _, ay, slopes = _track(sample, ekf.x[:2], ekf.x[2:], car)
        h_matrix = np.array([[1.0, 0.0, 0.0], slopes[2, order]])
        variance = np.array([noise.yaw_rate**2, noise.ay**2 + (wrong / car.track.mass) ** 2])
        z = sample[[at.YAW_RATE, at.AY]]
        nis = ekf.measure(z, np.array([ekf.x[0], ay]), h_matrix, variance, None if adapting else 2)
        ekf.x[1] = np.clip(ekf.x[1], -base.MAX_BETA, base.MAX_BETA)
        friction_bounds(state._replace(mean=ekf.x), sample, car, adapting)
        return ekf.x[1], math.sqrt(ekf.P[1, 1]), nis

    return walk_samples(inputs, car.track, start, step)

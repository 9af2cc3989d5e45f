"""The two Kalman filters of the switch once more, slow and plain, on filterpy's classes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.kinematic.kf import (
    BRIDGE,
    BRIDGE_ACCEL,
    MEAN_TIME,
    MOST_ACCEL,
    MOST_BIAS,
    MOST_YAW_RATE,
    KinematicKF,
    rolling_measurement,
)
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.filters.twins.shared import GivenPrediction, nis_of, walk_samples
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.models.single_track import single_track_rates, stable_substeps
from crosscomb.signals import MIN_SPEED


class BiasedKalman(KalmanFilter):
    """filterpy's filter with the states and the noise of `KinematicKF`: vx, vy and the accelerometer biases."""

    def __init__(self, noise: Any, dt: float) -> None:
        super().__init__(dim_x=4, dim_z=1, dim_u=2)
        self.noise, self.dt = noise, dt
        self.x, self.P = np.zeros((4, 1)), noise.accel_bias**2 * np.eye(4)
        self.keep = np.diag([1.0, 1.0, *[math.exp(-dt / noise.bias_time)] * 2])
        self.drift = noise.accel_bias**2 * (np.eye(4) - self.keep**2)
        self.means, self.missing = np.full(3, np.nan), 0.0

    def rest(self) -> None:
        """Let the biases drift over a sample without motion."""
        self.predict(u=np.zeros((2, 1)), B=np.zeros((4, 2)), F=self.keep, Q=self.drift)

    def begin(self, sample: np.ndarray, beta: float, beta_std: float) -> None:
        """Start the motion on a sample."""
        vx = sample[at.VX]
        self.x[:2] = [[vx], [vx * math.tan(beta)]]
        self.P[:2, :] = self.P[:, :2] = 0.0
        self.P[0, 0], self.P[1, 1] = self.noise.speed**2, (vx * beta_std) ** 2

    def bridge(self, sample: np.ndarray) -> tuple[np.ndarray, bool]:
        """Inputs of a sample, those that are missing for a short while as their means; tell whether some are."""
        felt = sample[[at.AX, at.AY, at.YAW_RATE]]
        there = np.abs(felt) < [MOST_ACCEL, MOST_ACCEL, MOST_YAW_RATE]
        share = min(self.dt / MEAN_TIME, 1.0)
        means = np.where(np.isnan(self.means), felt, self.means + share * (felt - self.means))
        self.means = np.where(there, means, self.means)
        self.missing = 0.0 if there.all() else self.missing + self.dt
        if there.all() or self.missing > BRIDGE + 1e-9:
            return felt, False
        return np.where(there, felt, self.means), True

    def move(self, sample: np.ndarray) -> None:
        """Predict over a sample."""
        inputs, bridged = self.bridge(sample)
        ax, ay, yaw_rate = inputs.tolist()
        known = abs(ax) < MOST_ACCEL and abs(ay) < MOST_ACCEL and abs(yaw_rate) < MOST_YAW_RATE
        if not known:
            ax, ay, yaw_rate = 0.0, 0.0, 0.0
        gain, f = np.zeros((4, 2)), self.keep.copy()
        gain[:2] = np.reshape(input_gain(yaw_rate, self.dt), (2, 2))
        f[:2, :2] = np.reshape(rotation(yaw_rate, self.dt), (2, 2))
        if known:
            f[:, 2:] -= gain
        density = self.noise.accel if known else self.noise.missing_accel
        across = math.hypot(density, self.noise.ay_scale * ay)
        added = self.drift + self.dt * np.diag([density, across, 0.0, 0.0]) ** 2
        if bridged:
            added[:2, :2] += self.dt * BRIDGE_ACCEL**2 * np.eye(2)
        self.predict(u=np.array([[ax], [ay]]), B=gain, F=f, Q=added)

    def measure(self, row: list[float], value: float, variance: float) -> float:
        """Update with a measurement of vx and vy; give its NIS."""
        self.update(value, R=np.array([[variance]]), H=np.array([[*row, 0.0, 0.0]]))
        return nis_of(self)

    def measure_speed(self, sample: np.ndarray) -> float:
        """Update with vx, where it is there; give its NIS."""
        if sample[at.VX_HELD]:
            self.x[0] = max(self.x[0], MIN_SPEED)
            return math.nan
        return self.measure([1.0, 0.0], sample[at.VX], self.noise.speed**2)

    def limit_slip(self) -> None:
        """Hold the velocity inside its bounds."""
        self.x[0] = max(self.x[0], 0.5 * MIN_SPEED)
        most = math.tan(base.MAX_BETA) * self.x[0]
        self.x[1] = np.clip(self.x[1], -most, most)

    def limit_biases(self) -> None:
        """Hold the biases inside their bounds."""
        most = MOST_BIAS * self.noise.accel_bias
        self.x[2:] = np.clip(self.x[2:], -most, most)


def slip_of(kf: KalmanFilter | ExtendedKalmanFilter) -> tuple[float, float]:
    """Sideslip angle of a filter whose first states are vx and vy, and its standard deviation [rad]."""
    vx, vy = np.ravel(kf.x)[:2]
    gradient = np.array([-vy, vx]) / (vx**2 + vy**2)
    return math.atan2(vy, vx), math.sqrt(gradient @ kf.P[:2, :2] @ gradient)


def twin_kinematic_kf(estimator: KinematicKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `KinematicKF.run` does, with filterpy's KalmanFilter.

    Parameters
    ----------
    estimator : KinematicKF
    inputs : Inputs
    """
    noise, car, dt = estimator.noise, estimator.car, inputs.dt
    kf = BiasedKalman(noise, dt)

    def step(sample: np.ndarray) -> tuple[float, ...]:
        innovations = [math.nan, math.nan]
        kf.move(sample)
        nis = kf.measure_speed(sample)
        if math.isfinite(nis):
            innovations[0] = kf.y.item()
        kf.limit_slip()
        h, rest, variance = rolling_measurement(sample, kf.x[0, 0], kf.x[3, 0], car, noise, dt)
        if math.isfinite(variance):
            kf.measure([h, 1.0], rest, variance)
            innovations[1] = kf.y.item()
        kf.limit_slip()
        kf.limit_biases()
        return *slip_of(kf), nis, *innovations

    return walk_samples(inputs, car, kf.begin, step, kf.rest, estimator.extras)


def twin_dynamic_ekf(estimator: DynamicEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `DynamicEKF.run` does, with filterpy's ExtendedKalmanFilter.

    All measurements of a sample update at once here, one after the other in the kernel.

    Parameters
    ----------
    estimator : DynamicEKF
    inputs : Inputs
    """
    noise, car = estimator.noise, estimator.car
    density = np.diag([noise.yaw_acceleration**2, noise.slip_rate**2])
    ekf = GivenPrediction(dim_x=2, dim_z=2)

    def model(sample: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Rates (2,), expected ay and the Jacobian (4, 2) of the rates, ax and ay at the filter's state."""
        vx, ax, ay, _, steer, steer_rear, fxf, fxr, *_ = sample.tolist()
        yaw_rate, beta = ekf.x.tolist()
        ax, ay = (value if math.isfinite(value) else 0.0 for value in (ax, ay))
        rates, (_, expected_ay), jacobian = single_track_rates(
            yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay, car
        )
        return np.array(rates), expected_ay, np.array(jacobian).reshape(2, 4).T

    def hold_beta() -> None:
        ekf.x[1] = min(max(ekf.x[1], -base.MAX_BETA), base.MAX_BETA)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        ekf.x = np.array([np.nan_to_num(sample[at.YAW_RATE]), beta])
        ekf.P = np.diag([noise.yaw_rate**2, beta_std**2])

    def step(sample: np.ndarray) -> tuple[float, ...]:
        steps = stable_substeps(sample[at.VX], inputs.dt, car)
        h = inputs.dt / steps
        wrong_force = noise.missing_steer * sample[at.STEER_HELD] * car.stiffness_front
        ekf.Q = h * density
        if wrong_force > 0.0:
            wrong = wrong_force * np.array([car.a / car.yaw_inertia, 1.0 / (car.mass * sample[at.VX])])
            ekf.Q += h * np.outer(wrong, wrong)
        for _ in range(steps):
            rates, _, jacobian = model(sample)
            ekf.F = np.eye(2) + h * jacobian[:2]
            ekf.predict(ekf.x + h * rates)
            hold_beta()
        z = sample[[at.YAW_RATE, at.AY]]
        there, innovations = np.isfinite(z), np.full(2, np.nan)
        if not there.any():
            return ekf.x[1], math.sqrt(ekf.P[1, 1]), math.nan, *innovations
        _, expected_ay, jacobian = model(sample)
        expected = np.array([ekf.x[0], expected_ay])[there]
        h_matrix = np.array([[1.0, 0.0], jacobian[3]])[there]
        variance = np.diag([noise.yaw_rate**2, noise.ay**2 + (wrong_force / car.mass) ** 2])[there][:, there]
        ekf.update(z[there], lambda _: h_matrix, lambda _: expected, R=variance)
        innovations[there] = ekf.y
        hold_beta()
        return ekf.x[1], math.sqrt(ekf.P[1, 1]), nis_of(ekf), *innovations

    return walk_samples(inputs, car, start, step, extras=estimator.extras)

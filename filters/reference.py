"""The three filters once more, slow and plain, on filterpy's classes: what the kernels are tested against.

The models are the same functions, so no formula stands here twice; prediction, update and resampling are
filterpy's. Only tests and benchmarks use this module; `estimate` never imports filterpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from filterpy.monte_carlo import systematic_resample

from crosscomb.filters import base
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.dynamic_ekf import DynamicEKF
from crosscomb.filters.kinematic_kf import BLIND_RELAXATION, LEAST_SHARE, KinematicKF
from crosscomb.filters.random_walk_pf import FAR_OFF, FIRST_SPREAD, MOST_DOUBT, RandomWalkPF
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.models.single_track import SingleTrack, body_rates, single_track_rates, stable_substeps
from crosscomb.signals import MIN_SPEED


def _straight(yaw_rate: float, turning: float) -> float:
    share = math.exp(-((yaw_rate / turning) ** 2))
    return share if share > LEAST_SHARE else 0.0


def reference_kinematic_kf(estimator: KinematicKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `KinematicKF.run` does, with filterpy's KalmanFilter.

    Parameters
    ----------
    estimator : KinematicKF
    inputs : Inputs
    """
    noise, dt = estimator.noise, inputs.dt
    kf = KalmanFilter(dim_x=2, dim_z=1, dim_u=2)
    kf.H = np.array([[1.0, 0.0]])
    kf.R = np.array([[noise.speed**2]])

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        kf.x = np.array([[sample[base.VX]], [sample[base.VX] * math.tan(beta)]])
        kf.P = np.diag([noise.speed**2, (sample[base.VX] * beta_std) ** 2])

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        vx, ax, ay, yaw_rate, *_ = sample.tolist()
        density = noise.accel
        rate = noise.relaxation * _straight(yaw_rate, noise.turning)
        if not math.isfinite(yaw_rate):
            rate = min(noise.relaxation, BLIND_RELAXATION)
        forget = np.diag([1.0, math.exp(-rate * dt)])
        if not math.isfinite(ax + ay + yaw_rate):
            ax, ay, yaw_rate, density = 0.0, 0.0, 0.0, noise.missing_accel
        kf.predict(
            u=np.array([[ax], [ay]]),
            B=np.array(input_gain(yaw_rate, dt)).reshape(2, 2),
            F=np.array(rotation(yaw_rate, dt)).reshape(2, 2) @ forget,
            Q=density**2 * dt,
        )
        if sample[base.VX_HELD]:
            kf.update(None)
            kf.x[0] = max(kf.x[0], MIN_SPEED)
        else:
            kf.update(vx)
        vx, vy = kf.x[:, 0].tolist()
        gradient = np.array([-vy, vx]) / (vx**2 + vy**2)
        nis = math.nan if sample[base.VX_HELD] else _nis(kf)
        return math.atan2(vy, vx), math.sqrt(gradient @ kf.P @ gradient), nis

    return _walk(inputs, estimator.car, start, step)


class _SingleTrackEKF(ExtendedKalmanFilter):
    """filterpy's filter with a nonlinear prediction: `predict(u)` takes the predicted state itself."""

    def predict_x(self, u: np.ndarray) -> None:
        self.x = u


def reference_dynamic_ekf(estimator: DynamicEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `DynamicEKF.run` does, with filterpy's ExtendedKalmanFilter.

    All measurements of a sample update at once here, one after the other in the kernel.

    Parameters
    ----------
    estimator : DynamicEKF
    inputs : Inputs
    """
    noise, car = estimator.noise, estimator.car
    density = np.diag([noise.yaw_acceleration**2, noise.slip_rate**2])
    ekf = _SingleTrackEKF(dim_x=2, dim_z=2)

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
        ekf.x = np.array([np.nan_to_num(sample[base.YAW_RATE]), beta])
        ekf.P = np.diag([noise.yaw_rate**2, beta_std**2])

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        steps = stable_substeps(sample[base.VX], inputs.dt, car)
        h = inputs.dt / steps
        wrong_force = noise.missing_steer * sample[base.STEER_HELD] * car.stiffness_front
        ekf.Q = h * density
        if wrong_force > 0.0:
            wrong = wrong_force * np.array([car.a / car.yaw_inertia, 1.0 / (car.mass * sample[base.VX])])
            ekf.Q += h * np.outer(wrong, wrong)
        for _ in range(steps):
            rates, _, jacobian = model(sample)
            ekf.F = np.eye(2) + h * jacobian[:2]
            ekf.predict(ekf.x + h * rates)
            hold_beta()
        z = sample[[base.YAW_RATE, base.AY]]
        there = np.isfinite(z)
        if not there.any():
            return ekf.x[1], math.sqrt(ekf.P[1, 1]), math.nan
        _, expected_ay, jacobian = model(sample)
        expected = np.array([ekf.x[0], expected_ay])[there]
        h_matrix = np.array([[1.0, 0.0], jacobian[3]])[there]
        variance = np.diag([noise.yaw_rate**2, noise.ay**2 + (wrong_force / car.mass) ** 2])[there][:, there]
        ekf.update(z[there], lambda _: h_matrix, lambda _: expected, R=variance)
        hold_beta()
        return ekf.x[1], math.sqrt(ekf.P[1, 1]), _nis(ekf)

    return _walk(inputs, car, start, step)


def reference_random_walk_pf(estimator: RandomWalkPF, inputs: Inputs) -> Estimate:
    """Estimate a log with the model and noise of `RandomWalkPF`, in plain numpy with filterpy's resampling.

    The random numbers are others than the kernel's, so the two agree within the scatter of their seeds.
    filterpy draws from numpy's global generator, which is seeded here.

    Parameters
    ----------
    estimator : RandomWalkPF
    inputs : Inputs
    """
    noise, car, dt, n = estimator.noise, estimator.car, inputs.dt, estimator.particles
    ekf = reference_dynamic_ekf(DynamicEKF(estimator.vehicle, noise.ekf, estimator.tyre), inputs)
    inputs = Inputs(dt, np.column_stack([inputs.samples, ekf.beta, ekf.beta_std]))
    np.random.seed(estimator.seed)  # noqa: NPY002
    rng = np.random.default_rng(estimator.seed)
    scale = np.array([1.0, 1.0, *[car.mass] * 4])
    walk = scale * [noise.yaw_acceleration, noise.slip_rate, *[noise.force] * 4] * np.sqrt(dt)
    x, weights = np.empty((6, n)), np.empty(n)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        yaw_rate, side = np.nan_to_num(sample[[base.YAW_RATE, base.AY]])
        axles = car.mass * side * np.array([car.b, car.a]) / (car.a + car.b)
        centre = np.array([yaw_rate, beta, sample[base.FXF], sample[base.FXR], *axles])
        half = scale * FIRST_SPREAD
        x[:] = rng.uniform((centre - half)[:, None], (centre + half)[:, None], (6, n))
        weights[:] = 1.0 / n

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        # Uniform noise of unit variance is sqrt(3) wide to either side.
        random = walk[:, None] * rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), (6, n))
        x[2:] += random[2:]
        steer, steer_rear = sample[[base.STEER, base.STEER_REAR]]
        yaw_acceleration, beta_rate, ax, ay = body_rates.py_func(
            x[2], x[3], x[4], x[5], sample[base.VX], x[0],
            np.cos(steer), np.sin(steer), np.cos(steer_rear), np.sin(steer_rear), np.cos(x[1]), np.sin(x[1]),
            car.mass, car.yaw_inertia, car.a, car.b,
        )  # fmt: skip
        x[0] += dt * yaw_acceleration + random[0]
        x[1] = np.clip(x[1] + dt * beta_rate + random[1], -base.MAX_BETA, base.MAX_BETA)
        measured = sample[[base.YAW_RATE, base.AX, base.AY, base.SAMPLE_WIDTH]]
        slip_variance = (noise.pseudo**2 + min(sample[base.SAMPLE_WIDTH + 1], MOST_DOUBT) ** 2) / dt
        variances = np.array([noise.yaw_rate**2, noise.accel**2, noise.accel**2, slip_variance])
        misfit = 0.5 * (np.stack([x[0], ax, ay, x[1]]).T - measured) ** 2 / variances
        misfit[:, :3] = np.minimum(misfit[:, :3], FAR_OFF)
        log_likelihood = -misfit[:, np.isfinite(measured)].sum(axis=1)
        weights[:] *= np.exp(log_likelihood - log_likelihood.max())
        weights[:] /= weights.sum()
        beta = weights @ x[1]
        beta_std = np.sqrt(weights @ (x[1] - beta) ** 2)
        if 1.0 / (weights @ weights) < 0.5 * n:
            x[:] = x[:, systematic_resample(weights)]
            weights[:] = 1.0 / n
        return beta, beta_std, np.nan

    return _walk(inputs, car, start, step)


def _walk(
    inputs: Inputs,
    car: SingleTrack,
    start: Callable[[np.ndarray, float, float], None],
    step: Callable[[np.ndarray], tuple[float, float, float]],
) -> Estimate:
    """Give the rolling answer until a sample above the gate starts the filter, then the filter's own."""
    out = np.empty((len(inputs.samples), 3))
    running = False
    for sample, answer in zip(inputs.samples, out, strict=True):
        if running and not base.below_gate(sample):
            answer[:] = step(sample)
            continue
        base.low_speed_answer(sample, car, answer)
        running = not base.below_gate(sample)
        if running:
            start(sample, answer[base.BETA], answer[base.BETA_STD])
    return Estimate(beta=out[:, base.BETA], beta_std=out[:, base.BETA_STD], nis=out[:, base.NIS])


def _nis(kf: KalmanFilter | ExtendedKalmanFilter) -> float:
    innovation = kf.y.ravel()
    return float(innovation @ kf.SI @ innovation)

"""Aided kinematic and dynamic filters once more, slow and plain, on filterpy's classes.

All measurements of a sample update at once here, unless they are linearised anew one after the other.
"""

from __future__ import annotations

import math

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import MAX_BETA, Estimate, Inputs
from crosscomb.filters.kinematic.gnss_kf import UNKNOWN_HEADING, GnssKinematicKF
from crosscomb.filters.kinematic.kf_variants import LEAST_SHARE, ZeroYawKF
from crosscomb.filters.single_track.gnss_ekf import GnssDynamicObserver
from crosscomb.filters.twins.basic import BiasedKalman, slip_of
from crosscomb.filters.twins.shared import GivenPrediction, nis_of, walk_samples
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.models.single_track import single_track_rates, stable_substeps


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def twin_zero_yaw_kf(estimator: ZeroYawKF, inputs: Inputs) -> Estimate:
    """Estimate a log without gaps as `ZeroYawKF.run` does, with filterpy's KalmanFilter.

    Parameters
    ----------
    estimator : ZeroYawKF
    inputs : Inputs
    """
    noise, car, dt = estimator.noise, estimator.car, inputs.dt
    kf = BiasedKalman(noise, dt)

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        vx, _, ay, yaw_rate, _, steer_rear, *_ = sample.tolist()
        kf.move(sample)
        nis = kf.measure_speed(sample)
        share = math.exp(-((yaw_rate / noise.turning) ** 2))
        if share > LEAST_SHARE:
            rear_force = car.mass * ay * car.a / (car.a + car.b)
            steady = steer_rear + car.b * yaw_rate / vx - rear_force / car.stiffness_rear
            nis += kf.measure([0.0, 1.0], vx * math.tan(steady), (noise.pseudo * vx) ** 2 / (dt * share))
        kf.limit_slip()
        kf.limit_biases()
        return *slip_of(kf), nis

    return walk_samples(inputs, car, kf.begin, step, kf.rest)


def twin_gnss_kinematic_kf(estimator: GnssKinematicKF, inputs: Inputs) -> Estimate:
    """Estimate a log without gaps or stops as `GnssKinematicKF.run` does, with filterpy's EKF.

    Parameters
    ----------
    estimator : GnssKinematicKF
    inputs : Inputs
        GNSS columns may be NaN, the others not.
    """
    noise, dt = estimator.noise, inputs.dt
    ekf = GivenPrediction(dim_x=7, dim_z=1)
    keep = math.exp(-dt / noise.bias_time)
    sizes = np.array([noise.gyro_bias, noise.accel_bias, noise.accel_bias, noise.scale])
    age = [noise.outage]

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        vx = sample[at.VX]
        ekf.x = np.array([vx, vx * math.tan(beta), 0.0, 0.0, 0.0, 0.0, 0.0])
        ekf.P = np.diag([noise.speed**2, (vx * beta_std) ** 2, UNKNOWN_HEADING, *sizes**2])

    def predict(sample: np.ndarray) -> None:
        yaw_rate = sample[at.YAW_RATE] - ekf.x[3]
        turn, gain = (np.reshape(f(yaw_rate, dt), (2, 2)) for f in (rotation, input_gain))
        decay = math.exp(-noise.relaxation * min(age[0] / noise.outage, 1.0) * dt)
        turn = turn @ np.diag([1.0, decay])
        velocity = turn @ ekf.x[:2] + gain @ (sample[[at.AX, at.AY]] - ekf.x[4:6])
        ekf.F = np.eye(7)
        ekf.F[3:, 3:] *= keep
        ekf.F[:2, :2], ekf.F[:2, 4:6] = turn, -gain
        ekf.F[:3, 3] = -dt * velocity[1], dt * velocity[0], -dt
        motion = dt * np.array([noise.accel, noise.accel, noise.gyro]) ** 2
        ekf.Q = np.diag([*motion, *(sizes**2 * (1.0 - keep**2))])
        ekf.predict(np.array([*velocity, _wrapped(ekf.x[2] + dt * yaw_rate), *(keep * ekf.x[3:])]))
        if ekf.P[2, 2] > UNKNOWN_HEADING:
            ekf.P[2, :] = ekf.P[:, 2] = 0.0
            ekf.P[2, 2] = UNKNOWN_HEADING
        age[0] += dt

    def update(row: list[float], innovation: float, variance: float) -> float:
        if not math.isfinite(innovation):
            return 0.0
        h = np.array([row])
        ekf.update(np.array([innovation]), lambda _: h, lambda _: np.zeros(1), R=np.array([[variance]]))
        return nis_of(ekf)

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        predict(sample)
        vx, _, _, _, _, _, scale = ekf.x
        row = [1.0 + scale, 0.0, 0.0, 0.0, 0.0, 0.0, vx]
        nis = update(row, sample[at.VX] - row[0] * vx, noise.speed**2)
        row = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
        nis += update(row, _wrapped(sample[at.HEADING] - ekf.x[2]), noise.heading**2)
        speed = math.hypot(*ekf.x[:2])
        row = [*(ekf.x[:2] / speed), 0.0, 0.0, 0.0, 0.0, 0.0]
        nis += update(row, sample[at.GNSS_SPEED] - speed, noise.gnss_velocity**2)
        vx, vy, psi = ekf.x[:3]
        speed2 = vx**2 + vy**2
        row = [-vy / speed2, vx / speed2, 1.0, 0.0, 0.0, 0.0, 0.0]
        innovation = _wrapped(sample[at.GNSS_COURSE] - psi - math.atan2(vy, vx))
        nis += update(row, innovation, noise.gnss_velocity**2 / speed2)
        if np.isfinite(sample[[at.GNSS_COURSE, at.HEADING]]).all():
            age[0] = 0.0
        ekf.x[3:] = np.clip(ekf.x[3:], -6.0 * sizes, 6.0 * sizes)
        return *slip_of(ekf), nis

    return walk_samples(inputs, estimator.car, start, step)


def twin_gnss_dynamic_observer(estimator: GnssDynamicObserver, inputs: Inputs) -> Estimate:
    """Estimate a log without gaps as `GnssDynamicObserver.run` does, with filterpy's ExtendedKalmanFilter.

    Parameters
    ----------
    estimator : GnssDynamicObserver
    inputs : Inputs
        GNSS columns may be NaN, the others not.
    """
    noise, car = estimator.noise, estimator.car
    ekf = GivenPrediction(dim_x=3, dim_z=3)

    def model(sample: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Rates (2,), expected ay and the Jacobian (4, 2) of the rates, ax and ay at the filter's state."""
        vx, ax, ay, _, steer, steer_rear, fxf, fxr, *_ = sample.tolist()
        yaw_rate, beta = ekf.x[:2].tolist()
        rates, (_, expected_ay), jacobian = single_track_rates(
            yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay, car
        )
        return np.array(rates), expected_ay, np.array(jacobian).reshape(2, 4).T

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        ekf.x = np.array([sample[at.YAW_RATE], beta, 0.0])
        ekf.P = np.diag([noise.yaw_rate**2, beta_std**2, noise.disturbance**2])

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        steps = stable_substeps(sample[at.VX], inputs.dt, car)
        h = inputs.dt / steps
        keep = math.exp(-h / noise.disturbance_time)
        ekf.Q = np.diag(
            [h * noise.yaw_acceleration**2, h * noise.slip_rate**2, noise.disturbance**2 * (1.0 - keep**2)]
        )
        for _ in range(steps):
            rates, _, jacobian = model(sample)
            ekf.F = np.diag([1.0, 1.0, keep])
            ekf.F[:2, :2] += h * jacobian[:2]
            ekf.F[1, 2] = h
            rates[1] += ekf.x[2]
            ekf.predict(np.array([*(ekf.x[:2] + h * rates), keep * ekf.x[2]]))
            ekf.x[1] = min(max(ekf.x[1], -MAX_BETA), MAX_BETA)
        _, expected_ay, jacobian = model(sample)
        seen = _wrapped(sample[at.GNSS_COURSE] - sample[at.HEADING] - ekf.x[1])
        rows = 3 if math.isfinite(seen) else 2
        innovation = np.array([sample[at.YAW_RATE] - ekf.x[0], sample[at.AY] - expected_ay, seen])[:rows]
        h_matrix = np.array([[1.0, 0.0, 0.0], [*jacobian[3], 0.0], [0.0, 1.0, 0.0]])[:rows]
        fix = (noise.gnss_velocity * math.cos(ekf.x[1]) / sample[at.VX]) ** 2 + noise.heading**2
        variance = np.diag([noise.yaw_rate**2, noise.ay**2, fix])[:rows, :rows]
        ekf.update(innovation, lambda _: h_matrix, lambda _: np.zeros(rows), R=variance)
        ekf.x[1] = min(max(ekf.x[1], -MAX_BETA), MAX_BETA)
        return ekf.x[1], math.sqrt(ekf.P[1, 1]), nis_of(ekf)

    return walk_samples(inputs, car, start, step)

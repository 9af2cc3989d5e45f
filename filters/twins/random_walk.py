"""The random-walk extended Kalman filters once more, slow and plain, on filterpy's ExtendedKalmanFilter."""

from __future__ import annotations

import math

import numpy as np

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.random_walk.double_track_ekf import DoubleTrackRandomWalkEKF
from crosscomb.filters.random_walk.ekf import RandomWalkEKF, friction_use
from crosscomb.filters.twins.adaptive import PlainEKF
from crosscomb.filters.twins.shared import walk_samples
from crosscomb.models.planar import COS, PEAK, SIDE_ARM, SIN, contacts, set_contacts
from crosscomb.models.random_walk import random_walk_jacobian, random_walk_rates
from crosscomb.signals import MIN_SPEED


def twin_random_walk_ekf(estimator: RandomWalkEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `RandomWalkEKF.run` does with `slip_from` linear or free.

    Parameters
    ----------
    estimator : RandomWalkEKF
    inputs : Inputs
    """
    noise, track, dt = estimator.noise, estimator.car.track, inputs.dt
    ekf, jacobian = PlainEKF(dim_x=6, dim_z=3), np.zeros((4, 6))
    density = np.square([noise.yaw_acceleration, noise.slip_rate, *[noise.force * track.mass] * 4])
    ekf.Q = np.diag(density * dt)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        force = track.mass * np.nan_to_num(sample[at.AY]) / (track.a + track.b)
        ekf.x = np.array(
            [np.nan_to_num(sample[at.YAW_RATE]), beta, sample[at.FXF], sample[at.FXR],
             force * track.b, force * track.a]
        )  # fmt: skip
        ekf.P = np.diag(np.square([noise.yaw_rate, beta_std, *[track.mass] * 4]))

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        given = (sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], track)
        yaw_acceleration, beta_rate, _, _ = random_walk_rates(ekf.x, *given)
        random_walk_jacobian(ekf.x, *given, jacobian)
        ekf.F = np.eye(6)
        ekf.F[:2] += dt * jacobian[:2]
        ekf.predict(ekf.x + dt * np.array([yaw_acceleration, beta_rate, 0.0, 0.0, 0.0, 0.0]))
        h = np.vstack([np.eye(6)[0], jacobian[2:]])
        z = sample[[at.YAW_RATE, at.AX, at.AY]]
        nis = ekf.measure(z, h @ ekf.x, h, np.square([noise.yaw_rate, noise.accel, noise.accel]))
        row = np.array([[0.0, 0.0, 1.0, -1.0, 0.0, 0.0]])
        split = np.array([sample[at.FXF] - sample[at.FXR]])
        ekf.measure(split, row @ ekf.x, row, np.array([(noise.split * track.mass) ** 2]))
        if estimator.slip_from == "linear":
            use = friction_use(ekf.x[0], sample[at.VX], track)
            doubt = noise.slip + abs(ekf.x[5]) / track.stiffness_rear * use
            row = np.array([[-track.b / sample[at.VX], 1.0, 0.0, 0.0, 0.0, 1.0 / track.stiffness_rear]])
            ekf.measure(sample[[at.STEER_REAR]], row @ ekf.x, row, np.array([doubt**2 / dt]))
        ekf.x[1] = np.clip(ekf.x[1], -base.MAX_BETA, base.MAX_BETA)
        return ekf.x[1], math.sqrt(ekf.P[1, 1]), nis

    return walk_samples(inputs, track, start, step)


def twin_double_track_random_walk_ekf(estimator: DoubleTrackRandomWalkEKF, inputs: Inputs) -> Estimate:
    """Estimate a log as `DoubleTrackRandomWalkEKF.run` does, at the default settings or with `measured` u_r.

    Parameters
    ----------
    estimator : DoubleTrackRandomWalkEKF
    inputs : Inputs
    """
    noise, track, car, dt = estimator.noise, estimator.car.track, estimator.car.planar, inputs.dt
    contact = contacts()
    ekf = PlainEKF(dim_x=7, dim_z=3)

    def sums(sample: np.ndarray) -> np.ndarray:
        """Rows by which the wheel forces add to the force along, across, and the moment."""
        ax, ay = np.nan_to_num(sample[[at.AX, at.AY]])
        steer, steer_rear, fxf, fxr = sample[[at.STEER, at.STEER_REAR, at.FXF, at.FXR]].tolist()
        set_contacts(contact, steer, steer_rear, fxf, fxr, ax, ay, car)
        wheels = contact.wheels
        return np.stack([-wheels[:, SIN], wheels[:, COS], wheels[:, SIDE_ARM]])

    def axle_noise(variance: float) -> np.ndarray:
        grip = contact.wheels[:, PEAK]
        share = np.concatenate([grip[:2] / grip[:2].sum(), grip[2:] / grip[2:].sum()])
        same_axle = np.kron(np.eye(2), np.ones((2, 2)))
        cov = np.zeros((7, 7))
        cov[3:, 3:] = np.outer(share, share) * same_axle * variance
        return cov

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        sums(sample)
        u = max(sample[at.VX], MIN_SPEED)
        ekf.x = np.array([u, u * math.tan(beta), np.nan_to_num(sample[at.YAW_RATE]), 0.0, 0.0, 0.0, 0.0])
        ekf.P = axle_noise(car.mass**2)
        ekf.P[:3, :3] = np.diag(np.square([noise.speed, u * beta_std, noise.yaw_rate]))

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        rows = sums(sample)
        per = np.array([car.mass, car.mass, car.yaw_inertia])
        u, v, r, *forces = ekf.x
        x, y, moment = (contact.known + rows @ forces) / per
        ekf.F = np.eye(7)
        ekf.F[:2, :3] += dt * np.array([[0.0, r, v], [-r, 0.0, -u]])
        ekf.F[:3, 3:] = dt * rows / per[:, None]
        ekf.Q = axle_noise((noise.force * car.mass) ** 2 * dt)
        ekf.Q[:3, :3] = dt * np.diag(np.square([noise.accel, noise.accel, noise.yaw_acceleration]))
        ekf.predict(ekf.x + dt * np.array([v * r + x, -u * r + y, moment, 0.0, 0.0, 0.0, 0.0]))
        ekf.x[0] = max(ekf.x[0], MIN_SPEED)
        h = np.zeros((3, 7))
        h[0, 0] = h[1, 2] = 1.0
        h[2, 3:] = rows[1] / car.mass
        expected = h @ ekf.x + [0.0, 0.0, contact.known[1] / car.mass]
        z = sample[[at.VX, at.YAW_RATE, at.AY]]
        if sample[at.VX_HELD]:
            z[0] = math.nan
        if estimator.measured == "u_r":
            z[2] = math.nan
        nis = ekf.measure(z, expected, h, np.square([noise.speed, noise.yaw_rate, noise.ay]))
        u, v, r = ekf.x[:3]
        slip = (ekf.x[5] + ekf.x[6]) / track.stiffness_rear
        doubt = noise.slip + abs(slip) * friction_use(r, u, track)
        row = np.array(
            [[(track.b * r - v) / u**2, 1.0 / u, -track.b / u, 0.0, 0.0, *[1.0 / track.stiffness_rear] * 2]]
        )
        expected = np.array([slip + (v - track.b * r) / u])
        ekf.measure(sample[[at.STEER_REAR]], expected, row, np.array([doubt**2 / dt]))
        ekf.x[0] = max(ekf.x[0], MIN_SPEED)
        u, v = ekf.x[:2]
        gradient = np.array([-v, u]) / (u**2 + v**2)
        return math.atan2(v, u), math.sqrt(gradient @ ekf.P[:2, :2] @ gradient), nis

    return walk_samples(inputs, track, start, step)

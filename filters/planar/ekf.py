"""Extended Kalman filters on the planar model: first order and iterated.

State [u, v, r] and measurements as in `crosscomb.filters.planar.shared`; Magic Formula tyres.

First order (D'Inverno 2021, algorithm 1) and iterated (algorithm 2, corrected): the measurements are
linearised at the iterate x_i, which starts at the prediction, and each iteration starts at the prediction
again:

    K_i = P H_i' (H_i P H_i' + R)^-1
    x_i+1 = x_prior + K_i (y - h(x_i) - H_i (x_prior - x_i))

The expected measurement is h(x_i) + H_i (x_prior - x_i); printed with a minus, which diverges. As
Gauss-Newton steps they converge to the most likely state (MAP). One iteration is the first-order filter.

Right while the tyre law is right, and unlike `dynamic_ekf` without vx as a given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_update_3, propagate_3
from crosscomb.filters.planar.shared import (
    Z_AX,
    Z_AY,
    Z_U,
    Z_YAW_RATE,
    PlanarFilter,
    answer,
    begin,
    clip_state,
    read_measurements,
    set_process_noise,
    set_sample,
    substeps,
)  # fmt: skip
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.planar import Contacts, contacts, planar_jacobian


class PlanarEKFState(NamedTuple):
    """Mean, covariance and scratch of the planar EKFs, changed in place."""

    mean: np.ndarray  # (3,)
    cov: np.ndarray  # (3, 3)
    running: np.ndarray  # (1,)
    iterations: np.ndarray  # (1,)
    contact: Contacts
    jacobian: np.ndarray  # (5, 3) of rates, ax, ay
    q: np.ndarray  # (3, 3)
    z: np.ndarray  # (2, 6) measured, its variance
    prior: np.ndarray  # (4, 3) mean and covariance of the prediction
    point: np.ndarray  # (3,) where the measurements are linearised


def ekf_state(iterations: int = 1) -> PlanarEKFState:
    """Make an unstarted planar EKF."""
    scratch = [np.zeros(shape) for shape in ((5, 3), (3, 3), (2, 6), (4, 3), (3,))]
    running, count = np.zeros(1, dtype=np.int64), np.array([iterations])
    return PlanarEKFState(np.zeros(3), np.eye(3), running, count, contacts(), *scratch)


@inlined
def ekf_predict(mean, cov, contact, jacobian, q, sample, car, noise, dt):
    """Predict mean and covariance over dt by Euler steps, to first order; arrays as in `PlanarEKFState`."""
    steps = substeps(mean, dt, car)
    h = dt / steps
    set_process_noise(q, sample, car, noise, h)
    for _ in range(steps):
        u_dot, v_dot, r_dot, _, _ = planar_jacobian(mean[0], mean[1], mean[2], contact, car, jacobian)
        mean[0] += h * u_dot
        mean[1] += h * v_dot
        mean[2] += h * r_dot
        propagate_3(cov, jacobian, h, q)
        clip_state(mean)


@inlined
def update_linear(mean, cov, rows, z):
    """Update with the measurements that are linear in the state: wheel speeds, or u, and the yaw rate.

    One measurement after the other, which equals the joint update as their noises are independent.

    Parameters
    ----------
    mean, cov, z
        As in `PlanarEKFState`; mean and cov are changed in place.
    rows : (2, 3)
        Of the wheel speeds.

    Returns
    -------
    nis : float
    measured : int
    """
    nis, measured = 0.0, 0
    for k in range(2):
        if math.isfinite(z[0, k]):
            innovation = z[0, k] - (rows[k, 0] * mean[0] + rows[k, 1] * mean[1] + rows[k, 2] * mean[2])
            nis += joseph_update_3(mean, cov, rows[k, 0], rows[k, 1], rows[k, 2], innovation, z[1, k])
            measured += 1
    if math.isfinite(z[0, Z_U]):
        nis += joseph_update_3(mean, cov, 1.0, 0.0, 0.0, z[0, Z_U] - mean[0], z[1, Z_U])
        measured += 1
    if math.isfinite(z[0, Z_YAW_RATE]):
        nis += joseph_update_3(mean, cov, 0.0, 0.0, 1.0, z[0, Z_YAW_RATE] - mean[2], z[1, Z_YAW_RATE])
        measured += 1
    return nis, measured


@inlined
def linear_update(mean, cov, point, contact, jacobian, z, car):
    """Update with all measurements, linearised at a point; arrays as in `PlanarEKFState`; give the NIS."""
    nis, measured = update_linear(mean, cov, contact.speed_rows, z)
    _, _, _, ax, ay = planar_jacobian(point[0], point[1], point[2], contact, car, jacobian)
    for k in range(Z_AX, Z_AY + 1):
        if math.isfinite(z[0, k]):
            h0, h1, h2 = jacobian[k, 0], jacobian[k, 1], jacobian[k, 2]
            expected = ax if k == Z_AX else ay
            expected += h0 * (mean[0] - point[0]) + h1 * (mean[1] - point[1]) + h2 * (mean[2] - point[2])
            nis += joseph_update_3(mean, cov, h0, h1, h2, z[0, k] - expected, z[1, k])
            measured += 1
    return nis if measured > 0 else math.nan


@inlined
def ekf_update(state, sample, car, noise):
    """Update with what is measured, as often as `state.iterations`; give the NIS of the last iteration."""
    mean, cov, prior, point, z = state.mean, state.cov, state.prior, state.point, state.z
    read_measurements(sample, car, noise, z[0], z[1])
    for i in range(3):
        prior[0, i] = point[i] = mean[i]
        for j in range(3):
            prior[1 + i, j] = cov[i, j]
    nis = linear_update(mean, cov, point, state.contact, state.jacobian, z, car)
    clip_state(mean)
    for _ in range(1, state.iterations[0]):
        for i in range(3):
            point[i], mean[i] = mean[i], prior[0, i]
            for j in range(3):
                cov[i, j] = prior[1 + i, j]
        nis = linear_update(mean, cov, point, state.contact, state.jacobian, z, car)
        clip_state(mean)
    return nis


@inlined
def planar_ekf_step(state, sample, car, noise, dt, out):
    """One sample of the first-order and iterated filter; `out` gets beta, its std and the NIS."""
    if begin(state.mean, state.cov, state.running, sample, car, noise, out):
        return
    set_sample(state.contact, sample, car)
    ekf_predict(state.mean, state.cov, state.contact, state.jacobian, state.q, sample, car, noise, dt)
    out[at.NIS] = ekf_update(state, sample, car, noise)
    answer(state.mean, state.cov, out)


@kernel
def planar_ekf_run(state, samples, car, noise, dt, out):
    """All samples of the first-order and iterated filter."""
    for k in range(samples.shape[0]):
        planar_ekf_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class FirstOrderEKF(PlanarFilter):
    """First-order extended Kalman filter on the planar model (D'Inverno 2021, algorithm 1)."""

    run_kernel = staticmethod(planar_ekf_run)

    def make_state(self) -> PlanarEKFState:
        """Make the kernels' state before the first sample."""
        return ekf_state()


@dataclass(frozen=True)
class DoubleTrackEKF(FirstOrderEKF):
    """First-order extended Kalman filter on the double track (Pieralice 2018, eq. 1 to 6)."""

    track: str = "double"


@dataclass(frozen=True)
class IteratedEKF(FirstOrderEKF):
    """Iterated extended Kalman filter on the planar model (D'Inverno 2021, algorithm 2, corrected)."""

    iterations: int = 4

    def make_state(self) -> PlanarEKFState:
        """Make the kernels' state before the first sample."""
        return ekf_state(self.iterations)

"""Second-order extended Kalman filter on the planar model.

State [u, v, r] and measurements as in `crosscomb.filters.planar`; Magic Formula tyres. D'Inverno 2021,
algorithm 3, with the terms of the covariances that it lacks (Simon 2006, section 13.3.2), over an Euler step
f(x) = x + dt g(x) with Hessians F_i of f and H_i of h, e_i being the i-th unit vector:

    x = f(x) + 1/2 sum e_i tr(F_i P)    P = F P F' + Q + 1/2 [tr(F_i P F_j P)]
    z = h(x) + 1/2 sum e_i tr(H_i P)    S = H P H' + R + 1/2 [tr(H_i P H_j P)]

The second-order terms tell how far the tyre law bends within the spread of the state. Where the spread
reaches beyond the peak of the tyre, a parabola is no good picture of it and they overstate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from crosscomb.filters.base import NIS
from crosscomb.filters.dense import joint_update, propagate_3
from crosscomb.filters.planar import (
    MEASUREMENTS,
    Z_AX,
    Z_AY,
    Z_U,
    Z_YAW_RATE,
    PlanarFilter,
    answer,
    begin,
    clip_state,
    expect,
    read_measurements,
    set_process_noise,
    set_sample,
    substeps,
)  # fmt: skip
from crosscomb.filters.planar_ekf import PlanarEKFState, ekf_state
from crosscomb.models.planar import planar_hessian, planar_jacobian


class SecondOrderState(NamedTuple):
    """A planar EKF with scratch for the second-order terms, changed in place."""

    ekf: PlanarEKFState
    rows: np.ndarray  # (6, 3) measurement matrix
    expected: np.ndarray  # (6,)
    hessian: np.ndarray  # (5, 3, 3)
    product: np.ndarray  # (5, 3, 3) Hessians times covariance
    s: np.ndarray  # (6, 6) covariance of the innovation
    factor: np.ndarray  # (6, 6)
    cross: np.ndarray  # (6, 3)
    innovation: np.ndarray  # (6,)


@njit(cache=True)
def curvature_terms(state, first, count, car):
    """Hessians times covariance at the mean, of the answers first, first + 1, ... of `planar_rates`."""
    mean, cov = state.ekf.mean, state.ekf.cov
    planar_hessian(mean[0], mean[1], mean[2], state.ekf.contact, car, state.hessian)
    for a in range(first, first + count):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += state.hessian[a, i, k] * cov[k, j]
                state.product[a, i, j] = total


@njit(cache=True)
def is_curved(k):
    """Tell whether measurement k is nonlinear in the state."""
    return k in (Z_AX, Z_AY)


@njit(cache=True)
def trace_of(product, a):
    """tr(D_a P)."""
    return product[a, 0, 0] + product[a, 1, 1] + product[a, 2, 2]


@njit(cache=True)
def trace_of_pair(product, a, b):
    """tr(D_a P D_b P)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += product[a, i, j] * product[b, j, i]
    return total


@njit(cache=True)
def second_order_predict(state, sample, car, noise, dt):
    """Predict mean and covariance over dt by Euler steps, to second order."""
    ekf, mean, q, product = state.ekf, state.ekf.mean, state.ekf.q, state.product
    steps = substeps(mean, dt, car)
    h = dt / steps
    for _ in range(steps):
        set_process_noise(q, sample, car, noise, h)
        curvature_terms(state, 0, 3, car)
        u_dot, v_dot, r_dot, _, _ = planar_jacobian(mean[0], mean[1], mean[2], ekf.contact, car, ekf.jacobian)
        mean[0] += h * (u_dot + 0.5 * trace_of(product, 0))
        mean[1] += h * (v_dot + 0.5 * trace_of(product, 1))
        mean[2] += h * (r_dot + 0.5 * trace_of(product, 2))
        for i in range(3):
            for j in range(i + 1):
                q[i, j] += 0.5 * h * h * trace_of_pair(product, i, j)
        propagate_3(ekf.cov, ekf.jacobian, h, q)
        clip_state(mean)


@njit(cache=True)
def linearise(state, car):
    """Set expected measurements and measurement matrix at the mean."""
    mean, contact, jacobian, rows = state.ekf.mean, state.ekf.contact, state.ekf.jacobian, state.rows
    _, _, _, ax, ay = planar_jacobian(mean[0], mean[1], mean[2], contact, car, jacobian)
    expect(mean, ax, ay, contact, state.expected)
    for j in range(3):
        rows[0, j], rows[1, j] = contact.speed_rows[0, j], contact.speed_rows[1, j]
        rows[Z_AX, j], rows[Z_AY, j] = jacobian[3, j], jacobian[4, j]
    rows[Z_YAW_RATE, 2] = 1.0
    rows[Z_U, 0] = 1.0


@njit(cache=True)
def second_order_update(state, sample, car, noise):
    """Update with what is measured at once, to second order; give the NIS."""
    ekf, s, cross = state.ekf, state.s, state.cross
    cov, z, rows = ekf.cov, ekf.z, state.rows
    read_measurements(sample, car, noise, z[0], z[1])
    linearise(state, car)
    curvature_terms(state, 3, 2, car)
    m = 0
    for k in range(MEASUREMENTS):
        if not math.isfinite(z[0, k]):
            continue
        state.innovation[m] = z[0, k] - state.expected[k]
        if is_curved(k):
            state.innovation[m] -= 0.5 * trace_of(state.product, k)
        for i in range(3):
            cross[m, i] = rows[k, 0] * cov[0, i] + rows[k, 1] * cov[1, i] + rows[k, 2] * cov[2, i]
        column = 0
        for j in range(k + 1):
            if not math.isfinite(z[0, j]):
                continue
            total = cross[m, 0] * rows[j, 0] + cross[m, 1] * rows[j, 1] + cross[m, 2] * rows[j, 2]
            if is_curved(k) and is_curved(j):
                total += 0.5 * trace_of_pair(state.product, k, j)
            s[m, column] = total
            column += 1
        s[m, m] += z[1, k]
        m += 1
    if m == 0:
        return math.nan
    nis = joint_update(ekf.mean, cov, cross, s, state.innovation, m, state.factor)
    clip_state(ekf.mean)
    return nis


@njit(cache=True)
def second_order_step(state, sample, car, noise, dt, out):
    """One sample of the second-order filter; `out` gets beta, its std and the NIS."""
    ekf = state.ekf
    if begin(ekf.mean, ekf.cov, ekf.running, sample, car, noise, out):
        return
    set_sample(ekf.contact, sample, car)
    second_order_predict(state, sample, car, noise, dt)
    out[NIS] = second_order_update(state, sample, car, noise)
    answer(ekf.mean, ekf.cov, out)


@njit(cache=True)
def second_order_run(state, samples, car, noise, dt, out):
    """All samples of the second-order filter."""
    for k in range(samples.shape[0]):
        second_order_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class SecondOrderEKF(PlanarFilter):
    """Second-order extended Kalman filter on the planar model (D'Inverno 2021, algorithm 3, corrected)."""

    step_kernel = staticmethod(second_order_step)
    run_kernel = staticmethod(second_order_run)

    def make_state(self) -> SecondOrderState:
        """Make the kernels' state before the first sample."""
        shapes = ((6, 3), (6,), (5, 3, 3), (5, 3, 3), (6, 6), (6, 6), (6, 3), (6,))
        return SecondOrderState(ekf_state(), *(np.zeros(shape) for shape in shapes))

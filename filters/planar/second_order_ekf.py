"""Second-order extended Kalman filter on the planar model.

State [u, v, r] and measurements as in `crosscomb.filters.planar.shared`; Magic Formula tyres. D'Inverno 2021,
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

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_update_3, propagate_3
from crosscomb.filters.planar.ekf import PlanarEKFState, ekf_state, update_linear
from crosscomb.filters.planar.shared import (
    Z_AX,
    Z_AY,
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
from crosscomb.models.planar import planar_hessian, planar_jacobian


class SecondOrderState(NamedTuple):
    """A planar EKF with scratch for the second-order terms, changed in place."""

    ekf: PlanarEKFState
    hessian: np.ndarray  # (5, 3, 3)
    product: np.ndarray  # (5, 3, 3) Hessians times covariance


@inlined
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


@inlined
def trace_of(product, a):
    """tr(D_a P)."""
    return product[a, 0, 0] + product[a, 1, 1] + product[a, 2, 2]


@inlined
def trace_of_pair(product, a, b):
    """tr(D_a P D_b P)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += product[a, i, j] * product[b, j, i]
    return total


@inlined
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


@inlined
def second_order_update(state, sample, car, noise):
    """Update with what is measured, to second order; give the NIS.

    The curvature of ax and ay is noise to the update, common to both. It is the joint update, written as one
    measurement after the other: ay less the part of its noise that ax explains.
    """
    ekf, product = state.ekf, state.product
    mean, cov, z, jacobian, point = ekf.mean, ekf.cov, ekf.z, ekf.jacobian, ekf.point
    read_measurements(sample, car, noise, z[0], z[1])
    for i in range(3):
        point[i] = mean[i]
    _, _, _, ax, ay = planar_jacobian(point[0], point[1], point[2], ekf.contact, car, jacobian)
    curvature_terms(state, Z_AX, 2, car)
    left_x = z[0, Z_AX] - ax - 0.5 * trace_of(product, Z_AX)
    left_y = z[0, Z_AY] - ay - 0.5 * trace_of(product, Z_AY)
    variance_x = z[1, Z_AX] + 0.5 * trace_of_pair(product, Z_AX, Z_AX)
    variance_y = z[1, Z_AY] + 0.5 * trace_of_pair(product, Z_AY, Z_AY)
    common = 0.5 * trace_of_pair(product, Z_AX, Z_AY)
    nis, measured = update_linear(mean, cov, ekf.contact.speed_rows, z)
    share = 0.0
    if math.isfinite(left_x):
        nis += update_row(mean, cov, point, jacobian, 1.0, 0.0, left_x, variance_x)
        share = common / variance_x
        left_y -= share * left_x
        variance_y -= share * common
        measured += 1
    if math.isfinite(left_y):
        nis += update_row(mean, cov, point, jacobian, -share, 1.0, left_y, variance_y)
        measured += 1
    clip_state(mean)
    return nis if measured > 0 else math.nan


@inlined
def update_row(mean, cov, point, jacobian, a, b, left, variance):
    """Update with a ax + b ay, linearised at a point where its innovation is `left`; give the NIS."""
    h0 = a * jacobian[Z_AX, 0] + b * jacobian[Z_AY, 0]
    h1 = a * jacobian[Z_AX, 1] + b * jacobian[Z_AY, 1]
    h2 = a * jacobian[Z_AX, 2] + b * jacobian[Z_AY, 2]
    left -= h0 * (mean[0] - point[0]) + h1 * (mean[1] - point[1]) + h2 * (mean[2] - point[2])
    return joseph_update_3(mean, cov, h0, h1, h2, left, variance)


@inlined
def second_order_step(state, sample, car, noise, dt, out):
    """One sample of the second-order filter; `out` gets beta, its std and the NIS."""
    ekf = state.ekf
    if begin(ekf.mean, ekf.cov, ekf.running, sample, car, noise, out):
        return
    set_sample(ekf.contact, sample, car)
    second_order_predict(state, sample, car, noise, dt)
    out[at.NIS] = second_order_update(state, sample, car, noise)
    answer(ekf.mean, ekf.cov, out)


@kernel
def second_order_run(state, samples, car, noise, dt, out):
    """All samples of the second-order filter."""
    for k in range(samples.shape[0]):
        second_order_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class SecondOrderEKF(PlanarFilter):
    """Second-order extended Kalman filter on the planar model (D'Inverno 2021, algorithm 3, corrected)."""

    run_kernel = staticmethod(second_order_run)

    def make_state(self) -> SecondOrderState:
        """Make the kernels' state before the first sample."""
        return SecondOrderState(ekf_state(), np.zeros((5, 3, 3)), np.zeros((5, 3, 3)))

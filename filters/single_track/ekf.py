"""Dynamic extended Kalman filter on the nonlinear single-track model.

State [yaw_rate, beta]; measurements yaw rate and ay (Atheupe 2023, eq. 22 and 23, corrected). The longitudinal
forces are inputs taken from ax or the wheel torques, so the ax row of eq. 23 tells nothing new and is left out.
Right while the tyre law is right; wrong when the car slides on another friction than the vehicle file's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from crosscomb.filters import columns as at
from crosscomb.filters.base import KernelFilter, bounded_slip, joined_nis, propagate, scalar_update, starting
from crosscomb.filters.single_track.shared import (
    ay_variance,
    motion_noise,
    rates_at,
    start_doubt,
    start_motion,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.single_track import stable_substeps


class DynamicNoise(NamedTuple):
    """Noise settings of the dynamic filter; process densities, so that they hold at every rate."""

    yaw_acceleration: float = 0.6  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.04  # model error [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 2.0  # measured ay, with what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]


@inlined
def dynamic_predict(state, sample, car, noise, dt):
    """Predict [yaw_rate, beta] over dt by Euler steps, as many as keep the stiff low-speed modes stable."""
    mean = state.mean
    of_yaw, of_both, of_slip = motion_noise(sample, car, noise)
    steps = stable_substeps(sample[at.VX], dt, car)
    h = dt / steps
    for _ in range(steps):
        rates, _, (yaw_r, slip_r, _, _, yaw_b, slip_b, _, _) = rates_at(mean[0], mean[1], sample, car)
        mean[0] += h * rates[0]
        mean[1] = bounded_slip(mean[1] + h * rates[1])
        propagate(
            state.cov, 1.0 + h * yaw_r, h * yaw_b, h * slip_r, 1.0 + h * slip_b,
            of_yaw * h, of_both * h, of_slip * h,
        )  # fmt: skip


@inlined
def dynamic_update(state, sample, car, noise):
    """Update with the yaw rate and ay that are there.

    One after the other with the Jacobian of the prediction, which equals the joint update as their noises are
    independent.

    Returns
    -------
    nis : float
        NaN without any.
    innovation_yaw_rate, innovation_ay : float [rad/s], [m/s^2]
        Measured minus predicted, both from before the update; NaN where not measured.
    """
    mean = state.mean
    yaw_prior, beta_prior = mean[0], mean[1]
    _, measured, jacobian = rates_at(yaw_prior, beta_prior, sample, car)
    ay_r, ay_b = jacobian[3], jacobian[7]
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        nis = scalar_update(state, 1.0, 0.0, sample[at.YAW_RATE] - yaw_prior, noise.yaw_rate**2)
    if math.isfinite(sample[at.AY]):
        expected = measured[1] + ay_r * (mean[0] - yaw_prior) + ay_b * (mean[1] - beta_prior)
        variance = ay_variance(sample, car, noise)
        nis = joined_nis(nis, scalar_update(state, ay_r, ay_b, sample[at.AY] - expected, variance))
    mean[1] = bounded_slip(mean[1])
    return nis, sample[at.YAW_RATE] - yaw_prior, sample[at.AY] - measured[1]


@inlined
def dynamic_step(state, sample, car, noise, dt, out):
    """One sample of the dynamic filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS.

    Gives the innovations of yaw rate [rad/s] and ay [m/s^2], NaN where nothing was updated.
    """
    if starting(state.running, sample, car, out):
        start_motion(state.mean, sample, out)
        start_doubt(state.cov, noise, out)
        return math.nan, math.nan
    dynamic_predict(state, sample, car, noise, dt)
    out[at.NIS], innovation_yaw_rate, innovation_ay = dynamic_update(state, sample, car, noise)
    out[at.BETA] = state.mean[1]
    out[at.BETA_STD] = math.sqrt(state.cov[1, 1])
    return innovation_yaw_rate, innovation_ay


@kernel
def dynamic_run(state, samples, car, noise, dt, out):
    """All samples; `out` ``(n, 5)`` gets the innovations too, as in `DynamicEKF.extras`."""
    for k in range(samples.shape[0]):
        out[k, at.NIS + 1], out[k, at.NIS + 2] = dynamic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class DynamicEKF(KernelFilter):
    """Dynamic extended Kalman filter of one vehicle."""

    noise: DynamicNoise = DynamicNoise()

    extras = ("innovation_yaw_rate [rad/s]", "innovation_ay [m/s^2]")
    odd_innovations = extras
    told_by_likelihood = ("yaw_acceleration", "slip_rate", "yaw_rate", "ay")
    run_kernel = staticmethod(dynamic_run)

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
from crosscomb.filters.base import (
    MAX_BETA,
    KernelFilter,
    below_gate,
    low_speed_answer,
    propagate,
    scalar_update,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.single_track import single_track_rates, stable_substeps


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
    vx = sample[at.VX]
    ax = sample[at.AX] if math.isfinite(sample[at.AX]) else 0.0
    ay = sample[at.AY] if math.isfinite(sample[at.AY]) else 0.0
    # The error of a held steering angle acts through the front tyres. It lasts about a second, so as white noise
    # its density is its size.
    wrong_force = noise.missing_steer * sample[at.STEER_HELD] * car.stiffness_front
    wrong_yaw, wrong_slip = wrong_force * car.a / car.yaw_inertia, wrong_force / (car.mass * vx)
    steps = stable_substeps(vx, dt, car)
    h = dt / steps
    for _ in range(steps):
        rates, _, jacobian = single_track_rates(
            mean[0],
            mean[1],
            vx,
            sample[at.STEER],
            sample[at.STEER_REAR],
            sample[at.FXF],
            sample[at.FXR],
            ax,
            ay,
            car,
        )
        yaw_r, slip_r, _, _, yaw_b, slip_b, _, _ = jacobian
        mean[0] += h * rates[0]
        mean[1] = min(max(mean[1] + h * rates[1], -MAX_BETA), MAX_BETA)
        propagate(
            state.cov, 1.0 + h * yaw_r, h * yaw_b, h * slip_r, 1.0 + h * slip_b,
            (noise.yaw_acceleration**2 + wrong_yaw**2) * h,
            wrong_yaw * wrong_slip * h,
            (noise.slip_rate**2 + wrong_slip**2) * h,
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
    ax = sample[at.AX] if math.isfinite(sample[at.AX]) else 0.0
    ay = sample[at.AY] if math.isfinite(sample[at.AY]) else 0.0
    _, measured, jacobian = single_track_rates(
        yaw_prior,
        beta_prior,
        sample[at.VX],
        sample[at.STEER],
        sample[at.STEER_REAR],
        sample[at.FXF],
        sample[at.FXR],
        ax,
        ay,
        car,
    )
    ay_r, ay_b = jacobian[3], jacobian[7]
    wrong_ay = noise.missing_steer * sample[at.STEER_HELD] * car.stiffness_front / car.mass
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        nis = scalar_update(state, 1.0, 0.0, sample[at.YAW_RATE] - yaw_prior, noise.yaw_rate**2)
    if math.isfinite(sample[at.AY]):
        expected = measured[1] + ay_r * (mean[0] - yaw_prior) + ay_b * (mean[1] - beta_prior)
        part = scalar_update(state, ay_r, ay_b, sample[at.AY] - expected, noise.ay**2 + wrong_ay**2)
        nis = part if math.isnan(nis) else nis + part
    mean[1] = min(max(mean[1], -MAX_BETA), MAX_BETA)
    return nis, sample[at.YAW_RATE] - yaw_prior, sample[at.AY] - measured[1]


@inlined
def dynamic_step(state, sample, car, noise, dt, out):
    """One sample of the dynamic filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS.

    Gives the innovations of yaw rate [rad/s] and ay [m/s^2], NaN where nothing was updated.
    """
    mean, cov = state.mean, state.cov
    if below_gate(sample):
        low_speed_answer(sample, car, out)
        state.running[0] = 0
        return math.nan, math.nan
    if state.running[0] == 0:
        low_speed_answer(sample, car, out)
        mean[0] = sample[at.YAW_RATE] if math.isfinite(sample[at.YAW_RATE]) else 0.0
        mean[1] = out[at.BETA]
        cov[0, 0], cov[0, 1], cov[1, 0], cov[1, 1] = noise.yaw_rate**2, 0.0, 0.0, out[at.BETA_STD] ** 2
        state.running[0] = 1
        return math.nan, math.nan
    dynamic_predict(state, sample, car, noise, dt)
    out[at.NIS], innovation_yaw_rate, innovation_ay = dynamic_update(state, sample, car, noise)
    out[at.BETA] = mean[1]
    out[at.BETA_STD] = math.sqrt(cov[1, 1])
    return innovation_yaw_rate, innovation_ay


@inlined
def telling_dynamic_step(state, sample, car, noise, dt, out):
    """One sample of the dynamic filter; `out` ``(5,)`` gets the innovations too, as in `DynamicEKF.extras`."""
    out[at.NIS + 1], out[at.NIS + 2] = dynamic_step(state, sample, car, noise, dt, out)


@kernel
def dynamic_run(state, samples, car, noise, dt, out):
    """All samples of the dynamic filter."""
    for k in range(samples.shape[0]):
        telling_dynamic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class DynamicEKF(KernelFilter):
    """Dynamic extended Kalman filter of one vehicle."""

    noise: DynamicNoise = DynamicNoise()

    extras = ("innovation_yaw_rate [rad/s]", "innovation_ay [m/s^2]")
    told_by_likelihood = ("yaw_acceleration", "slip_rate", "yaw_rate", "ay")
    step_kernel = staticmethod(telling_dynamic_step)
    run_kernel = staticmethod(dynamic_run)

"""Kinematic Kalman filters with the help of a tyre near zero yaw rate.

The kinematic filter's vy is observable only while the car turns (Chindamo 2018, section 2.1). Both filters
here help it where it is not, with the share w = exp(-(yaw_rate / turning)^2) of driving that counts as
straight, in place of the rolling rear axle of `crosscomb.filters.kinematic.kf`:

- `ZeroYawKF` (after Farrelly and Wellstead; Chindamo 2018, section 2.2) measures vy there: the linear single
  track in a steady state gives beta = b r / vx + steer_rear - m a ay / (L Cr).
- `BlendKF` (after Ungoren et al.; Chindamo 2018, section 2.2) integrates there the lateral force of the
  dynamic model instead of the accelerometer: vy_dot = (1 - w) ay + w Fy(vy) / m - r vx, which pulls vy back
  as tyres do.

Both learn the accelerometers' biases. In turns nothing but vx is measured, so slides do not hurt them; both are
wrong when the car slides straight on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from crosscomb.filters import columns as at
from crosscomb.filters.base import KernelFilter, bounded_slip, joined_nis
from crosscomb.filters.kinematic.kf import (
    Kinematic,
    blind_update,
    inertial_known,
    kinematic_predict,
    kinematic_start,
    kinematic_state,
    kinematic_update,
    limit_biases,
    limit_slip,
    predict_felt,
    propagate_biased,
    take_inputs,
    velocity_answer,
    velocity_update,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import input_gain
from crosscomb.models.single_track import single_track_rates, stable_substeps


class ZeroYawNoise(NamedTuple):
    """Noise settings of the filter with a pseudo-measurement; densities, so that they hold at every rate."""

    accel: float = 0.15  # accelerometer error beside the bias [m/s^2 per sqrt(Hz)]
    ay_scale: float = 0.03  # the same over ay, of scale and body roll [1 per sqrt(Hz)]
    speed: float = 0.1  # measured vx [m/s]
    accel_bias: float = 0.3  # size of the accelerometer biases, bank and slope included [m/s^2]
    bias_time: float = 100.0  # time in which they change [s]
    missing_accel: float = 3.0  # accelerometer error while a channel is missing [m/s^2 per sqrt(Hz)]
    turning: float = 0.1  # yaw rate from which on the car turns [rad/s]
    pseudo: float = 0.012  # error of the steady beta, counted once per second [rad]


class BlendNoise(NamedTuple):
    """Noise settings of the blending filter; densities, so that they hold at every rate."""

    accel: float = 0.15  # accelerometer error beside the bias [m/s^2 per sqrt(Hz)]
    ay_scale: float = 0.03  # the same over ay, of scale and body roll [1 per sqrt(Hz)]
    speed: float = 0.1  # measured vx [m/s]
    accel_bias: float = 0.3  # size of the accelerometer biases, bank and slope included [m/s^2]
    bias_time: float = 100.0  # time in which they change [s]
    missing_accel: float = 3.0  # accelerometer error while a channel is missing [m/s^2 per sqrt(Hz)]
    turning: float = 0.1  # yaw rate from which on the car turns [rad/s]


LEAST_SHARE = 1e-3
"""A smaller share of straight driving than this is none."""


@inlined
def straight_share(yaw_rate, turning):
    """Share in which driving counts as straight, 1 at zero yaw rate; 0 where the yaw rate is not known."""
    if not math.isfinite(yaw_rate):
        return 0.0
    ratio = yaw_rate / turning
    share = math.exp(-ratio * ratio)
    return share if share > LEAST_SHARE else 0.0


@inlined
def steady_slip(sample, car):
    """Sideslip angle of the linear single track in a steady state [rad], from yaw rate and ay as measured.

    The rear axle carries its share a / L of the lateral force m ay.
    """
    rear_slip = car.mass * car.a * sample[at.AY] / ((car.a + car.b) * car.stiffness_rear)
    return sample[at.STEER_REAR] + car.b * sample[at.YAW_RATE] / sample[at.VX] - rear_slip


@inlined
def zero_yaw_step(state, sample, car, noise, dt, out):
    """One sample of the measuring filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    if kinematic_start(state, sample, car, noise, dt, out):
        return
    predict_felt(state, sample, noise, dt)
    nis, _ = kinematic_update(state, sample, noise)
    share = straight_share(sample[at.YAW_RATE], noise.turning)
    if share > 0.0 and math.isfinite(sample[at.AY]):
        # Its error lasts, so it counts as one measurement per second, spread over the samples.
        variance = (noise.pseudo * sample[at.VX]) ** 2 / (dt * share)
        pseudo = sample[at.VX] * math.tan(bounded_slip(steady_slip(sample, car)))
        part, _ = velocity_update(state, 0.0, 1.0, pseudo - state.mean[1], variance)
        nis = joined_nis(nis, part)
    blind_update(state, sample[at.YAW_RATE], dt)
    limit_slip(state.mean)
    limit_biases(state.mean, noise)
    out[at.NIS] = nis
    velocity_answer(state, out)


@kernel
def zero_yaw_run(state, samples, car, noise, dt, out):
    """All samples of the pseudo-measuring filter."""
    for k in range(samples.shape[0]):
        zero_yaw_step(state, samples[k], car, noise, dt, out[k])


@inlined
def blend_predict(state, sample, share, car, noise, dt):
    """Predict [vx, vy] over dt, in the given share with the lateral acceleration that the tyres give."""
    mean = state.mean
    vx, ax, ay, yaw_rate = sample[at.VX], sample[at.AX], sample[at.AY], sample[at.YAW_RATE]
    steps = stable_substeps(vx, dt, car)
    h = dt / steps
    for _ in range(steps):
        _, (_, ay_tyres), jacobian = single_track_rates(
            yaw_rate, math.atan2(mean[1], mean[0]), vx,
            sample[at.STEER], sample[at.STEER_REAR], sample[at.FXF], sample[at.FXR], ax, ay, car,
        )  # fmt: skip
        # The tyres answer to the state: the transition is F + G slope = F (I + F^-1 G slope), and F^-1 G is
        # the gain of a frame that turns the other way.
        _, along, _, across = input_gain(-yaw_rate, h)
        slope = share * jacobian[7] / (mean[0] * mean[0] + mean[1] * mean[1])
        slope_x, slope_y = -slope * mean[1], slope * mean[0]
        propagate_biased(
            state.cov, 1.0 + along * slope_x, along * slope_y, across * slope_x, 1.0 + across * slope_y,
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        kinematic_predict(state, ax, ay, yaw_rate, 1.0 - share, share * ay_tyres, noise, h)
        limit_slip(mean)


@inlined
def blend_step(state, sample, car, noise, dt, out):
    """One sample of the blending filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    if kinematic_start(state, sample, car, noise, dt, out):
        return
    share = straight_share(sample[at.YAW_RATE], noise.turning)
    if share > 0.0 and inertial_known(sample[at.AX], sample[at.AY], sample[at.YAW_RATE]):
        take_inputs(state, sample, dt)
        blend_predict(state, sample, share, car, noise, dt)
    else:
        predict_felt(state, sample, noise, dt)
    out[at.NIS], _ = kinematic_update(state, sample, noise)
    blind_update(state, sample[at.YAW_RATE], dt)
    limit_slip(state.mean)
    limit_biases(state.mean, noise)
    velocity_answer(state, out)


@kernel
def blend_run(state, samples, car, noise, dt, out):
    """All samples of the blending filter."""
    for k in range(samples.shape[0]):
        blend_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class ZeroYawKF(KernelFilter):
    """Kinematic Kalman filter with a pseudo-measurement of vy near zero yaw rate."""

    noise: ZeroYawNoise = ZeroYawNoise()

    divisors = (*KernelFilter.divisors, "pseudo", "turning", "bias_time")
    run_kernel = staticmethod(zero_yaw_run)

    def make_state(self) -> Kinematic:
        """Make an unstarted filter."""
        return kinematic_state(self.noise)


@dataclass(frozen=True)
class BlendKF(KernelFilter):
    """Kinematic Kalman filter that goes over to the dynamic model near zero yaw rate."""

    noise: BlendNoise = BlendNoise()

    divisors = (*KernelFilter.divisors, "turning", "bias_time")
    told_by_likelihood = ("accel", "speed", "accel_bias")
    run_kernel = staticmethod(blend_run)

    def make_state(self) -> Kinematic:
        """Make an unstarted filter."""
        return kinematic_state(self.noise)

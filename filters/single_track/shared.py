"""What filters on the single track share: start, rates at a sample, error of a held steering angle.

Their states begin with [yaw_rate, beta].
"""

from __future__ import annotations

from crosscomb.filters import columns as at
from crosscomb.filters.base import or_zero
from crosscomb.models.compiled import inlined
from crosscomb.models.parameter_track import parameter_track_rates
from crosscomb.models.single_track import single_track_rates


@inlined
def start_motion(mean, sample, out):
    """Start [yaw_rate, beta] from the gyro and the answer of rolling in `out`."""
    mean[0] = or_zero(sample[at.YAW_RATE])
    mean[1] = out[at.BETA]


@inlined
def start_doubt(cov, noise, out):
    """Start the covariance of [yaw_rate, beta], which knows of no other state yet."""
    cov[:2, :] = 0.0
    cov[:, :2] = 0.0
    cov[0, 0], cov[1, 1] = noise.yaw_rate**2, out[at.BETA_STD] ** 2


@inlined
def rates_at(yaw_rate, beta, sample, car):
    """Single track at a state and a sample, as `single_track_rates` gives it."""
    return single_track_rates(
        yaw_rate, beta, sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], sample[at.FXF], sample[at.FXR],
        or_zero(sample[at.AX]), or_zero(sample[at.AY]), car,
    )  # fmt: skip


@inlined
def parameter_rates_at(yaw_rate, beta, sample, car, parameters, state):
    """Single track under given tyre parameters at a state and a sample; fills `state.slopes`, see there."""
    return parameter_track_rates(
        yaw_rate, beta, sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], sample[at.FXF], sample[at.FXR],
        or_zero(sample[at.AX]), or_zero(sample[at.AY]), car.law, parameters, car.track, state.by, state.slopes,
    )  # fmt: skip


@inlined
def wrong_front_force(sample, car, noise):
    """Error of the front axle's force by a held steering angle [N].

    It lasts about a second, so as white noise its density is its size.
    """
    return noise.missing_steer * sample[at.STEER_HELD] * car.stiffness_front


@inlined
def motion_noise(sample, car, noise):
    """Densities of the process noise of [yaw_rate, beta]: of the yaw rate, of both, of beta."""
    force = wrong_front_force(sample, car, noise)
    wrong_yaw, wrong_slip = force * car.a / car.yaw_inertia, force / (car.mass * sample[at.VX])
    return (
        noise.yaw_acceleration**2 + wrong_yaw**2,
        wrong_yaw * wrong_slip,
        noise.slip_rate**2 + wrong_slip**2,
    )


@inlined
def ay_variance(sample, car, noise):
    """Variance of the measured ay."""
    return noise.ay**2 + (wrong_front_force(sample, car, noise) / car.mass) ** 2

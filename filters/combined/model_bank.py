"""Bank of three models on the common state [yaw_rate, beta], for multiple-model estimators.

Three extended Kalman filters run at once (Atheupe 2023, references 63 and 67):

0. the single track on the vehicle's friction,
1. the single track on low friction,
2. the kinematic model beta_dot = (ay cos beta - ax sin beta) cos beta / vx - yaw_rate, which forgets beta
   slowly.

All three measure the yaw rate and ay. The kinematic model uses ay up as an input and so predicts nothing
about it: its density of ay is that of a normal one standard deviation `surprise` away from its centre, so
it takes over where the tyre models miss ay by more than about that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into
from crosscomb.filters.base import (
    LOG_2_PI,
    Gaussian,
    bounded_slip,
    normal_log_density,
    propagate,
    scalar_update,
    starting,
)
from crosscomb.filters.single_track.ekf import DynamicNoise, dynamic_predict, dynamic_update
from crosscomb.filters.single_track.shared import ay_variance, start_doubt, start_motion
from crosscomb.models.compiled import inlined
from crosscomb.models.single_track import SingleTrack, body_rates, slip_rate_slope

MODELS = 3


class ModelNoise(NamedTuple):
    """Settings of both banks; process densities, so that they hold at every rate."""

    accel: float = 0.5  # accelerometer error of the kinematic model [m/s^2 per sqrt(Hz)]
    missing_accel: float = 3.0  # the same while ax or ay is missing
    yaw_acceleration: float = 1.0  # yaw acceleration that the kinematic model allows [rad/s^2 per sqrt(Hz)]
    relaxation: float = 0.3  # rate at which the kinematic model forgets beta [1/s]
    surprise: float = 2.5  # ay error beyond which tyre models lose to the kinematic one [m/s^2]
    correlation: float = 0.1  # time for which a model's error lasts [s]
    stay: float = 1.0  # time for which the IMM's car stays with a model [s]
    low_share: float = 0.05  # share of driving on low friction, before anything is measured
    kinematic_share: float = 0.2  # share of driving that the kinematic model describes best
    floor: float = 0.01  # least probability in the MMAE
    dynamic: DynamicNoise = DynamicNoise()


class Cars(NamedTuple):
    """The car on its own friction and on low friction."""

    high: SingleTrack
    low: SingleTrack


class Bank(NamedTuple):
    """State of both banks, changed in place by their kernels."""

    high: Gaussian
    low: Gaussian
    kinematic: Gaussian
    probability: np.ndarray  # (3,)
    log_likelihood: np.ndarray  # (3,) of the last update
    nis: np.ndarray  # (3,)
    mixed_mean: np.ndarray  # (3, 2) scratch
    mixed_cov: np.ndarray  # (3, 2, 2) scratch
    prior: np.ndarray  # (3,) scratch
    weights: np.ndarray  # (3,) scratch
    running: np.ndarray  # (1,)


@inlined
def slip_predict(state, sample, noise, dt):
    """Predict [yaw_rate, beta] by the kinematic model; a missing channel keeps beta and widens it."""
    mean, vx = state.mean, sample[at.VX]
    known = math.isfinite(sample[at.AX]) and math.isfinite(sample[at.AY])
    rate, slope, by_yaw = 0.0, 0.0, 0.0
    if known:
        cosine, sine = math.cos(mean[1]), math.sin(mean[1])
        # The accelerations are those of a unit mass under forces in the axes of the car.
        _, rate, _, _ = body_rates(
            sample[at.AX], 0.0, sample[at.AY], 0.0, vx, mean[0],
            1.0, 0.0, 1.0, 0.0, cosine, sine, 1.0, 1.0, 0.0, 0.0,
        )  # fmt: skip
        slope, by_yaw = slip_rate_slope(sample[at.AX], sample[at.AY], cosine, sine, vx), -1.0
    beta = mean[1] + dt * (rate - noise.relaxation * mean[1])
    mean[1] = bounded_slip(beta)
    density = (noise.accel if known else noise.missing_accel) / vx
    propagate(
        state.cov, 1.0, 0.0, dt * by_yaw, 1.0 + dt * (slope - noise.relaxation),
        noise.yaw_acceleration**2 * dt, 0.0, density * density * dt,
    )  # fmt: skip


@inlined
def slip_update(state, sample, noise):
    """Update the kinematic model with the yaw rate; give the NIS and the log likelihood of both channels."""
    nis, log_likelihood = math.nan, 0.0
    if math.isfinite(sample[at.YAW_RATE]):
        variance = state.cov[0, 0] + noise.dynamic.yaw_rate**2
        nis = scalar_update(state, 1.0, 0.0, sample[at.YAW_RATE] - state.mean[0], noise.dynamic.yaw_rate**2)
        state.mean[1] = bounded_slip(state.mean[1])
        log_likelihood += normal_log_density(nis, variance)
    if math.isfinite(sample[at.AY]):
        log_likelihood += normal_log_density(1.0, noise.surprise**2)
    return nis, log_likelihood


@inlined
def tyre_update(state, sample, car, noise):
    """Update a single-track model; give the NIS and the log likelihood of yaw rate and ay.

    By the matrix determinant lemma det S = det R det P_prior / det P_posterior, however many were measured.
    """
    cov, n, noises = state.cov, 0, 0.0
    if math.isfinite(sample[at.YAW_RATE]):
        n += 1
        noises += 2.0 * math.log(noise.yaw_rate)
    if math.isfinite(sample[at.AY]):
        n += 1
        noises += math.log(ay_variance(sample, car, noise))
    if n == 0:
        return math.nan, 0.0
    prior = cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[0, 1]
    nis, _, _ = dynamic_update(state, sample, car, noise)
    posterior = cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[0, 1]
    return nis, -0.5 * (nis + noises + math.log(prior / posterior) + n * LOG_2_PI)


@inlined
def step_models(bank, sample, cars, noise, dt):
    """Predict and update every filter of the bank."""
    dynamic_predict(bank.high, sample, cars.high, noise.dynamic, dt)
    dynamic_predict(bank.low, sample, cars.low, noise.dynamic, dt)
    slip_predict(bank.kinematic, sample, noise, dt)
    bank.nis[0], bank.log_likelihood[0] = tyre_update(bank.high, sample, cars.high, noise.dynamic)
    bank.nis[1], bank.log_likelihood[1] = tyre_update(bank.low, sample, cars.low, noise.dynamic)
    bank.nis[2], bank.log_likelihood[2] = slip_update(bank.kinematic, sample, noise)


@inlined
def combine(bank, weights, mean, cov):
    """Mean (2,) and covariance (2, 2) of the mixture of the three states."""
    members = (bank.high, bank.low, bank.kinematic)
    mean[:] = 0.0
    cov[:, :] = 0.0
    for i in range(MODELS):
        for j in range(2):
            mean[j] += weights[i] * members[i].mean[j]
    for i in range(MODELS):
        d0, d1 = members[i].mean[0] - mean[0], members[i].mean[1] - mean[1]
        cov[0, 0] += weights[i] * (members[i].cov[0, 0] + d0 * d0)
        cov[0, 1] += weights[i] * (members[i].cov[0, 1] + d0 * d1)
        cov[1, 1] += weights[i] * (members[i].cov[1, 1] + d1 * d1)
    cov[1, 0] = cov[0, 1]


@inlined
def model_shares(noise):
    """Probabilities of the three models before anything is measured; they sum to one."""
    low, kinematic = min(noise.low_share, 0.5), min(noise.kinematic_share, 0.5)
    return 1.0 - low - kinematic, low, kinematic


@inlined
def bank_start(bank, sample, cars, noise, out):
    """Answer where the car is slow and start on the first sample above the gate; True where it did either."""
    if not starting(bank.running, sample, cars.high, out):
        return False
    for member in (bank.high, bank.low, bank.kinematic):
        start_motion(member.mean, sample, out)
        start_doubt(member.cov, noise.dynamic, out)
    bank.probability[0], bank.probability[1], bank.probability[2] = model_shares(noise)
    copy_into(out[3:], bank.probability)
    return True

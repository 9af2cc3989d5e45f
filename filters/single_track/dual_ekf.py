"""Dual extended Kalman filter: one filter for the motion, one for the rational tyres, in step.

Ahangarnejad and Baslamisli 2016 (as cited in Di Biase 2020 [22]), in the form of Wan and Nelson: the motion
filter [yaw_rate, beta] runs on the latest parameters; the parameter filter [c1, c2 front, c1, c2 rear] sees
the same innovations through their total derivative by the parameters, which carries the past along:

    S_k- = F S_k-1 + df/dp        derivative of the predicted state
    C_k  = H S_k- + dh/dp         derivative of the predicted measurement
    S_k  = S_k- - K C_k           derivative of the updated state, the gain taken as constant

Cheaper than states and parameters in one filter, but it knows no correlation between the two. The doubt about
the tyres reaches beta through S: beta_std is that of P + S Pt S', P and Pt being the covariances of motion and
tyres; the NIS is the motion filter's own. Adaptation is gated and bounded by
`crosscomb.filters.single_track.adaptation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.leading import consider_update
from crosscomb.filters.base import (
    KernelFilter,
    bounded_slip,
    joined_nis,
    propagate,
    scalar_update,
    starting,
)
from crosscomb.filters.single_track.adaptation import Limits, TyreCar, excited, growth, parameter_limits
from crosscomb.filters.single_track.shared import (
    ay_variance,
    motion_noise,
    parameter_rates_at,
    start_doubt,
    start_motion,
)
from crosscomb.filters.single_track.tyre_ekf import RATTE
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.parameter_track import (
    BETA_RATE,
    BY_BETA,
    BY_PARAMETER,
    BY_YAW_RATE,
    LATERAL,
    LAWS,
    SLOPES_SHAPE,
    YAW_ACCELERATION,
)
from crosscomb.models.single_track import single_track, stable_substeps

PARAMETERS = 4


class DualNoise(NamedTuple):
    """Noise settings of the dual filter; process densities, so that they hold at every rate."""

    yaw_acceleration: float = 0.6  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.02  # model error [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 2.0  # measured ay, with bank and what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]
    parameter_walk: float = 0.01  # change of a tyre parameter, in shares of its first value [per sqrt(s)]
    parameter_spread: float = 0.08  # standard deviation at the start, in shares of the first value
    parameter_range: float = 2.0  # a stiffness stays within this factor of its first value, either way
    adapt_ay: float = 1.5  # parameters adapt above this measured |ay| [m/s^2]
    adapt_speed: float = 6.0  # and above this speed [m/s]


class DualState(NamedTuple):
    """Both filters and scratch, changed in place by the kernels."""

    mean: np.ndarray  # (2,) yaw rate and beta
    cov: np.ndarray  # (2, 2)
    tyres: np.ndarray  # (4,)
    tyre_cov: np.ndarray  # (4, 4)
    limits: Limits
    sensitivity: np.ndarray  # (2, 4) derivative of the mean by the tyres
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    slopes: np.ndarray  # (3, 7)
    by: np.ndarray  # (4, 2)
    vectors: np.ndarray  # (3, 4) measurement row of the tyres and scratch
    evidence: np.ndarray  # of the motion filter, as in `crosscomb.filters.base.Gaussian`


@inlined
def dual_predict(state, sample, car, noise, dt):
    """Predict the motion and its sensitivity over dt by Euler steps."""
    mean, slopes, sensitivity = state.mean, state.slopes, state.sensitivity
    of_yaw, of_both, of_slip = motion_noise(sample, car.track, noise)
    steps = stable_substeps(sample[at.VX], dt, car.track)
    h = dt / steps
    for _ in range(steps):
        yaw_acceleration, beta_rate, _ = parameter_rates_at(mean[0], mean[1], sample, car, state.tyres, state)
        f00, f01 = 1.0 + h * slopes[YAW_ACCELERATION, BY_YAW_RATE], h * slopes[YAW_ACCELERATION, BY_BETA]
        f10, f11 = h * slopes[BETA_RATE, BY_YAW_RATE], 1.0 + h * slopes[BETA_RATE, BY_BETA]
        mean[0] += h * yaw_acceleration
        mean[1] = bounded_slip(mean[1] + h * beta_rate)
        propagate(state.cov, f00, f01, f10, f11, of_yaw * h, of_both * h, of_slip * h)
        for i in range(PARAMETERS):
            yaw, beta = sensitivity[0, i], sensitivity[1, i]
            sensitivity[0, i] = f00 * yaw + f01 * beta + h * slopes[YAW_ACCELERATION, BY_PARAMETER + i]
            sensitivity[1, i] = f10 * yaw + f11 * beta + h * slopes[BETA_RATE, BY_PARAMETER + i]


@inlined
def dual_measure(state, h0, h1, direct, innovation, variance, moved, adapting):
    """Update both filters with one measurement.

    Parameters
    ----------
    state : DualState
    h0, h1 : float
        Row of the measurement matrix of the motion filter.
    direct : (4,)
        Derivative of the measurement by the tyres at constant motion.
    innovation : float
        Measured minus predicted.
    variance : float
        Of the measurement noise.
    moved : (4,)
        Change of the tyres by the measurements before in this sample; gets this one's too.
    adapting : bool
    """
    cov, sensitivity = state.cov, state.sensitivity
    row, gain, crossed = state.vectors[0], state.vectors[1], state.vectors[2]
    ph0, ph1 = cov[0, 0] * h0 + cov[0, 1] * h1, cov[0, 1] * h0 + cov[1, 1] * h1
    s = h0 * ph0 + h1 * ph1 + variance
    expected = 0.0
    for i in range(PARAMETERS):
        row[i] = h0 * sensitivity[0, i] + h1 * sensitivity[1, i] + direct[i]
        expected += row[i] * moved[i]
        sensitivity[0, i] -= ph0 / s * row[i]
        sensitivity[1, i] -= ph1 / s * row[i]
    nis = scalar_update(state, h0, h1, innovation, variance)
    if adapting:
        for i in range(PARAMETERS):
            moved[i] -= state.tyres[i]
        # To the parameters, all that the motion filter does not know counts as noise.
        consider_update(state.tyres, state.tyre_cov, row, innovation - expected, s, PARAMETERS, gain, crossed)
        for i in range(PARAMETERS):
            moved[i] += state.tyres[i]
    return nis


@inlined
def dual_update(state, sample, car, noise, adapting):
    """Update with the yaw rate and ay that are there; give the NIS, NaN without any."""
    mean, slopes, limits = state.mean, state.slopes, state.limits
    yaw_prior, beta_prior = mean[0], mean[1]
    _, _, expected = parameter_rates_at(yaw_prior, beta_prior, sample, car, state.tyres, state)
    moved = state.by.reshape(8)  # its slopes are in `slopes` now
    moved[:] = 0.0
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        innovation = sample[at.YAW_RATE] - yaw_prior
        nis = dual_measure(state, 1.0, 0.0, moved[4:], innovation, noise.yaw_rate**2, moved[:4], adapting)
    if math.isfinite(sample[at.AY]):
        ay_r, ay_b = slopes[LATERAL, BY_YAW_RATE], slopes[LATERAL, BY_BETA]
        innovation = sample[at.AY] - expected - ay_r * (mean[0] - yaw_prior) - ay_b * (mean[1] - beta_prior)
        part = dual_measure(
            state, ay_r, ay_b, slopes[LATERAL, BY_PARAMETER:], innovation,
            ay_variance(sample, car.track, noise), moved[:4], adapting,
        )  # fmt: skip
        nis = joined_nis(nis, part)
    if math.isnan(nis):
        state.sensitivity[:] = 0.0  # nothing holds it while nothing is measured
    mean[1] = bounded_slip(mean[1])
    for i in range(PARAMETERS):
        state.tyres[i] = min(max(state.tyres[i], limits.least[i]), limits.most[i])
    return nis


@inlined
def doubt_of_tyres(by_tyres, tyre_cov):
    """Variance that the doubt about the tyres adds to a state with these derivatives ``(4,)`` by them."""
    variance = 0.0
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            variance += by_tyres[i] * tyre_cov[i, j] * by_tyres[j]
    return variance


@inlined
def dual_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(7,)`` gets beta, its standard deviation, the NIS and the four tyre parameters."""
    mean, cov, limits = state.mean, state.cov, state.limits
    if starting(state.running, sample, car.track, out):
        start_motion(mean, sample, out)
        start_doubt(cov, noise, out)
        state.sensitivity[:] = 0.0
    else:
        adapting = excited(sample, noise)
        for i in range(PARAMETERS):
            if adapting:
                state.tyre_cov[i, i] += growth(state.tyre_cov[i, i], limits.walk[i], limits.spread[i], dt)
        dual_predict(state, sample, car, noise, dt)
        out[at.NIS] = dual_update(state, sample, car, noise, adapting)
        out[at.BETA] = mean[1]
        out[at.BETA_STD] = math.sqrt(cov[1, 1] + doubt_of_tyres(state.sensitivity[1], state.tyre_cov))
    for i in range(PARAMETERS):
        out[3 + i] = state.tyres[i]


@kernel
def dual_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        dual_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class DualEKF(KernelFilter):
    """Dual extended Kalman filter with rational tyres."""

    noise: DualNoise = DualNoise()
    tyre: str = "rational"

    divisors = RATTE.divisors
    told_by_likelihood = ("yaw_acceleration", "slip_rate", "yaw_rate", "ay")
    run_kernel = staticmethod(dual_run)
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": ("rational",)}
    extras: ClassVar[tuple[str, ...]] = RATTE.extras

    @cached_property
    def car(self) -> Any:
        """The car and its tyre law."""
        return TyreCar(single_track(self.vehicle, self.tyre), LAWS[self.tyre])

    def make_state(self) -> DualState:
        """Make the kernels' state before the first sample."""
        limits = parameter_limits(self.car.law, self.car.track, self.noise)
        return DualState(
            mean=np.zeros(2),
            cov=np.eye(2),
            tyres=limits.first.copy(),
            tyre_cov=np.diag(limits.spread**2),
            limits=limits,
            sensitivity=np.zeros((2, PARAMETERS)),
            running=np.zeros(1, dtype=np.int64),
            slopes=np.zeros(SLOPES_SHAPE),
            by=np.zeros((4, 2)),
            vectors=np.zeros((3, PARAMETERS)),
            evidence=np.empty(0),
        )

"""Extended Kalman filters with the rates as states, and with tyre parameters to adapt: LINT, RATT, RATTE.

Di Biase 2020: state [beta, yaw_rate, beta_rate, yaw_acceleration] and behind it the cornering stiffnesses
(LINT, eq. 21), nothing (RATT, eq. 46), or the rational parameters (RATTE, eq. 53); measurements yaw rate and
ay (eq. 38). beta and yaw rate move on with their rates, and the tyres give the next rates:

    beta_k+1 = beta_k + beta_rate_k dt          beta_rate_k+1 = f(beta_k, yaw_rate_k, steer, parameters_k)
    yaw_rate_k+1 = yaw_rate_k + yaw_acc_k dt    yaw_acc_k+1 = g(beta_k, yaw_rate_k, steer, parameters_k)

Departures: f and g are those of the single track without small angles; eq. 39 is corrected for angle and
braking (`lateral_acceleration`); the Jacobians are derived anew (the printed appendix mixes indices); noise
is a density.

When and how far parameters adapt: `crosscomb.filters.single_track.adaptation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.leading import consider_update, propagate_leading
from crosscomb.filters.base import MAX_BETA, KernelFilter, joined_nis, or_zero, starting
from crosscomb.filters.single_track.adaptation import Limits, TyreCar, excited, growth, parameter_limits
from crosscomb.filters.single_track.shared import parameter_rates_at
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.parameter_track import (
    BETA_RATE,
    BY_BETA,
    BY_PARAMETER,
    BY_STEER,
    BY_YAW_RATE,
    LAWS,
    SLOPES_SHAPE,
    YAW_ACCELERATION,
    lateral_acceleration,
)
from crosscomb.models.single_track import single_track, stable_substeps

S_BETA, S_YAW_RATE, S_BETA_RATE, S_YAW_ACCELERATION = range(4)
"""States, in the order of the paper."""

RATES = 4
"""States before the tyre parameters."""

MAX_STATE = (MAX_BETA, 5.0, 10.0, 100.0)
"""What no car reaches [rad, rad/s, rad/s, rad/s^2]: states are held inside."""

FIRST_RATES_STD = (0.2, 0.5)
"""Standard deviation of beta_rate and yaw_acceleration at the start [rad/s, rad/s^2]."""


class TyreNoise(NamedTuple):
    """Noise settings of LINT, RATT and RATTE; process densities, so that they hold at every rate.

    The settings that begin with parameter and adapt do nothing in RATT.
    """

    steer: float = 0.002  # error of the steering angle, acting through the front tyres [rad per sqrt(Hz)]
    yaw_acceleration: float = 0.3  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.01  # model error [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 1.5  # measured ay, with bank and what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]
    parameter_walk: float = 0.01  # change of a tyre parameter, in shares of its first value [per sqrt(s)]
    parameter_spread: float = 0.08  # standard deviation at the start, in shares of the first value
    parameter_range: float = 2.0  # a stiffness stays within this factor of its first value, either way
    adapt_ay: float = 1.5  # parameters adapt above this measured |ay| [m/s^2]
    adapt_speed: float = 6.0  # and above this speed [m/s]


class TyreState(NamedTuple):
    """Estimate and scratch; n states, p parameters, changed in place by the kernels."""

    mean: np.ndarray  # (4 + p,) RATT has its constant parameters here too
    cov: np.ndarray  # (n, n) n = 4 without and 4 + p with adaptation
    limits: Limits
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    slopes: np.ndarray  # (3, 7)
    by: np.ndarray  # (4, 2)
    rows: np.ndarray  # (4, n)
    work: np.ndarray  # (4, n)
    vectors: np.ndarray  # (3, n) measurement row and scratch


def make_tyre_state(limits: Limits, adapting: bool) -> TyreState:
    """Make an unstarted filter."""
    n = RATES + (len(limits.first) if adapting else 0)
    cov = np.zeros((n, n))
    cov[range(RATES, n), range(RATES, n)] = limits.spread[: n - RATES] ** 2
    return TyreState(
        mean=np.concatenate([np.zeros(RATES), limits.first]),
        cov=cov,
        limits=limits,
        running=np.zeros(1, dtype=np.int64),
        slopes=np.zeros(SLOPES_SHAPE),
        by=np.zeros((4, 2)),
        rows=np.zeros((RATES, n)),
        work=np.zeros((RATES, n)),
        vectors=np.zeros((3, n)),
    )


@inlined
def tyre_start(state, sample, beta, beta_std, noise):
    """Start beta, yaw rate and the rates anew; the parameters stay as they were learned."""
    mean, cov = state.mean, state.cov
    mean[S_BETA], mean[S_YAW_RATE] = beta, or_zero(sample[at.YAW_RATE])
    mean[S_BETA_RATE] = mean[S_YAW_ACCELERATION] = 0.0
    cov[:RATES, :] = 0.0
    cov[:, :RATES] = 0.0
    cov[S_BETA, S_BETA], cov[S_YAW_RATE, S_YAW_RATE] = beta_std**2, noise.yaw_rate**2
    cov[S_BETA_RATE, S_BETA_RATE] = FIRST_RATES_STD[0] ** 2
    cov[S_YAW_ACCELERATION, S_YAW_ACCELERATION] = FIRST_RATES_STD[1] ** 2


@inlined
def tyre_predict(state, sample, car, noise, dt, adapting):
    """Predict over dt by Euler steps, so many that the rates, which lag a step behind, stay stable."""
    mean, cov, slopes, rows, limits = state.mean, state.cov, state.slopes, state.rows, state.limits
    n = cov.shape[0]
    angle = noise.steer**2 + (noise.missing_steer * sample[at.STEER_HELD]) ** 2
    steps = stable_substeps(sample[at.VX], 2.0 * dt, car.track)
    h = dt / steps
    for _ in range(steps):
        yaw_acceleration, beta_rate, _ = parameter_rates_at(
            mean[S_YAW_RATE], mean[S_BETA], sample, car, mean[RATES:], state
        )
        rows[S_BETA, S_BETA] = rows[S_YAW_RATE, S_YAW_RATE] = 1.0
        rows[S_BETA, S_BETA_RATE] = rows[S_YAW_RATE, S_YAW_ACCELERATION] = h
        for i in range(n):
            if i < S_BETA_RATE or i >= RATES:
                by = BY_BETA if i == S_BETA else BY_YAW_RATE if i == S_YAW_RATE else BY_PARAMETER + i - RATES
                rows[S_BETA_RATE, i] = slopes[BETA_RATE, by]
                rows[S_YAW_ACCELERATION, i] = slopes[YAW_ACCELERATION, by]
        propagate_leading(cov, rows, state.work)
        # White noise of the rates: over h it must give beta and yaw rate its density times h.
        by_slip, by_yaw = slopes[BETA_RATE, BY_STEER], slopes[YAW_ACCELERATION, BY_STEER]
        cov[S_BETA_RATE, S_BETA_RATE] += (angle * by_slip**2 + noise.slip_rate**2) / h
        cov[S_YAW_ACCELERATION, S_YAW_ACCELERATION] += (angle * by_yaw**2 + noise.yaw_acceleration**2) / h
        cov[S_BETA_RATE, S_YAW_ACCELERATION] += angle * by_slip * by_yaw / h
        cov[S_YAW_ACCELERATION, S_BETA_RATE] = cov[S_BETA_RATE, S_YAW_ACCELERATION]
        mean[S_BETA] += h * mean[S_BETA_RATE]
        mean[S_YAW_RATE] += h * mean[S_YAW_ACCELERATION]
        mean[S_BETA_RATE], mean[S_YAW_ACCELERATION] = beta_rate, yaw_acceleration
        hold_rates(mean)
    for i in range(RATES, n):
        p = i - RATES
        if adapting:
            cov[i, i] += growth(cov[i, i], limits.walk[p], limits.spread[p], dt)


@inlined
def hold_rates(mean):
    """Hold beta, yaw rate and their rates inside `MAX_STATE`."""
    for i in range(RATES):
        mean[i] = min(max(mean[i], -MAX_STATE[i]), MAX_STATE[i])


@inlined
def tyre_update(state, sample, noise, free):
    """Update the first `free` states with yaw rate and ay, as far as they are there; give the NIS."""
    mean, cov = state.mean, state.cov
    row, gain, crossed = state.vectors[0], state.vectors[1], state.vectors[2]
    beta, yaw_rate, beta_rate = mean[S_BETA], mean[S_YAW_RATE], mean[S_BETA_RATE]
    nis = math.nan
    if math.isfinite(sample[at.YAW_RATE]):
        row[:] = 0.0
        row[S_YAW_RATE] = 1.0
        nis = consider_update(
            mean, cov, row, sample[at.YAW_RATE] - yaw_rate, noise.yaw_rate**2, free, gain, crossed
        )
    if math.isfinite(sample[at.AY]):
        expected, by_beta, by_rate = lateral_acceleration(
            beta, yaw_rate, beta_rate, sample[at.VX], or_zero(sample[at.AX])
        )
        # The yaw rate has moved the state: same Jacobian, so the two equal one joint update.
        expected += by_beta * (mean[S_BETA] - beta) + by_rate * (
            mean[S_YAW_RATE] - yaw_rate + mean[S_BETA_RATE] - beta_rate
        )
        row[:] = 0.0
        row[S_BETA], row[S_YAW_RATE], row[S_BETA_RATE] = by_beta, by_rate, by_rate
        part = consider_update(mean, cov, row, sample[at.AY] - expected, noise.ay**2, free, gain, crossed)
        nis = joined_nis(nis, part)
    hold_rates(mean)
    for i in range(RATES, free):
        mean[i] = min(max(mean[i], state.limits.least[i - RATES]), state.limits.most[i - RATES])
    return nis


@inlined
def tyre_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(3 + extras,)`` gets beta, its std, the NIS and adapted parameters."""
    mean, cov = state.mean, state.cov
    for i in range(3, out.shape[0]):
        out[i] = mean[RATES + i - 3]
    if starting(state.running, sample, car.track, out):
        tyre_start(state, sample, out[at.BETA], out[at.BETA_STD], noise)
        return
    adapting = excited(sample, noise)
    tyre_predict(state, sample, car, noise, dt, adapting)
    out[at.NIS] = tyre_update(state, sample, noise, cov.shape[0] if adapting else RATES)
    out[at.BETA] = mean[S_BETA]
    out[at.BETA_STD] = math.sqrt(cov[S_BETA, S_BETA])
    for i in range(3, out.shape[0]):
        out[i] = mean[RATES + i - 3]


@kernel
def tyre_run(state, samples, car, noise, dt, out):
    """All samples."""
    for k in range(samples.shape[0]):
        tyre_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class RATT(KernelFilter):
    """Filter with fixed rational tyres that have the slope and the peak of the vehicle file."""

    noise: TyreNoise = TyreNoise()
    tyre: str = "rational"

    divisors = (*KernelFilter.divisors, "parameter_range")
    run_kernel = staticmethod(tyre_run)
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": ("rational",)}

    @cached_property
    def car(self) -> Any:
        """The car and its tyre law."""
        return TyreCar(single_track(self.vehicle, self.tyre), LAWS[self.tyre])

    def make_state(self) -> TyreState:
        """Make the kernels' state before the first sample; a filter with extra outputs adapts its tyres."""
        return make_tyre_state(parameter_limits(self.car.law, self.car.track, self.noise), bool(self.extras))


@dataclass(frozen=True)
class RATTE(RATT):
    """Filter that adapts its rational tyres."""

    extras: ClassVar[tuple[str, ...]] = (
        "c1_front [rad^2]",
        "c2_front [N/rad]",
        "c1_rear [rad^2]",
        "c2_rear [N/rad]",
    )


@dataclass(frozen=True)
class LINT(RATT):
    """Filter that adapts its linear tyres."""

    tyre: str = "linear"

    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": ("linear",)}
    extras: ClassVar[tuple[str, ...]] = (
        "cornering_stiffness_front [N/rad]",
        "cornering_stiffness_rear [N/rad]",
    )

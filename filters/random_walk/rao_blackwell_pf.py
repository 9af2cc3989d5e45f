"""Rao-Blackwellised particle filter on the random-walk force model: only beta is carried by particles.

The model, its noise and its answer are those of `crosscomb.filters.random_walk.pf`. In it beta acts on nothing but
itself, so that yaw rate and axle forces, given the course of beta, are a linear Gaussian problem; a Kalman filter
solves it exactly where the plain filter spends particles in five dimensions (Schoen, Gustafsson and Nordlund 2005):

1. forces walk: ``P += Q``;
2. each particle draws ``beta_k+1 = beta_k + dt beta_rate(beta_k, yaw_rate, forces) + e``, the variance of e being
   ``dt^2 g P g' + slip_rate^2 dt`` with the slope g of beta_rate by yaw rate and forces (eq. 29, corrected);
3. what it drew tells something about its forces: they move by ``L e``. Thus an error of the forces acts on a particle
   for as long as it lasts, and not as white noise, which would make the spread of beta too small;
4. the yaw rate is predicted; yaw rate, ax and ay (eq. 23) update it and the forces, and weigh the particle by how
   well they fit; the EKF's beta (eq. 17) weighs it too.

Covariance and gains hardly depend on beta (through g alone), so all particles share those at the mean beta; the
conditional means are each particle's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import njit

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_update
from crosscomb.filters.algebra.particles import RESAMPLE_BELOW, cloud, normalise, weighted_beta
from crosscomb.filters.algebra.resampling import RESAMPLING, resample
from crosscomb.filters.base import (
    Gaussian,
    KernelFilter,
    bounded_slip,
    gaussian,
    starting,
)
from crosscomb.filters.random_walk.pf import FIRST_SPREAD, ParticleNoise, first_guess, sin_cos, slip_precision
from crosscomb.filters.single_track.ekf import dynamic_step
from crosscomb.models.compiled import kernel
from crosscomb.models.random_walk import random_walk_jacobian
from crosscomb.models.single_track import body_rates

OUTLIER = 5.0**2
"""A measurement further off than five standard deviations is not used."""

MAX_FORCE_STD = 10.0
"""No axle force is less certain than this, over the mass [m/s^2]: tyres do not give more."""

BY_BETA, BY_YAW, BY_AX, BY_AY = range(4)
"""Rows of the gains: what the draw of beta and each measurement tell about the state."""


class Blackwell(NamedTuple):
    """State of the filter, changed in place by its kernel. Rows: yaw_rate, beta, fxf, fxr, fyf, fyr."""

    x: np.ndarray  # (6, n) beta as drawn, the others as conditional means
    log_weights: np.ndarray  # (n,) up to a constant
    weights: np.ndarray  # (n,) sum to one
    scratch: np.ndarray  # (6, n)
    source: np.ndarray  # (n,) int64, which particle each new one copied last
    scheme: int  # of resampling
    rng: np.random.Generator
    mean: np.ndarray  # (6,) over all particles
    cov: np.ndarray  # (6, 6) given beta: the row and column of beta are zero
    slopes: np.ndarray  # (4, 6) of yaw_acceleration, beta_rate, ax, ay
    gains: np.ndarray  # (4, 6) by beta, yaw rate, ax, ay
    precisions: np.ndarray  # (4,) one over the variance of the draw and of the innovations; 0 where not used
    work: np.ndarray  # (2, 6)
    running: np.ndarray  # (1,) 1 above the low-speed gate
    ekf: Gaussian
    ekf_out: np.ndarray  # (3,)


@kernel
def blackwell_start(state, sample, beta, car):
    """Spread beta uniformly around the first guess, and give the other states covariances as wide."""
    x, mean, cov = state.x, state.mean, state.cov
    guess = first_guess(sample, beta, car)
    cov[:, :] = 0.0
    for row in range(6):
        mean[row] = guess[row]
        x[row, :] = guess[row]
        if row != 1:
            cov[row, row] = (FIRST_SPREAD[row] * (car.mass if row > 1 else 1.0)) ** 2 / 3.0  # uniform
    for i in range(x.shape[1]):
        x[1, i] += FIRST_SPREAD[1] * (2.0 * state.rng.random() - 1.0)
    state.log_weights[:] = 0.0


@kernel
def learn(state, by, row, variance):
    """Update the shared covariance with one scalar, and keep its gain and precision for the particles."""
    gain = state.gains[by]
    gain[:] = 0.0
    # An update by an innovation of one moves a mean of zero to the gain; its NIS is the precision.
    state.precisions[by] = joseph_update(gain, state.cov, row, 1.0, variance, state.work)


@kernel
def share_prediction(state, sample, car, noise, dt):
    """Predict the shared covariance over dt: forces, what the draw of beta tells, yaw rate."""
    mean, cov, slopes, gain = state.mean, state.cov, state.slopes, state.gains[BY_BETA]
    for row in range(2, 6):
        full = cov[row, row] / (MAX_FORCE_STD * car.mass) ** 2
        cov[row, row] += dt * (noise.force * car.mass) ** 2 * max(1.0 - full, 0.0)
    random_walk_jacobian(mean, sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], car, slopes)
    for column in range(6):
        slopes[1, column] *= dt
    learn(state, BY_BETA, slopes[1], dt * noise.slip_rate**2)
    # Yaw rate: P = F P F' + Q with F = I but for its row of yaw rate.
    variance, turn = dt * noise.yaw_acceleration**2, 0.0
    for row in range(2, 6):
        turn += dt * slopes[0, row] * gain[row]
    gain[0] += turn
    for row in range(6):
        moved = 0.0
        for column in range(2, 6):
            moved += dt * slopes[0, column] * cov[row, column]
        state.work[0, row] = moved
    for row in range(2, 6):
        variance += dt * slopes[0, row] * state.work[0, row]
    for row in range(6):
        cov[row, 0] += state.work[0, row]
        cov[0, row] += state.work[0, row]
    cov[0, 0] += variance


@kernel
def measure(state, by, row, measured, std):
    """Update what is shared with one measurement; give its NIS, 0 where it is missing or too far off to be true."""
    mean, cov, gain = state.mean, state.cov, state.gains[by]
    gain[:] = 0.0
    state.precisions[by] = 0.0
    innovation, variance = measured, std * std
    for i in range(6):
        innovation -= row[i] * mean[i]
        for j in range(6):
            variance += row[i] * cov[i, j] * row[j]
    if not innovation * innovation < OUTLIER * variance:
        return 0.0
    learn(state, by, row, std * std)
    for i in range(6):
        mean[i] += gain[i] * innovation
    return innovation * innovation * state.precisions[by]


@kernel
def share_update(state, sample, noise, dt):
    """Update what is shared with yaw rate, ax and ay, one after the other; give the NIS, NaN without any.

    Accelerations and yaw acceleration are linear in the forces, with the slopes as factors.
    """
    mean, slopes = state.mean, state.slopes
    for column in range(2, 6):
        mean[0] += dt * slopes[0, column] * mean[column]
    slopes[0, :] = 0.0  # from here on the row of the measured yaw rate
    slopes[0, 0] = 1.0
    nis = measure(state, BY_YAW, slopes[0], sample[at.YAW_RATE], noise.yaw_rate)
    nis += measure(state, BY_AX, slopes[2], sample[at.AX], noise.accel)
    nis += measure(state, BY_AY, slopes[3], sample[at.AY], noise.accel)
    used = state.precisions[BY_YAW] + state.precisions[BY_AX] + state.precisions[BY_AY]
    return nis if used > 0.0 else math.nan


@kernel
def six(row):
    """The row as plain numbers: the compiler need not fear that writing particles changes them."""
    return row[0], row[1], row[2], row[3], row[4], row[5]


@kernel
def along(row, gain):
    """What a change of the forces by a gain does to an acceleration with these slopes."""
    return row[2] * gain[2] + row[3] * gain[3] + row[4] * gain[4] + row[5] * gain[5]


@kernel
def draw_and_weigh(state, sample, beta_ekf, std_ekf, car, noise, dt):
    """Draw each particle's beta, update its means with the shared gains, and add its log likelihood."""
    x, log_weights, draws, gains = state.x, state.log_weights, state.scratch[0], state.gains
    gb, gr, gx, gy = six(gains[BY_BETA]), six(gains[BY_YAW]), six(gains[BY_AX]), six(gains[BY_AY])
    ax_row, ay_row = six(state.slopes[2]), six(state.slopes[3])
    ax_by_b, ax_by_r = along(ax_row, gb), along(ax_row, gr)
    ay_by_b, ay_by_r, ay_by_x = along(ay_row, gb), along(ay_row, gr), along(ay_row, gx)
    spread = 1.0 / math.sqrt(state.precisions[BY_BETA])
    for i in range(draws.size):
        draws[i] = spread * state.rng.standard_normal()
    vx = sample[at.VX]
    cos_f, sin_f = math.cos(sample[at.STEER]), math.sin(sample[at.STEER])
    cos_r, sin_r = math.cos(sample[at.STEER_REAR]), math.sin(sample[at.STEER_REAR])
    p_yaw = 0.5 * state.precisions[BY_YAW]
    p_ax = 0.5 * state.precisions[BY_AX]
    p_ay = 0.5 * state.precisions[BY_AY]
    p_beta = slip_precision(std_ekf, noise, dt)
    z_yaw = sample[at.YAW_RATE] if p_yaw > 0.0 else 0.0
    z_ax = sample[at.AX] if p_ax > 0.0 else 0.0
    z_ay = sample[at.AY] if p_ay > 0.0 else 0.0
    for i in range(draws.size):
        drawn = draws[i]
        fxf, fxr, fyf, fyr = x[2, i], x[3, i], x[4, i], x[5, i]
        sin_b, cos_b = sin_cos(x[1, i])
        yaw_acceleration, beta_rate, ax, ay = body_rates(
            fxf, fxr, fyf, fyr, vx, x[0, i], cos_f, sin_f, cos_r, sin_r,
            cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b,
        )  # fmt: skip
        beta = bounded_slip(x[1, i] + dt * beta_rate + drawn)
        yaw_rate = x[0, i] + dt * yaw_acceleration + gb[0] * drawn
        off_r = z_yaw - yaw_rate
        off_x = z_ax - (ax + ax_by_b * drawn + ax_by_r * off_r)
        off_y = z_ay - (ay + ay_by_b * drawn + ay_by_r * off_r + ay_by_x * off_x)
        x[0, i] = yaw_rate + gr[0] * off_r + gx[0] * off_x + gy[0] * off_y
        x[1, i] = beta
        x[2, i] = fxf + gb[2] * drawn + gr[2] * off_r + gx[2] * off_x + gy[2] * off_y
        x[3, i] = fxr + gb[3] * drawn + gr[3] * off_r + gx[3] * off_x + gy[3] * off_y
        x[4, i] = fyf + gb[4] * drawn + gr[4] * off_r + gx[4] * off_x + gy[4] * off_y
        x[5, i] = fyr + gb[5] * drawn + gr[5] * off_r + gx[5] * off_x + gy[5] * off_y
        log_weights[i] -= (
            p_yaw * off_r**2 + p_ax * off_x**2 + p_ay * off_y**2 + p_beta * (beta_ekf - beta) ** 2
        )


@kernel
def take_means(state):
    """Mean of each state over the weighted particles."""
    x, weights = state.x, state.weights
    m0 = m1 = m2 = m3 = m4 = m5 = 0.0
    for i in range(weights.size):
        w = weights[i]
        m0, m1, m2 = m0 + w * x[0, i], m1 + w * x[1, i], m2 + w * x[2, i]
        m3, m4, m5 = m3 + w * x[3, i], m4 + w * x[4, i], m5 + w * x[5, i]
    mean = state.mean
    mean[0], mean[1], mean[2], mean[3], mean[4], mean[5] = m0, m1, m2, m3, m4, m5


@njit(cache=True)
def blackwell_step(state, sample, car, noise, dt, out):
    """One sample; `out` ``(5,)`` gets beta, its standard deviation, the NIS and the lateral axle forces."""
    dynamic_step(state.ekf, sample, car, noise.ekf, dt, state.ekf_out)
    beta_ekf, std_ekf = state.ekf_out[at.BETA], state.ekf_out[at.BETA_STD]
    if starting(state.running, sample, car, out):
        out[3] = out[4] = math.nan
        if state.running[0] == 1:
            blackwell_start(state, sample, beta_ekf, car)
        return
    share_prediction(state, sample, car, noise, dt)
    out[at.NIS] = share_update(state, sample, noise, dt)
    draw_and_weigh(state, sample, beta_ekf, std_ekf, car, noise, dt)
    effective = normalise(state.log_weights, state.weights)
    take_means(state)
    out[at.BETA], out[at.BETA_STD] = weighted_beta(state)
    out[3], out[4] = state.mean[4], state.mean[5]
    if effective < RESAMPLE_BELOW * state.weights.size:
        resample(state)


@njit(cache=True)
def blackwell_run(state, samples, car, noise, dt, out):
    """All samples of the filter."""
    for k in range(samples.shape[0]):
        blackwell_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class RaoBlackwellPF(KernelFilter):
    """Rao-Blackwellised random-walk particle filter of one vehicle.

    500 particles come as close to the posterior as 10,000 plain ones, in 6 % of their time
    (`benchmarks/speed_particles.py`).
    """

    noise: ParticleNoise = ParticleNoise()
    particles: int = 500
    resampling: str = "systematic"
    seed: int = 0

    divisors = (*KernelFilter.divisors, "pseudo")
    choices: ClassVar = {**KernelFilter.choices, "resampling": tuple(RESAMPLING)}
    extras = ("fyf [N]", "fyr [N]")
    run_kernel = staticmethod(blackwell_run)

    def make_state(self) -> Any:
        """Make the particles before the first sample."""
        return Blackwell(
            **cloud(6, self.particles, self.resampling, self.seed),
            mean=np.zeros(6),
            cov=np.zeros((6, 6)),
            slopes=np.zeros((4, 6)),
            gains=np.zeros((4, 6)),
            precisions=np.zeros(4),
            work=np.empty((2, 6)),
            running=np.zeros(1, dtype=np.int64),
            ekf=gaussian(),
            ekf_out=np.empty(3),
        )

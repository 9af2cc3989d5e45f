"""Rao-Blackwellised particle filter on the random-walk force model: only beta is carried by particles.

The model and its noise are those of `crosscomb.filters.random_walk.plain_pf`. In it beta acts on nothing but itself, so
that yaw rate and axle forces, given the course of beta, are a linear Gaussian problem; a Kalman filter solves it
exactly where the plain filter spends particles in five dimensions (Schoen, Gustafsson and Nordlund 2005):

1. forces walk: ``P += Q``;
2. each particle draws ``beta_k+1 = beta_k + dt beta_rate(beta_k, yaw_rate, forces) + e``, the variance of e being
   ``dt^2 g P g' + slip_rate^2 dt`` with the slope g of beta_rate by yaw rate and forces (eq. 29, corrected);
3. what it drew tells something about its forces: they move by ``L e``. Thus an error of the forces acts on a particle
   for as long as it lasts, and not as white noise, which would make the spread of beta too small;
4. the yaw rate is predicted; yaw rate, ax and ay (eq. 23) update it and the forces, and weigh the particle by how
   well they fit; the EKF's beta (eq. 17) weighs it too.

Covariance and gains hardly depend on beta (through g alone), so all particles share those at the mean beta; the
conditional means are each particle's own.

What is drawn is matched to its moments: at each step the draws have the mean and variance that they should, and no
correlation with beta, over the weighted particles; and resampling leaves the means and the variance of beta as they
were. This halves the scatter over seeds. The draws themselves are a piece of a table of normal numbers, each step
from another place of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_first
from crosscomb.filters.algebra.particles import (
    LEAST_STD,
    RESAMPLE_BELOW,
    cloud,
    weighted_square,
    weighted_sum,
)
from crosscomb.filters.algebra.resampling import resample
from crosscomb.filters.base import Gaussian, bounded_slip, gaussian, normal_log_density, starting
from crosscomb.filters.random_walk.shared import FIRST_SPREAD, first_guess, sin_cos, slip_precision
from crosscomb.filters.single_track.ekf import dynamic_step
from crosscomb.models.compiled import allocating, inlined, kernel, summing
from crosscomb.models.random_walk import random_walk_jacobian

OUTLIER = 5.0**2
"""A measurement further off than five standard deviations is not used."""

MAX_FORCE_STD = 10.0
"""No axle force is less certain than this, over the mass [m/s^2]: tyres do not give more."""

BY_BETA, BY_YAW, BY_AX, BY_AY = range(4)
"""Rows of the gains: what the draw of beta and each measurement tell about the state."""

DRAWN, AX, AY, OFF_YAW, OFF_AX, OFF_AY = range(6)
"""Rows of the scratch: draw of beta [rad], predicted accelerations, innovations."""

NORMALS = 4096
"""Places in the table of normal numbers at which a step may begin."""

LEAST_KEPT = 0.25
"""Draws, or resampled particles, with less than this share of their variance are left as they are: too few count."""

LEAST_WEIGHT = 1e-200
"""No weight falls below this: smaller numbers are slow."""

ALL = 6
"""States; a literal, so that short loops are unrolled."""


class Blackwell(NamedTuple):
    """State of the filter, changed in place by its kernel. Rows: yaw_rate, beta, fxf, fxr, fyf, fyr."""

    x: np.ndarray  # (6, n) beta as drawn, the others as conditional means
    log_weights: np.ndarray  # (n,) what the last sample added
    weights: np.ndarray  # (n,) sum to one
    scratch: np.ndarray  # (6, n)
    source: np.ndarray  # (n,) int64, which particle each new one copied last
    scheme: int  # of resampling
    rng: np.random.Generator
    normals: np.ndarray  # (NORMALS + n,)
    mean: np.ndarray  # (6,) over all particles
    variance: np.ndarray  # (1,) of beta over all particles
    cov: np.ndarray  # (6, 6) given beta: the row and column of beta are zero
    slopes: np.ndarray  # (4, 6) of yaw_acceleration and beta_rate, times dt, and of ax and ay
    measured_yaw: np.ndarray  # (6,) row of the yaw rate as measurement
    gains: np.ndarray  # (4, 6) by beta, yaw rate, ax, ay
    precisions: np.ndarray  # (4,) one over the variance of the draw and of the innovations; 0 where not used
    work: np.ndarray  # (2, 6)
    running: np.ndarray  # (1,) 1 above the low-speed gate
    ekf: Gaussian
    ekf_out: np.ndarray  # (3,)
    evidence: np.ndarray  # (1,) sum of the measurements' log densities; (0,) where nobody asks for it


@inlined
def take_means(state):
    """Mean of each state, and variance of beta, over the weighted particles."""
    for row in range(ALL):
        state.mean[row] = weighted_sum(state.weights, state.x[row])
    state.variance[0] = max(weighted_square(state.weights, state.x[1], state.mean[1]), LEAST_STD**2)


@inlined
def blackwell_start(state, sample, beta, car):
    """Spread beta evenly around the first guess, and give the other states covariances as wide."""
    x, cov = state.x, state.cov
    guess = first_guess(sample, beta, car)
    cov[:, :] = 0.0
    for row in range(ALL):
        x[row, :] = guess[row]
        if row != 1:
            cov[row, row] = (FIRST_SPREAD[row] * (car.mass if row > 1 else 1.0)) ** 2 / 3.0  # uniform
    n, offset = x.shape[1], state.rng.random()
    for i in range(n):
        x[1, i] += FIRST_SPREAD[1] * (2.0 * (i + offset) / n - 1.0)
    state.weights[:] = 1.0 / n
    take_means(state)


@inlined
def learn(state, by, row, variance):
    """Update the shared covariance with one scalar, and keep its gain and precision for the particles."""
    gain = state.gains[by]
    gain[:] = 0.0
    # An update by an innovation of one moves a mean of zero to the gain; its NIS is the precision.
    state.precisions[by] = joseph_first(ALL, gain, state.cov, row, 1.0, variance, state.work)


@inlined
def share_prediction(state, sample, car, noise, dt):
    """Predict the shared covariance over dt: forces, what the draw of beta tells, yaw rate."""
    cov, slopes, gain, moved = state.cov, state.slopes, state.gains[BY_BETA], state.work[0]
    for row in range(2, ALL):
        full = cov[row, row] / (MAX_FORCE_STD * car.mass) ** 2
        cov[row, row] += dt * (noise.force * car.mass) ** 2 * max(1.0 - full, 0.0)
    random_walk_jacobian(state.mean, sample[at.VX], sample[at.STEER], sample[at.STEER_REAR], car, slopes)
    for row in range(2):
        for column in range(ALL):
            slopes[row, column] *= dt
    learn(state, BY_BETA, slopes[1], dt * noise.slip_rate**2)
    # Yaw rate: P = F P F' + Q with F = I but for its row of yaw rate.
    turn = slopes[0]
    gain[0] += along(turn, gain)
    for row in range(ALL):
        moved[row] = along(turn, cov[row])
    for row in range(ALL):
        cov[row, 0] += moved[row]
        cov[0, row] += moved[row]
    cov[0, 0] += along(turn, moved) + dt * noise.yaw_acceleration**2


@inlined
def measure(state, by, row, measured, std):
    """Update what is shared with one measurement; give its NIS, 0 where it is missing or too far off to be true."""
    mean, cov, gain = state.mean, state.cov, state.gains[by]
    state.precisions[by] = 0.0
    innovation, variance = measured, std * std
    for i in range(ALL):
        known = 0.0
        for j in range(ALL):
            known += cov[i, j] * row[j]
        innovation -= row[i] * mean[i]
        variance += row[i] * known
    if not math.isfinite(innovation):
        gain[:] = 0.0
        return 0.0
    nis = min(innovation * innovation / variance, OUTLIER)
    if state.evidence.size > 0:
        state.evidence[0] += normal_log_density(0.0 if nis < OUTLIER else OUTLIER, variance)
    if not nis < OUTLIER:
        gain[:] = 0.0
        return 0.0
    learn(state, by, row, std * std)
    for i in range(ALL):
        mean[i] += gain[i] * innovation
    return nis


@inlined
def share_update(state, sample, noise):
    """Update what is shared with yaw rate, ax and ay, one after the other; give the NIS, NaN without any.

    Accelerations and yaw acceleration are linear in the forces, with the slopes as factors.
    """
    slopes = state.slopes
    state.mean[0] += along(slopes[0], state.mean)
    nis = measure(state, BY_YAW, state.measured_yaw, sample[at.YAW_RATE], noise.yaw_rate)
    nis += measure(state, BY_AX, slopes[2], sample[at.AX], noise.accel)
    nis += measure(state, BY_AY, slopes[3], sample[at.AY], noise.accel)
    used = state.precisions[BY_YAW] + state.precisions[BY_AX] + state.precisions[BY_AY]
    return nis if used > 0.0 else math.nan


@inlined
def along(row, states):
    """What the forces in these states do to a rate or acceleration with these slopes."""
    return row[2] * states[2] + row[3] * states[3] + row[4] * states[4] + row[5] * states[5]


@summing
def weighted_products(weights, normals, beta, centre):
    """Sums of weight times normal, times normal and distance of beta from its centre, times squared normal."""
    first = crossed = second = 0.0
    for i in range(weights.size):
        part = weights[i] * normals[i]
        first += part
        crossed += part * (beta[i] - centre)
        second += part * normals[i]
    return first, crossed, second


@inlined
def draw(state, std, drawn):
    """Fill `drawn` with normal numbers of standard deviation std, matched to their moments."""
    beta, centre, n = state.x[1], state.mean[1], drawn.size
    begin = int(NORMALS * state.rng.random())
    normals = state.normals[begin : begin + n]
    first, crossed, second = weighted_products(state.weights, normals, beta, centre)
    slope = crossed / state.variance[0]
    kept = second - first * first - crossed * slope
    if kept > LEAST_KEPT:
        scale = std / math.sqrt(kept)
    else:
        scale, first, slope = std, 0.0, 0.0
    for i in range(n):
        drawn[i] = scale * (normals[i] - first - slope * (beta[i] - centre))


@inlined
def forces_along(row, forces, out):
    """`along` for every particle: forces ``(6, n)``, out ``(n,)``."""
    fxf, fxr, fyf, fyr = forces[2], forces[3], forces[4], forces[5]
    by_fxf, by_fxr, by_fyf, by_fyr = row[2], row[3], row[4], row[5]
    for i in range(out.size):
        out[i] = by_fxf * fxf[i] + by_fxr * fxr[i] + by_fyf * fyf[i] + by_fyr * fyr[i]


@inlined
def move_beta(state, vx, dt):
    """Predict every particle's beta over dt, with what it drew."""
    yaw_rate, beta, scratch = state.x[0], state.x[1], state.scratch
    drawn, ax, ay, per_vx = scratch[DRAWN], scratch[AX], scratch[AY], 1.0 / vx
    for i in range(beta.size):
        sin_b, cos_b = sin_cos(beta[i])
        rate = (ay[i] * cos_b - ax[i] * sin_b) * cos_b * per_vx - yaw_rate[i]
        beta[i] = bounded_slip(beta[i] + dt * rate + drawn[i])


@inlined
def find_innovations(state, sample):
    """Predict every particle's yaw rate, and find its innovations, each after the update by those before it."""
    yaw_rate, scratch, slopes, gains = state.x[0], state.scratch, state.slopes, state.gains
    drawn, ax, ay = scratch[DRAWN], scratch[AX], scratch[AY]
    off_r, off_x, off_y = scratch[OFF_YAW], scratch[OFF_AX], scratch[OFF_AY]
    by_draw, n = gains[BY_BETA, 0], drawn.size
    ax_by_b, ax_by_r = along(slopes[2], gains[BY_BETA]), along(slopes[2], gains[BY_YAW])
    ay_by_b, ay_by_r = along(slopes[3], gains[BY_BETA]), along(slopes[3], gains[BY_YAW])
    ay_by_x = along(slopes[3], gains[BY_AX])
    z_yaw = sample[at.YAW_RATE] if state.precisions[BY_YAW] > 0.0 else 0.0
    z_ax = sample[at.AX] if state.precisions[BY_AX] > 0.0 else 0.0
    z_ay = sample[at.AY] if state.precisions[BY_AY] > 0.0 else 0.0
    forces_along(slopes[0], state.x, off_r)
    # A loop for each row: the compiler makes vector instructions of loops that write one.
    for i in range(n):
        yaw_rate[i] += off_r[i] + by_draw * drawn[i]
    for i in range(n):
        off_r[i] = z_yaw - yaw_rate[i]
    for i in range(n):
        off_x[i] = z_ax - (ax[i] + ax_by_b * drawn[i] + ax_by_r * off_r[i])
    for i in range(n):
        off_y[i] = z_ay - (ay[i] + ay_by_b * drawn[i] + ay_by_r * off_r[i] + ay_by_x * off_x[i])


@inlined
def update_means(state, row):
    """Update the conditional means of a row of states by the draw and the innovations."""
    means, scratch, gains = state.x[row], state.scratch, state.gains
    drawn, off_r, off_x, off_y = scratch[DRAWN], scratch[OFF_YAW], scratch[OFF_AX], scratch[OFF_AY]
    by_b = gains[BY_BETA, row] if row > 0 else 0.0  # the yaw rate was predicted with it
    by_r, by_x, by_y = gains[BY_YAW, row], gains[BY_AX, row], gains[BY_AY, row]
    for i in range(means.size):
        means[i] += by_b * drawn[i] + by_r * off_r[i] + by_x * off_x[i] + by_y * off_y[i]


@inlined
def power_of_e(exponent):
    """Exponential function by series, to 1e-10 within 10, 1e-5 within 40, where it ends: inlines into vector code."""
    y = min(max(exponent, -40.0), 40.0) * (1 / 64)
    power = 1 + y * (1 / 6) * (1 + y * (1 / 7) * (1 + y * (1 / 8)))
    power = 1 + y * (1 + y * (1 / 2) * (1 + y * (1 / 3) * (1 + y * (1 / 4) * (1 + y * (1 / 5) * power))))
    for _ in range(6):
        power *= power
    return power


@summing
def times_powers(weights, exponents, centre):
    """Multiply weights by the powers of e; give their sum, and the sum of their squares."""
    total = squares = 0.0
    for i in range(weights.size):
        weight = max(weights[i] * power_of_e(exponents[i] - centre), LEAST_WEIGHT)
        weights[i] = weight
        total += weight
        squares += weight * weight
    return total, squares


@inlined
def weigh(state, beta_ekf, p_beta):
    """Weigh every particle by its innovations and the EKF's beta; give the effective sample size."""
    weights, log_weights, beta, scratch = state.weights, state.log_weights, state.x[1], state.scratch
    off_r, off_x, off_y = scratch[OFF_YAW], scratch[OFF_AX], scratch[OFF_AY]
    p_yaw = 0.5 * state.precisions[BY_YAW]
    p_ax = 0.5 * state.precisions[BY_AX]
    p_ay = 0.5 * state.precisions[BY_AY]
    for i in range(weights.size):
        log_weights[i] = -(
            p_yaw * off_r[i] ** 2
            + p_ax * off_x[i] ** 2
            + p_ay * off_y[i] ** 2
            + p_beta * (beta_ekf - beta[i]) ** 2
        )
    centre = weighted_sum(weights, log_weights)
    total, squares = times_powers(weights, log_weights, centre)
    for i in range(weights.size):
        weights[i] /= total
    if state.evidence.size > 0:
        state.evidence[0] += centre + math.log(total)
    return total * total / squares


@inlined
def draw_and_weigh(state, sample, beta_ekf, std_ekf, noise, dt):
    """Draw each particle's beta, update its means with the shared gains, and weigh it; give the effective size."""
    scratch, slopes = state.scratch, state.slopes
    draw(state, 1.0 / math.sqrt(state.precisions[BY_BETA]), scratch[DRAWN])
    forces_along(slopes[2], state.x, scratch[AX])
    forces_along(slopes[3], state.x, scratch[AY])
    move_beta(state, sample[at.VX], dt)
    find_innovations(state, sample)
    for row in range(ALL):
        if row != 1:
            update_means(state, row)
    effective = weigh(state, beta_ekf, slip_precision(std_ekf, noise, dt))
    take_means(state)
    return effective


@inlined
def resample_matched(state):
    """Draw the particles anew by their weights; their means and the variance of beta stay."""
    resample(state)
    n = state.weights.size
    state.weights[:] = 1.0 / n
    for row in range(ALL):
        values, wanted = state.x[row], state.mean[row]
        found, stretch = weighted_sum(state.weights, values), 1.0
        if row == 1:
            kept = weighted_square(state.weights, values, found) / state.variance[0]
            if kept > LEAST_KEPT:
                stretch = 1.0 / math.sqrt(kept)
            state.variance[0] = max(state.variance[0] * kept * stretch**2, LEAST_STD**2)
        for i in range(n):
            values[i] = wanted + stretch * (values[i] - found)


@inlined
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
    out[at.NIS] = share_update(state, sample, noise)
    effective = draw_and_weigh(state, sample, beta_ekf, std_ekf, noise, dt)
    out[at.BETA], out[at.BETA_STD] = state.mean[1], math.sqrt(state.variance[0])
    out[3], out[4] = state.mean[4], state.mean[5]
    if effective < RESAMPLE_BELOW * state.weights.size:
        resample_matched(state)


@kernel
def blackwell_steps(state, samples, car, noise, dt, out):
    """All samples of the filter, without counting who holds its arrays."""
    for k in range(samples.shape[0]):
        blackwell_step(state, samples[k], car, noise, dt, out[k])


@allocating
def blackwell_run(state, samples, car, noise, dt, out):
    """All samples of the filter."""
    blackwell_steps(state, samples, car, noise, dt, out)


def blackwell_state(particles: int, resampling: str, seed: int) -> Blackwell:
    """Make the particles before the first sample."""
    fields = cloud(6, particles, resampling, seed)
    return Blackwell(
        **fields,
        normals=fields["rng"].standard_normal(NORMALS + particles),
        mean=np.zeros(6),
        variance=np.ones(1),
        cov=np.zeros((6, 6)),
        slopes=np.zeros((4, 6)),
        measured_yaw=np.eye(6)[0],
        gains=np.zeros((4, 6)),
        precisions=np.zeros(4),
        work=np.empty((2, 6)),
        running=np.zeros(1, dtype=np.int64),
        ekf=gaussian(),
        ekf_out=np.empty(3),
        evidence=np.empty(0),
    )

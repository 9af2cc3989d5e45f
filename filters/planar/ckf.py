"""Square-root cubature Kalman filters on the planar model: plain, receding-horizon, and the hybrid of both.

State [u, v, r] and measurements as in `crosscomb.filters.planar.shared`; Magic Formula tyres. Chindamo 2018,
section 2.2, describes the three filters of Li and Zhang in words only; where it leaves a choice, the
textbook form stands here.

Plain (Arasaratnam and Haykin 2009): third-degree cubature points x +/- sqrt(n) S e_i of equal weight,
S S' = P. S is never squared: with centred points X and Z, each over sqrt(2 n), and square roots of the noises,

    predict   S = Tria [X, SQ]
    update    Tria [[Z, SR], [X, 0]] = [[Szz, 0], [T, S]],   x += T Szz^-1 (y - z)

Receding horizon: at each sample the plain filter runs anew over the last `horizon` seconds only, from a prior
that knows little of v: rolling without slip, give or take 6 deg. A wider prior puts points beyond the peak of
the tyre, where the force no longer tells the slip. Older errors are forgotten altogether; so is what was right,
which is why it follows long slides worse than the plain filter. What it says of its errors holds where the tyres
are nearly linear over the prior, and on bent ones once the horizon is full; in the first 0.1 s it is too sure there.

Hybrid: both side by side, weighed by the likelihood of their innovations, which fades with a time constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into, guarded_cholesky, solve_lower, triangular_factor
from crosscomb.filters.base import below_gate, low_speed_answer
from crosscomb.filters.planar.shared import (
    MEASUREMENTS,
    PlanarFilter,
    answer,
    begin,
    clip_state,
    expect,
    planar_move,
    read_measurements,
    set_process_noise,
    set_sample,
    start,
    substeps,
)  # fmt: skip
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.planar import Contacts, contacts, planar_rates

POINTS = 6
ROWS = MEASUREMENTS + 3
MAX_WINDOW = 1000
"""Most samples in a horizon."""
HORIZON_PRIOR = math.radians(6.0)
"""Standard deviation of beta where a horizon begins [rad]."""
LEAST_WEIGHT = 1e-3
"""No filter of the hybrid falls below this weight, or it could not come back."""


class CubatureState(NamedTuple):
    """Mean, root of the covariance and scratch of a cubature filter, changed in place."""

    mean: np.ndarray  # (3,)
    root: np.ndarray  # (3, 3) lower triangular
    cov: np.ndarray  # (3, 3) root root', for the answer
    running: np.ndarray  # (1,)
    log_likelihood: np.ndarray  # (1,) of the last innovation
    contact: Contacts
    points: np.ndarray  # (6, 3)
    images: np.ndarray  # (6, 6) expected measurements of each point
    q: np.ndarray  # (3, 3)
    q_root: np.ndarray  # (3, 3)
    z: np.ndarray  # (2, 6) measured, its variance
    array: np.ndarray  # (9, 12) what is made triangular
    factor: np.ndarray  # (9, 9)
    innovation: np.ndarray  # (6,)


def cubature_state() -> CubatureState:
    """Make an unstarted cubature filter."""
    filter_shapes = ((POINTS, 3), (POINTS, MEASUREMENTS), (3, 3), (3, 3), (2, MEASUREMENTS))
    update_shapes = ((ROWS, POINTS + MEASUREMENTS), (ROWS, ROWS), (MEASUREMENTS,))
    scratch = (np.zeros(shape) for shape in (*filter_shapes, *update_shapes))
    running = np.zeros(1, dtype=np.int64)
    return CubatureState(np.zeros(3), np.eye(3), np.eye(3), running, np.zeros(1), contacts(), *scratch)


@inlined
def cubature_points(mean, root, points):
    """Write the points x +/- sqrt(n) S e_i into points ``(2 n, n)``."""
    n = mean.size
    reach = math.sqrt(n)
    for p in range(n):
        for i in range(n):
            points[p, i] = mean[i] + reach * root[i, p]
            points[n + p, i] = mean[i] - reach * root[i, p]


@inlined
def predict_by_points(points, q_root, mean, root, array):
    """Write the mean of moved points ``(2 n, n)`` and the root of their covariance plus the process noise."""
    n, count = mean.size, points.shape[0]
    scale = 1.0 / math.sqrt(count)
    for i in range(n):
        total = 0.0
        for p in range(count):
            total += points[p, i]
        mean[i] = total / count
        for p in range(count):
            array[i, p] = scale * (points[p, i] - mean[i])
        for j in range(n):
            array[i, count + j] = q_root[i, j]
    triangular_factor(array, n, count + n, root)


@inlined
def root_update(mean, root, points, images, z, array, factor, innovation):
    """Update with the measurements that are not NaN; the arrays as in `CubatureState`.

    Returns
    -------
    nis, log_likelihood : float
        NaN and 0 without any measurement; the likelihood but for a constant.
    """
    n, count, m = mean.size, points.shape[0], 0
    scale = 1.0 / math.sqrt(count)
    array[:] = 0.0
    for k in range(images.shape[1]):
        if not math.isfinite(z[0, k]):
            continue
        expected = 0.0
        for p in range(count):
            expected += images[p, k]
        expected /= count
        innovation[m] = z[0, k] - expected
        for p in range(count):
            array[m, p] = scale * (images[p, k] - expected)
        array[m, count + m] = math.sqrt(z[1, k])
        m += 1
    if m == 0:
        return math.nan, 0.0
    for i in range(n):
        for p in range(count):
            array[m + i, p] = scale * (points[p, i] - mean[i])
    triangular_factor(array, m + n, count + m, factor)
    solve_lower(factor, innovation, m)
    nis, log_likelihood = 0.0, 0.0
    for k in range(m):
        nis += innovation[k] * innovation[k]
        log_likelihood -= 0.5 * innovation[k] * innovation[k] + math.log(factor[k, k])
    for i in range(n):
        for k in range(m):
            mean[i] += factor[m + i, k] * innovation[k]
        for j in range(n):
            root[i, j] = factor[m + i, m + j]
    return nis, log_likelihood


@inlined
def cubature_advance(state, sample, car, noise, dt):
    """Predict over dt and update with the sample; give the NIS."""
    mean, root, points, contact, z = state.mean, state.root, state.points, state.contact, state.z
    set_sample(contact, sample, car)
    set_process_noise(state.q, sample, car, noise, dt)
    guarded_cholesky(state.q, 3, state.q_root)
    steps = substeps(mean, dt, car)
    cubature_points(mean, root, points)
    for p in range(POINTS):
        planar_move(points[p], contact, steps, dt, car)
    predict_by_points(points, state.q_root, mean, root, state.array)
    clip_state(mean)
    read_measurements(sample, car, noise, z[0], z[1])
    cubature_points(mean, root, points)
    for p in range(POINTS):
        _, _, _, ax, ay = planar_rates(points[p, 0], points[p, 1], points[p, 2], contact, car)
        expect(points[p], ax, ay, contact, state.images[p])
    nis, state.log_likelihood[0] = root_update(
        mean, root, points, state.images, z, state.array, state.factor, state.innovation
    )
    clip_state(mean)
    return nis


@inlined
def cubature_answer(state, out):
    """Write beta and its standard deviation."""
    root, cov = state.root, state.cov
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(j + 1):
                total += root[i, k] * root[j, k]
            cov[i, j] = cov[j, i] = total
    answer(state.mean, cov, out)


@inlined
def cubature_step(state, sample, car, noise, dt, out):
    """One sample of the plain filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    if begin(state.mean, state.cov, state.running, sample, car, noise, out):
        guarded_cholesky(state.cov, 3, state.root)
        return
    out[at.NIS] = cubature_advance(state, sample, car, noise, dt)
    cubature_answer(state, out)


@kernel
def cubature_run(state, samples, car, noise, dt, out):
    """All samples of the plain filter."""
    for k in range(samples.shape[0]):
        cubature_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class SqrtCubatureKF(PlanarFilter):
    """Square-root cubature Kalman filter (Chindamo 2018, section 2.2)."""

    run_kernel = staticmethod(cubature_run)

    def make_state(self) -> CubatureState:
        """Make the kernels' state before the first sample."""
        return cubature_state()


class HorizonState(NamedTuple):
    """Filter and last samples of the receding-horizon filter."""

    filter: CubatureState
    window: np.ndarray  # (1000, 17) samples, a ring
    place: np.ndarray  # (2,) samples in the window, row of the next one
    horizon: np.ndarray  # (1,) [s]


def horizon_state(horizon: float) -> HorizonState:
    """Make an unstarted receding-horizon filter with its horizon [s]."""
    window, place = np.zeros((MAX_WINDOW, at.SAMPLE_WIDTH)), np.zeros(2, dtype=np.int64)
    return HorizonState(cubature_state(), window, place, np.array([horizon]))


@inlined
def horizon_step(state, sample, car, noise, dt, out):
    """One sample of the receding-horizon filter; `out` as in `cubature_step`."""
    inner, window, place = state.filter, state.window, state.place
    low_speed_answer(sample, car, out)
    if below_gate(sample):
        place[0] = place[1] = 0
        return
    length = min(max(round(state.horizon[0] / dt), 1) + 1, window.shape[0])
    copy_into(window[place[1]], sample)
    place[1] = (place[1] + 1) % length
    place[0] = min(place[0] + 1, length)
    if place[0] == 1:
        return
    first = (place[1] - place[0]) % length
    low_speed_answer(window[first], car, out)
    start(inner.mean, inner.cov, window[first], out[at.BETA], HORIZON_PRIOR, noise)
    guarded_cholesky(inner.cov, 3, inner.root)
    for i in range(1, place[0]):
        out[at.NIS] = cubature_advance(inner, window[(first + i) % length], car, noise, dt)
    cubature_answer(inner, out)


@kernel
def horizon_run(state, samples, car, noise, dt, out):
    """All samples of the receding-horizon filter."""
    for k in range(samples.shape[0]):
        horizon_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class CubatureRecedingHorizonKF(PlanarFilter):
    """Square-root cubature receding-horizon Kalman filter (Chindamo 2018, section 2.2)."""

    horizon: float = 0.3

    run_kernel = staticmethod(horizon_run)

    def make_state(self) -> HorizonState:
        """Make the kernels' state before the first sample."""
        return horizon_state(self.horizon)


class HybridState(NamedTuple):
    """Both cubature filters and their weights."""

    plain: CubatureState
    receding: HorizonState
    weights: np.ndarray  # (2,)
    memory: np.ndarray  # (1,) [s]
    answers: np.ndarray  # (2, 3)


@inlined
def hybrid_step(state, sample, car, noise, dt, out):
    """One sample of the hybrid; `out` as in `cubature_step`."""
    weights, answers = state.weights, state.answers
    cubature_step(state.plain, sample, car, noise, dt, answers[0])
    horizon_step(state.receding, sample, car, noise, dt, answers[1])
    if below_gate(sample):
        weights[0] = weights[1] = 0.5
    elif math.isfinite(answers[0, at.NIS]):
        fade = math.exp(-dt / state.memory[0])
        gap = fade * math.log(weights[1] / weights[0])
        gap += state.receding.filter.log_likelihood[0] - state.plain.log_likelihood[0]
        weights[1] = 1.0 / (1.0 + math.exp(min(max(-gap, -50.0), 50.0)))
        weights[1] = min(max(weights[1], LEAST_WEIGHT), 1.0 - LEAST_WEIGHT)
        weights[0] = 1.0 - weights[1]
    beta = weights[0] * answers[0, at.BETA] + weights[1] * answers[1, at.BETA]
    variance = 0.0
    for i in range(2):
        variance += weights[i] * (answers[i, at.BETA_STD] ** 2 + (answers[i, at.BETA] - beta) ** 2)
    out[at.BETA], out[at.BETA_STD] = beta, math.sqrt(variance)
    out[at.NIS] = weights[0] * answers[0, at.NIS] + weights[1] * answers[1, at.NIS]


@kernel
def hybrid_run(state, samples, car, noise, dt, out):
    """All samples of the hybrid."""
    for k in range(samples.shape[0]):
        hybrid_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class CubatureHybridKF(CubatureRecedingHorizonKF):
    """Plain and receding-horizon cubature filter, merged (Chindamo 2018, section 2.2)."""

    memory: float = 0.5

    divisors = (*PlanarFilter.divisors, "memory")
    run_kernel = staticmethod(hybrid_run)

    def make_state(self) -> HybridState:  # type: ignore[override]
        """Make the kernels' state before the first sample."""
        weights, memory = np.full(2, 0.5), np.array([max(self.memory, 1e-3)])
        return HybridState(
            cubature_state(), horizon_state(self.horizon), weights, memory, np.full((2, 3), np.nan)
        )

"""Rao-Blackwellised particle filter: the textbook's numbers, the plain filter's posterior, an honest spread."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA, Inputs
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.rao_blackwell_pf import (
    MAX_FORCE_STD,
    NORMALS,
    blackwell_start,
    draw_and_weigh,
    power_of_e,
    resample_matched,
    share_prediction,
    share_update,
)
from crosscomb.filters.random_walk.shared import FIRST_SPREAD, MOST_DOUBT, ParticleNoise
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.random_walk import random_walk_jacobian, random_walk_rates
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import MIN_SPEED

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")
NOISE = ParticleNoise()
LINEAR = [0, 2, 3, 4, 5]  # states that are linear given beta


def slalom(steps: int, vx: float = 18.0, steer: float = 0.03) -> Inputs:
    """Noisy samples of a slalom, braking and pushing."""
    rng = np.random.default_rng(4)
    t = DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = vx * (1.0 + 0.2 * np.sin(0.6 * t))
    samples[:, at.STEER] = steer * np.sin(2.0 * t)
    samples[:, at.STEER_REAR] = -0.1 * samples[:, at.STEER]
    gain = samples[:, at.VX] / (GOLF.wheelbase + 0.003 * samples[:, at.VX] ** 2)
    samples[:, at.YAW_RATE] = gain * samples[:, at.STEER]
    samples[:, at.AX] = 0.12 * vx * np.cos(0.6 * t)
    samples[:, at.AY] = samples[:, at.VX] * samples[:, at.YAW_RATE]
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * GOLF.mass * samples[:, at.AX]
    samples[:, [at.VX, at.AX, at.AY, at.YAW_RATE]] += rng.normal(0.0, [0.05, 0.2, 0.3, 0.01], (steps, 4))
    return Inputs(DT, samples)


def rough() -> Inputs:
    """A slalom with gaps, a stop, reverse driving, crawling about the gate and wild samples."""
    samples = slalom(1000).samples
    samples[50:90, at.AY] = samples[70:120, at.YAW_RATE] = samples[100:130, at.AX] = np.nan
    samples[200:260, at.VX], samples[200:260, at.VX_HELD] = samples[199, at.VX], 1.0
    samples[300:900, at.AY] = samples[300:900, at.YAW_RATE] = np.nan
    samples[400:440, at.VX], samples[440:460, at.VX] = 0.0, -2.0
    samples[600:660, at.VX] = MIN_SPEED + 0.2 * np.sin(np.arange(60))
    samples[910:913, at.AY], samples[920:922, at.YAW_RATE], samples[940, at.AX] = 400.0, -20.0, 1e6
    samples[960:970, at.STEER] = 0.6
    return Inputs(DT, samples)


# The textbook's numbers.


def matched(normals: np.ndarray, weights: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Draws of weighted mean 0 and variance 1 that beta does not tell: the residuals of a regression, scaled."""
    given = np.column_stack([np.ones(len(beta)), beta])
    root = np.sqrt(weights)
    fitted = np.linalg.lstsq(given * root[:, None], normals * root, rcond=None)[0]
    rest = normals - given @ fitted
    return rest / np.sqrt(weights @ rest**2)


def textbook(estimator: RandomWalkPF, inputs: Inputs, own: bool) -> tuple[np.ndarray, int]:
    """Marginalised particle filter (Schoen, Gustafsson and Nordlund 2005) in numpy, with the kernel's random numbers.

    With `own`, every particle has its own covariance, gains and slopes, as exact; else those at the mean beta.

    Returns
    -------
    (n, 4) beta, its standard deviation, fyf, fyr, and the sample of the first resampling
    """
    noise, car, n = estimator.noise, estimator.car, estimator.particles
    rng = np.random.Generator(np.random.SFC64(estimator.seed))
    normals = rng.standard_normal(NORMALS + n)
    ekf = DynamicEKF(estimator.vehicle, noise.ekf).run(inputs)
    slip_variance = (noise.pseudo**2 + np.minimum(ekf.beta_std, MOST_DOUBT) ** 2) / DT
    force = (noise.force * car.mass) ** 2
    limit = (MAX_FORCE_STD * car.mass) ** 2
    r = np.diag([noise.yaw_rate, noise.accel, noise.accel]) ** 2
    first = inputs.samples[0]
    axles = car.mass * first[at.AY] * np.array([car.b, car.a]) / (car.a + car.b)
    z = np.tile(np.array([first[at.YAW_RATE], first[at.FXF], first[at.FXR], *axles]), (n, 1))
    beta = ekf.beta[0] + FIRST_SPREAD[1] * (2.0 * (np.arange(n) + rng.random()) / n - 1.0)
    p = np.tile(np.diag(np.array([FIRST_SPREAD[0], *[2.0 * car.mass] * 4]) ** 2 / 3.0), (n, 1, 1))
    weights = np.full(n, 1.0 / n)
    mean = weights @ np.insert(z, 1, beta, axis=1)
    out, first_drawn_anew = np.full((len(inputs.samples), 4), np.nan), len(inputs.samples)
    for k in range(1, len(inputs.samples)):
        sample = inputs.samples[k]
        given = (*sample[[at.VX, at.STEER, at.STEER_REAR]], car)
        begin = int(NORMALS * rng.random())
        draws = matched(normals[begin : begin + n], weights, beta)
        log_weights = np.zeros(n)
        for i in range(n):
            pi = p[i] + DT * force * np.diag([0.0, *np.maximum(1.0 - np.diag(p[i])[1:] / limit, 0.0)])
            state, slopes = np.insert(z[i], 1, beta[i]), np.empty((4, 6))
            random_walk_jacobian(state if own else mean, *given, slopes)
            yaw_row, g, ax_row, ay_row = slopes[:, LINEAR]
            # Beta: draw it, and learn from it.
            s = DT**2 * g @ pi @ g + DT * noise.slip_rate**2
            error = np.sqrt(s) * draws[i]
            beta[i] += DT * random_walk_rates(state, *given)[1] + error
            gain = pi @ g * DT / s
            z[i] += gain * error
            pi = pi - s * np.outer(gain, gain)
            # Yaw rate.
            f = np.eye(5)
            f[0] += DT * yaw_row
            z[i] = f @ z[i]
            pi = f @ pi @ f.T
            pi[0, 0] += DT * noise.yaw_acceleration**2
            # Measurements.
            h = np.array([np.eye(5)[0], ax_row, ay_row])
            off = sample[[at.YAW_RATE, at.AX, at.AY]] - h @ z[i]
            s = h @ pi @ h.T + r
            gain = pi @ h.T @ np.linalg.inv(s)
            z[i] += gain @ off
            p[i] = pi - gain @ s @ gain.T
            fit = off @ np.linalg.solve(s, off) + np.log(np.linalg.det(s) / np.linalg.det(r))
            log_weights[i] -= 0.5 * (fit + (beta[i] - ekf.beta[k]) ** 2 / slip_variance[k])
        weights *= np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        mean = weights @ np.insert(z, 1, beta, axis=1)
        out[k] = mean[1], np.sqrt(weights @ (beta - mean[1]) ** 2), mean[4], mean[5]
        if 1.0 / (weights @ weights) < 0.5 * n:
            positions = (np.arange(n) + rng.random()) / n
            source = np.searchsorted(np.cumsum(weights), positions)
            z, beta, p, weights = z[source], beta[source], p[source], np.full(n, 1.0 / n)
            z += mean[LINEAR] - z.mean(axis=0)
            beta = mean[1] + (beta - beta.mean()) * out[k, 1] / beta.std()
            first_drawn_anew = min(first_drawn_anew, k)
    return out, first_drawn_anew


@pytest.fixture(scope="module")
def textbook_case() -> tuple[RandomWalkPF, Inputs, np.ndarray]:
    """A drive at 6 m/s, where the error of the forces matters, and the kernel's answer."""
    estimator = RandomWalkPF(GOLF, NOISE._replace(slip_rate=0.03), particles=40, seed=2)
    inputs = slalom(150, vx=6.0, steer=0.2)
    estimate = estimator.run(inputs)
    return estimator, inputs, np.column_stack([estimate.beta, estimate.beta_std, *estimate.extra.values()])


def test_the_kernel_gives_the_textbook_numbers(
    textbook_case: tuple[RandomWalkPF, Inputs, np.ndarray],
) -> None:
    estimator, inputs, answer = textbook_case
    expected, first = textbook(estimator, inputs, own=False)
    assert first < 100, "resampling is part of it"
    np.testing.assert_allclose(answer[1:, :2], expected[1:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(answer[1:, 2:], expected[1:, 2:], rtol=0.0, atol=1e-4)


def test_sharing_the_covariance_costs_next_to_nothing() -> None:
    """Without a say of the EKF the particles stay spread with a standard deviation of 5 deg.

    The first resampling then turns the least difference of the weights into other particles.
    """
    estimator = RandomWalkPF(GOLF, NOISE._replace(slip_rate=0.03, pseudo=10.0), particles=20)
    inputs = slalom(100, vx=6.0, steer=0.2)
    exact, first = textbook(estimator, inputs, own=True)
    assert first > 50
    estimate = estimator.run(inputs)
    difference = np.degrees([estimate.beta - exact[:, 0], estimate.beta_std - exact[:, 1]])[:, 1:first]
    assert 0.0 < np.abs(difference).max() < 0.1, "next to a spread of 5 deg"


def test_the_power_of_e_is_exact_enough() -> None:
    exponents = np.linspace(-39.9, 39.9, 4001)
    np.testing.assert_allclose([power_of_e(x) for x in exponents], np.exp(exponents), rtol=1e-5)
    near = np.linspace(-10.0, 10.0, 4001)
    np.testing.assert_allclose([power_of_e(x) for x in near], np.exp(near), rtol=1e-10)
    assert power_of_e(-1e6) == power_of_e(-40.0) > 0.0


# The posterior.


def runs(estimator: RandomWalkPF, inputs: Inputs, seeds: int) -> np.ndarray:
    """Mean and standard deviation of beta at every 25th sample from the 75th on ``(seeds, 2 m)``."""
    estimates = [replace(estimator, seed=seed).run(inputs) for seed in range(seeds)]
    return np.array([np.concatenate([run.beta[75::25], run.beta_std[75::25]]) for run in estimates])


def welch(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Difference of the means of two sets of runs over its standard error."""
    error2 = first.var(axis=0, ddof=1) / len(first) + second.var(axis=0, ddof=1) / len(second)
    return (first.mean(axis=0) - second.mean(axis=0)) / np.sqrt(error2)


@pytest.fixture(scope="module")
def plain_runs() -> np.ndarray:
    return runs(RandomWalkPF(GOLF, particles=15_000, forces="drawn"), slalom(150), 12)


def test_the_posterior_is_that_of_very_many_plain_particles(plain_runs: np.ndarray) -> None:
    blackwell = runs(RandomWalkPF(GOLF, particles=1000), slalom(150), 12)
    assert np.abs(welch(blackwell, plain_runs)).max() < 5.0
    difference = np.degrees(np.abs(blackwell.mean(axis=0) - plain_runs.mean(axis=0)))
    assert difference.max() < 0.05, "and the scatter is small enough for this to mean something"


def test_a_wrong_posterior_would_show(plain_runs: np.ndarray) -> None:
    noise = NOISE._replace(slip_rate=1.2 * NOISE.slip_rate)
    wrong = runs(RandomWalkPF(GOLF, noise, particles=1000), slalom(150), 12)
    assert np.abs(welch(wrong, plain_runs)).max() > 5.0


def test_fewer_particles_scatter_less_than_as_many_plain_ones() -> None:
    inputs = slalom(200)
    blackwell = runs(RandomWalkPF(GOLF, particles=200), inputs, 16).std(axis=0)
    plain = runs(RandomWalkPF(GOLF, particles=200, forces="drawn"), inputs, 16).std(axis=0)
    assert np.median(plain / blackwell) > 2.0


def extended_kalman(
    noise: ParticleNoise, inputs: Inputs, forgetful: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of beta by an EKF on all six states; exact where beta stays small.

    A forgetful one drops the covariance of beta with the forces and yaw rate at every step: to it their errors are
    white noise on beta.
    """
    car = RandomWalkPF(GOLF).car
    ekf = DynamicEKF(GOLF, noise.ekf).run(inputs)
    first = inputs.samples[0]
    axles = car.mass * first[at.AY] * np.array([car.b, car.a]) / (car.a + car.b)
    x = np.array([first[at.YAW_RATE], ekf.beta[0], first[at.FXF], first[at.FXR], *axles])
    p = np.diag(np.array([*FIRST_SPREAD[:2], *[2.0 * car.mass] * 4]) ** 2 / 3.0)
    walk = DT * np.diag([0.0, 0.0, *[(noise.force * car.mass) ** 2] * 4])
    shake = DT * np.diag([noise.yaw_acceleration**2, noise.slip_rate**2, 0.0, 0.0, 0.0, 0.0])
    r = np.diag([noise.yaw_rate, noise.accel, noise.accel, 0.0]) ** 2
    slopes, out = np.empty((4, 6)), np.full((len(inputs.samples), 2), np.nan)
    for k in range(1, len(inputs.samples)):
        sample = inputs.samples[k]
        given = (*sample[[at.VX, at.STEER, at.STEER_REAR]], car)
        random_walk_jacobian(x, *given, slopes)
        f = np.eye(6) + DT * np.vstack([slopes[:2], np.zeros((4, 6))])
        x[:2] += DT * np.array(random_walk_rates(x, *given)[:2])
        p = f @ (p + walk) @ f.T + shake
        if forgetful:
            p[1, LINEAR] = p[LINEAR, 1] = 0.0
        h = np.vstack([np.eye(6)[0], slopes[2:], np.eye(6)[1]])
        r[3, 3] = (noise.pseudo**2 + min(ekf.beta_std[k], MOST_DOUBT) ** 2) / DT
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        x += gain @ (np.append(sample[[at.YAW_RATE, at.AX, at.AY]], ekf.beta[k]) - h @ x)
        p = (np.eye(6) - gain @ h) @ p
        out[k] = x[1], np.sqrt(p[1, 1])
    return out[:, 0], out[:, 1]


def test_errors_of_the_forces_act_on_beta_for_as_long_as_they_last() -> None:
    """Slow, with poor accelerometers and little other noise, beta is as uncertain as the forces make it."""
    noise = NOISE._replace(slip_rate=0.005, accel=4.0, force=1.0, yaw_acceleration=0.1, pseudo=0.03)
    inputs = slalom(300, vx=5.0, steer=0.05)
    estimate = RandomWalkPF(GOLF, noise, particles=10_000).run(inputs)
    beta, std = extended_kalman(noise, inputs)
    _, white = extended_kalman(noise, inputs, forgetful=True)
    assert np.abs(estimate.beta - beta)[150:].max() < 0.1 * std[150:].mean()
    np.testing.assert_allclose(estimate.beta_std[150:], std[150:], rtol=0.06)
    assert white[150:].max() < 0.8 * std[150:].min(), "white noise would make the spread too small"


# Consistency.


def matched_drive(rng: np.random.Generator, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A drive of the model with its own noise: samples, true states (steps, 6) and measured beta (steps,)."""
    car, scale = RandomWalkPF(GOLF).car, np.array([1.0, 1.0, *[GOLF.mass] * 4])
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.STEER] = 12.0, 0.03
    samples[0, [at.YAW_RATE, at.AY]] = 0.12, 1.5
    side = car.mass * 1.5 / (car.a + car.b)
    state = np.array([0.12, 0.01, 0.0, 0.0, car.b * side, car.a * side])
    state += scale * FIRST_SPREAD * rng.uniform(-1.0, 1.0, 6)
    walk = np.sqrt(DT) * scale * [NOISE.yaw_acceleration, NOISE.slip_rate, *[NOISE.force] * 4]
    truth, measured = np.empty((steps, 6)), np.empty(steps)
    truth[0], measured[0] = state, 0.01
    for k in range(1, steps):
        shaken = walk * rng.normal(size=6)
        state[2:] += shaken[2:]
        *rates, ax, ay = random_walk_rates(state, 12.0, 0.03, 0.0, car)
        state[:2] += DT * np.array(rates) + shaken[:2]
        stds = [NOISE.yaw_rate, NOISE.accel, NOISE.accel]
        samples[k, [at.YAW_RATE, at.AX, at.AY]] = rng.normal([state[0], ax, ay], stds)
        truth[k], measured[k] = state, rng.normal(state[1], NOISE.pseudo / np.sqrt(DT))
    return samples, truth, measured


def test_errors_are_as_large_as_the_filter_says() -> None:
    """Its own step would take the EKF's beta as measurement; here it is one that has the error it expects."""
    rng, drives, steps = np.random.default_rng(12), 60, 49
    estimator = RandomWalkPF(GOLF, particles=500)
    nees, nees_beta, nis = np.zeros((drives, 4)), np.zeros((drives, 4)), 0.0
    for drive in range(drives):
        samples, truth, measured = matched_drive(rng, steps)
        state = replace(estimator, seed=drive).make_state()
        blackwell_start(state, samples[0], measured[0], estimator.car)
        for k in range(1, steps):
            share_prediction(state, samples[k], estimator.car, NOISE, DT)
            nis += share_update(state, samples[k], NOISE)
            effective = draw_and_weigh(state, samples[k], measured[k], 0.0, NOISE, DT)
            if k % 12 == 0:
                cov = state.cov + np.cov(state.x, aweights=state.weights, ddof=0)
                error = truth[k] - state.mean
                nees[drive, k // 12 - 1] = error @ np.linalg.solve(cov, error)
                nees_beta[drive, k // 12 - 1] = error[1] ** 2 / cov[1, 1]
            if effective < 0.5 * estimator.particles:
                resample_matched(state)
    for values, degrees in ((nees, 6), (nees_beta, 1)):
        low, high = chi2.interval(0.999, degrees * drives)
        assert np.all((low < values.sum(axis=0)) & (values.sum(axis=0) < high))
    low, high = chi2.interval(0.999, 3 * drives * (steps - 1))
    assert low < nis < high


# Whatever comes.


@pytest.mark.parametrize("particles", [1, 200])
@pytest.mark.parametrize("resampling", ["systematic", "stratified", "multinomial", "residual"])
def test_steps_give_the_bits_of_a_run_and_the_answer_is_finite(particles: int, resampling: str) -> None:
    estimator, inputs = RandomWalkPF(GOLF, particles=particles, resampling=resampling), rough()
    estimate = estimator.run(inputs)
    started = estimator.start(DT)
    stepped = np.array([estimator.step(started, sample) for sample in inputs.samples])
    np.testing.assert_array_equal(stepped.T, [estimate.beta, estimate.beta_std, estimate.nis])
    again = estimator.run(inputs)
    np.testing.assert_array_equal(again.beta, estimate.beta)
    assert np.isfinite(estimate.beta).all()
    assert np.isfinite(estimate.beta_std).all()
    assert np.all(np.abs(estimate.beta) <= MAX_BETA)
    assert np.all(estimate.beta_std > 0.0)
    slow = ~(inputs.samples[:, at.VX] > MIN_SPEED)
    car = estimator.car
    rolling = [
        slip_of_rolling_rear(*s[[at.STEER, at.STEER_REAR]], car.a, car.b) for s in inputs.samples[slow]
    ]
    np.testing.assert_array_equal(estimate.beta[slow], rolling)
    np.testing.assert_array_equal(estimate.beta_std[slow], LOW_SPEED_STD)
    assert np.isnan(estimate.nis[slow]).all()
    running = np.isfinite(list(estimate.extra.values())).all(axis=0)
    assert not running[slow].any()
    assert running[~slow].mean() > 0.9


def test_another_seed_is_another_estimate() -> None:
    inputs = slalom(100)
    first, second = (RandomWalkPF(GOLF, seed=seed).run(inputs).beta for seed in range(2))
    assert np.all(first[1:] != second[1:])


def test_a_missing_or_wild_measurement_is_as_none() -> None:
    for column, wild in ((at.AY, 200.0), (at.YAW_RATE, -15.0), (at.AX, 1e6)):
        missing, absurd = slalom(100), slalom(100)
        missing.samples[60, column], absurd.samples[60, column] = np.nan, wild
        # The EKF that gives the pseudo-measurement believes what it gets; only what follows from it may differ.
        noise = NOISE._replace(pseudo=1e6)
        first, second = (RandomWalkPF(GOLF, noise).run(inputs) for inputs in (missing, absurd))
        np.testing.assert_allclose(first.beta, second.beta, rtol=0.0, atol=1e-6)
        untouched = RandomWalkPF(GOLF, noise).run(slalom(100))
        assert np.all(untouched.beta[60:] != first.beta[60:])


def test_forces_stay_bounded_without_measurements() -> None:
    samples = slalom(3000).samples
    samples[100:, [at.AX, at.AY, at.YAW_RATE]] = np.nan
    estimator = RandomWalkPF(GOLF, particles=50)
    started = estimator.start(DT)
    for sample in samples:
        _, std, nis = estimator.step(started, sample)
    force_std = np.sqrt(np.diag(started.state.cov)[2:]) / GOLF.mass
    assert np.all(force_std < 1.01 * MAX_FORCE_STD)
    assert np.isnan(nis)
    assert std < np.radians(30.0)


def test_a_turn_is_seen_in_the_axle_forces() -> None:
    samples = np.zeros((400, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.AY], samples[:, at.YAW_RATE] = 15.0, 3.0, 0.2
    estimate = RandomWalkPF(GOLF).run(Inputs(DT, samples))
    fyf, fyr = (estimate.extra[name][200:].mean() for name in ("fyf [N]", "fyr [N]"))
    side = GOLF.mass * 3.0 / GOLF.wheelbase
    np.testing.assert_allclose(
        [fyf, fyr], [GOLF.cg_to_rear_axle * side, GOLF.cg_to_front_axle * side], rtol=0.03
    )

"""Particle filters and their resampling: unbiased draws, and the answer of the exact or the plain filter."""

from dataclasses import replace
from functools import cache

import filterpy.monte_carlo.resampling as filterpy_resampling
import numpy as np
import pytest
from scipy.stats import kstest

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.algebra.resampling import RESAMPLING, draw_sources, sorted_uniforms
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA, Estimate, Inputs, KernelFilter
from crosscomb.filters.catalogue import make_filter, settings_of
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.kinematic.pf import KinematicPF
from crosscomb.filters.random_walk.adaptive_pf import AdaptivePF
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.single_track.ekf import DynamicEKF, DynamicNoise
from crosscomb.filters.single_track.pf import DynamicPF
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.single_track import single_track_rates
from drives import DT, GOLF, rolling_slalom, rough_slalom, spread, welch

WEIGHTS = np.array([0.0, 0.31, 0.02, 0.0, 0.07, 0.4, 0.015, 0.085, 0.1, 0.0])
each_scheme = pytest.mark.parametrize("scheme", RESAMPLING)


# Resampling.


def draw(
    scheme: str, weights: np.ndarray, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sources ``(count,)`` and the positions that were used for them."""
    positions, source = np.full(count, np.nan), np.full(count, -1)
    draw_sources(RESAMPLING[scheme], weights, rng, positions, np.empty(weights.size), source)
    return source, positions


@pytest.mark.parametrize("scheme", ["systematic", "stratified", "multinomial"])
def test_the_same_random_numbers_draw_the_same_particles_as_in_filterpy(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    for n in (2, 7, 100):
        weights = rng.dirichlet(np.full(n, 0.3))
        source, positions = draw(scheme, weights, rng, n)
        numbers = positions if scheme == "multinomial" else positions * n - np.arange(n)
        monkeypatch.setattr(
            filterpy_resampling, "random", lambda size=None, u=numbers: u[0] if size is None else u
        )
        expected = getattr(filterpy_resampling, f"{scheme}_resample")(weights)
        np.testing.assert_array_equal(source, expected)


def test_residual_resampling_first_copies_as_filterpy_does() -> None:
    """The rest is not compared: filterpy 2.0.0 subtracts the copies from w, not from n w, and draws it wrongly."""
    source, _ = draw("residual", WEIGHTS, np.random.default_rng(1), 10)
    whole = int(np.floor(10 * WEIGHTS).sum())
    assert whole == 8
    np.testing.assert_array_equal(source[:whole], filterpy_resampling.residual_resample(WEIGHTS)[:whole])


def counts(scheme: str, draws: int, count: int = 10) -> np.ndarray:
    """How often each particle was drawn ``(draws, n)``."""
    rng = np.random.Generator(np.random.SFC64(5))
    sources = (draw(scheme, WEIGHTS, rng, count)[0] for _ in range(draws))
    return np.array([np.bincount(source, minlength=WEIGHTS.size) for source in sources])


@each_scheme
@pytest.mark.parametrize("count", [10, 4, 33])
def test_resampling_is_unbiased(scheme: str, count: int) -> None:
    drawn = counts(scheme, 4000, count)
    error = drawn.mean(axis=0) - count * WEIGHTS
    # The scatter of a number of copies is binomial at most.
    limit = 5.0 * np.sqrt(count * WEIGHTS * (1.0 - WEIGHTS) / len(drawn)) + 1e-12
    assert np.all(np.abs(error) < limit), "beyond five standard errors"
    assert drawn.sum(axis=1).tolist() == [count] * len(drawn)


def test_schemes_scatter_as_theory_says() -> None:
    whole = np.floor(10 * WEIGHTS)
    assert np.all(np.isin(counts("systematic", 500) - whole, [0, 1])), "less than one copy off"
    assert np.all(counts("residual", 500) >= whole)
    spread = {scheme: counts(scheme, 4000).var(axis=0) for scheme in RESAMPLING}
    binomial = 10 * WEIGHTS * (1.0 - WEIGHTS)
    np.testing.assert_allclose(spread["multinomial"], binomial, rtol=0.15)
    for scheme in ("systematic", "stratified", "residual"):
        assert spread[scheme].sum() < 0.6 * binomial.sum()


@each_scheme
def test_one_particle_with_all_the_weight_is_the_only_one_drawn(scheme: str) -> None:
    for place in (0, 4, 9):
        weights = np.eye(10)[place]
        source, _ = draw(scheme, weights, np.random.default_rng(0), 10)
        assert source.tolist() == [place] * 10


@each_scheme
def test_weights_that_miss_one_by_rounding_draw_no_particle_that_is_not_there(scheme: str) -> None:
    for off in (1.0 - 1e-12, 1.0 + 1e-12):
        source, _ = draw(scheme, np.full(1000, off / 1000), np.random.default_rng(0), 1000)
        assert np.all((source >= 0) & (source < 1000))


def test_sorted_uniform_numbers_are_uniform_and_sorted() -> None:
    rng, rows = np.random.Generator(np.random.SFC64(2)), np.empty((500, 20))
    for row in rows:
        sorted_uniforms(rng, row)
    assert np.all(np.diff(rows, axis=1) >= 0.0)
    assert kstest(rows.ravel(), "uniform").pvalue > 1e-3
    # The smallest of 20 uniform numbers has the distribution 1 - (1 - u)^20.
    assert kstest(1.0 - (1.0 - rows[:, 0]) ** 20, "uniform").pvalue > 1e-3


# Drives.


def slalom(steps: int = 400) -> Inputs:
    """Noisy samples of a slalom at about 18 m/s that the single track nearly drives."""
    return rolling_slalom(steps, swing=2.0 / 9.0, pace=0.3, rear=0.0)


@pytest.mark.parametrize("estimator", [KinematicPF(GOLF, particles=200), DynamicPF(GOLF, particles=200)])
def test_samples_without_any_measurement_are_answered(estimator: KernelFilter) -> None:
    samples = slalom(300).samples
    samples[100:, [at.AX, at.AY, at.YAW_RATE]] = np.nan
    samples[100:, at.VX], samples[100:, at.VX_HELD] = samples[99, at.VX], 1.0
    estimate = estimator.run(Inputs(DT, samples))
    assert np.isfinite(estimate.beta).all()
    assert np.all(np.abs(estimate.beta) <= MAX_BETA)
    assert estimate.beta_std[-1] > estimate.beta_std[90]


def test_all_schemes_give_the_same_posterior() -> None:
    inputs, estimator = slalom(100), DynamicPF(GOLF, particles=300)
    runs = {
        scheme: spread([replace(estimator, resampling=scheme, seed=seed).run(inputs) for seed in range(12)])
        for scheme in RESAMPLING
    }
    for scheme in ("stratified", "multinomial", "residual"):
        assert not np.array_equal(runs[scheme], runs["systematic"])
        assert np.abs(welch(runs[scheme], runs["systematic"])).max() < 5.0


# Kinematic and dynamic model: against exact and plain filters.


@cache
def kinematic_runs(accel: float) -> np.ndarray:
    noise = KinematicNoise(accel=accel)
    return spread([KinematicPF(GOLF, noise, particles=4000, seed=s).run(slalom(200)) for s in range(16)])


def test_the_kinematic_particle_filter_agrees_with_the_exact_kalman_filter() -> None:
    exact = spread([KinematicKF(GOLF).run(slalom(200))])[0]
    runs = kinematic_runs(KinematicNoise().accel)
    error = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    assert np.abs((runs.mean(axis=0) - exact) / error).max() < 5.0


def test_that_agreement_would_show_a_wrong_noise() -> None:
    exact = spread([KinematicKF(GOLF).run(slalom(200))])[0]
    runs = kinematic_runs(1.2 * KinematicNoise().accel)
    error = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    assert np.abs((runs.mean(axis=0) - exact) / error).max() > 5.0


def plain_dynamic_pf(estimator: DynamicPF, inputs: Inputs) -> Estimate:
    """The dynamic particle filter in plain numpy, with filterpy's systematic resampling and Gaussian noise."""
    noise, car, n = estimator.noise, estimator.car, estimator.particles
    np.random.seed(estimator.seed)  # noqa: NPY002
    rng = np.random.default_rng(estimator.seed)
    out = np.full((len(inputs.samples), 2), np.nan)
    rolling = slip_of_rolling_rear(inputs.samples[0, at.STEER], 0.0, car.a, car.b)
    x = rng.normal([inputs.samples[0, at.YAW_RATE], rolling], [noise.yaw_rate, LOW_SPEED_STD], (n, 2))
    weights = np.full(n, 1.0 / n)
    density = np.array([noise.yaw_acceleration, noise.slip_rate]) * np.sqrt(DT)
    for sample, answer in zip(inputs.samples[1:], out[1:], strict=True):
        given = (*sample[[at.VX, at.STEER, at.STEER_REAR, at.FXF, at.FXR, at.AX, at.AY]], car)
        rates = np.array([single_track_rates(*p, *given)[0] for p in x])
        x = x + DT * rates + density * rng.normal(size=(n, 2))
        ay = np.array([single_track_rates(*p, *given)[1][1] for p in x])
        misfit = ((x[:, 0] - sample[at.YAW_RATE]) / noise.yaw_rate) ** 2 + (
            (ay - sample[at.AY]) / noise.ay
        ) ** 2
        weights = weights * np.exp(-0.5 * (misfit - misfit.min()))
        weights /= weights.sum()
        mean = weights @ x[:, 1]
        answer[:] = mean, np.sqrt(weights @ (x[:, 1] - mean) ** 2)
        if 1.0 / (weights @ weights) < 0.5 * n:
            x = x[filterpy_resampling.systematic_resample(weights)]
            weights = np.full(n, 1.0 / n)
    return Estimate(out[:, 0], out[:, 1], np.full(len(out), np.nan))


def test_the_dynamic_particle_filter_agrees_with_a_plain_one_within_scatter() -> None:
    estimator, inputs, seeds = DynamicPF(GOLF, particles=200), slalom(80), 12
    plain = spread([plain_dynamic_pf(replace(estimator, seed=s), inputs) for s in range(seeds)])
    runs = spread([replace(estimator, seed=s).run(inputs) for s in range(seeds)])
    assert np.abs(welch(runs, plain)).max() < 5.0
    wrong = replace(estimator, noise=DynamicNoise(slip_rate=1.5 * DynamicNoise().slip_rate))
    runs = spread([replace(wrong, seed=s).run(inputs) for s in range(seeds)])
    assert np.abs(welch(runs, plain)).max() > 5.0


def test_the_dynamic_particle_filter_on_linear_tyres_is_the_kalman_filter() -> None:
    """At small angles nothing but the tyres is nonlinear."""
    inputs = slalom(150)
    kalman = DynamicEKF(GOLF, tyre="linear").run(inputs)
    many = DynamicPF(GOLF, particles=8000, tyre="linear").run(inputs)
    assert np.abs(many.beta - kalman.beta)[50:].max() < 0.1 * kalman.beta_std[50:].mean()
    np.testing.assert_allclose(many.beta_std[50:], kalman.beta_std[50:], rtol=0.1)


def test_missing_measurements_leave_the_weights_alone() -> None:
    samples = slalom(60).samples
    samples[30:, [at.AY, at.YAW_RATE]] = np.nan
    estimator = DynamicPF(GOLF, particles=100)
    started = estimator.start(DT)
    for sample in samples[:30]:
        estimator.step(started, sample)
    before = started.state.log_weights - started.state.log_weights.max()
    for sample in samples[30:]:
        estimator.step(started, sample)
    np.testing.assert_array_equal(started.state.log_weights, before)


# Adaptive number.


def test_with_equal_limits_the_adaptive_filter_is_the_plain_one() -> None:
    for scheme in RESAMPLING:
        fixed = RandomWalkPF(GOLF, particles=300, resampling=scheme, seed=3, forces="drawn")
        adaptive = AdaptivePF(GOLF, least_particles=300, most_particles=300, resampling=scheme, seed=3)
        found, expected = adaptive.run(rough_slalom()), fixed.run(rough_slalom())
        np.testing.assert_array_equal(found.beta, expected.beta)
        np.testing.assert_array_equal(found.beta_std, expected.beta_std)


def test_the_number_of_particles_follows_the_need_between_its_limits() -> None:
    samples = slalom(600).samples
    samples[300:, at.AY] += np.where(np.arange(300) // 10 % 2, 3.0, -3.0)  # forces come and go
    estimator = AdaptivePF(GOLF, effective=200, least_particles=300, most_particles=4000)
    count = estimator.run(Inputs(DT, samples)).extra["particles [1]"]
    assert count[1] == 4000, "the first particles are spread wide"
    calm, hard = count[200:300], count[320:]
    assert calm.min() >= 300
    assert calm.max() < 700, "twice the effective number where all goes as expected"
    assert hard.mean() > 1.5 * calm.mean()
    assert count[1:].max() <= 4000


def test_limits_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(UsageError, match="least_particles 500 is more than most_particles 100"):
        make_filter("adaptive_pf", GOLF, {"most_particles": 100})


# Catalogue.


@pytest.mark.parametrize("name", ["random_walk_pf", "kinematic_pf", "dynamic_pf", "adaptive_pf"])
def test_the_scheme_is_a_setting(name: str) -> None:
    estimator = make_filter(name, GOLF, {"resampling": "residual", "seed": 3})
    assert settings_of(estimator)["resampling"] == "residual"
    with pytest.raises(
        UsageError, match="resampling: 'wheel' is unknown: take one of systematic, stratified"
    ):
        make_filter(name, GOLF, {"resampling": "wheel"})

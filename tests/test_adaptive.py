"""Adaptive extended Kalman filters: twins on filterpy, consistency, and what adaptation may do."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs, KernelFilter
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.single_track.dual_ekf import DualEKF, DualNoise
from crosscomb.filters.single_track.friction_ekf import FrictionAdaptiveEKF, FrictionNoise
from crosscomb.filters.single_track.tyre_ekf import LINT, RATES, RATT, RATTE, TyreNoise
from crosscomb.filters.twins.table import TWINS
from crosscomb.models import parameter_track as track_model
from crosscomb.models.single_track import SingleTrack, single_track
from drives import DT, GOLF, nonsense, rmse_deg

NAMES = ("lint_ekf", "ratt_ekf", "ratte_ekf", "dual_ekf", "friction_adaptive_ekf")
LAW_OF = {"lint_ekf": "linear", "ratt_ekf": "rational", "ratte_ekf": "rational", "dual_ekf": "rational"}


def drive(
    parameters: np.ndarray,
    law: int,
    car: SingleTrack,
    steer: np.ndarray,
    vx: float = 20.0,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[Inputs, np.ndarray]:
    """Samples of a car on tyres of these parameters at constant speed, in 1 ms steps, and its beta."""
    rng = np.random.default_rng(seed)
    slopes, by = np.zeros(track_model.SLOPES_SHAPE), np.zeros((4, 2))
    samples = np.zeros((len(steer), at.SAMPLE_WIDTH))
    samples[:, at.VFL :] = np.nan
    truth = np.empty(len(steer))
    yaw_rate = beta = 0.0
    for k, angle in enumerate(steer):
        given = (vx, angle, 0.0, 0.0, 0.0, 0.0, 0.0, law, parameters, car, by, slopes)
        for _ in range(10):
            yaw_acceleration, beta_rate, ay = track_model.parameter_track_rates(yaw_rate, beta, *given)
            beta += 0.1 * DT * beta_rate
            yaw_rate += 0.1 * DT * yaw_acceleration
        truth[k] = beta
        samples[k, [at.VX, at.STEER, at.YAW_RATE, at.AY]] = vx, angle, yaw_rate, ay
    samples[:, at.YAW_RATE] += noise * 0.005 * rng.normal(size=len(steer))
    samples[:, at.AY] += noise * 0.2 * rng.normal(size=len(steer))
    return Inputs(DT, samples), truth


def slalom(seconds: float, amplitude: float) -> np.ndarray:
    """Steering angles at 100 Hz."""
    return amplitude * np.sin(2.0 * np.pi * 0.4 * np.arange(0.0, seconds, DT))


# --- filters ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rough() -> Inputs:
    """Hard slalom with gaps, held inputs, a stop and noise."""
    inputs, _ = drive(
        track_model.first_parameters(track_model.FRICTION, single_track(GOLF)) * 0.7,
        track_model.FRICTION,
        single_track(GOLF),
        slalom(8.0, 0.09),
        noise=1.0,
    )
    samples, rng = inputs.samples, np.random.default_rng(6)
    samples[:, at.AX] = 2.0 * np.sin(np.arange(800) * 0.02)
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * GOLF.mass * samples[:, at.AX]
    for column in (at.AX, at.AY, at.YAW_RATE):
        samples[rng.random(800) < 0.05, column] = np.nan
    samples[100:120, [at.AY, at.YAW_RATE]] = np.nan
    samples[200:215, at.STEER_HELD] = 1.0
    samples[400:420, at.VX] = 1.0
    samples[420:480, at.VX] = 4.0
    return inputs


@pytest.mark.parametrize("name", NAMES)
def test_kernel_agrees_with_its_twin_on_filterpy(name: str, rough: Inputs) -> None:
    estimator = make_filter(name, GOLF)
    found, expected = estimator.run(rough), TWINS[name](estimator, rough)
    np.testing.assert_allclose(found.beta, expected.beta, atol=1e-9)
    np.testing.assert_allclose(found.beta_std, expected.beta_std, atol=1e-9)
    np.testing.assert_allclose(found.nis, expected.nis, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_nonsense_leaves_the_estimate_finite_and_the_tyres_in_range(name: str) -> None:
    estimator = make_filter(name, GOLF)
    result = estimator.run(nonsense(held=False))
    assert np.isfinite(result.beta).all()
    assert np.isfinite(result.beta_std).all()
    assert np.abs(result.beta).max() <= base.MAX_BETA
    for text, values in result.extra.items():
        if "friction" in text:
            assert (values >= 0.08).all()
            assert (values <= 1.5).all()
        else:
            factor = estimator.noise.parameter_range ** (2 if text.startswith("c1") else 1)
            assert values.max() <= values[0] * factor * (1.0 + 1e-12)
            assert values.min() >= values[0] / factor * (1.0 - 1e-12)


@pytest.mark.parametrize("name", [n for n in NAMES if n != "ratt_ekf"])
def test_straight_and_slow_driving_teach_nothing(name: str) -> None:
    rng = np.random.default_rng(8)
    samples = np.zeros((3000, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 25.0
    samples[:, at.AY] = 0.3 + rng.normal(0.0, 0.15, 3000)  # a banked straight
    samples[:, at.YAW_RATE] = rng.normal(0.0, 0.01, 3000)
    samples[2000:, at.VX], samples[2000:, at.AY] = 4.0, 3.0  # a wrong sensor at walking speed
    result = make_filter(name, GOLF).run(Inputs(DT, samples))
    for text, values in result.extra.items():
        assert (values == values[0]).all(), text


@pytest.mark.parametrize("name", [n for n in NAMES if n != "ratt_ekf"])
def test_a_shaking_accelerometer_teaches_nothing_straight_ahead(name: str) -> None:
    rng = np.random.default_rng(9)
    samples = np.zeros((2000, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 25.0
    samples[:, at.AY] = rng.normal(0.0, 4.0, 2000)
    samples[:, at.YAW_RATE] = rng.normal(0.0, 0.005, 2000)
    result = make_filter(name, GOLF).run(Inputs(DT, samples))
    for text, values in result.extra.items():
        assert (values == values[0]).all(), text


@pytest.mark.parametrize("name", NAMES)
def test_noiseless_data_of_its_own_model_gives_the_truth(name: str) -> None:
    steer, vx = slalom(4.0, 0.05), 22.0
    estimator = make_filter(name, GOLF)
    truth, samples = own_model(estimator, steer, vx)
    state = estimator.make_state()
    state.running[0] = 1
    state.mean[: len(truth[0])] = truth[0]
    out = np.full((len(steer) - 1, 3 + len(estimator.extras)), np.nan)
    estimator.run_kernel(state, samples[1:], estimator.car, estimator.noise, DT, out)
    index = 0 if isinstance(estimator, RATT) else 1
    assert np.abs(truth[1:, index]).max() > 0.01
    np.testing.assert_allclose(out[:, at.BETA], truth[1:, index], atol=1e-9)


def own_model(
    estimator: KernelFilter,
    steer: np.ndarray,
    vx: float,
    parameters: np.ndarray | None = None,
    first: np.ndarray | None = None,
    shocks: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """States and samples of the filter's discrete model: [yaw_rate, beta] or Di Biase's four rates.

    `shocks` ``(n, 2)`` add to yaw acceleration and slip rate (Di Biase) or to yaw rate and beta.
    """
    car = estimator.car
    if parameters is None:
        parameters = track_model.first_parameters(car.law, car.track)
    slopes, by = np.zeros(track_model.SLOPES_SHAPE), np.zeros((4, 2))
    rates_as_states = isinstance(estimator, RATT)
    state = np.zeros(4 if rates_as_states else 2) if first is None else first.copy()
    states, samples = [state.copy()], np.zeros((len(steer), at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.STEER] = vx, steer
    shocks = np.zeros((len(steer), 2)) if shocks is None else shocks
    for k in range(1, len(steer)):
        # The model takes the friction in use from ay; small here, so that it is the file's.
        beta, yaw_rate = (state[0], state[1]) if rates_as_states else (state[1], state[0])
        given = (vx, steer[k], 0.0, 0.0, 0.0, 0.0, 0.0, car.law, parameters, car.track, by, slopes)
        yaw_acceleration, beta_rate, _ = track_model.parameter_track_rates(yaw_rate, beta, *given)
        if rates_as_states:
            state = np.array([beta + DT * state[2], yaw_rate + DT * state[3], beta_rate, yaw_acceleration])
            state[[3, 2]] += shocks[k]
            ay, _, _ = track_model.lateral_acceleration(*state[:3], vx, 0.0)
        else:
            state = np.array([yaw_rate + DT * yaw_acceleration, beta + DT * beta_rate]) + shocks[k]
            _, _, ay = track_model.parameter_track_rates(*state, *given)
        samples[k, at.YAW_RATE] = state[1] if rates_as_states else state[0]
        samples[k, at.AY] = ay
        states.append(state.copy())
    return np.array(states), samples


@pytest.mark.parametrize("cls", [LINT, RATT, RATTE])
def test_errors_are_as_large_as_the_filter_says(cls: type[RATT]) -> None:
    """NEES and NIS over runs of the filter's own model with drawn start, tyres and noise."""
    noise = TyreNoise(
        steer=0.0, yaw_acceleration=0.05, slip_rate=0.005, yaw_rate=0.01, ay=0.3,
        parameter_walk=0.0, parameter_spread=0.03, parameter_range=3.0, adapt_ay=0.0, adapt_speed=0.0,
    )  # fmt: skip
    estimator, runs, steps, vx = cls(GOLF, noise), 60, 120, 22.0
    rng = np.random.default_rng(9)
    steer = slalom(steps * DT, 0.02)
    n = len(estimator.make_state().cov)
    nees, nis = [], []
    for _ in range(runs):
        state = estimator.make_state()
        limits = state.limits
        drawn = rng.normal(size=n)
        cov = np.diag([0.01**2, 0.01**2, 0.05**2, 0.1**2])
        state.cov[:RATES, :RATES] = cov
        first = drawn[:RATES] * np.sqrt(np.diag(cov))
        tyres = limits.first + (limits.spread * drawn[RATES:] if n > RATES else 0.0)
        shocks = rng.normal(size=(steps, 2)) * [noise.yaw_acceleration, noise.slip_rate] / math.sqrt(DT)
        truth, samples = own_model(estimator, steer, vx, tyres, first, shocks)
        samples[:, at.YAW_RATE] += noise.yaw_rate * rng.normal(size=steps)
        samples[:, at.AY] += noise.ay * rng.normal(size=steps)
        state.running[0] = 1
        out = np.full(3 + len(estimator.extras), np.nan)
        for k in range(1, steps):
            estimator.run_kernel(state, samples[k][None], estimator.car, noise, DT, out[None])
            nis.append(out[at.NIS])
        error = np.concatenate([truth[-1], tyres])[:n] - state.mean[:n]
        nees.append(error @ np.linalg.solve(state.cov, error))
    inside(np.sum(nees), runs * n)
    inside(np.sum(nis), 2 * len(nis))


def inside(total: float, degrees: int) -> None:
    """Check a sum of squared normal errors against its 99.9 % bounds."""
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert low < total < high


def matched_runs(
    estimator: KernelFilter, steer: np.ndarray, vx: float, spread: np.ndarray
) -> Iterator[tuple[Any, np.ndarray, np.ndarray, int, float]]:
    """Runs of the filter's own model, with start, tyres of this spread ``(p,)`` and noise drawn.

    Gives the filter's state, the true motion and tyres, the sample's number and its NIS, sample by sample.
    """
    noise, rng, steps = estimator.noise, np.random.default_rng(3), len(steer)
    first = track_model.first_parameters(estimator.car.law, estimator.car.track)
    for _ in range(RUNS):
        state, out = estimator.make_state(), np.full(3 + len(estimator.extras), np.nan)
        state.cov[:2, :2], state.running[0] = np.diag([noise.yaw_rate**2, FIRST_BETA_STD**2]), 1
        state.mean[:2] = 0.0
        at_start = rng.normal(size=2) * [noise.yaw_rate, FIRST_BETA_STD]
        tyres = first + spread * rng.normal(size=len(first))
        shocks = rng.normal(size=(steps, 2)) * [noise.yaw_acceleration, noise.slip_rate] * math.sqrt(DT)
        truth, samples = own_model(estimator, steer, vx, tyres, at_start, shocks)
        samples[:, [at.YAW_RATE, at.AY]] += rng.normal(size=(steps, 2)) * [noise.yaw_rate, noise.ay]
        for k in range(1, steps):
            estimator.run_kernel(state, samples[k][None], estimator.car, noise, DT, out[None])
            yield state, truth[k], tyres, k, out[at.NIS]


SHARP = {"yaw_acceleration": 0.1, "slip_rate": 0.01, "yaw_rate": 0.01, "ay": 0.3, "adapt_speed": 0.0}
RUNS, FIRST_BETA_STD = 60, 0.01
INSTANTS = (40, 80, 120)


def test_the_friction_filter_errs_as_much_as_it_says() -> None:
    noise = FrictionNoise(friction_walk=0.0, friction_spread=0.1, adapt_ay=0.0, **SHARP)
    estimator, nees, nis = FrictionAdaptiveEKF(GOLF, noise), dict.fromkeys(INSTANTS, 0.0), []
    certainty = []
    for state, motion, tyres, k, of_sample in matched_runs(
        estimator, slalom(1.21, 0.05), 22.0, np.array([0.1])
    ):
        nis.append(of_sample)
        if k in nees:
            error = np.append(motion, tyres) - state.mean
            nees[k] += error @ np.linalg.solve(state.cov, error)
            certainty.append(state.cov[2, 2])
    for total in nees.values():
        inside(total, 3 * RUNS)
    inside(np.sum(nis), 2 * len(nis))
    assert np.sqrt(certainty[2::3]).mean() < 0.085, "it has learned of the friction"


def dual_sums(estimator: DualEKF, steer: np.ndarray, vx: float, spread: np.ndarray) -> np.ndarray:
    """Summed NEES of the motion without and with the doubt about the tyres, and of the tyres ``(3, instants)``.

    In the last column the NIS, per measurement, and their number.
    """
    sums = np.zeros((3, len(INSTANTS) + 1))
    for state, motion, tyres, k, of_sample in matched_runs(estimator, steer, vx, spread):
        sums[:2, -1] += of_sample, 2.0
        if k in INSTANTS:
            error, off = motion - state.mean, tyres - state.tyres
            whole = state.cov + state.sensitivity @ state.tyre_cov @ state.sensitivity.T
            sums[:, INSTANTS.index(k)] += (
                error @ np.linalg.solve(state.cov, error),
                error @ np.linalg.solve(whole, error),
                off @ np.linalg.solve(state.tyre_cov, off),
            )
    return sums


def test_the_dual_filter_errs_as_much_as_it_says() -> None:
    noise = DualNoise(parameter_walk=0.0, parameter_spread=0.1, parameter_range=3.0, adapt_ay=0.0, **SHARP)
    estimator = DualEKF(GOLF, noise)
    spread = estimator.make_state().limits.spread
    motion_alone, motion, tyres = dual_sums(estimator, slalom(1.21, 0.09), 15.0, spread)
    for total in motion[:-1]:
        inside(total, 2 * RUNS)
    for total in tyres[:-1]:
        inside(total, 4 * RUNS)
    inside(motion_alone[-1], int(motion[-1]))
    assert motion_alone[:-1].max() > chi2.ppf(0.9995, 2 * RUNS), (
        "without the tyres' doubt it would be too sure"
    )


def test_the_dual_filter_on_tyres_it_knows_errs_as_much_as_it_says() -> None:
    estimator = DualEKF(GOLF, DualNoise(parameter_spread=1e-9, adapt_ay=90.0, **SHARP))
    motion_alone, motion, _ = dual_sums(estimator, slalom(1.21, 0.02), 22.0, np.zeros(4))
    for total in motion_alone[:-1]:
        inside(total, 2 * RUNS)
    inside(motion_alone[-1], int(motion[-1]))


# --- adaptation -------------------------------------------------------------------------------------------


def test_lint_learns_softer_tyres() -> None:
    car = single_track(GOLF, "linear")
    true = np.array([0.75, 0.8]) * track_model.first_parameters(track_model.STIFFNESS, car)
    inputs, truth = drive(true, track_model.STIFFNESS, car, slalom(60.0, 0.03), noise=1.0)
    result = LINT(GOLF).run(inputs)
    front, rear = result.extra.values()
    # The two axles share one lateral acceleration, so what is learned is half-way there after a minute.
    for found, wanted in ((front, true[0]), (rear, true[1])):
        assert abs(found[-1] - wanted) < 0.6 * abs(found[0] - wanted)
    fixed = LINT(GOLF, TyreNoise(adapt_ay=99.0)).run(inputs)
    assert rmse_deg(result.beta[3000:], truth[3000:]) < 0.6 * rmse_deg(fixed.beta[3000:], truth[3000:])


@pytest.mark.parametrize("cls", [RATTE, DualEKF])
def test_adapted_rational_tyres_beat_fixed_ones_on_a_wet_road(cls: type) -> None:
    car = single_track(GOLF, "rational")
    true = track_model.first_parameters(track_model.RATIONAL, car) * [0.6, 0.8, 0.6, 0.8]
    inputs, truth = drive(true, track_model.RATIONAL, car, slalom(60.0, 0.06), noise=1.0)
    adapted = rmse_deg(cls(GOLF).run(inputs).beta[3000:], truth[3000:])
    assert adapted < 0.7 * rmse_deg(RATT(GOLF).run(inputs).beta[3000:], truth[3000:])


def test_friction_is_learned_in_hard_turns_only() -> None:
    car = single_track(GOLF)
    snow = np.array([0.35])
    hard, truth = drive(snow, track_model.FRICTION, car, slalom(30.0, 0.08), vx=15.0, noise=1.0)
    gentle, _ = drive(snow, track_model.FRICTION, car, slalom(30.0, 0.008), vx=15.0, noise=1.0)
    learned = FrictionAdaptiveEKF(GOLF).run(hard)
    assert learned.extra["friction [-]"][-1] == pytest.approx(0.35, abs=0.08)
    assert FrictionAdaptiveEKF(GOLF).run(gentle).extra["friction [-]"][-1] == pytest.approx(
        GOLF.friction, abs=0.05
    )
    fixed = FrictionAdaptiveEKF(GOLF, FrictionNoise(adapt_ay=99.0)).run(hard)
    assert rmse_deg(learned.beta[1000:], truth[1000:]) < 0.8 * rmse_deg(fixed.beta[1000:], truth[1000:])


def test_friction_is_never_below_the_acceleration_in_use() -> None:
    car = single_track(GOLF)
    inputs, _ = drive(np.array([1.0]), track_model.FRICTION, car, slalom(20.0, 0.06))
    result = FrictionAdaptiveEKF(GOLF.model_copy(update={"friction": 0.3})).run(inputs)
    used = (
        np.minimum(np.abs(inputs.samples[:, at.AY]), 20.0 * np.abs(inputs.samples[:, at.YAW_RATE])) / 9.80665
    )
    used[np.abs(inputs.samples[:, at.AY]) <= 1.0] = 0.0
    assert used.max() > 0.5
    assert (result.extra["friction [-]"][1:] >= used[1:] - 1e-3).all()

"""Combinations: filterpy's multiple models, honest mixtures, and members that are the filters themselves."""

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, MMAEFilterBank
from scipy.stats import chi2

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, KernelFilter, gaussian
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.combined.blends import CovarianceFusion, FuzzyBlend
from crosscomb.filters.combined.cross_combined import CrossCombinedUKF, CrossNoise, kinematic_share
from crosscomb.filters.combined.model_bank import Cars, ModelNoise, model_shares, slip_predict
from crosscomb.filters.combined.multiple_model import IMM, MMAE
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.planar.ukf import SimpleUKF
from crosscomb.filters.single_track.ekf import DynamicEKF, DynamicNoise
from crosscomb.models.single_track import single_track, single_track_rates, stable_substeps
from drives import DT, GOLF, limit_slalom, simulated_inputs


def simulated(manoeuvre: str, surface: str = "dry", duration: float = 15.0) -> tuple[Inputs, np.ndarray]:
    return simulated_inputs(GOLF, manoeuvre, 7, surface=surface, duration=duration)


def rmse(estimate: Estimate, beta: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean((estimate.beta - beta)[100:] ** 2))))


# Multiple models against filterpy.


class PlainModel:
    """One filter of the bank in plain numpy, as filterpy's estimators want it."""

    def __init__(self, car, noise: ModelNoise, sample: np.ndarray, beta: float, beta_std: float) -> None:
        self.car, self.noise = car, noise
        self.x = np.array([sample[at.YAW_RATE], beta])
        self.P = np.diag([noise.dynamic.yaw_rate**2, beta_std**2])
        self.z, self.likelihood, self.nis = np.zeros(2), 1.0, 0.0

    def model(self, sample: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        given = (*sample[[at.VX, at.STEER]], 0.0, *sample[[at.FXF, at.FXR, at.AX, at.AY]])
        rates, (_, ay), jacobian = single_track_rates(*self.x, *given, self.car)
        return np.array(rates), ay, np.array(jacobian).reshape(2, 4).T

    def predict(self, sample: np.ndarray) -> None:
        noise, vx = self.noise, sample[at.VX]
        if self.car is None:
            cos, sin = np.cos(self.x[1]), np.sin(self.x[1])
            rate = (sample[at.AY] * cos - sample[at.AX] * sin) * cos / vx - self.x[0]
            slope = -(2.0 * sample[at.AY] * sin * cos + sample[at.AX] * (cos**2 - sin**2)) / vx
            f = np.array([[1.0, 0.0], [-DT, 1.0 + DT * (slope - noise.relaxation)]])
            self.x = self.x + np.array([0.0, DT * (rate - noise.relaxation * self.x[1])])
            q = np.array([noise.yaw_acceleration, noise.accel / vx]) ** 2
            self.P = f @ self.P @ f.T + DT * np.diag(q)
            return
        steps = stable_substeps(vx, DT, self.car)
        h = DT / steps
        for _ in range(steps):
            rates, _, jacobian = self.model(sample)
            f = np.eye(2) + h * jacobian[:2]
            self.x = self.x + h * rates
            q = np.array([noise.dynamic.yaw_acceleration, noise.dynamic.slip_rate]) ** 2
            self.P = f @ self.P @ f.T + h * np.diag(q)

    def update(self, sample: np.ndarray, r: object = None, h: object = None) -> None:
        noise = self.noise
        if self.car is None:
            rows, innovation = np.array([[1.0, 0.0]]), sample[[at.YAW_RATE]] - self.x[:1]
            r_matrix = np.array([[noise.dynamic.yaw_rate**2]])
            ay = math.exp(-0.5) / (noise.surprise * math.sqrt(2.0 * math.pi))
        else:
            _, expected, jacobian = self.model(sample)
            rows, innovation = (
                np.array([[1.0, 0.0], jacobian[3]]),
                sample[[at.YAW_RATE, at.AY]] - np.array([self.x[0], expected]),
            )
            r_matrix, ay = np.diag([noise.dynamic.yaw_rate, noise.dynamic.ay]) ** 2, 1.0
        s = rows @ self.P @ rows.T + r_matrix
        gain = self.P @ rows.T @ np.linalg.inv(s)
        self.nis = float(innovation @ np.linalg.solve(s, innovation))
        self.likelihood = ay * math.exp(-0.5 * self.nis) / math.sqrt(np.linalg.det(2.0 * np.pi * s))
        self.x = self.x + gain @ innovation
        self.P = (np.eye(2) - gain @ rows) @ self.P


PLAIN = ModelNoise(correlation=0.0, floor=0.0)


def plain_models(estimator: KernelFilter, sample: np.ndarray) -> list[PlainModel]:
    cars = (estimator.car.high, estimator.car.low, None)
    answer = np.empty(6)
    started = estimator.start(DT)
    answer[:3] = estimator.step(started, sample)
    return [PlainModel(car, estimator.noise, sample, *answer[:2]) for car in cars]


@pytest.mark.parametrize("manoeuvre", ["slalom", "drift"])
def test_imm_agrees_with_filterpy(manoeuvre: str) -> None:
    inputs, _ = simulated(manoeuvre, duration=6.0)
    estimator = IMM(GOLF, PLAIN)
    slow = np.flatnonzero(inputs.samples[:, at.VX] < 3.5)  # the plain models know no stops
    inputs = replace(inputs, samples=inputs.samples[: slow[0] if len(slow) else None])
    samples = inputs.samples
    assert len(samples) > 200
    shares, stay = np.array(model_shares(PLAIN)), math.exp(-DT / PLAIN.stay)
    models = plain_models(estimator, samples[0])
    imm = IMMEstimator(models, shares, stay * np.eye(3) + (1.0 - stay) * np.outer(np.ones(3), shares))
    expected = np.empty((len(samples) - 1, 6))
    for sample, row in zip(samples[1:], expected, strict=True):
        imm.predict(sample)
        imm.update(sample)
        row[:] = imm.x[1], math.sqrt(imm.P[1, 1]), imm.mu @ [m.nis for m in models], *imm.mu
    estimate = estimator.run(inputs)
    got = np.column_stack([estimate.beta, estimate.beta_std, estimate.nis, *estimate.extra.values()])[1:]
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-8)
    assert np.ptp(got[:, 3:], axis=0).min() > 0.05, "probabilities that stay where they are prove nothing"


def test_mmae_agrees_with_filterpy() -> None:
    inputs, _ = simulated("slalom", duration=6.0)
    estimator = MMAE(GOLF, PLAIN)
    models = plain_models(estimator, inputs.samples[0])
    bank = MMAEFilterBank(models, np.array(model_shares(PLAIN)), dim_x=2)
    expected = np.empty((len(inputs.samples) - 1, 5))
    for sample, row in zip(inputs.samples[1:], expected, strict=True):
        bank.predict(sample)
        bank.update(sample)
        # filterpy 2.0's own covariance of the bank pairs states with filters; the formula is this one.
        spread = [p * (m.P[1, 1] + (m.x[1] - bank.x[1]) ** 2) for p, m in zip(bank.p, models, strict=True)]
        row[:] = bank.x[1], math.sqrt(sum(spread)), *bank.p
    estimate = estimator.run(inputs)
    got = np.column_stack([estimate.beta, estimate.beta_std, *estimate.extra.values()])[1:]
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("cls", [IMM, MMAE])
def test_low_friction_is_seen_in_a_hard_slalom(cls: type[KernelFilter]) -> None:
    noise = ModelNoise(dynamic=DynamicNoise(0.1, 0.01, 0.005, 0.2))
    estimator, chances = cls(GOLF, noise), []
    for car in (estimator.car.high, estimator.car.low):
        rng, steps = np.random.default_rng(1), 600
        samples = np.full((steps, at.SAMPLE_WIDTH), np.nan)
        samples[:, 1:10] = 0.0
        samples[:, at.VX], samples[:, at.STEER] = 15.0, 0.06 * np.sin(2.0 * DT * np.arange(steps))
        state = np.zeros(2)
        for sample in samples:
            rates, (_, ay), _ = single_track_rates(
                *state, 15.0, sample[at.STEER], 0.0, 0.0, 0.0, 0.0, 0.0, car
            )
            state = state + DT * np.array(rates)
            sample[[at.YAW_RATE, at.AY]] = rng.normal([state[0], ay], [0.005, 0.2])
        estimate = estimator.run(Inputs(DT, samples))
        chances.append(estimate.extra["probability_low_friction [-]"][300:].mean())
        np.testing.assert_allclose(np.sum([*estimate.extra.values()], axis=0), 1.0, rtol=1e-12)
    # On high friction both models hold, as the low one is raised to what the car plainly uses.
    assert chances[1] > 0.7
    assert chances[1] > chances[0] + 0.1


def test_one_model_alone_is_its_filter() -> None:
    """With all the say to the dynamic model IMM and MMAE are the dynamic EKF."""
    inputs, _ = simulated("slalom", duration=6.0)
    alone = ModelNoise(low_share=0.0, kinematic_share=0.0, floor=0.0)
    for estimator in (IMM(GOLF, alone), MMAE(GOLF, alone)):
        estimate, ekf = estimator.run(inputs), DynamicEKF(GOLF).run(inputs)
        np.testing.assert_allclose(estimate.beta, ekf.beta, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(estimate.beta_std, ekf.beta_std, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(estimate.nis, ekf.nis, rtol=1e-9)


def test_kinematic_model_of_the_bank_follows_the_kinematic_equation() -> None:
    state, sample = gaussian(), np.zeros(at.SAMPLE_WIDTH)
    sample[[at.VX, at.AX, at.AY]] = 20.0, -2.0, 6.0
    state.mean[:] = 0.3, -0.1
    slip_predict(state, sample, ModelNoise(relaxation=0.0), 1e-4)
    vy = 20.0 * math.tan(-0.1)
    vx_dot, vy_dot = -2.0 + 0.3 * vy, 6.0 - 0.3 * 20.0
    beta_dot = (20.0 * vy_dot - vy * vx_dot) / (20.0**2 + vy**2)
    assert (state.mean[1] + 0.1) / 1e-4 == pytest.approx(beta_dot, rel=1e-6)


# Monte Carlo: on drives of their own models errors and innovations are as large as they say; the IMM's jump, the
# MMAE's do not. The mean of the filters' NIS, weighted by what the measurement says of the models, is that of one
# matched filter.


def jumping_drive(
    estimator: IMM | MMAE, rng: np.random.Generator, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    noise, cars = estimator.noise.dynamic, (estimator.car.high, estimator.car.low)
    shares, stay = np.array(model_shares(estimator.noise)[:2]), math.exp(-DT / estimator.noise.stay)
    samples, truth = np.full((steps, at.SAMPLE_WIDTH), np.nan), np.zeros((steps, 2))
    samples[:, 1:10] = 0.0
    samples[:, at.VX], samples[:, at.STEER] = 20.0, 0.04 * np.sin(4.0 * DT * np.arange(steps))
    samples[0, at.YAW_RATE] = 0.0
    truth[0] = rng.normal(0.0, [noise.yaw_rate, math.radians(2.0)])
    mode = rng.choice(2, p=shares / shares.sum())
    for k in range(1, steps):
        if rng.random() > stay:
            mode = rng.choice(2, p=shares / shares.sum())
        given = (20.0, samples[k, at.STEER], 0.0, 0.0, 0.0, 0.0, 0.0)
        rates, _, _ = single_track_rates(*truth[k - 1], *given, cars[mode])
        shaken = rng.normal(0.0, np.sqrt(DT) * np.array([noise.yaw_acceleration, noise.slip_rate]))
        truth[k] = truth[k - 1] + DT * np.array(rates) + shaken
        _, (_, ay), _ = single_track_rates(*truth[k], *given, cars[mode])
        samples[k, [at.YAW_RATE, at.AY]] = rng.normal([truth[k, 0], ay], [noise.yaw_rate, noise.ay])
    return samples, truth


MATCHED = DynamicNoise(0.3, 0.05, 0.01, 1.0)


def two_cars(estimator: IMM | MMAE) -> Cars:
    """The car on linear tyres, stiff and soft: the filters of both are exact on their own drives."""
    stiff = single_track(estimator.vehicle, "linear")
    soft = {"stiffness_front": 0.6 * stiff.stiffness_front, "stiffness_rear": 0.5 * stiff.stiffness_rear}
    return Cars(stiff, stiff._replace(**soft))


class LinearIMM(IMM):
    car = property(two_cars)


class LinearMMAE(MMAE):
    car = property(two_cars)


def bank_consistency(kind: type[IMM | MMAE], stay: float, dynamic: DynamicNoise) -> tuple[float, float]:
    """Where in its chi-square distribution the NEES of the last beta and the NIS of all samples lie.

    The drives have the errors of `MATCHED`, the filter expects those of `dynamic`.
    """
    noise = ModelNoise(
        correlation=0.0,
        kinematic_share=0.0,
        low_share=0.3,
        stay=stay,
        floor=1e-12,  # a floor gives models a say that these drives do not have
        dynamic=MATCHED,
    )
    # The friction margin sees the measured ay, the drive does not: low friction is above it all the same.
    estimator, rng, runs, steps = kind(GOLF, noise, low_friction=0.6), np.random.default_rng(8), 150, 150
    tested = replace(estimator, noise=noise._replace(dynamic=dynamic))
    nees, nis = 0.0, 0.0
    for _ in range(runs):
        samples, truth = jumping_drive(estimator, rng, steps)
        estimate = tested.run(Inputs(DT, samples))
        nees += ((estimate.beta - truth[:, 1]) / estimate.beta_std)[-1] ** 2
        nis += estimate.nis[1:].sum()  # the first sample starts the filters
    return float(chi2.cdf(nees, runs)), float(chi2.cdf(nis, 2 * runs * (steps - 1)))


@pytest.mark.parametrize(("kind", "stay"), [(IMM, 2.0), (MMAE, 1e9), (LinearIMM, 2.0), (LinearMMAE, 1e9)])
def test_errors_of_the_banks_are_as_large_as_they_say(kind: type[IMM | MMAE], stay: float) -> None:
    nees, nis = bank_consistency(kind, stay, MATCHED)
    assert 0.0005 < nees < 0.9995
    # Near saturation a first-order filter expects 3 % too much of its innovations, alone as in a bank.
    assert nis < 0.9995
    assert nis > 0.0005 or kind is IMM


@pytest.mark.parametrize(("kind", "stay"), [(LinearIMM, 2.0), (LinearMMAE, 1e9)])
def test_a_bank_that_is_too_sure_is_seen(kind: type[IMM | MMAE], stay: float) -> None:
    nees, nis = bank_consistency(kind, stay, DynamicNoise(0.15, 0.01, 0.01, 0.7))
    assert nees > 0.9995
    assert nis > 0.9995


# Blends.


def members(inputs: Inputs, estimator: KernelFilter) -> tuple[Estimate, Estimate]:
    noise = estimator.noise
    return KinematicKF(GOLF, noise.kinematic).run(inputs), DynamicEKF(GOLF, noise.dynamic).run(inputs)


def test_fuzzy_blend_mixes_its_members_by_its_index() -> None:
    inputs, _ = simulated("step_steer")
    estimate = FuzzyBlend(GOLF).run(inputs)
    kinematic, dynamic = members(inputs, FuzzyBlend(GOLF))
    (index,) = estimate.extra.values()
    mixture = index * dynamic.beta + (1.0 - index) * kinematic.beta
    second = index * (dynamic.beta_std**2 + dynamic.beta**2)
    second += (1.0 - index) * (kinematic.beta_std**2 + kinematic.beta**2)
    np.testing.assert_allclose(estimate.beta, mixture, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(estimate.beta_std, np.sqrt(second - mixture**2), rtol=0.0, atol=1e-9)
    assert index.min() < 0.7
    assert index.max() == 1.0


def test_steady_state_index_tells_steady_from_transient_and_counts_the_yaw_rate_most() -> None:
    n = 600
    steady = np.zeros((n, at.SAMPLE_WIDTH))
    steady[:, [at.VX, at.AY, at.YAW_RATE, at.STEER]] = 20.0, 4.0, 0.2, 0.03
    (index,) = FuzzyBlend(GOLF).run(Inputs(DT, steady)).extra.values()
    np.testing.assert_array_equal(index, 1.0)
    lowest = {}
    for column, step in ((at.AY, 6.0), (at.YAW_RATE, 0.4), (at.STEER, 0.1)):
        samples = steady.copy()
        samples[300:, column] += step
        (index,) = FuzzyBlend(GOLF).run(Inputs(DT, samples)).extra.values()
        np.testing.assert_array_equal(index[:300], 1.0)
        assert index[-1] == 1.0, "a new steady state"
        lowest[column] = index.min()
    assert lowest[at.AY] == lowest[at.STEER] == pytest.approx(0.75)
    assert lowest[at.YAW_RATE] == pytest.approx(0.5)


def test_fusion_weighs_by_variance_and_is_never_surer_than_its_surest_member() -> None:
    inputs, _ = simulated("slalom")
    estimate = CovarianceFusion(GOLF).run(inputs)
    kinematic, dynamic = members(inputs, CovarianceFusion(GOLF))
    weights = 1.0 / np.array([kinematic.beta_std**2, dynamic.beta_std**2])
    expected = (weights[0] * kinematic.beta + weights[1] * dynamic.beta) / weights.sum(axis=0)
    np.testing.assert_allclose(estimate.beta, expected, rtol=0.0, atol=1e-12)
    surest = np.minimum(kinematic.beta_std, dynamic.beta_std)
    assert np.all(estimate.beta_std >= surest * (1.0 - 1e-12))


def test_fusion_of_like_members_says_what_they_say() -> None:
    """Two members of one variance that agree are no surer together: their errors may be the same."""
    inputs, _ = simulated("slalom")
    estimate = CovarianceFusion(GOLF).run(inputs)
    assert estimate.beta_std[0] == KinematicKF(GOLF).run(inputs).beta_std[0]


def test_cross_combination_hands_over_by_speed_and_yaw_rate() -> None:
    noise = CrossNoise()

    def share(vx: float, yaw_rate: float) -> float:
        sample = np.zeros(at.SAMPLE_WIDTH)
        sample[[at.VX, at.YAW_RATE]] = vx, yaw_rate
        return float(kinematic_share(sample, noise))

    assert share(20.0, 0.0) < 0.02
    assert share(3.5, 0.5) < 0.1
    assert share(20.0, -0.5) == share(20.0, 0.5) > 0.99
    assert share(20.0, np.nan) == 0.0


def test_cross_combination_is_its_members_where_one_has_all_the_say() -> None:
    inputs, _ = simulated("country_road")
    never = CrossCombinedUKF(GOLF, CrossNoise(turning=1e3)).run(inputs)
    np.testing.assert_allclose(never.beta, SimpleUKF(GOLF).run(inputs).beta, rtol=0.0, atol=1e-12)
    always = CrossCombinedUKF(GOLF, CrossNoise(turning=-1e3, moving=-1e3, support=1e6)).run(inputs)
    kinematic = KinematicKF(GOLF, CrossNoise().kinematic).run(inputs)
    np.testing.assert_allclose(always.beta, kinematic.beta, rtol=0.0, atol=1e-9)


def test_cross_combination_does_not_drift_as_its_kinematic_member_alone_does() -> None:
    inputs, beta = simulated("country_road", duration=20.0)
    integrates = KinematicNoise(accel_bias=0.0, disagreement=1e-9)  # and measures vx alone
    cross = CrossCombinedUKF(GOLF, CrossNoise(kinematic=integrates)).run(inputs)
    kinematic = KinematicKF(GOLF, integrates).run(inputs)
    assert rmse(kinematic, beta) > 0.8
    assert rmse(cross, beta) < 0.7 * rmse(kinematic, beta)


# What holds for every filter of these families.

NAMES = (
    "kinematic_kf_zero_yaw", "kinematic_blend_kf", "luenberger", "extended_luenberger", "sliding_mode",
    "gnss_kinematic_kf", "gnss_dynamic_observer", "fuzzy_blend", "cross_combined_ukf", "covariance_fusion", "imm",
    "mmae", "network", "network_feedback",
)  # fmt: skip
each_filter = pytest.mark.parametrize("name", NAMES)


@each_filter
def test_further_answers_are_finite_at_every_sample(name: str) -> None:
    estimate = make_filter(name, GOLF).run(limit_slalom())
    assert all(np.isfinite(part).all() for part in estimate.extra.values())

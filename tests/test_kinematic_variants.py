"""Kinematic filters with help near zero yaw rate: no drift on straights, the plain filter in turns."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, Estimate, Inputs, KernelFilter
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.kinematic.kf_variants import (
    LEAST_SHARE,
    BlendKF,
    BlendNoise,
    ZeroYawKF,
    straight_share,
)
from crosscomb.filters.twins.shared import walk_samples
from crosscomb.filters.twins.table import TWINS
from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear
from crosscomb.models.single_track import single_track_rates, stable_substeps
from crosscomb.models.vehicle import load_vehicle

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")
VARIANTS: list[KernelFilter] = [ZeroYawKF(GOLF), BlendKF(GOLF)]
each_variant = pytest.mark.parametrize("estimator", VARIANTS, ids=["zero yaw", "blend"])
CAR = VARIANTS[0].car


def lane_changes(steps: int, seed: int = 0) -> Inputs:
    """Noisy samples with straights and bends to either side at 20 m/s."""
    rng, t = np.random.default_rng(seed), DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 20.0 + rng.normal(0.0, 0.05, steps)
    samples[:, at.YAW_RATE] = 0.25 * np.sin(t) ** 3 + rng.normal(0.0, 0.005, steps)
    samples[:, at.AX] = rng.normal(0.0, 0.2, steps)
    samples[:, at.AY] = 5.0 * np.sin(t) ** 3 + 3.0 * np.cos(4.0 * t) + rng.normal(0.0, 0.3, steps)
    samples[:, at.STEER] = 0.04 * np.sin(t) ** 3
    samples[:, at.STEER_REAR] = 0.1 * samples[:, at.STEER]
    samples[:, 10:] = np.nan
    return Inputs(DT, samples)


def test_zero_yaw_kernel_agrees_with_filterpy() -> None:
    inputs = lane_changes(1500)
    estimate, expected = VARIANTS[0].run(inputs), TWINS["kinematic_kf_zero_yaw"](VARIANTS[0], inputs)
    for part in ("beta", "beta_std", "nis"):
        np.testing.assert_allclose(getattr(estimate, part), getattr(expected, part), rtol=1e-9, atol=1e-9)
    assert np.ptp(estimate.beta) > np.radians(1.0)


def blend_transition(x: np.ndarray, sample: np.ndarray, share: float, noise: Any) -> np.ndarray:
    """State (4,) of the blending model one sample later, without noise."""
    given = (*sample[[at.VX, at.STEER, at.STEER_REAR]], 0.0, 0.0, sample[at.AX], sample[at.AY])
    _, (_, ay), _ = single_track_rates(sample[at.YAW_RATE], np.arctan2(x[1], x[0]), *given, CAR)
    acceleration = [sample[at.AX] - x[2], (1.0 - share) * (sample[at.AY] - x[3]) + share * ay]
    turned = np.reshape(rotation(sample[at.YAW_RATE], DT), (2, 2)) @ x[:2]
    velocity = turned + np.reshape(input_gain(sample[at.YAW_RATE], DT), (2, 2)) @ acceleration
    return np.concatenate([velocity, np.exp(-DT / noise.bias_time) * x[2:]])


def process_noise(noise: Any, felt: float) -> np.ndarray:
    """Variances (4,) that a sample adds to vx, vy and the biases; `felt` is what counts of the measured ay."""
    drift = noise.accel_bias**2 * (1.0 - np.exp(-2.0 * DT / noise.bias_time))
    return np.array([noise.accel**2 * DT, (noise.accel**2 + (noise.ay_scale * felt) ** 2) * DT, drift, drift])


def textbook_blend(noise: BlendNoise, inputs: Inputs) -> Estimate:
    """The blending filter in plain numpy, its Jacobian by differences."""
    x, p = np.zeros(4), np.eye(4)

    def start(sample: np.ndarray, beta: float, beta_std: float) -> None:
        x[:] = sample[at.VX], sample[at.VX] * np.tan(beta), 0.0, 0.0
        p[:] = np.diag([noise.speed, sample[at.VX] * beta_std, noise.accel_bias, noise.accel_bias]) ** 2

    def step(sample: np.ndarray) -> tuple[float, float, float]:
        share = np.exp(-((sample[at.YAW_RATE] / noise.turning) ** 2))
        share = share if share > LEAST_SHARE else 0.0
        assert stable_substeps(sample[at.VX], DT, CAR) == 1
        ends = [
            blend_transition(x + d, sample, share, noise) - blend_transition(x - d, sample, share, noise)
            for d in STEPS
        ]
        jacobian = np.array(ends).T / 2e-4
        x[:] = blend_transition(x, sample, share, noise)
        p[:] = jacobian @ p @ jacobian.T + np.diag(process_noise(noise, (1.0 - share) * sample[at.AY]))
        s = p[0, 0] + noise.speed**2
        innovation, gain = sample[at.VX] - x[0], p[:, 0] / s
        x[:] += gain * innovation
        p[:] -= np.outer(gain, gain) * s
        gradient = np.array([-x[1], x[0]]) / (x[:2] @ x[:2])
        return np.arctan2(x[1], x[0]), np.sqrt(gradient @ p[:2, :2] @ gradient), innovation**2 / s

    return walk_samples(inputs, CAR, start, step)


STEPS = 1e-4 * np.eye(4)


def test_blend_kernel_agrees_with_a_textbook_filter() -> None:
    noise, inputs = BlendNoise(), lane_changes(1000)
    inputs.samples[:, at.AX] = 0.0  # linear tyres below: no load transfer, no friction margin
    estimate = BlendKF(GOLF, noise, "linear").run(inputs)
    global CAR
    CAR, before = BlendKF(GOLF, noise, "linear").car, CAR
    try:
        expected = textbook_blend(noise, inputs)
    finally:
        CAR = before
    for part in ("beta", "beta_std", "nis"):
        np.testing.assert_allclose(getattr(estimate, part), getattr(expected, part), rtol=1e-6, atol=1e-8)


def plain_noise(estimator) -> KinematicNoise:
    """Noise of a kinematic filter without help."""
    shared = {key: value for key, value in estimator.noise._asdict().items() if key in KinematicNoise._fields}
    return KinematicNoise(disagreement=1e-9, **shared)


@each_variant
def test_no_drift_on_a_straight(estimator) -> None:
    samples = np.zeros((3000, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.AY] = 20.0, 0.3  # a road with 3 % bank
    samples[:, at.YAW_RATE] = 0.002
    plain = KinematicKF(GOLF, plain_noise(estimator)).run(Inputs(DT, samples))
    helped = estimator.run(Inputs(DT, samples))
    assert abs(plain.beta[-1]) > np.radians(4.0)
    assert np.abs(helped.beta).max() < np.radians(0.7)
    assert helped.beta_std[-1] < 0.4 * plain.beta_std[-1]


@each_variant
def test_in_turns_it_is_the_kinematic_filter_bit_for_bit(estimator) -> None:
    inputs = lane_changes(1000)
    inputs.samples[:, at.YAW_RATE] = 0.4 + 0.1 * np.sin(DT * np.arange(1000))
    inputs.samples[:, at.AY] = 20.0 * inputs.samples[:, at.YAW_RATE] + 3.0 * np.cos(
        4.0 * DT * np.arange(1000)
    )
    estimate, plain = estimator.run(inputs), KinematicKF(GOLF, plain_noise(estimator)).run(inputs)
    np.testing.assert_array_equal(estimate.beta, plain.beta)
    np.testing.assert_array_equal(estimate.beta_std, plain.beta_std)
    assert np.ptp(plain.beta) > np.radians(1.0)


def test_share_of_straight_driving() -> None:
    assert straight_share(0.0, 0.1) == 1.0
    assert straight_share(-0.1, 0.1) == straight_share(0.1, 0.1) == pytest.approx(np.exp(-1.0))
    assert straight_share(0.4, 0.1) == 0.0
    assert straight_share(np.nan, 0.1) == 0.0


def test_blend_follows_its_own_model() -> None:
    noise, inputs = BlendNoise(), lane_changes(1000)
    rolling = np.tan(slip_of_rolling_rear(*inputs.samples[0, [4, 5]], CAR.a, CAR.b))
    x, beta = np.array([20.0, 20.0 * rolling, 0.0, 0.0]), []
    for k, sample in enumerate(inputs.samples):
        if k:
            x = blend_transition(x, sample, straight_share(sample[at.YAW_RATE], noise.turning), noise)
        # The model takes the speed as measured, and the same one as state: both are exact here.
        sample[at.VX] = x[0]
        beta.append(np.arctan2(x[1], x[0]))
        if k + 1 < len(inputs.samples):
            inputs.samples[k + 1, at.VX] = predicted_speed(x, inputs.samples[k + 1])
    assert np.ptp(beta) > np.radians(1.0)
    estimate = BlendKF(GOLF, noise).run(inputs)
    np.testing.assert_allclose(estimate.beta, beta, rtol=0.0, atol=1e-9)


def predicted_speed(x: np.ndarray, sample: np.ndarray) -> float:
    """Speed at the end of the sample, which the tyres' share in ay hardly changes: solved by repetition."""
    guess, noise = sample.copy(), BlendNoise()
    guess[at.VX] = x[0]
    for _ in range(20):
        guess[at.VX] = blend_transition(x, guess, straight_share(sample[at.YAW_RATE], noise.turning), noise)[
            0
        ]
    return float(guess[at.VX])


# Monte Carlo on drives of the filters' own stochastic models.

RUNS, LENGTH = 150, 150


def matched_drive(estimator: KernelFilter, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    noise, car = estimator.noise, estimator.car
    samples, truth = lane_changes(LENGTH, 1).samples, np.empty((LENGTH, 4))
    samples[:, [at.VX, at.AX]] = 20.0, 0.0
    rolling = np.tan(slip_of_rolling_rear(*samples[0, [at.STEER, at.STEER_REAR]], car.a, car.b))
    truth[0, :2] = rng.normal(20.0, noise.speed), 20.0 * rng.normal(rolling, LOW_SPEED_STD)
    truth[0, 2:] = rng.normal(0.0, noise.accel_bias, 2)
    for k in range(1, LENGTH):
        sample = samples[k]
        share = straight_share(sample[at.YAW_RATE], noise.turning)
        blended = share if isinstance(estimator, BlendKF) else 0.0
        truth[k] = blend_transition(truth[k - 1], sample, blended, noise)
        truth[k] += rng.normal(0.0, np.sqrt(process_noise(noise, (1.0 - blended) * sample[at.AY])))
        if isinstance(estimator, ZeroYawKF) and share > 0.0:
            # Rear steering moves the steady slip alone: it makes the pseudo-measurement as the truth demands.
            speed = 20.0
            pseudo = truth[k, 1] + rng.normal(0.0, noise.pseudo * speed / np.sqrt(DT * share))
            rear_slip = car.mass * car.a * sample[at.AY] / ((car.a + car.b) * car.stiffness_rear)
            steady = car.b * sample[at.YAW_RATE] / speed - rear_slip
            sample[at.STEER_REAR] = np.arctan(pseudo / speed) - steady
    measured = truth[:, 0] + rng.normal(0.0, noise.speed, LENGTH)
    return np.column_stack([measured, samples[:, 1:]]), truth


@each_variant
def test_errors_are_as_large_as_the_filter_says(estimator) -> None:
    # A small error of speed, as the steady slip and the tyres take the measured speed as true.
    estimator = replace(estimator, noise=estimator.noise._replace(speed=0.02, accel=0.3))
    rng, taken = np.random.default_rng(6), (40, 90, 149)
    nees, nis, count = dict.fromkeys(taken, 0.0), 0.0, 0
    for _ in range(RUNS):
        samples, truth = matched_drive(estimator, rng)
        started = estimator.start(DT)
        for k, sample in enumerate(samples):
            _, _, part = estimator.step(started, sample)
            if k:
                pseudo = isinstance(estimator, ZeroYawKF) and straight_share(sample[at.YAW_RATE], 0.1) > 0.0
                nis, count = nis + part, count + 1 + pseudo
            if k in nees:
                error = truth[k] - started.state.mean
                nees[k] += error @ np.linalg.solve(started.state.cov, error)
    low, high = chi2.interval(0.999, count)
    assert low < nis < high
    low, high = chi2.interval(0.999, 4 * RUNS)
    assert all(low < total < high for total in nees.values())

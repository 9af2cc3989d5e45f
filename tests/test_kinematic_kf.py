"""The kinematic filter: holds slides, learns what its sensors get wrong, and is never wild."""

import numpy as np
import pytest

from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA, Inputs
from crosscomb.filters.kinematic.kf import (
    BIAS_AX,
    BIAS_AY,
    MOST_BIAS,
    KinematicKF,
    KinematicNoise,
    rolling_measurement,
)
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import GRAVITY, MIN_SPEED

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")
KF = KinematicKF(GOLF)
NOISE = KF.noise


def drive(vx: np.ndarray, beta: np.ndarray, yaw_rate: np.ndarray, steer: np.ndarray) -> Inputs:
    """Samples of a motion with perfect sensors: the accelerations follow from the velocity."""
    vy = vx * np.tan(beta)
    samples = np.zeros((len(vx), at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.YAW_RATE], samples[:, at.STEER] = vx, yaw_rate, steer
    samples[:, at.AX] = np.gradient(vx, DT) - yaw_rate * vy
    samples[:, at.AY] = np.gradient(vy, DT) + yaw_rate * vx
    return Inputs(DT, samples)


def winding_road(seconds: float, vx: float = 20.0) -> tuple[Inputs, np.ndarray]:
    """A quiet drive through bends to either side, and its beta ``(n,) [rad]``: rear tyres slip 0.004 per ay."""
    t = DT * np.arange(int(seconds / DT))
    yaw_rate = 0.12 * np.sin(0.4 * t) * np.sin(0.05 * t)
    ay = vx * yaw_rate
    steer = yaw_rate * GOLF.wheelbase / vx + 0.002 * ay
    beta = np.arctan(GOLF.cg_to_rear_axle * yaw_rate / vx - 0.004 * ay)
    return drive(np.full(len(t), vx), beta, yaw_rate, steer), beta


def states_of(inputs: Inputs, estimator: KinematicKF = KF) -> np.ndarray:
    """Mean of the state after each sample ``(n, 4)``."""
    started, states = estimator.start(DT), []
    for sample in inputs.samples:
        estimator.step(started, sample)
        states.append(started.state.mean.copy())
    return np.array(states)


def degrees_off(inputs: Inputs, beta: np.ndarray) -> np.ndarray:
    return np.degrees(np.abs(KF.run(inputs).beta - beta))


# Sensors that read too much, roads that lean.


@pytest.mark.parametrize("offset", [-0.5, 0.5])
def test_offsets_are_learnt_in_quiet_driving(offset: float) -> None:
    inputs, beta = winding_road(60.0)
    inputs.samples[:, [at.AX, at.AY]] += offset
    np.testing.assert_allclose(states_of(inputs)[-1, [BIAS_AX, BIAS_AY]], offset, atol=0.1)
    assert degrees_off(inputs, beta)[3000:].max() < 1.0
    unaware = KinematicKF(GOLF, NOISE._replace(accel_bias=0.0)).run(inputs)
    assert np.degrees(np.abs(unaware.beta - beta))[3000:].max() > 1.5


def test_a_banked_road_does_not_pull_it_off() -> None:
    inputs, beta = winding_road(60.0)
    leaning = np.clip((DT * np.arange(6000) - 20.0) / 3.0, 0.0, 1.0)
    inputs.samples[:, at.AY] += 0.1 * GRAVITY * leaning
    assert degrees_off(inputs, beta).max() < 3.0
    assert degrees_off(inputs, beta)[4000:].max() < 1.0


def test_a_long_turn_after_a_straight_is_followed_with_an_offset() -> None:
    """Two minutes of an even bend at 4 m/s^2, whose beta the speed alone has to tell."""
    t = DT * np.arange(15_000)
    yaw_rate = 0.2 * np.clip((t - 30.0) / 2.0, 0.0, 1.0)
    vx, ay = np.full(len(t), 20.0), 20.0 * yaw_rate
    beta = np.arctan(GOLF.cg_to_rear_axle * yaw_rate / vx - 0.004 * ay)
    inputs = drive(vx, beta, yaw_rate, yaw_rate * GOLF.wheelbase / vx + 0.002 * ay)
    inputs.samples[:, at.AY] += 0.3
    inputs.samples[:, at.AX] -= 0.2
    assert degrees_off(inputs, beta).max() < 2.0


def test_what_it_knows_of_its_sensors_outlasts_a_stop() -> None:
    inputs, _ = winding_road(60.0)
    inputs.samples[:, [at.AX, at.AY]] += 0.3
    inputs.samples[4000:4500, at.VX] = 0.0
    states = states_of(inputs)
    before, after = states[3999, BIAS_AX:], states[4501, BIAS_AX:]
    np.testing.assert_allclose(after, before * np.exp(-5.0 / NOISE.bias_time), rtol=0.05)
    started = KF.start(DT)
    for sample in inputs.samples[:4501]:
        _, beta_std, _ = KF.step(started, sample)
    assert started.state.cov[BIAS_AY, BIAS_AY] < 0.5 * NOISE.accel_bias**2
    np.testing.assert_array_equal(started.state.cov[:2, 2:], 0.0)
    assert beta_std == LOW_SPEED_STD


def test_biases_know_no_more_than_their_size_in_the_end() -> None:
    started = KF.start(DT)
    standing = np.zeros(at.SAMPLE_WIDTH)
    for sample in winding_road(30.0)[0].samples:
        KF.step(started, sample)
    for _ in range(50_000):
        KF.step(started, standing)
    np.testing.assert_allclose(np.diag(started.state.cov)[2:], NOISE.accel_bias**2, rtol=0.01)
    np.testing.assert_allclose(started.state.mean[2:], 0.0, atol=1e-3)


# Slides.


def drift_transitions() -> tuple[Inputs, np.ndarray]:
    """Twenty quiet seconds, then the car swings from 25 deg of slip to the other side and back for ten more."""
    t = DT * np.arange(3000)
    sliding = np.clip((t - 20.0) / 0.5, 0.0, 1.0)
    beta = np.radians(25.0) * sliding * np.sin(1.2 * (t - 20.0))
    yaw_rate = -0.5 * sliding * np.sin(1.2 * (t - 20.0))
    return drive(np.full(len(t), 15.0), beta, yaw_rate, 0.9 * beta), beta


def test_a_slide_is_held_while_the_yaw_rate_crosses_zero() -> None:
    inputs, beta = drift_transitions()
    inputs.samples[:, [at.AX, at.AY]] += 0.2
    assert np.degrees(np.abs(beta)).max() > 24.0
    assert degrees_off(inputs, beta)[2000:].max() < 3.0


def test_a_car_that_slides_on_straight_is_not_taken_to_roll() -> None:
    """On a grippy road ay says so, on ice the yaw rate that was not steered."""
    sample = np.zeros(at.SAMPLE_WIDTH)
    sample[at.VX] = 15.0
    _, _, rolls = rolling_measurement(sample, 15.0, 0.0, KF.car, NOISE, DT)
    assert rolls == pytest.approx(NOISE.rolling**2 / DT)
    sample[at.AY] = 8.0
    assert rolling_measurement(sample, 15.0, 0.0, KF.car, NOISE, DT)[2] == np.inf
    assert rolling_measurement(sample, 15.0, 8.0, KF.car, NOISE, DT)[2] == pytest.approx(rolls)
    sample[at.AY], sample[at.STEER] = 0.5, 0.15
    assert rolling_measurement(sample, 15.0, 0.0, KF.car, NOISE, DT)[2] == np.inf


def test_a_rolling_car_moves_along_its_rear_wheels() -> None:
    sample = np.zeros(at.SAMPLE_WIDTH)
    sample[[at.VX, at.YAW_RATE, at.STEER]] = 5.0, 0.2, np.arctan(0.2 * GOLF.wheelbase / 5.0)
    sample[5] = 0.0
    h, rest, variance = rolling_measurement(sample, 5.0, 0.0, KF.car, NOISE, DT)
    assert (h, rest) == (0.0, pytest.approx(0.2 * GOLF.cg_to_rear_axle))
    assert variance < 3.0 * NOISE.rolling**2 / DT
    sample[5] = 0.1
    h, rest, _ = rolling_measurement(sample, 5.0, 0.0, KF.car, NOISE, DT)
    assert np.arctan((rest - h * 5.0) / 5.0) == pytest.approx(
        np.arctan(np.tan(0.1) + 0.2 * GOLF.cg_to_rear_axle / 5.0)
    )


def test_without_a_steering_angle_only_a_straight_is_one() -> None:
    sample = np.zeros(at.SAMPLE_WIDTH)
    sample[[at.VX, at.STEER_HELD, at.STEER]] = 15.0, 1.0, 0.3
    assert rolling_measurement(sample, 15.0, 0.0, KF.car, NOISE, DT)[2] == pytest.approx(
        NOISE.rolling**2 / DT
    )
    sample[at.YAW_RATE] = 0.5
    assert rolling_measurement(sample, 15.0, 0.0, KF.car, NOISE, DT)[2] == np.inf


# Never wild.


def test_an_impossible_sample_counts_as_missing() -> None:
    inputs, _ = winding_road(10.0)
    for column, value in ((at.AX, 1e6), (at.AY, -1e6), (at.YAW_RATE, 1e3)):
        wild, missing = inputs.samples.copy(), inputs.samples.copy()
        wild[500:503, column], missing[500:503, column] = value, np.nan
        np.testing.assert_array_equal(KF.run(Inputs(DT, wild)).beta, KF.run(Inputs(DT, missing)).beta)


@pytest.mark.parametrize("seed", range(4))
def test_no_nonsense_makes_it_diverge(seed: int) -> None:
    """Twenty minutes of signals that contradict each other, then it is right again within a minute."""
    rng = np.random.default_rng(seed)
    n = 120_000
    samples = np.zeros((n, at.SAMPLE_WIDTH))
    steps = np.repeat(rng.normal(size=(n // 100, 5)), 100, axis=0)
    samples[:, at.VX] = 15.0 + 10.0 * steps[:, 0]
    samples[:, [at.AX, at.AY]] = 8.0 * steps[:, 1:3]
    samples[:, at.YAW_RATE], samples[:, at.STEER] = steps[:, 3], 0.1 * steps[:, 4]
    samples[rng.random(n) < 0.1, at.AY] = np.nan
    samples[rng.random(n) < 0.1, at.YAW_RATE] = np.nan
    quiet, beta = winding_road(60.0)
    estimate = KF.run(Inputs(DT, np.concatenate([samples, quiet.samples])))
    assert np.isfinite(estimate.beta_std).all()
    assert np.abs(estimate.beta).max() <= MAX_BETA + 1e-9
    assert np.degrees(np.abs(estimate.beta[-1000:] - beta[-1000:])).max() < 1.0
    assert np.abs(states_of(Inputs(DT, samples[:3000]))[:, 2:]).max() <= MOST_BIAS * NOISE.accel_bias


def test_the_covariance_stays_symmetric_and_positive_over_an_hour() -> None:
    started, samples = KF.start(DT), winding_road(60.0)[0].samples
    for _ in range(60):
        KF.advance(started, samples)
        cov = started.state.cov
        np.testing.assert_array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(cov).min() > 0.0


def test_a_log_without_yaw_rate_stays_doubtful_and_bounded() -> None:
    inputs, _ = winding_road(300.0)
    inputs.samples[:, at.YAW_RATE] = np.nan
    estimate = KF.run(inputs)
    assert np.degrees(np.abs(estimate.beta)).max() < 10.0
    assert 5.0 < np.degrees(estimate.beta_std[-1]) < 30.0


def test_the_published_filter_is_a_setting() -> None:
    """Without biases and rolling it integrates: a steady error of ay grows to a drift on a straight."""
    samples = np.zeros((1000, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.AY] = 20.0, 0.1
    plain = KinematicKF(GOLF, KinematicNoise(accel_bias=0.0, disagreement=1e-9, ay_scale=0.0))
    samples[:, at.YAW_RATE] = 1e-6  # a yaw rate of zero agrees with the steering to the last bit
    vy = 20.0 * np.tan(plain.run(Inputs(DT, samples)).beta[-1])
    assert vy == pytest.approx(0.1 * 999 * DT, rel=1e-2)
    assert samples[:, at.VX].min() > MIN_SPEED

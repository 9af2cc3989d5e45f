"""Deterministic observers: poles where they are asked for, convergence, and a bounded pull."""

from dataclasses import replace

import numpy as np
import pytest

from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs, KernelFilter
from crosscomb.filters.single_track.observers import (
    ExtendedLuenberger,
    Luenberger,
    ObserverGains,
    SlidingGains,
    SlidingMode,
    gains,
)
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.linear_single_track import linear_single_track_rates
from drives import DT, GOLF, model_slalom

OBSERVERS: dict[str, KernelFilter] = {
    "luenberger": Luenberger(GOLF),
    "extended": ExtendedLuenberger(GOLF),
    "sliding": SlidingMode(GOLF),
}
CAR = OBSERVERS["luenberger"].car
each_observer = pytest.mark.parametrize("name", OBSERVERS)


def slalom(name: str, steps: int = 1200) -> tuple[Inputs, np.ndarray]:
    """Noiseless slalom of the observer's own model, and its beta."""
    inputs, beta = model_slalom(steps, CAR, linear=name == "luenberger")
    inputs.samples[:, at.VFL :] = np.nan
    return inputs, beta


def textbook(vx: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C, D of the linear single track, state [yaw_rate, beta], input steer, output [yaw_rate, ay]."""
    m, iz, a, b, cf, cr = CAR[:6]
    a_matrix = np.array(
        [
            [-(a**2 * cf + b**2 * cr) / (iz * vx), (b * cr - a * cf) / iz],
            [(b * cr - a * cf) / (m * vx**2) - 1.0, -(cf + cr) / (m * vx)],
        ]
    )
    c_matrix = np.array([[1.0, 0.0], [(b * cr - a * cf) / (m * vx), -(cf + cr) / m]])
    return a_matrix, np.array([a * cf / iz, cf / (m * vx)]), c_matrix, np.array([0.0, cf / m])


def test_linear_model_is_the_textbook_one() -> None:
    for vx in (5.0, 15.0, 40.0):
        a, b, c, d = textbook(vx)
        state, steer = np.array([0.3, -0.04]), 0.05
        rates, ay, jacobian = linear_single_track_rates(*state, vx, steer, 0.0, CAR)
        np.testing.assert_allclose(rates, a @ state + b * steer, rtol=1e-12)
        assert ay == pytest.approx(c[1] @ state + d[1] * steer)
        np.testing.assert_allclose(np.reshape(jacobian, (2, 3)).T, np.vstack([a, c[1]]), rtol=1e-12)


@pytest.mark.parametrize("vx", [4.0, 10.0, 25.0, 60.0])
@pytest.mark.parametrize("slip_pole", [0.0, 0.3, 1.0])
def test_poles_are_where_they_are_asked_for(vx: float, slip_pole: float) -> None:
    a, _, c, _ = textbook(vx)
    settings = ObserverGains(yaw_pole=2.5, slip_pole=slip_pole)
    l11, l21, l22 = gains(a[0, 0], a[1, 0], c[1, 0], 0.0, vx, CAR, settings)
    poles = np.linalg.eigvals(a - np.array([[l11, 0.0], [l21, l22]]) @ c)
    wanted = [2.5 * a[0, 0], slip_pole * a[1, 1]]
    np.testing.assert_allclose(sorted(poles), sorted(wanted), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("slip_pole", [0.2, 0.7])
def test_luenberger_is_the_textbook_observer(slip_pole: float) -> None:
    """A drive at constant speed in small steps, by matrices and pole placement."""
    inputs, _ = slalom("luenberger", 400)
    samples, rng, dt = inputs.samples, np.random.default_rng(1), 1e-4
    samples[:, at.VX], samples[:, at.STEER_REAR] = 20.0, 0.0
    samples[:, at.YAW_RATE] += rng.normal(0.0, 0.01, 400)
    samples[:, at.AY] += rng.normal(0.0, 0.3, 400)
    samples = np.repeat(samples, 100, axis=0)
    a, b, c, d = textbook(20.0)
    place = np.diag([3.0 * a[0, 0], slip_pole * a[1, 1]])
    place[0, 1] = a[0, 1]
    observer = (a - place) @ np.linalg.inv(c)
    state = np.array([samples[0, at.YAW_RATE], slip_of_rolling_rear(samples[0, at.STEER], 0.0, CAR.a, CAR.b)])
    expected = [state[1]]
    for sample in samples[1:]:
        error = sample[[at.YAW_RATE, at.AY]] - c @ state - d * sample[at.STEER]
        state = state + dt * (a @ state + b * sample[at.STEER] + observer @ error)
        expected.append(state[1])
    estimate = Luenberger(GOLF, ObserverGains(slip_pole=slip_pole)).run(Inputs(dt, samples))
    assert np.ptp(expected) > np.radians(1.0)
    np.testing.assert_allclose(estimate.beta, expected, rtol=0.0, atol=0.002 * np.ptp(expected))


@each_observer
def test_own_model_is_followed_without_error(name: str) -> None:
    inputs, beta = slalom(name)
    estimate = OBSERVERS[name].run(inputs)
    np.testing.assert_allclose(estimate.beta, beta, rtol=0.0, atol=1e-9)
    assert np.ptp(beta) > np.radians(1.0)


@each_observer
def test_a_wrong_start_is_forgotten_at_the_pole(name: str) -> None:
    inputs, beta = slalom(name)
    estimator = OBSERVERS[name]
    started = estimator.start(DT)
    estimator.step(started, inputs.samples[0])
    started.state.mean[1] += 0.02
    errors = [estimator.step(started, s)[0] - b for s, b in zip(inputs.samples[1:], beta[1:], strict=True)]
    error = np.abs(errors)
    # At 18 to 24 m/s half of the car's slip damping is 3 to 6 per second on linear tyres, less on bent ones.
    assert error[0] > 0.015
    assert error[100] < 0.005
    assert error[400] < 1e-4


@each_observer
@pytest.mark.parametrize("dt", [0.005, 0.02, 0.1])
def test_every_rate_is_stable(name: str, dt: float) -> None:
    inputs, beta = slalom(name)
    step = max(round(dt / DT), 1)
    samples = np.repeat(inputs.samples, 2, axis=0) if dt < DT else inputs.samples[::step]
    truth = np.repeat(beta, 2) if dt < DT else beta[::step]
    for vx in (1.0, 0.2):  # the same drive at a fifth of the speed, down to just above the gate
        slower = samples.copy()
        slower[:, [at.VX, at.YAW_RATE]] *= vx
        slower[:, at.AY] *= vx * vx
        estimate = OBSERVERS[name].run(Inputs(dt, slower))
        assert np.abs(estimate.beta).max() < np.radians(12.0)
        if vx == 1.0:
            assert np.sqrt(np.mean((estimate.beta - truth) ** 2)) < np.radians(0.6)


def test_sliding_mode_inside_its_layer_is_the_extended_observer() -> None:
    inputs, _ = slalom("sliding")
    inputs.samples[:, at.AY] += 0.3
    wide = SlidingMode(GOLF, SlidingGains(yaw_layer=1e9, ay_layer=1e9)).run(inputs)
    np.testing.assert_array_equal(wide.beta, OBSERVERS["extended"].run(inputs).beta)


@pytest.mark.parametrize("column", [at.AY, at.YAW_RATE])
def test_sliding_mode_pulls_no_harder_than_its_layer(column: int) -> None:
    inputs, _ = slalom("sliding")
    wild, wilder = (inputs.samples.copy() for _ in range(2))
    wild[700, column] += 50.0
    wilder[700, column] += 100.0
    one, two = (OBSERVERS["sliding"].run(Inputs(DT, s)).beta for s in (wild, wilder))
    if column == at.YAW_RATE:
        np.testing.assert_array_equal(one, two)
    calm = OBSERVERS["sliding"].run(inputs).beta
    linear = OBSERVERS["extended"].run(Inputs(DT, wild)).beta
    assert np.abs(one - calm).max() < 0.2 * np.abs(linear - calm).max()
    assert np.abs(one - calm).max() < np.radians(0.6)


@each_observer
def test_stated_error_grows_with_the_innovation_and_where_inputs_are_missing(name: str) -> None:
    inputs, _ = slalom(name)
    estimator = OBSERVERS[name]
    calm = estimator.run(inputs)
    settled = calm.beta_std[600:]
    share = np.abs(calm.beta[600:]) * estimator.noise.share
    np.testing.assert_allclose(settled, np.hypot(estimator.noise.floor, share), rtol=0.15)
    assert np.isnan(calm.nis).all()
    for change in ({at.AY: 2.0}, {at.AY: np.nan}, {at.STEER_HELD: 1.0}):
        samples = inputs.samples.copy()
        for column, value in change.items():
            samples[600:, column] += value
        broken = estimator.run(replace(inputs, samples=samples))
        assert np.isfinite(broken.beta).all()
        assert broken.beta_std[-300:].mean() > 1.3 * calm.beta_std[-300:].mean()


@each_observer
def test_without_ay_or_yaw_rate_the_model_carries_on(name: str) -> None:
    inputs, beta = slalom(name)
    for column in (at.AY, at.YAW_RATE):
        samples = inputs.samples.copy()
        samples[300:, column] = np.nan
        estimate = OBSERVERS[name].run(replace(inputs, samples=samples))
        # The friction margin sees the measured ay; without it the tyres hold a little less.
        assert np.abs(estimate.beta - beta).max() < np.radians(0.7)

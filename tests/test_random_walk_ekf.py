"""Random-walk extended Kalman filters: twins on filterpy, consistency, what ties beta, further outputs."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.random_walk.double_track_ekf import DoubleTrackRandomWalkEKF, DoubleWalkNoise
from crosscomb.filters.random_walk.ekf import FORCE_EXTRAS, RandomWalkEKF, WalkNoise
from crosscomb.filters.twins.table import TWINS
from crosscomb.models.planar import COS, SIDE_ARM, SIN, contacts, planar_car, set_contacts
from crosscomb.models.random_walk import random_walk_jacobian, random_walk_rates
from crosscomb.models.single_track import single_track, single_track_rates
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.simulate import simulate_log
from crosscomb.training.suites.papers_adaptive import EVOQUE, RAMP_BAR, pieralice_figure_2, ramp_steer
from drives import DT, GOLF, nonsense, rmse_deg

CAR = single_track(GOLF)
BOTH = ("random_walk_ekf", "double_track_random_walk_ekf")


def drive(seconds: float, amplitude: float, noise: float = 0.0, seed: int = 0) -> tuple[Inputs, np.ndarray]:
    """Samples of a slalom of the linear single track at 20 m/s, with its beta."""
    car, rng = single_track(GOLF, "linear"), np.random.default_rng(seed)
    steer = amplitude * np.sin(2.0 * np.pi * 0.3 * np.arange(0.0, seconds, DT))
    samples, truth = np.zeros((len(steer), at.SAMPLE_WIDTH)), np.empty(len(steer))
    samples[:, at.VFL :] = np.nan
    yaw_rate = beta = 0.0
    for k, angle in enumerate(steer):
        for _ in range(10):
            given = (20.0, angle, 0.0, 0.0, 0.0, 0.0, 0.0, car)
            (yaw_acceleration, beta_rate), (ax, ay), _ = single_track_rates(yaw_rate, beta, *given)
            yaw_rate, beta = yaw_rate + 0.1 * DT * yaw_acceleration, beta + 0.1 * DT * beta_rate
        truth[k] = beta
        samples[k, :5] = 20.0, ax, ay, yaw_rate, angle
    samples[:, 1:4] += noise * rng.normal(size=(len(steer), 3)) * [0.2, 0.2, 0.005]
    return Inputs(DT, samples), truth


def inside(total: float, degrees: int) -> None:
    """Check a sum of squared normal errors against its 99.9 % bounds."""
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert low < total < high


@pytest.fixture(scope="module")
def rough() -> Inputs:
    """Hard slalom with gaps, held speed, braking and a stop."""
    inputs, _ = drive(8.0, 0.07, noise=1.0)
    samples, rng = inputs.samples, np.random.default_rng(6)
    samples[:, at.AX] += 2.0 * np.sin(np.arange(800) * 0.02)
    samples[:, at.FXF], samples[:, at.FXR] = 0.7 * GOLF.mass * samples[:, at.AX], 300.0
    for column in (at.AX, at.AY, at.YAW_RATE):
        samples[rng.random(800) < 0.05, column] = np.nan
    samples[100:120, at.AY : at.STEER] = np.nan
    samples[200:215, at.VX_HELD] = 1.0
    samples[400:420, at.VX] = 1.0
    samples[420:480, at.VX] = 4.0
    return inputs


@pytest.mark.parametrize("slip_from", ["linear", "free"])
def test_single_track_agrees_with_its_twin_on_filterpy(slip_from: str, rough: Inputs) -> None:
    estimator = RandomWalkEKF(GOLF, slip_from=slip_from)
    agree(estimator.run(rough), TWINS["random_walk_ekf"](estimator, rough))


@pytest.mark.parametrize("measured", ["u_r", "u_r_ay"])
def test_double_track_agrees_with_its_twin_on_filterpy(measured: str, rough: Inputs) -> None:
    estimator = DoubleTrackRandomWalkEKF(GOLF, measured=measured)
    agree(estimator.run(rough), TWINS["double_track_random_walk_ekf"](estimator, rough))


def agree(found: base.Estimate, expected: base.Estimate) -> None:
    np.testing.assert_allclose(found.beta, expected.beta, atol=1e-9)
    np.testing.assert_allclose(found.beta_std, expected.beta_std, atol=1e-9)
    np.testing.assert_allclose(found.nis, expected.nis, rtol=1e-6, atol=1e-9)


SETTINGS = [
    (RandomWalkEKF, {"slip_from": "linear"}),
    (RandomWalkEKF, {"slip_from": "geometric"}),
    (RandomWalkEKF, {"slip_from": "free"}),
    (DoubleTrackRandomWalkEKF, {}),
    (DoubleTrackRandomWalkEKF, {"measured": "u_r", "yaw_moment": "zero", "slip_from": "free"}),
    (DoubleTrackRandomWalkEKF, {"slip_from": "geometric", "yaw_moment": "zero"}),
]


@pytest.mark.parametrize(("cls", "settings"), SETTINGS)
def test_nonsense_leaves_the_estimate_finite(cls: type, settings: dict[str, str]) -> None:
    result = cls(GOLF, **settings).run(nonsense())
    for values in (result.beta, result.beta_std, *result.extra.values()):
        assert np.isfinite(values).all()
    assert np.abs(result.beta).max() <= base.MAX_BETA + 1e-9


def own_walk(steps: int, first: np.ndarray, shocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States ``(steps, 6)`` and samples of the single-track filter's discrete model at 20 m/s."""
    state, states, jacobian = first.copy(), [first.copy()], np.zeros((4, 6))
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 20.0
    samples[:, at.STEER] = 0.05 * np.sin(0.03 * np.arange(steps))
    for k in range(1, steps):
        steer = samples[k, at.STEER]
        yaw_acceleration, beta_rate, _, _ = random_walk_rates(state, 20.0, steer, 0.0, CAR)
        state = state + DT * np.array([yaw_acceleration, beta_rate, 0.0, 0.0, 0.0, 0.0]) + shocks[k]
        random_walk_jacobian(state, 20.0, steer, 0.0, CAR, jacobian)
        samples[k, [at.AX, at.AY]] = jacobian[2:] @ state
        samples[k, [at.YAW_RATE, at.FXF, at.FXR]] = state[[0, 2, 3]]
        states.append(state)
    return np.array(states), samples


def test_noiseless_data_of_its_own_model_gives_the_truth() -> None:
    rng = np.random.default_rng(3)
    first = np.array([0.1, 0.02, 300.0, -200.0, 2500.0, 2200.0])
    shocks = np.zeros((300, 6))
    estimator = RandomWalkEKF(GOLF, slip_from="free")
    truth, samples = own_walk(300, first, shocks)
    state = estimator.make_state()
    state.mean[:], state.running[0] = first, 1
    state.cov[:] = np.diag(rng.uniform(0.5, 1.5, 6) * [1e-4, 1e-4, 1e5, 1e5, 1e5, 1e5])
    out = np.full((299, 6), np.nan)
    estimator.run_kernel(state, samples[1:], estimator.car, estimator.noise, DT, out)
    np.testing.assert_allclose(out[:, at.BETA], truth[1:, 1], atol=1e-9)
    assert np.ptp(truth[:, 1]) > 0.02


def test_noiseless_data_of_the_double_tracks_own_model_gives_the_truth() -> None:
    estimator, contact = DoubleTrackRandomWalkEKF(GOLF, slip_from="free"), contacts()
    x = np.array([20.0, 0.4, 0.1, 1200.0, 1300.0, 1000.0, 1100.0])
    state, out, sample = estimator.make_state(), np.full(6, np.nan), np.zeros(at.SAMPLE_WIDTH)
    state.mean[:], state.running[0] = x, 1
    state.cov[:] = np.diag([0.01, 0.01, 1e-3, 1e5, 1e5, 1e5, 1e5])
    for k in range(100):
        steer = 0.05 * math.sin(0.03 * k)
        set_contacts(contact, steer, 0.0, 0.0, 0.0, 0.0, 0.0, planar_car(GOLF, "double"))
        wheels = contact.wheels
        along, across = -wheels[:, SIN] @ x[3:], wheels[:, COS] @ x[3:]
        u_dot, v_dot = along / GOLF.mass + x[1] * x[2], across / GOLF.mass - x[0] * x[2]
        r_dot = wheels[:, SIDE_ARM] @ x[3:] / GOLF.yaw_inertia
        x[:3] += DT * np.array([u_dot, v_dot, r_dot])
        sample[:5] = x[0], 0.0, across / GOLF.mass, x[2], steer
        estimator.run_kernel(state, sample[None], estimator.car, estimator.noise, DT, out[None])
        assert out[at.BETA] == pytest.approx(math.atan2(x[1], x[0]), abs=1e-9)


def test_errors_of_the_single_track_are_as_large_as_it_says() -> None:
    noise = WalkNoise(force=1.0, yaw_acceleration=0.1, slip_rate=0.01, yaw_rate=0.01, accel=0.2, split=0.3)
    estimator, runs, steps = RandomWalkEKF(GOLF, noise, slip_from="free"), 60, 100
    rng, mass = np.random.default_rng(4), GOLF.mass
    cov = np.diag(np.square([0.02, 0.02, *[0.5 * mass] * 4]))
    per_step = np.array([0.1, 0.01, *[mass] * 4]) * math.sqrt(DT)
    nees, nis = [], []
    for _ in range(runs):
        start = rng.normal(size=6) * np.sqrt(np.diag(cov))
        truth, samples = own_walk(steps, start, rng.normal(size=(steps, 6)) * per_step)
        samples[:, at.YAW_RATE] += 0.01 * rng.normal(size=steps)
        samples[:, [at.AX, at.AY]] += 0.2 * rng.normal(size=(steps, 2))
        samples[:, at.FXF] += 0.3 * mass * rng.normal(size=steps)
        state, out = estimator.make_state(), np.full(6, np.nan)
        state.cov[:], state.running[0] = cov, 1
        for k in range(1, steps):
            estimator.run_kernel(state, samples[k][None], estimator.car, noise, DT, out[None])
            nis.append(out[at.NIS])
        error = truth[-1] - state.mean
        nees.append(error @ np.linalg.solve(state.cov, error))
    inside(np.sum(nees), 6 * runs)
    inside(np.sum(nis), 3 * len(nis))


def test_errors_of_the_double_track_are_as_large_as_it_says() -> None:
    """NEES of [u, v, r] and the two axle forces; left and right are not told apart."""
    noise = DoubleWalkNoise(force=0.2, accel=0.1, yaw_acceleration=0.1, speed=0.05, yaw_rate=0.01, ay=0.2)
    estimator, runs, steps = DoubleTrackRandomWalkEKF(GOLF, noise, slip_from="free"), 60, 100
    rng, mass, car, contact = np.random.default_rng(5), GOLF.mass, planar_car(GOLF, "double"), contacts()
    pick = np.zeros((5, 7))
    pick[:3, :3] = np.eye(3)
    pick[3, 3:5] = pick[4, 5:7] = 1.0
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    wheels, nees, nis = contact.wheels, [], []
    for _ in range(runs):
        x = np.array([20.0, 0.0, 0.0, 0.0, 0.0])  # u, v, r and the axle forces, straight wheels
        state, out = estimator.make_state(), np.full(6, np.nan)
        sample = np.zeros(at.SAMPLE_WIDTH)
        sample[:5] = 20.0, 0.0, 0.0, 0.0, 0.0
        estimator.run_kernel(state, sample[None], estimator.car, noise, DT, out[None])
        state.cov[:] *= 0.01  # or the car spins
        x = x + 0.1 * rng.normal(size=5) * [0.05, 20.0 * out[at.BETA_STD], 0.01, mass, mass]
        for _ in range(steps):
            forces = np.repeat(0.5 * x[3:], 2)
            y, moment = wheels[:, COS] @ forces, wheels[:, SIDE_ARM] @ forces
            rates = [x[1] * x[2], y / mass - x[0] * x[2], moment / GOLF.yaw_inertia]
            x[:3] += DT * np.array(rates)
            x += rng.normal(size=5) * np.array([0.1, 0.1, 0.1, 0.2 * mass, 0.2 * mass]) * math.sqrt(DT)
            sample[at.VX] = x[0] + 0.05 * rng.normal()
            sample[at.YAW_RATE] = x[2] + 0.01 * rng.normal()
            sample[at.AY] = np.sum(x[3:]) / mass + 0.2 * rng.normal()
            estimator.run_kernel(state, sample[None], estimator.car, noise, DT, out[None])
            nis.append(out[at.NIS])
        error = x - pick @ state.mean
        nees.append(error @ np.linalg.solve(pick @ state.cov @ pick.T, error))
    inside(np.sum(nees), 5 * runs)
    inside(np.sum(nis), 3 * len(nis))


@pytest.mark.parametrize("name", BOTH)
def test_a_tied_beta_does_not_drift_where_a_free_one_does(name: str) -> None:
    inputs, truth = drive(60.0, 0.03, noise=1.0)
    inputs.samples[:, at.AY] += 0.4  # a banked road, or a sensor offset
    tied = make_filter(name, GOLF).run(inputs).beta
    free = make_filter(name, GOLF, {"slip_from": "free"}).run(inputs).beta
    assert rmse_deg(tied, truth) < 1.2
    assert rmse_deg(free, truth) > 3.0 * rmse_deg(tied, truth)


@pytest.mark.parametrize("name", BOTH)
def test_forces_and_friction_use_are_those_of_the_drive(name: str) -> None:
    inputs, _ = drive(20.0, 0.05, noise=0.5)
    extra = make_filter(name, GOLF).run(inputs).extra
    clean, _ = drive(20.0, 0.05)
    ay, yaw_rate = clean.samples[500:, at.AY], clean.samples[:, at.YAW_RATE]
    lateral, moment, use = (
        extra[key][500:] for key in ("lateral_force [N]", "yaw_moment [N m]", "friction_use [-]")
    )
    assert np.corrcoef(lateral, GOLF.mass * ay)[0, 1] > 0.99
    assert np.abs(lateral - GOLF.mass * ay).mean() < 0.08 * GOLF.mass * np.abs(ay).max()
    assert np.corrcoef(moment, GOLF.yaw_inertia * np.gradient(yaw_rate, DT)[500:])[0, 1] > 0.9
    expected = np.abs(yaw_rate[500:]) * 20.0 / (GOLF.friction * GRAVITY)
    np.testing.assert_allclose(use, expected, atol=0.05)


def test_friction_use_above_one_shows_that_the_file_is_wrong() -> None:
    inputs, _ = drive(10.0, 0.05)
    snow = GOLF.model_copy(update={"friction": 0.2})
    assert RandomWalkEKF(snow).run(inputs).extra["friction_use [-]"].max() > 1.0
    assert RandomWalkEKF(GOLF).run(inputs).extra["friction_use [-]"].max() < 1.0


def test_slow_ramp_steer_is_followed_as_published() -> None:
    """Pieralice 2018: EKF+RW stays close in slow ramps, up to 4 m/s^2 here, where the rear tyre is linear."""
    inputs, truth = ramp_steer(EVOQUE, 60.0 / 3.6, seed=1)
    gentle = slice(100, int(np.argmax(inputs.samples[:, at.AY] > 4.0)))
    estimator = DoubleTrackRandomWalkEKF(EVOQUE, measured="u_r", yaw_moment="zero")
    error = np.degrees(estimator.run(inputs).beta - truth)[gentle]
    smooth = np.convolve(error, np.full(50, 0.02), "valid")
    assert np.abs(smooth).max() < 0.5
    assert np.degrees(np.abs(truth[gentle])).max() > 0.5


def test_rebuilt_figure_2_says_what_its_numbers_say() -> None:
    table, verdict = pieralice_figure_2()
    largest = table.filter(like="largest").max(axis=1)
    assert np.isfinite(table.to_numpy()).all()
    within, closer, _ = verdict.split(". ", 2)
    for said, bar in ((within, RAMP_BAR), (closer, largest["EKF"])):
        for name in table.index[1:]:
            assert (name in said.split("not:")[0]) == (largest[name] <= bar)


def test_a_log_gives_forces_and_yaw_moment_from_the_command_line(crosscomb, write_log, tmp_path) -> None:
    log = simulate_log(GOLF, "slalom", 5, duration=8.0)
    path = write_log(log.frame, tmp_path / "slalom.csv")
    words = ("estimate", path, "--vehicle", "golf_gti_2018", "-o", tmp_path / "out", "--extras")
    ran = crosscomb(*words, "--filters", "random_walk_ekf,double_track_random_walk_ekf,dynamic_ekf", "--plot")
    assert (ran.code, ran.err) == (0, "")
    table = pd.read_csv(tmp_path / "out" / "slalom.extras.csv")
    assert table["t"].tolist() == log.t.tolist()
    for name in BOTH:
        assert {f"{name} {key}" for key in FORCE_EXTRAS} <= set(table.columns)
        force, ay = table[f"{name} lateral_force [N]"][200:], GOLF.mass * log.column("ay")[200:]
        assert np.corrcoef(force, ay)[0, 1] > 0.98
    assert (tmp_path / "out" / "slalom.extras.png").stat().st_size > 10_000
    assert np.isfinite(table["dynamic_ekf innovation_ay [m/s^2]"][200:]).all()
    ran = crosscomb(*words, "--filters", "luenberger", "-o", tmp_path / "none")
    assert ran.code == 2
    assert "random_walk_ekf" in ran.err
    assert len(ran.err.splitlines()) == 1
    assert not (tmp_path / "none").exists()

"""Monte Carlo: on drives of its own stochastic model a filter's error is as large as the filter says.

Normalised errors squared are chi-square distributed (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.resampling import resample
from crosscomb.filters.base import LOW_SPEED_STD, Inputs, KernelFilter
from crosscomb.filters.combined.blends import CovarianceFusion, FusionNoise, FuzzyBlend, FuzzyNoise
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.kinematic.pf import KinematicPF
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.plain_pf import move_and_weigh, normalise, weighted_beta
from crosscomb.filters.random_walk.shared import ParticleNoise
from crosscomb.filters.single_track.ekf import DynamicEKF, DynamicNoise
from crosscomb.filters.single_track.pf import DynamicPF
from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear
from crosscomb.models.random_walk import random_walk_rates
from crosscomb.models.single_track import single_track_rates, stable_substeps
from crosscomb.models.vehicle import load_vehicle

DT = 0.01
RUNS = 100
PARTICLE_RUNS = 60
STEPS = 161
GOLF = load_vehicle("golf_gti_2018")
KF = KinematicKF(GOLF, KinematicNoise(accel=0.4, bias_time=20.0, rear_slip=0.0, demand=1e6))
LINEAR_EKF = DynamicEKF(GOLF, DynamicNoise(0.3, 0.05, 0.01, 0.3), tyre="linear")
DUGOFF_EKF = replace(LINEAR_EKF, tyre="dugoff")
PF = RandomWalkPF(GOLF, ParticleNoise(force=1.0, pseudo=0.005), particles=2000, forces="drawn")

Drive = tuple[np.ndarray, np.ndarray]  # samples (STEPS, 17) and true states (STEPS, 2 or 4)
Draw = Callable[[np.random.Generator, Any, Any], np.ndarray]


def turn(ay: float) -> np.ndarray:
    """Samples of a left turn that tightens and opens, without states and measurements."""
    samples = np.zeros((STEPS, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 20.0
    swing = 0.6 + 0.4 * np.sin(3.0 * DT * np.arange(STEPS))
    samples[:, at.YAW_RATE] = ay / 20.0 * swing
    samples[:, at.AY] = ay * swing
    samples[:, at.STEER] = ay * swing * 0.009
    return samples


def normal(rng: np.random.Generator, centre: Any, std: Any) -> np.ndarray:
    """Random numbers as the Kalman filters think of them."""
    return rng.normal(centre, std)


def uniform(rng: np.random.Generator, centre: Any, std: Any) -> np.ndarray:
    """The same as the particle filters draw them."""
    half = np.sqrt(3.0) * np.asarray(std)
    return rng.uniform(np.asarray(centre) - half, np.asarray(centre) + half)


def kinematic_drive(rng: np.random.Generator, draw: Draw = normal) -> Drive:
    """A drive of the kinematic model; what the accelerometers miss is a slow bias and white noise.

    The rear wheels are steered so that the rear axle moves along them but for the error that the filter expects.
    """
    noise, car, samples = KF.noise, KF.car, turn(6.0)
    truth = np.empty((STEPS, 4))
    rolling = slip_of_rolling_rear(samples[0, at.STEER], 0.0, car.a, car.b)
    truth[0, :2] = rng.normal([20.0, 20.0 * np.tan(rolling)], [noise.speed, 20.0 * LOW_SPEED_STD])
    truth[0, 2:] = rng.normal(0.0, noise.accel_bias, 2)
    keep = np.exp(-DT / noise.bias_time)
    for k in range(1, STEPS):
        ax, ay, yaw_rate = samples[k, [at.AX, at.AY, at.YAW_RATE]]
        held = np.reshape(input_gain(yaw_rate, DT), (2, 2)) @ ([ax, ay] - truth[k - 1, 2:])
        turned = np.reshape(rotation(yaw_rate, DT), (2, 2)) @ truth[k - 1, :2]
        across = np.hypot(noise.accel, noise.ay_scale * ay)
        truth[k, :2] = draw(rng, turned + held, np.sqrt(DT) * np.array([noise.accel, across]))
        truth[k, 2:] = draw(
            rng, keep * truth[k - 1, 2:], np.full(2, noise.accel_bias * np.sqrt(1.0 - keep**2))
        )
        vx, vy = truth[k, :2]
        samples[k, at.VX] = vx + rng.normal(0.0, noise.speed)
        front = np.tan(samples[k, at.STEER])
        share = np.exp(-(((yaw_rate - vx * front / (car.a + car.b)) / noise.disagreement) ** 2))
        rear = (vy - car.b * yaw_rate + rng.normal(0.0, noise.rolling / np.sqrt(DT * share))) / vx
        samples[k, [at.STEER, at.STEER_REAR]] = np.arctan([front + rear, rear])
    return samples, truth


def dynamic_drive(rng: np.random.Generator, estimator: DynamicEKF, draw: Draw = normal) -> Drive:
    """A drive of the single track with white noise on its rates and on its measurements."""
    noise, car, samples = estimator.noise, estimator.car, turn(3.0)
    truth = np.empty((STEPS, 2))
    rolling = slip_of_rolling_rear(samples[0, at.STEER], 0.0, car.a, car.b)
    truth[0] = draw(rng, [samples[0, at.YAW_RATE], rolling], [noise.yaw_rate, LOW_SPEED_STD])
    assert stable_substeps(20.0, DT, car) == 1
    for k in range(1, STEPS):
        given = (20.0, samples[k, at.STEER], 0.0, 0.0, 0.0, 0.0, 0.0)
        rates, _, _ = single_track_rates(*truth[k - 1], *given, car)
        walk = np.sqrt(DT) * np.array([noise.yaw_acceleration, noise.slip_rate])
        truth[k] = draw(rng, truth[k - 1] + DT * np.array(rates), walk)
        _, (_, ay), _ = single_track_rates(*truth[k], *given, car)
        samples[k, [at.YAW_RATE, at.AY]] = rng.normal([truth[k, 0], ay], [noise.yaw_rate, noise.ay])
    return samples, truth


def consistent(
    estimator: KernelFilter, drive: Callable[[np.random.Generator], Drive], measurements: int
) -> dict[str, bool]:
    """Tell whether the NEES of the runs at five instants and the NIS of all samples are within bounds."""
    rng = np.random.default_rng(11)
    instants = (0, 40, 80, 120, 160)
    nees, nis = np.zeros(len(instants)), 0.0
    for _ in range(RUNS):
        samples, truth = drive(rng)
        started = estimator.start(DT)
        for k, sample in enumerate(samples):
            _, _, of_sample = estimator.step(started, sample)
            nis += of_sample if k else 0.0  # the first sample starts the filter
            if k in instants:
                error = truth[k] - started.state.mean
                nees[instants.index(k)] += error @ np.linalg.solve(started.state.cov, error)
    return {
        "nees": within_bounds(nees, truth.shape[1] * RUNS),
        "nis": within_bounds(np.array(nis), measurements * RUNS * (STEPS - 1)),
    }


def within_bounds(sums: np.ndarray, degrees: int) -> bool:
    low, high = chi2.interval(0.999, degrees)
    return bool(np.all((low < sums) & (sums < high)))


CASES = {
    "kinematic_kf": (KF, kinematic_drive, 1),
    "dynamic_ekf_linear": (LINEAR_EKF, lambda rng: dynamic_drive(rng, LINEAR_EKF), 2),
    "dynamic_ekf_dugoff": (DUGOFF_EKF, lambda rng: dynamic_drive(rng, DUGOFF_EKF), 2),
}


@pytest.mark.parametrize("name", CASES)
def test_kalman_filters_are_consistent(name: str) -> None:
    assert consistent(*CASES[name]) == {"nees": True, "nis": True}


@pytest.mark.parametrize(
    ("name", "wrong"), [("kinematic_kf", {"accel": 0.2}), ("dynamic_ekf_dugoff", {"slip_rate": 0.02})]
)
def test_a_filter_that_is_too_sure_is_seen(name: str, wrong: dict[str, float]) -> None:
    estimator, drive, measurements = CASES[name]
    too_sure = replace(estimator, noise=estimator.noise._replace(**wrong))
    assert consistent(too_sure, drive, measurements) == {"nees": False, "nis": False}


def first_states(sample: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """States (..., 6) spread uniformly (..., 6) about the sample.

    Less than the filter's own first particles: a few thousand cannot fill that box in six dimensions.
    """
    car = PF.car
    side = car.mass * sample[at.AY] / (car.a + car.b)
    centre = np.array([sample[at.YAW_RATE], 0.01, 0.0, 0.0, car.b * side, car.a * side])
    return centre + uniform * [0.05, 0.05, *[0.7 * car.mass] * 4]


def particle_drive(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A drive of the random-walk model: samples, true states (STEPS, 6) and measurements of beta (STEPS,)."""
    noise, car, samples = PF.noise, PF.car, turn(4.5)
    scale = np.array([1.0, 1.0, *[car.mass] * 4])
    walk = np.sqrt(3.0 * DT) * scale * [noise.yaw_acceleration, noise.slip_rate, *[noise.force] * 4]
    state = first_states(samples[0], rng.uniform(-1.0, 1.0, 6))
    truth, pseudo = np.empty((STEPS, 6)), np.empty(STEPS)
    truth[0], pseudo[0] = state, 0.01
    for k in range(1, STEPS):
        sample, shaken = samples[k], walk * rng.uniform(-1.0, 1.0, 6)
        state = state + np.array([0.0, 0.0, *shaken[2:]])
        *rates, ax, ay = random_walk_rates(state, 20.0, sample[at.STEER], 0.0, car)
        state = state + np.array([*(DT * np.array(rates) + shaken[:2]), 0.0, 0.0, 0.0, 0.0])
        sample[[at.YAW_RATE, at.AX, at.AY]] = rng.normal(
            [state[0], ax, ay], [noise.yaw_rate, noise.accel, noise.accel]
        )
        truth[k], pseudo[k] = state, rng.normal(state[1], noise.pseudo / np.sqrt(DT))
    return samples, truth, pseudo


def particle_consistency(estimator: RandomWalkPF) -> bool:
    """Tell whether the NEES of beta is within bounds at three instants.

    Not through `step`, which takes the EKF's beta as measurement: here one with the error the filter expects.
    """
    rng = np.random.default_rng(12)
    instants = (20, 40, 60)  # later the free forces spin the true car
    nees = np.zeros(len(instants))
    for run in range(PARTICLE_RUNS):
        samples, truth, pseudo = particle_drive(rng)
        particles = replace(estimator, seed=run).make_state()
        particles.x[:] = first_states(samples[0], rng.uniform(-1.0, 1.0, particles.x.shape).T).T
        for k in range(1, max(instants) + 1):
            move_and_weigh(particles, samples[k], pseudo[k], 0.0, estimator.car, estimator.noise, DT)
            effective = normalise(particles.log_weights, particles.weights)
            if k in instants:
                beta, beta_std = weighted_beta(particles)
                nees[instants.index(k)] += ((truth[k, 1] - beta) / beta_std) ** 2
            if effective < 0.5 * estimator.particles:
                resample(particles)
    return within_bounds(nees, PARTICLE_RUNS)


def test_particle_filter_is_consistent() -> None:
    assert particle_consistency(PF)


def test_a_particle_filter_that_is_too_sure_is_seen() -> None:
    assert not particle_consistency(replace(PF, noise=PF.noise._replace(pseudo=0.0025)))


TWO_STATES = {
    "kinematic_pf": (
        KinematicPF(GOLF, KF.noise),
        lambda rng: kinematic_drive(rng, uniform),
        lambda x: np.arctan2(x[:, 1], x[:, 0]),
    ),
    "dynamic_pf": (
        DynamicPF(GOLF, DUGOFF_EKF.noise),
        lambda rng: dynamic_drive(rng, DUGOFF_EKF, uniform),
        lambda x: x[:, 1],
    ),
}


def nees_of_beta(name: str, **wrong: float) -> np.ndarray:
    """Summed NEES of beta at four instants, of a particle filter on a model of two states."""
    estimator, drive, slip = TWO_STATES[name]
    rng, instants = np.random.default_rng(13), [40, 80, 120, 160]
    nees = np.zeros(len(instants))
    for run in range(PARTICLE_RUNS):
        samples, truth = drive(rng)
        seeded = replace(estimator, seed=run, noise=estimator.noise._replace(**wrong))
        estimate = seeded.run(Inputs(DT, samples))
        nees += (((slip(truth) - estimate.beta) / estimate.beta_std) ** 2)[instants]
    return nees


@pytest.mark.parametrize(("name", "wrong"), [("kinematic_pf", "accel"), ("dynamic_pf", "slip_rate")])
def test_particle_filters_of_two_states_are_consistent(name: str, wrong: str) -> None:
    assert within_bounds(nees_of_beta(name), PARTICLE_RUNS)
    halved = 0.5 * getattr(TWO_STATES[name][0].noise, wrong)
    assert not within_bounds(nees_of_beta(name, **{wrong: halved}), PARTICLE_RUNS)


def right_members(slip_rate: float) -> dict[str, KernelFilter]:
    """Blends and their members, with the errors that each member has on drives of the single track.

    The kinematic filter's accelerometers are right there but for what shakes beta and ay beside them.
    """
    dynamic = DynamicNoise(0.3, slip_rate, 0.01, 0.3)
    accel = float(np.hypot(20.0 * slip_rate, 0.3 * np.sqrt(DT)))
    kinematic = KinematicNoise(accel=accel, ay_scale=0.0, accel_bias=1e-6, rolling=1e6)
    return {
        "kinematic": KinematicKF(GOLF, kinematic),
        "dynamic": DynamicEKF(GOLF, dynamic),
        "fuzzy_blend": FuzzyBlend(GOLF, FuzzyNoise(kinematic=kinematic, dynamic=dynamic)),
        "covariance_fusion": CovarianceFusion(GOLF, FusionNoise(kinematic, dynamic)),
    }


def nees_of_blends(slip_rate: float) -> dict[str, np.ndarray]:
    """Summed NEES of beta at four instants, of filters that expect this disturbance of beta, on drives with 0.02."""
    rng, instants = np.random.default_rng(5), [40, 80, 120, 160]
    drive_of, tested = right_members(0.02)["dynamic"], right_members(slip_rate)
    nees = {name: np.zeros(len(instants)) for name in tested}
    for _ in range(RUNS):
        samples, truth = dynamic_drive(rng, drive_of)
        samples[:, at.AX] = -truth[:, 0] * 20.0 * np.tan(truth[:, 1])  # the speed is held
        for name, estimator in tested.items():
            estimate = estimator.run(Inputs(DT, samples))
            nees[name] += (((estimate.beta - truth[:, 1]) / estimate.beta_std) ** 2)[instants]
    return nees


def test_blends_err_no_more_than_they_say() -> None:
    """A blend counts its members' disagreement on top of their spread, as one of them may be wrong.

    Where both are right, as here, that overstates its error: its NEES is below the two-sided bounds.
    """
    low, high = chi2.interval(0.999, RUNS)
    nees = nees_of_blends(0.02)
    for name in ("kinematic", "dynamic"):
        assert np.all((low < nees[name]) & (nees[name] < high)), name
    for name in ("fuzzy_blend", "covariance_fusion"):
        assert np.all((nees[name] > 0.1 * RUNS) & (nees[name] < low)), name


def test_blends_of_members_that_are_too_sure_are_seen() -> None:
    high = chi2.ppf(0.9995, RUNS)
    nees = nees_of_blends(0.004)
    for name in ("fuzzy_blend", "covariance_fusion"):
        assert np.any(nees[name] > high), name

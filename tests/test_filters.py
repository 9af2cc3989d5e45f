"""The three filters: the same answer as filterpy, by steps as in one run, and an answer whatever comes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstest

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.resampling import resample
from crosscomb.filters.base import MAX_BETA, Estimate, Inputs, KernelFilter, make_inputs
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.plain_pf import draw_uniform, first_particles, move_and_weigh
from crosscomb.filters.random_walk.shared import ParticleNoise, sin_cos
from crosscomb.filters.single_track.ekf import DynamicEKF, DynamicNoise
from crosscomb.filters.twins.table import TWINS
from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear
from crosscomb.models.random_walk import random_walk_rates
from crosscomb.models.single_track import FRICTION_MARGIN, single_track
from crosscomb.signals import GRAVITY, MIN_SPEED, Signals
from drives import DT, GOLF, NAMED, mirrored, model_slalom, named, noisy, spread, welch, with_gaps


def slalom(
    steps: int, tyre: str = "dugoff", steer: float = 0.04, rear: float = 0.1
) -> tuple[Inputs, np.ndarray]:
    """Noiseless slalom of the Golf, and its beta ``(n,) [rad]``."""
    return model_slalom(steps, single_track(GOLF, tyre), steer=steer, rear=rear)


FILTERS: dict[str, KernelFilter] = {
    "kinematic_kf": KinematicKF(GOLF),
    "dynamic_ekf_linear": DynamicEKF(GOLF, tyre="linear"),
    "dynamic_ekf_dugoff": DynamicEKF(GOLF, tyre="dugoff"),
    "random_walk_pf": RandomWalkPF(GOLF, particles=200, forces="drawn"),
    "random_walk_pf solved": RandomWalkPF(GOLF),
}
KALMAN = [name for name in FILTERS if "pf" not in name]
each_filter = pytest.mark.parametrize("name", FILTERS)
each_kalman_filter = pytest.mark.parametrize("name", KALMAN)
each_drive = pytest.mark.parametrize("inputs_of", NAMED)


# Against filterpy.


@each_kalman_filter
@each_drive
def test_kalman_kernels_agree_with_filterpy(name: str, inputs_of: str) -> None:
    estimator, inputs = FILTERS[name], named(inputs_of)
    if isinstance(estimator, KinematicKF):
        expected = TWINS["kinematic_kf"](estimator, inputs)
    else:
        assert isinstance(estimator, DynamicEKF)
        expected = TWINS["dynamic_ekf"](estimator, inputs)
    estimate = estimator.run(inputs)
    np.testing.assert_allclose(estimate.beta, expected.beta, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(estimate.beta_std, expected.beta_std, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(estimate.nis, expected.nis, rtol=1e-9, atol=1e-9)
    assert len(estimator.innovations()) == 2
    for innovation in estimator.innovations():
        found = estimate.extra[innovation]
        np.testing.assert_allclose(
            found, expected.extra[innovation], rtol=1e-9, atol=1e-9, err_msg=innovation
        )
        assert np.isfinite(found).any()
        assert np.isnan(found[0]), "the first sample starts the filter"
    assert np.isfinite(estimate.nis).mean() > 0.5
    assert np.ptp(estimate.beta) > np.radians(1.0), "a filter that stays where it is proves nothing"


PF_SEEDS = 30
PLAIN_PF = RandomWalkPF(GOLF, particles=400, forces="drawn")


def pf_drive() -> Inputs:
    return with_gaps(noisy(slalom(160)[0]))


def pf_runs(estimator: RandomWalkPF, inputs: Inputs) -> list[Estimate]:
    return [replace(estimator, seed=seed).run(inputs) for seed in range(PF_SEEDS)]


@pytest.fixture(scope="module")
def plain_pf_runs() -> list[Estimate]:
    inputs = pf_drive()
    return [TWINS["random_walk_pf"](replace(PLAIN_PF, seed=900 + i), inputs) for i in range(PF_SEEDS)]


def test_particle_kernel_agrees_with_a_plain_filter_within_scatter(plain_pf_runs: list[Estimate]) -> None:
    t = welch(spread(pf_runs(PLAIN_PF, pf_drive())), spread(plain_pf_runs))
    # One of 14 values of Welch's t (at least 29 degrees of freedom) is beyond 4.5 by chance in 1 of 700.
    assert np.abs(t).max() < 4.5


NOISE = ParticleNoise()


@pytest.mark.parametrize(
    "wrong",
    [
        replace(PLAIN_PF, noise=NOISE._replace(slip_rate=1.5 * NOISE.slip_rate)),
        replace(PLAIN_PF, noise=NOISE._replace(pseudo=1.5 * NOISE.pseudo)),
    ],
    ids=["slip noise", "pseudo-measurement"],
)
def test_the_scatter_would_show_a_wrong_particle_filter(
    wrong: RandomWalkPF, plain_pf_runs: list[Estimate]
) -> None:
    assert np.abs(welch(spread(pf_runs(wrong, pf_drive())), spread(plain_pf_runs))).max() > 4.5


@pytest.mark.parametrize("missing", [[], [at.YAW_RATE], [at.AX], [at.AY], [at.YAW_RATE, at.AX, at.AY]])
def test_particles_without_noise_follow_the_model_exactly(missing: list[int]) -> None:
    estimator = RandomWalkPF(
        GOLF, NOISE._replace(force=0.0, yaw_acceleration=0.0, slip_rate=0.0), particles=300, forces="drawn"
    )
    noise, car = estimator.noise, estimator.car
    particles = estimator.make_state()
    first_particles(particles, slalom(20)[0].samples[0], -0.05, car)
    x, log_weights = particles.x.copy(), np.zeros(300)
    z_beta, std_beta = 0.03, 0.02
    for sample in noisy(slalom(20)[0]).samples:
        sample[missing] = np.nan
        move_and_weigh(particles, sample, z_beta, std_beta, car, noise, DT)
        for i in range(300):
            *rates, ax, ay = random_walk_rates(x[:, i], *sample[[at.VX, at.STEER, at.STEER_REAR]], car)
            x[:2, i] += DT * np.array(rates)
            errors = np.array([x[0, i], ax, ay]) - sample[[at.YAW_RATE, at.AX, at.AY]]
            misfit = 0.5 * (errors / [noise.yaw_rate, noise.accel, noise.accel]) ** 2
            pseudo = 0.5 * DT * (x[1, i] - z_beta) ** 2 / (noise.pseudo**2 + std_beta**2)
            log_weights[i] -= np.nansum(np.minimum(misfit, 0.5 * 5.0**2)) + pseudo
    np.testing.assert_allclose(particles.x, x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(particles.log_weights, log_weights, rtol=1e-9)


def test_particles_are_shaken_independently_and_as_much_as_the_settings_say() -> None:
    estimator = RandomWalkPF(GOLF, particles=5000, forces="drawn")
    noise, car = estimator.noise, estimator.car
    sample = slalom(2)[0].samples[1]
    particles = estimator.make_state()
    particles.x[:] = np.array([0.2, -0.05, 500.0, -300.0, 4000.0, 3000.0])[:, None]
    shaken = -particles.x
    move_and_weigh(particles, sample, 0.0, 0.0, car, noise, DT)
    shaken += particles.x
    for i in range(5000):  # what is left when the forces have done their part is noise
        moved = np.array([0.2, -0.05, *particles.x[2:, i]])
        yaw_acceleration, slip_rate, _, _ = random_walk_rates(
            moved, *sample[[at.VX, at.STEER, at.STEER_REAR]], car
        )
        shaken[:2, i] -= DT * yaw_acceleration, DT * slip_rate
    size = np.array([noise.yaw_acceleration, noise.slip_rate, *[car.mass * noise.force] * 4]) * np.sqrt(DT)
    np.testing.assert_allclose(np.cov(shaken / size[:, None]), np.eye(6), atol=4.5 / np.sqrt(5000))


def test_uniform_draws_are_white_and_of_unit_variance() -> None:
    n = 200_000
    noise = np.empty((6, n))
    draw_uniform(np.random.Generator(np.random.SFC64(1)), noise)
    assert np.abs(noise).max() <= np.sqrt(3.0)
    for row in noise:
        assert kstest(row, "uniform", args=(-np.sqrt(3.0), 2.0 * np.sqrt(3.0))).pvalue > 1e-4
    # Also between the two that one random number serves, and from one particle to the next.
    products = [noise[i] * noise[j] for i in range(6) for j in range(i)] + [
        row[1:] * row[:-1] for row in noise
    ]
    assert max(abs(product.mean()) for product in products) < 4.5 / np.sqrt(n)


def test_resampling_copies_particles_by_their_weights() -> None:
    n = 500
    particles = RandomWalkPF(GOLF, particles=n, forces="drawn").make_state()
    weights = np.random.default_rng(2).exponential(size=n) ** 3
    particles.weights[:] = weights / weights.sum()
    particles.x[:] = np.arange(n) + 1000.0 * np.arange(6)[:, None]
    resample(particles)
    copies = np.bincount(particles.x[0].astype(int), minlength=n)
    assert np.all(np.abs(copies - n * weights / weights.sum()) < 1.0), "systematic: never off by a whole copy"
    np.testing.assert_array_equal(particles.x - particles.x[0], 1000.0 * np.arange(6)[:, None] + np.zeros(n))
    assert not particles.log_weights.any()


def test_fast_sine_and_cosine() -> None:
    angles = np.linspace(-MAX_BETA, MAX_BETA, 2001)
    fast = np.array([sin_cos(angle) for angle in angles])
    np.testing.assert_allclose(fast, np.column_stack([np.sin(angles), np.cos(angles)]), rtol=0.0, atol=1e-11)


# A noiseless drive of the filter's own model is followed without error.


@pytest.mark.parametrize("tyre", ["linear", "dugoff"])
def test_dynamic_ekf_follows_its_own_model(tyre: str) -> None:
    inputs, beta = slalom(1500, tyre)
    in_use = np.hypot(inputs.samples[:, at.AX], inputs.samples[:, at.AY]).max()
    assert 0.5 * GOLF.friction * GRAVITY < in_use < GOLF.friction * GRAVITY / FRICTION_MARGIN, (
        "beyond linear tyres"
    )
    estimate = DynamicEKF(GOLF, tyre=tyre).run(inputs)
    np.testing.assert_allclose(estimate.beta, beta, rtol=0.0, atol=1e-9)
    assert np.nanmax(estimate.nis) < 1e-9


NO_ROLLING = KinematicNoise(disagreement=1e-9)
"""No driving is so gentle that the rear axle counts as rolling: nothing but vx is measured."""


def test_kinematic_kf_follows_its_own_model() -> None:
    inputs, _ = slalom(1500)
    samples = inputs.samples
    samples[:, at.AY] = samples[:, at.VX] * samples[:, at.YAW_RATE] + 3.0 * np.sin(5.0 * DT * np.arange(1500))
    velocity = np.array(
        [18.0, 18.0 * np.tan(slip_of_rolling_rear(*samples[0, [at.STEER, at.STEER_REAR]], 1.264, 1.367))]
    )
    truth = np.empty((1500, 2))
    for k, sample in enumerate(samples):
        if k:
            ax, ay, yaw_rate = sample[[at.AX, at.AY, at.YAW_RATE]]
            turned = np.reshape(rotation(yaw_rate, DT), (2, 2)) @ velocity
            velocity = turned + np.reshape(input_gain(yaw_rate, DT), (2, 2)) @ [ax, ay]
        truth[k] = velocity
    samples[:, at.VX] = truth[:, 0]
    assert samples[:, at.VX].min() > MIN_SPEED
    estimate = KinematicKF(GOLF, NO_ROLLING).run(inputs)
    expected = np.arctan2(truth[:, 1], truth[:, 0])
    assert np.ptp(expected) > np.radians(5.0)
    np.testing.assert_allclose(estimate.beta, expected, rtol=0.0, atol=1e-9)


# Left and right.


def test_a_mirrored_drive_gives_the_mirrored_answer_of_the_particles_within_scatter() -> None:
    flipped = pf_runs(PLAIN_PF, mirrored(pf_drive()))
    backed = [replace(run, beta=-run.beta) for run in flipped]
    others = spread([replace(PLAIN_PF, seed=100 + seed).run(pf_drive()) for seed in range(PF_SEEDS)])
    assert np.abs(welch(spread(backed), others)).max() < 4.5
    assert np.abs(welch(spread(flipped), others)).max() > 4.5


# Whatever comes.


@each_filter
@each_drive
def test_state_stays_a_probability(name: str, inputs_of: str) -> None:
    estimator = FILTERS[name]
    started = estimator.start(DT)
    for sample in named(inputs_of).samples:
        beta, beta_std, _ = estimator.step(started, sample)
        assert np.isfinite(beta)
        assert 0.0 <= beta_std < np.radians(180.0)
        if name in KALMAN:
            assert beta_std > 0.0
            cov = started.state.cov
            assert cov[0, 1] == cov[1, 0]
            assert cov[0, 0] > 0.0
            assert np.linalg.det(cov) > 0.0
        elif started.state.running[0]:
            assert started.state.weights.sum() == pytest.approx(1.0)


@each_filter
def test_a_stop_makes_the_filter_forget(name: str) -> None:
    inputs, other = named("noisy"), named("noisy").samples.copy()
    # What the kinematic filter has learnt of its sensors it keeps: see the test below.
    estimator = KinematicKF(GOLF, KinematicNoise(accel_bias=0.0)) if name == "kinematic_kf" else FILTERS[name]
    other[:500, [at.AX, at.AY, at.YAW_RATE]] += 1.0
    first, second = inputs.samples.copy(), other
    first[500, at.VX] = second[500, at.VX] = 0.0
    one, two = (estimator.run(replace(inputs, samples=samples)) for samples in (first, second))
    assert not np.allclose(one.beta[1:500], two.beta[1:500])
    if name in KALMAN:  # the particles go on with other random numbers
        np.testing.assert_array_equal(one.beta[500:], two.beta[500:])
    else:
        np.testing.assert_allclose(one.beta[501:505], two.beta[501:505], atol=0.05)


# From a log.


def log(steps: int = 600, **columns: np.ndarray) -> Signals:
    """A steady left turn of the Golf, as a log at 100 Hz."""
    samples = slalom(steps, steer=0.0)[0].samples
    names = {
        "vx": at.VX,
        "ax": at.AX,
        "ay": at.AY,
        "yaw_rate": at.YAW_RATE,
        "steer": at.STEER,
        "steer_rear": at.STEER_REAR,
    }
    table = {name: samples[:, column] for name, column in names.items()}
    return Signals("log", pd.DataFrame({"t": DT * np.arange(steps), **table, **columns}))


def without(signals: Signals, channel: str, start: int, stop: int) -> Signals:
    values = signals.column(channel).copy()
    values[start:stop] = np.nan
    return signals.with_columns(**{channel: values})


def test_inputs_hold_what_models_need_and_say_so() -> None:
    samples = make_inputs(without(without(log(20), "vx", 5, 9), "steer", 0, 3), GOLF, DT).samples
    whole = make_inputs(log(20), GOLF, DT).samples
    np.testing.assert_array_equal(samples[5:9, at.VX], whole[4, at.VX])
    np.testing.assert_array_equal(samples[:3, at.STEER], 0.0)
    np.testing.assert_array_equal(np.flatnonzero(samples[:, at.VX_HELD]), range(5, 9))
    np.testing.assert_array_equal(np.flatnonzero(samples[:, at.STEER_HELD]), range(3))
    np.testing.assert_array_equal(whole[:, [at.VX_HELD, at.STEER_HELD]], 0.0)
    assert np.isnan(make_inputs(without(log(20), "ay", 5, 9), GOLF, DT).samples[5:9, at.AY]).all()


def test_inputs_take_the_gravity_of_body_roll_out_of_ay() -> None:
    rolling = GOLF.model_copy(update={"roll_gradient": 0.007})
    felt = log(20).with_columns(ay=5.0 + GRAVITY * np.sin(0.007 * np.full(20, 5.0)))
    np.testing.assert_allclose(make_inputs(felt, rolling, DT).samples[:, at.AY], 5.0, rtol=1e-4)


def test_inputs_know_the_longitudinal_forces() -> None:
    braking = log(20).with_columns(ax=np.full(20, -4.0))
    samples = make_inputs(braking, GOLF, DT).samples
    np.testing.assert_allclose(samples[:, at.FXF] + samples[:, at.FXR], -4.0 * GOLF.mass)
    share = GOLF.cg_to_rear_axle / (GOLF.cg_to_front_axle + GOLF.cg_to_rear_axle)
    np.testing.assert_allclose(samples[:, at.FXF], -4.0 * GOLF.mass * share)
    torques = {"torque_fl": 300.0, "torque_fr": 200.0, "torque_rl": -50.0, "torque_rr": 0.0}
    known = braking.with_columns(**{name: np.full(20, value) for name, value in torques.items()})
    samples = make_inputs(without(known, "torque_rr", 10, 20), GOLF, DT).samples
    np.testing.assert_allclose(
        samples[:10, [at.FXF, at.FXR]], [[500.0 / GOLF.wheel_radius, -50.0 / GOLF.wheel_radius]] * 10
    )
    np.testing.assert_allclose(samples[10:, at.FXF], -4.0 * GOLF.mass * share, err_msg="else from ax")


SHARP = {
    "kinematic_kf": KinematicKF(GOLF, NO_ROLLING._replace(speed=0.03)),
    "dynamic_ekf": DynamicEKF(GOLF, DynamicNoise(slip_rate=0.04, ay=0.5)),
    "random_walk_pf": RandomWalkPF(GOLF, particles=4000, forces="drawn"),
    "random_walk_pf solved": RandomWalkPF(GOLF),
}
"""Filters that trust their measurements, so that a missing one tells."""

TELLING = {
    "kinematic_kf": {"vx", "ax", "ay", "yaw_rate"},
    "dynamic_ekf": {"ay", "yaw_rate", "steer"},
    "random_walk_pf": {"ay", "yaw_rate"},
    "random_walk_pf solved": {"ay", "yaw_rate"},
}
"""Channels that each filter measures or integrates; the others only shift its model a little."""


@pytest.mark.parametrize("name", SHARP)
@pytest.mark.parametrize("channel", ["vx", "ax", "ay", "yaw_rate", "steer"])
def test_a_missing_channel_widens_the_answer_and_comes_back(name: str, channel: str) -> None:
    whole = SHARP[name].run(make_inputs(log(), GOLF, DT))
    broken = SHARP[name].run(make_inputs(without(log(), channel, 200, 400), GOLF, DT))
    growth = broken.beta_std / whole.beta_std
    assert np.isfinite(broken.beta).all()
    np.testing.assert_array_equal(growth[:200], 1.0)
    if (name, channel) == ("kinematic_kf", "vx"):
        assert np.isnan(broken.nis[200:400]).all(), "a held speed is no measurement"
    if channel in TELLING[name]:
        assert growth[350:400].mean() > 1.03
        assert growth[599] < 0.5 * (1.0 + growth[399])
    else:
        assert 0.85 < growth[350:400].mean() < 1.2


@pytest.mark.parametrize("name", FILTERS)
def test_a_log_without_any_value_gets_an_answer(name: str) -> None:
    empty = {c: np.full(50, np.nan) for c in ("vx", "ax", "ay", "yaw_rate", "steer", "steer_rear")}
    estimate = FILTERS[name].run(make_inputs(log(50, **empty), GOLF, DT))
    np.testing.assert_array_equal(estimate.beta, np.zeros(50))
    empty.pop("vx")
    estimate = FILTERS[name].run(make_inputs(log(50, **empty), GOLF, DT))
    assert np.isfinite(estimate.beta).all()
    assert np.isfinite(estimate.beta_std).all()
    assert np.isfinite(estimate.nis).any() == (name == "kinematic_kf"), "only vx was measured"

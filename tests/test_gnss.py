"""GNSS-aided filters: as filterpy's, consistent, better with fixes, and honest without."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, Inputs, KernelFilter, make_inputs
from crosscomb.filters.kinematic.gnss_kf import (
    UNKNOWN_HEADING,
    GnssKinematicKF,
    GnssKinematicNoise,
    wrap,
)
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.filters.single_track.gnss_ekf import GnssDynamicNoise, GnssDynamicObserver
from crosscomb.filters.twins.table import TWINS
from crosscomb.logs.prepare import complete
from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear
from crosscomb.models.single_track import single_track_rates, stable_substeps
from drives import DT, FIXES, GOLF, simulated_log, without

FILTERS: list[KernelFilter] = [GnssKinematicKF(GOLF), GnssDynamicObserver(GOLF)]
each_filter = pytest.mark.parametrize("estimator", FILTERS, ids=["kinematic", "dynamic"])


def drive(manoeuvre: str, seed: int = 7, duration: float = 20.0) -> tuple[Inputs, np.ndarray]:
    """A simulated drive seen by production sensors and two antennas at 5 Hz, and its true beta ``(n,)``."""
    log, true = (
        simulated_log(GOLF, manoeuvre, seed, duration=duration, surface="dry", faults=faults)
        for faults in (True, False)
    )
    inputs, rng, n = make_inputs(complete(log, GOLF), GOLF, DT), np.random.default_rng(seed), len(log)
    vx, vy = log.column("vx_ref"), log.column("vy_ref")
    speed, beta = np.hypot(vx, vy), np.arctan2(vy, vx)
    heading = 2.0 + DT * np.cumsum(true.column("yaw_rate"))
    course = heading + beta + rng.normal(0.0, 0.05, n) / np.maximum(speed, 1.0)
    fix = np.arange(n) % 20 == 0
    values = (speed + rng.normal(0.0, 0.05, n), course, heading + rng.normal(0.0, 0.005, n))
    for column, value in zip(FIXES, values, strict=True):
        angle = value if column == at.GNSS_SPEED else np.arctan2(np.sin(value), np.cos(value))
        inputs.samples[:, column] = np.where(fix, angle, np.nan)
    return inputs, beta


def rmse(estimator: KernelFilter, inputs: Inputs, beta: np.ndarray, rows: slice = slice(200, None)) -> float:
    return float(np.degrees(np.sqrt(np.mean((estimator.run(inputs).beta - beta)[rows] ** 2))))


@pytest.mark.parametrize("manoeuvre", ["slalom", "drift"])
@pytest.mark.parametrize("lost", [[], [at.HEADING], FIXES], ids=["two antennas", "one antenna", "no fix"])
@pytest.mark.parametrize(
    ("estimator", "twin"),
    [(FILTERS[0], TWINS["gnss_kinematic_kf"]), (FILTERS[1], TWINS["gnss_dynamic_observer"])],
    ids=["kinematic", "dynamic"],
)
def test_kernels_agree_with_filterpy(estimator, twin, lost, manoeuvre) -> None:
    inputs = without(drive(manoeuvre, seed=5)[0], lost)
    slow = np.flatnonzero(inputs.samples[:, at.VX] < 3.5)  # the twins know no stops
    inputs = replace(inputs, samples=inputs.samples[: slow[0] if len(slow) else 1000])
    assert len(inputs.samples) > 300
    inputs.samples[:, [at.VX_HELD, at.STEER_HELD]] = 0.0  # nor held samples
    estimate, expected = estimator.run(inputs), twin(estimator, inputs)
    np.testing.assert_allclose(estimate.beta, expected.beta, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(estimate.beta_std, expected.beta_std, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(estimate.nis, expected.nis, rtol=1e-6, atol=1e-6)
    assert np.ptp(estimate.beta) > np.radians(1.0)


@each_filter
def test_fixes_help_in_a_drift(estimator) -> None:
    inputs, beta = drive("drift", seed=5)
    assert np.abs(beta).max() > np.radians(12.0)
    with_fixes, alone = rmse(estimator, inputs, beta), rmse(estimator, without(inputs, FIXES), beta)
    assert with_fixes < 1.6
    assert with_fixes < 0.6 * alone


@each_filter
def test_without_fixes_the_answer_is_sensible_and_less_sure(estimator) -> None:
    inputs, beta = drive("slalom")
    alone = estimator.run(without(inputs, FIXES))
    assert rmse(estimator, without(inputs, FIXES), beta) < 1.0
    assert alone.beta_std[200:].mean() > 1.002 * estimator.run(inputs).beta_std[200:].mean()
    assert alone.beta_std.max() < np.radians(10.0)


@each_filter
def test_an_outage_is_carried_through(estimator) -> None:
    inputs, beta = drive("slalom")
    gone = without(inputs, FIXES, slice(800, 1600))
    whole, broken = estimator.run(inputs), estimator.run(gone)
    np.testing.assert_array_equal(whole.beta[:800], broken.beta[:800])
    assert rmse(estimator, gone, beta, slice(800, 1600)) < 1.0
    assert broken.beta_std[1500:1600].mean() > whole.beta_std[1500:1600].mean()
    # 2 s after the fixes are back they are as if never gone.
    np.testing.assert_allclose(broken.beta[1800:], whole.beta[1800:], atol=np.radians(0.3))


def test_what_fixes_taught_holds_through_an_outage() -> None:
    """With an accelerometer that is off, the biases learnt before the outage tell in it."""
    inputs, beta = drive("slalom")
    inputs.samples[:, at.AY] += 0.5
    learnt = rmse(FILTERS[0], without(inputs, FIXES, slice(1000, 1400)), beta, slice(1000, 1400))
    never = rmse(FILTERS[0], without(inputs, FIXES), beta, slice(1000, 1400))
    assert learnt < 0.5 * never


def test_sensor_errors_are_found() -> None:
    inputs, _ = drive("slalom", duration=40.0)
    offsets = {3: 0.02, 5: 0.4}  # gyro bias, ay bias
    found = []
    for sign in (1.0, -1.0):
        samples = inputs.samples.copy()
        samples[:, at.YAW_RATE] += sign * offsets[3]
        samples[:, at.AY] += sign * offsets[5]
        started = FILTERS[0].start(DT)
        for sample in samples:
            FILTERS[0].step(started, sample)
        found.append(started.state.mean.copy())
    # The sensors of the drive have errors of their own; the difference is twice what was added.
    half = 0.5 * (found[0] - found[1])
    assert half[3] == pytest.approx(offsets[3], rel=0.1)
    assert half[5] == pytest.approx(offsets[5], rel=0.25)


def test_a_wheel_speed_that_is_off_is_no_slip() -> None:
    inputs, beta = drive("slalom", seed=4)
    inputs.samples[:, at.VX] *= 0.985
    assert rmse(FILTERS[0], without(inputs, [at.HEADING]), beta) < 1.5
    blind = GnssKinematicKF(GOLF, GnssKinematicNoise(scale=1e-6))
    assert rmse(blind, without(inputs, [at.HEADING]), beta) > 3.0


def test_own_kinematic_model_is_followed_without_error() -> None:
    noise = GnssKinematicNoise(relaxation=0.0)
    n, rng = 600, np.random.default_rng(3)
    samples = np.full((n, at.SAMPLE_WIDTH), np.nan)
    samples[:, 4:10] = 0.0
    t = DT * np.arange(n)
    samples[:, at.YAW_RATE], samples[:, at.AX], samples[:, at.AY] = (
        0.4 * np.sin(t),
        np.cos(t),
        3.0 * np.sin(1.3 * t),
    )
    velocity, heading, beta = np.array([20.0, 0.0]), 0.0, np.zeros(n)
    for k in range(n):
        if k:
            yaw_rate = samples[k, at.YAW_RATE]
            turned = np.reshape(rotation(yaw_rate, DT), (2, 2)) @ velocity
            velocity = turned + np.reshape(input_gain(yaw_rate, DT), (2, 2)) @ samples[k, [at.AX, at.AY]]
            heading += DT * yaw_rate
        beta[k] = np.arctan2(velocity[1], velocity[0])
        samples[k, at.VX] = velocity[0]
        if rng.random() < 0.1:
            samples[k, FIXES] = np.hypot(*velocity), heading + beta[k], heading
    assert np.ptp(beta) > np.radians(5.0)
    estimate = GnssKinematicKF(GOLF, noise).run(Inputs(DT, samples))
    np.testing.assert_allclose(estimate.beta, beta, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("angle", "inside"), [(0.3, 0.3), (3.3, 3.3 - 2 * np.pi), (-9.0, -9.0 + 2 * np.pi)])
def test_angles_are_wrapped(angle, inside) -> None:
    assert wrap(angle) == pytest.approx(inside)


def test_a_stop_forgets_the_motion_but_not_the_sensors() -> None:
    inputs, _ = drive("slalom")
    inputs.samples[:, at.YAW_RATE] += 0.02
    started = FILTERS[0].start(DT)
    for sample in inputs.samples[:1000]:
        FILTERS[0].step(started, sample)
    bias = started.state.mean[3]
    assert abs(bias) > 0.01
    stop = inputs.samples[1000].copy()
    stop[at.VX] = 0.0
    beta, beta_std, _ = FILTERS[0].step(started, stop)
    assert (beta, beta_std) == (slip_of_rolling_rear(stop[at.STEER], stop[5], 1.264, 1.367), LOW_SPEED_STD)
    FILTERS[0].step(started, inputs.samples[1001])
    assert started.state.mean[3] == bias
    assert started.state.cov[2, 2] == UNKNOWN_HEADING


# Monte Carlo on drives of the filters' own stochastic models.

RUNS, STEPS = 120, 150


def inside(total: float, degrees: int) -> bool:
    low, high = chi2.interval(0.999, degrees)
    return bool(low < total < high)


def turn() -> np.ndarray:
    samples = np.full((STEPS, at.SAMPLE_WIDTH), np.nan)
    samples[:, 4:10] = 0.0
    swing = 0.6 + 0.4 * np.sin(3.0 * DT * np.arange(STEPS))
    samples[:, at.VX], samples[:, at.YAW_RATE], samples[:, at.AY] = 20.0, 0.3 * swing, 6.0 * swing
    samples[:, at.AX], samples[:, at.STEER] = 0.0, 0.05 * swing
    return samples


def kinematic_case(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    noise, samples, truth = GnssKinematicNoise(relaxation=0.0), turn(), np.zeros((STEPS, 7))
    rolling = np.tan(slip_of_rolling_rear(samples[0, at.STEER], 0.0, 1.264, 1.367))
    sizes = np.array([noise.gyro_bias, noise.accel_bias, noise.accel_bias, noise.scale])
    truth[0, 0] = rng.normal(20.0, noise.speed)
    truth[0, 1] = 20.0 * rng.normal(rolling, LOW_SPEED_STD)
    truth[0, 2] = rng.normal(0.0, 0.3)  # less than the filter allows: its wrapped update is linear for any
    truth[0, 3:] = rng.normal(0.0, sizes)
    keep = np.exp(-DT / noise.bias_time)
    for k in range(1, STEPS):
        gyro, *accel = samples[k, [at.YAW_RATE, at.AX, at.AY]] - truth[k - 1, 3:6]
        velocity = np.reshape(rotation(gyro, DT), (2, 2)) @ truth[k - 1, :2]
        velocity += np.reshape(input_gain(gyro, DT), (2, 2)) @ accel
        truth[k, :2] = velocity + rng.normal(0.0, noise.accel * np.sqrt(DT), 2)
        truth[k, 2] = truth[k - 1, 2] + DT * gyro + rng.normal(0.0, noise.gyro * np.sqrt(DT))
        truth[k, 3:] = keep * truth[k - 1, 3:] + rng.normal(0.0, sizes * np.sqrt(1.0 - keep**2))
        vx, vy, heading, *_, scale = truth[k]
        speed = np.hypot(vx, vy)
        samples[k, at.VX] = (1.0 + scale) * vx + rng.normal(0.0, noise.speed)
        if k % 10 == 0:
            samples[k, at.GNSS_SPEED] = speed + rng.normal(0.0, noise.gnss_velocity)
            samples[k, at.HEADING] = heading + rng.normal(0.0, noise.heading)
            samples[k, at.GNSS_COURSE] = (
                heading + np.arctan2(vy, vx) + rng.normal(0.0, noise.gnss_velocity) / speed
            )
    return samples, truth


def dynamic_case(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    noise, samples, truth = DYNAMIC_NOISE, turn(), np.zeros((STEPS, 3))
    car = GnssDynamicObserver(GOLF, noise).car
    samples[:, at.STEER] *= 0.8
    rolling = slip_of_rolling_rear(samples[0, at.STEER], 0.0, car.a, car.b)
    truth[0] = rng.normal(
        [samples[0, at.YAW_RATE], rolling, 0.0], [noise.yaw_rate, LOW_SPEED_STD, noise.disturbance]
    )
    keep = np.exp(-DT / noise.disturbance_time)
    assert stable_substeps(20.0, DT, car) == 1
    samples[:, at.AY] = 0.0  # only the friction margin would use it
    for k in range(1, STEPS):
        given = (20.0, samples[k, at.STEER], 0.0, 0.0, 0.0, 0.0, 0.0)
        rates, _, _ = single_track_rates(*truth[k - 1, :2], *given, car)
        motion = np.array([rates[0], rates[1] + truth[k - 1, 2]])
        shaken = rng.normal(0.0, np.sqrt(DT) * np.array([noise.yaw_acceleration, noise.slip_rate]))
        truth[k, :2] = truth[k - 1, :2] + DT * motion + shaken
        truth[k, 2] = keep * truth[k - 1, 2] + rng.normal(0.0, noise.disturbance * np.sqrt(1.0 - keep**2))
        _, (_, ay), _ = single_track_rates(*truth[k, :2], *given, car)
        samples[k, [at.YAW_RATE, at.AY]] = rng.normal([truth[k, 0], ay], [noise.yaw_rate, noise.ay])
        if k % 10 == 0:
            error = np.hypot(noise.gnss_velocity * np.cos(truth[k, 1]) / 20.0, noise.heading)
            samples[k, [at.HEADING, at.GNSS_COURSE]] = 1.0, 1.0 + rng.normal(truth[k, 1], error)
    return samples, truth


DYNAMIC_NOISE = GnssDynamicNoise(0.3, 0.05, 0.01, 0.3)
CASES = {
    "kinematic": (GnssKinematicKF(GOLF, GnssKinematicNoise(relaxation=0.0)), kinematic_case),
    "dynamic": (GnssDynamicObserver(GOLF, DYNAMIC_NOISE), dynamic_case),
}


@pytest.mark.parametrize("name", CASES)
def test_errors_are_as_large_as_the_filter_says(name) -> None:
    estimator, case = CASES[name]
    rng, taken = np.random.default_rng(5), range(40, STEPS, 50)
    nees, nis, measured = dict.fromkeys(taken, 0.0), 0.0, 0
    for _ in range(RUNS):
        samples, truth = case(rng)
        started = estimator.start(DT)
        for k, sample in enumerate(samples):
            _, _, part = estimator.step(started, sample)
            fixes = np.isfinite(sample[FIXES]).sum()
            if k > 10 and name == "kinematic":  # the first heading has the filter's own prior
                nis, measured = nis + part, measured + 1 + fixes
            elif k and name == "dynamic":
                nis, measured = nis + part, measured + 2 + fixes // 2
            if k in nees:
                error = truth[k] - started.state.mean
                nees[k] += error @ np.linalg.solve(started.state.cov, error)
    assert inside(nis, measured)
    assert all(inside(total, RUNS * truth.shape[1]) for total in nees.values())


def test_dynamic_observer_without_disturbance_and_fixes_is_the_dynamic_ekf() -> None:
    inputs, _ = drive("slalom")
    plain = GnssDynamicObserver(GOLF, GnssDynamicNoise(disturbance=0.0)).run(without(inputs, FIXES))
    ekf = DynamicEKF(GOLF).run(inputs)
    np.testing.assert_allclose(plain.beta, ekf.beta, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(plain.beta_std, ekf.beta_std, rtol=0.0, atol=1e-12)

"""Filters on the planar model: answers of filterpy and textbooks, the Kalman filter on linear models."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import (
    guarded_cholesky,
    joint_update,
    joseph_update,
    joseph_update_3,
    propagate_3,
    propagate_cov,
    triangular_factor,
)
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA, Estimate, Inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.filters.combined.cross_combined import CrossCombinedUKF, CrossNoise
from crosscomb.filters.kinematic.kf import KinematicNoise
from crosscomb.filters.planar.ckf import (
    HORIZON_PRIOR,
    LEAST_WEIGHT,
    CubatureHybridKF,
    CubatureRecedingHorizonKF,
    SqrtCubatureKF,
    cubature_points,
    predict_by_points,
    root_update,
)
from crosscomb.filters.planar.ekf import DoubleTrackEKF, FirstOrderEKF, IteratedEKF, ekf_update
from crosscomb.filters.planar.second_order_ekf import SecondOrderEKF
from crosscomb.filters.planar.shared import PlanarFilter, PlanarNoise, expect, planar_move, substeps
from crosscomb.filters.planar.ukf import (
    GeneralUKF,
    SigmaPoints,
    SimpleUKF,
    SimplexUKF,
    SphericalUKF,
    draw,
    general_points,
    moments,
    simple_points,
    simplex_points,
    spherical_points,
    update_by_points,
)
from crosscomb.filters.twins.table import TWINS
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.planar import Contacts, PlanarCar, contacts, planar_rates, set_contacts
from crosscomb.signals import MIN_SPEED
from drives import DT, GOLF, mirrored

FILTERS: dict[str, PlanarFilter] = {
    "first_order_ekf": FirstOrderEKF(GOLF),
    "double_track_ekf": DoubleTrackEKF(GOLF),
    "iterated_ekf": IteratedEKF(GOLF),
    "second_order_ekf": SecondOrderEKF(GOLF),
    "second_order_double_track": SecondOrderEKF(GOLF, track="double"),
    "simple_ukf": SimpleUKF(GOLF),
    "general_ukf": GeneralUKF(GOLF, alpha=0.9, kappa=0.5),
    "simplex_ukf": SimplexUKF(GOLF),
    "spherical_ukf": SphericalUKF(GOLF),
    "ukf_double_track": SimpleUKF(GOLF, track="double"),
    "sqrt_cubature_kf": SqrtCubatureKF(GOLF),
    "cubature_receding_horizon_kf": CubatureRecedingHorizonKF(GOLF, horizon=0.05),
    "cubature_hybrid_kf": CubatureHybridKF(GOLF, horizon=0.05),
}
TWIN_OF = {
    **{name: TWINS[name] for name in FILTERS if name in TWINS},
    "second_order_double_track": TWINS["second_order_ekf"],
    "ukf_double_track": TWINS["simple_ukf"],
}
each_filter = pytest.mark.parametrize("name", FILTERS)
SIGMA_POINTS = {
    "simple": simple_points(3),
    "general": general_points(3, 0.7, 1.0, 2.0),
    "simplex": simplex_points(3, 0.2),
    "spherical": spherical_points(3, 0.3),
}


def set_matched(
    contact: Contacts, sample: np.ndarray, state: np.ndarray, errors: np.ndarray, car: PlanarCar
) -> np.ndarray:
    """Set contacts, ax and ay so that they belong together: loads follow from what is measured.

    errors ``(2,)`` are those of measured ax and ay; gives the measurements without errors ``(6,)``.
    """
    ax = ay = 0.0
    for _ in range(12):
        set_contacts(
            contact, *sample[[at.STEER, at.STEER_REAR, at.FXF, at.FXR]], ax + errors[0], ay + errors[1], car
        )
        _, _, _, ax, ay = planar_rates(*state, contact, car)
    sample[[at.AX, at.AY]] = ax + errors[0], ay + errors[1]
    z = np.empty(6)
    expect(state, ax, ay, contact, z)
    return z


@cache
def own_drive(track: str, steps: int, steer: float = 0.03) -> tuple[Inputs, np.ndarray]:
    """Noiseless slalom of the planar model, started as the filters start, and its states ``(n, 3)``."""
    car = FirstOrderEKF(GOLF, track=track).car
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VFL :] = np.nan
    t = DT * np.arange(steps)
    samples[:, at.STEER] = 0.02 + steer * np.sin(2.5 * t)
    samples[:, at.STEER_REAR] = 0.1 * samples[:, at.STEER]
    samples[:, at.FXF] = samples[:, at.FXR] = 900.0 * np.cos(0.7 * t)
    beta = slip_of_rolling_rear(*samples[0, [at.STEER, at.STEER_REAR]], car.a, car.b)
    states = np.empty((steps, 3))
    states[0] = 18.0, 18.0 * np.tan(beta), 0.1
    contact, state = contacts(), states[0].copy()
    for k, sample in enumerate(samples):
        if k:
            # Loads belong to the sample at the end of the step; these are known once the state is.
            for _ in range(12):
                state = states[k - 1].copy()
                set_contacts(contact, *sample[[at.STEER, at.STEER_REAR, at.FXF, at.FXR, at.AX, at.AY]], car)
                planar_move(state, contact, substeps(states[k - 1], DT, car), DT, car)
                _, _, _, sample[at.AX], sample[at.AY] = planar_rates(*state, contact, car)
            states[k] = state
        z = set_matched(contact, sample, state, np.zeros(2), car) if k == 0 else measured(state, contact, car)
        sample[at.VFL], sample[at.VFR], sample[at.YAW_RATE], sample[at.VX] = z[0], z[1], z[2], z[5]
    return Inputs(DT, samples), states


def measured(state: np.ndarray, contact: Contacts, car: PlanarCar) -> np.ndarray:
    z = np.empty(6)
    _, _, _, ax, ay = planar_rates(*state, contact, car)
    expect(state, ax, ay, contact, z)
    return z


@cache
def rough_drive() -> Inputs:
    """Noisy slalom with gaps in every channel, a stop, reversing, and without wheel speeds in a part."""
    rng = np.random.default_rng(2)
    samples = own_drive("single", 600, 0.06)[0].samples.copy()
    columns = [at.VX, at.VFL, at.VFR, at.AX, at.AY, at.YAW_RATE]
    samples[:, columns] += rng.normal(0.0, [0.1, 0.2, 0.2, 0.3, 0.5, 0.01], (600, 6))
    samples[350:500, at.VFL : at.VFR + 1] = np.nan
    for column, held in (
        (at.AX, None),
        (at.AY, None),
        (at.YAW_RATE, None),
        (at.VFL, None),
        (at.VX, at.VX_HELD),
        (at.STEER, at.STEER_HELD),
    ):
        for begin in rng.integers(1, 560, 4):
            stop = begin + rng.integers(1, 30)
            if held is None:
                samples[begin:stop, column] = np.nan
            else:
                samples[begin:stop, column] = samples[begin - 1, column]
                samples[begin:stop, held] = 1.0
    samples[400:405, [at.AX, at.AY, at.YAW_RATE]] = np.nan
    samples[400:405, at.VX_HELD] = 1.0
    samples[250:270, at.VX] = 0.0
    samples[270:280, at.VX] = -2.0
    return Inputs(DT, samples)


def assert_same(first: Estimate, second: Estimate, tolerance: float) -> None:
    np.testing.assert_allclose(first.beta, second.beta, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(first.beta_std, second.beta_std, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(first.nis, second.nis, rtol=tolerance, atol=tolerance)


# Against filterpy and textbooks.


@pytest.mark.parametrize("name", TWIN_OF)
def test_kernels_agree_with_their_plain_twins(name: str) -> None:
    inputs = rough_drive()
    estimate = FILTERS[name].run(inputs)
    assert_same(estimate, TWIN_OF[name](FILTERS[name], inputs), 1e-8)
    assert np.isfinite(estimate.nis).mean() > 0.8
    assert np.ptp(estimate.beta) > np.radians(1.0), "a filter that stays where it is proves nothing"


def test_the_cubature_filter_is_the_simple_unscented_filter() -> None:
    inputs = rough_drive()
    assert_same(SqrtCubatureKF(GOLF).run(inputs), SimpleUKF(GOLF).run(inputs), 1e-9)


def test_one_iteration_is_the_first_order_filter_and_four_are_not() -> None:
    inputs = rough_drive()
    first = FirstOrderEKF(GOLF).run(inputs)
    np.testing.assert_array_equal(first.beta, IteratedEKF(GOLF, iterations=1).run(inputs).beta)
    assert np.abs(first.beta - IteratedEKF(GOLF).run(inputs).beta).max() > 1e-6


def test_the_iterated_filter_converges_to_the_most_likely_state() -> None:
    # A wide prior and sharp measurements, or the update would be linear; ay at half the grip bends.
    estimator = IteratedEKF(GOLF, noise=PlanarNoise(ay=0.2, ax=0.3, yaw_rate=0.02), iterations=60)
    first = replace(estimator, iterations=1)
    sample = own_drive("single", 200, 0.06)[0].samples[120]
    prior, cov = np.array([sample[at.VX], 1.5, sample[at.YAW_RATE]]), np.diag([0.3, 3.0, 0.2]) ** 2
    contact = contacts()
    given = sample[[at.STEER, at.STEER_REAR, at.FXF, at.FXR, at.AX, at.AY]]
    set_contacts(contact, *given, estimator.car)
    noise = estimator.noise
    z = sample[[at.VFL, at.VFR, at.YAW_RATE, at.AX, at.AY]]
    std = np.array([noise.wheel_speed, noise.wheel_speed, noise.yaw_rate, noise.ax, noise.ay])

    def cost(x: np.ndarray) -> float:
        misfit = (measured(x, contact, estimator.car)[:5] - z) / std
        return float(misfit @ misfit + (x - prior) @ np.linalg.solve(cov, x - prior))

    def updated(filter_: FirstOrderEKF) -> np.ndarray:
        state = filter_.make_state()
        state.mean[:], state.cov[:] = prior, cov
        set_contacts(state.contact, *given, filter_.car)
        ekf_update(state, sample, filter_.car, filter_.noise)
        return state.mean

    best = minimize(
        cost, prior, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 5000}
    ).x
    np.testing.assert_allclose(updated(estimator), best, atol=1e-5)
    assert np.abs(updated(first) - best).max() > 0.05


# Linear models: every filter is the Kalman filter.


@pytest.mark.parametrize("sigma", SIGMA_POINTS.values(), ids=SIGMA_POINTS)
def test_sigma_points_have_mean_zero_and_unit_covariance(sigma: SigmaPoints) -> None:
    assert sigma.mean_weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(sigma.mean_weights @ sigma.unit, 0.0, atol=1e-12)
    np.testing.assert_allclose((sigma.cov_weights * sigma.unit.T) @ sigma.unit, np.eye(3), atol=1e-12)


def linear_model(seed: int) -> tuple[np.ndarray, ...]:
    """x, P, F, Q, H, R and a measurement of which the fourth is missing."""
    rng = np.random.default_rng(seed)
    root, f, h = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(6, 3))
    q, r = np.diag(rng.uniform(0.1, 1.0, 3)), rng.uniform(0.1, 1.0, 6)
    z = rng.normal(size=6)
    z[3] = np.nan
    return rng.normal(size=3), root @ root.T, f, q, h, r, z


def kalman(x, p, f, q, h, r, z):  # type: ignore[no-untyped-def]
    """Textbook Kalman filter: mean, covariance, NIS and log-likelihood but for a constant."""
    there = np.isfinite(z)
    x, p, h = f @ x, f @ p @ f.T + q, h[there]
    s = h @ p @ h.T + np.diag(r[there])
    k = p @ h.T @ np.linalg.inv(s)
    y = z[there] - h @ x
    nis = y @ np.linalg.solve(s, y)
    return x + k @ y, p - k @ s @ k.T, nis, -0.5 * (nis + np.linalg.slogdet(s)[1])


@pytest.mark.parametrize("sigma", SIGMA_POINTS.values(), ids=SIGMA_POINTS)
@pytest.mark.parametrize("seed", range(3))
def test_unscented_filters_on_a_linear_model_are_the_kalman_filter(sigma: SigmaPoints, seed: int) -> None:
    x, p, f, q, h, r, z = linear_model(seed)
    mean, cov, factor = x.copy(), p.copy(), np.empty((6, 6))
    points = np.empty((len(sigma.unit), 3))
    draw(mean, cov, sigma, factor, points)
    moments(points @ f.T, sigma, q, mean, cov)
    draw(mean, cov, sigma, factor, points)
    scratch = np.empty((6, 6)), np.empty((6, 3)), np.empty(6), factor
    nis = update_by_points(mean, cov, points, points @ h.T, sigma, np.array([z, r]), *scratch)
    expected = kalman(x, p, f, q, h, r, z)
    np.testing.assert_allclose(mean, expected[0], atol=1e-10)
    np.testing.assert_allclose(cov, expected[1], atol=1e-10)
    assert nis == pytest.approx(expected[2])


@pytest.mark.parametrize("seed", range(3))
def test_the_cubature_filter_on_a_linear_model_is_the_kalman_filter(seed: int) -> None:
    x, p, f, q, h, r, z = linear_model(seed)
    mean, root, points, array = x.copy(), np.linalg.cholesky(p), np.empty((6, 3)), np.empty((9, 12))
    cubature_points(mean, root, points)
    predict_by_points(points @ f.T, np.sqrt(q), mean, root, array)
    cubature_points(mean, root, points)
    nis, likelihood = root_update(
        mean, root, points, points @ h.T, np.array([z, r]), array, np.empty((9, 9)), np.empty(6)
    )
    expected = kalman(x, p, f, q, h, r, z)
    np.testing.assert_allclose(mean, expected[0], atol=1e-10)
    np.testing.assert_allclose(root @ root.T, expected[1], atol=1e-10)
    assert (nis, likelihood) == (pytest.approx(expected[2]), pytest.approx(expected[3]))


@pytest.mark.parametrize("seed", range(3))
def test_dense_kernels_are_the_kalman_filter(seed: int) -> None:
    x, p, f, q, h, r, z = linear_model(seed)
    expected = kalman(x, p, f, q, h, r, z)
    there = np.flatnonzero(np.isfinite(z))
    loops, scalars = (x.copy(), p.copy()), (x.copy(), p.copy())
    propagate_cov(loops[1], f, q, np.empty((3, 3)))
    propagate_3(scalars[1], (f - np.eye(3)) / 0.1, 0.1, q)
    loops[0][:] = scalars[0][:] = f @ x
    nis = [
        (
            joseph_update(*loops, h[k], z[k] - h[k] @ loops[0], r[k], np.empty((2, 3))),
            joseph_update_3(*scalars, *h[k], z[k] - h[k] @ scalars[0], r[k]),
        )
        for k in there
    ]
    prior = f @ p @ f.T + q
    joint, s = (f @ x, prior.copy()), h[there] @ prior @ h[there].T + np.diag(r[there])
    nis_joint = joint_update(*joint, h[there] @ prior, s, z[there] - h[there] @ (f @ x), 5, np.empty((5, 5)))
    for mean, cov in (loops, scalars, joint):
        np.testing.assert_allclose(mean, expected[0], atol=1e-10)
        np.testing.assert_allclose(cov, expected[1], atol=1e-10)
    np.testing.assert_allclose([*np.sum(nis, axis=0), nis_joint], expected[2])


def test_triangular_factors() -> None:
    rng = np.random.default_rng(0)
    a, factor = rng.normal(size=(4, 9)), np.empty((4, 4))
    guarded_cholesky(a @ a.T, 4, factor)
    np.testing.assert_allclose(factor, np.linalg.cholesky(a @ a.T))
    triangular_factor(a.copy(), 4, 9, factor)
    np.testing.assert_allclose(factor, np.linalg.cholesky(a @ a.T))
    # A matrix without full rank, or not quite positive, still has a factor near it.
    for spoilt in (np.diag([1.0, 0.0, 2.0, 3.0]), np.diag([1.0, -1e-13, 2.0, 3.0])):
        guarded_cholesky(spoilt, 4, factor)
        np.testing.assert_allclose(factor @ factor.T, spoilt, atol=1e-11)
        assert np.all(np.diag(factor) > 0.0)


# On their own model.

SIGMA_POINT_FILTERS = [SimpleUKF, GeneralUKF, SimplexUKF, SphericalUKF, SqrtCubatureKF]
SURE = PlanarNoise(u_rate=1e-9, v_rate=1e-9, yaw_acceleration=1e-9)


@pytest.mark.parametrize("track", ["single", "double"])
@pytest.mark.parametrize("kind", [FirstOrderEKF, IteratedEKF, SecondOrderEKF, *SIGMA_POINT_FILTERS])
def test_no_error_on_noiseless_data_of_the_own_model(kind: type[PlanarFilter], track: str) -> None:
    inputs, states = own_drive(track, 400, 0.06)
    truth = np.arctan2(states[:, 1], states[:, 0])
    estimator = kind(GOLF, track=track, noise=SURE)
    started = estimator.start(DT)
    estimator.step(started, inputs.samples[0])
    state = started.state.ekf if kind is SecondOrderEKF else started.state
    # Sure of the truth: with a spread, curved models give another mean than the truth, rightly.
    state.mean[:] = states[0]
    state.cov[:] = 1e-18 * np.eye(3)
    if kind is SqrtCubatureKF:
        state.root[:] = 1e-9 * np.eye(3)
    beta = [estimator.step(started, sample)[0] for sample in inputs.samples[1:]]
    assert np.ptp(truth) > np.radians(1.0)
    np.testing.assert_allclose(beta, truth[1:], atol=1e-9)


@pytest.mark.parametrize("track", ["single", "double"])
def test_first_order_filter_started_at_the_truth_stays_there(track: str) -> None:
    inputs, states = own_drive(track, 400)
    estimate = FirstOrderEKF(GOLF, track=track).run(inputs)
    np.testing.assert_allclose(estimate.beta, np.arctan2(states[:, 1], states[:, 0]), atol=1e-9)


SHARP = PlanarNoise(0.3, 0.3, 0.3, 0.1, 0.1, 0.01, 0.3, 0.4)
RUNS, STEPS = 60, 121
INSTANTS = [0, 40, 80, 120]


@cache
def shaken_drives(track: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Drives of the model with white noise on its rates and its measurements: samples, and beta [rad]."""
    rng = np.random.default_rng(7)
    return [shaken_drive(rng, FirstOrderEKF(GOLF, noise=SHARP, track=track)) for _ in range(RUNS)]


def shaken_drive(
    rng: np.random.Generator, estimator: PlanarFilter, steps: int = STEPS, first_std: float = LOW_SPEED_STD
) -> tuple[np.ndarray, np.ndarray]:
    """One such drive; `first_std` [rad] is that of the first beta."""
    noise, car, contact = estimator.noise, estimator.car, contacts()
    samples, truth = np.zeros((steps, at.SAMPLE_WIDTH)), np.empty((steps, 3))
    samples[:, at.VFL :] = np.nan
    samples[:, at.STEER] = 0.02 + 0.01 * np.sin(4.0 * DT * np.arange(steps))
    rolling = slip_of_rolling_rear(samples[0, at.STEER], 0.0, car.a, car.b)
    samples[0, [at.VX, at.YAW_RATE]] = 20.0, 0.15
    at_start = np.array([20.0, 20.0 * np.tan(rolling), 0.15])
    truth[0] = rng.normal(at_start, [noise.speed, 20.0 * first_std, noise.yaw_rate])
    walk = np.sqrt(DT) * np.array([noise.u_rate, noise.v_rate, noise.yaw_acceleration])
    for k in range(1, steps):
        sample, errors, shake = samples[k], rng.normal(0.0, [noise.ax, noise.ay]), rng.normal(0.0, walk)
        for _ in range(4):  # loads follow from the measured accelerations, and these from the loads
            set_contacts(contact, *sample[[at.STEER, at.STEER_REAR, at.FXF, at.FXR, at.AX, at.AY]], car)
            truth[k] = truth[k - 1]
            planar_move(truth[k], contact, substeps(truth[k - 1], DT, car), DT, car)
            truth[k] += shake
            z = measured(truth[k], contact, car)
            sample[[at.AX, at.AY]] = z[3] + errors[0], z[4] + errors[1]
        sample[[at.VFL, at.VFR]] = z[:2] + rng.normal(0.0, noise.wheel_speed, 2)
        sample[at.YAW_RATE] = z[2] + rng.normal(0.0, noise.yaw_rate)
        sample[at.VX] = z[5]
    return samples, np.arctan2(truth[:, 1], truth[:, 0])


def consistency(
    estimator: PlanarFilter,
    first: int = 1,
    drives: list[tuple[np.ndarray, np.ndarray]] | None = None,
    instants: list[int] = INSTANTS,
) -> tuple[np.ndarray, float]:
    """Where in its chi-square distribution the NEES at instants and the NIS of samples from first on lie."""
    nees, nis, count = np.zeros(len(instants)), 0.0, 0
    for samples, beta in drives or shaken_drives(estimator.track):
        estimate = estimator.run(Inputs(DT, samples))
        nis += estimate.nis[first:].sum()
        count += 5 * len(estimate.nis[first:])
        nees += (((beta - estimate.beta) / estimate.beta_std) ** 2)[instants]
    return chi2.cdf(nees, RUNS), float(chi2.cdf(nis, count))


CONSISTENT = [name for name in FILTERS if not name.startswith("cubature")]


@pytest.mark.parametrize("name", CONSISTENT)
def test_errors_are_as_large_as_the_filter_says(name: str) -> None:
    nees, nis = consistency(replace(FILTERS[name], noise=SHARP))
    assert np.all((nees > 0.0005) & (nees < 0.9995)), nees
    assert 0.0005 < nis < 0.9995


def test_a_filter_that_is_too_sure_is_seen() -> None:
    nees, nis = consistency(FirstOrderEKF(GOLF, noise=SHARP._replace(v_rate=0.1, ay=0.2)))
    assert nees.max() > 0.9995
    assert nis > 0.9995


@pytest.mark.parametrize(("accel", "sure"), [(0.31, False), (0.03, True)])
def test_the_cross_combination_errs_no_more_than_it_says(accel: float, sure: bool) -> None:
    """Both members are right here; it counts their disagreement all the same and so overstates its error."""
    kinematic = KinematicNoise(accel=accel, ay_scale=0.0, accel_bias=1e-6, rolling=1e6, speed=0.05)
    noise = CrossNoise(kinematic=kinematic, dynamic=SHARP._replace(v_rate=0.03) if sure else SHARP)
    nees, _ = consistency(CrossCombinedUKF(GOLF, noise))
    assert nees[0] < 0.9995, "both start at one answer"
    assert np.any(nees[1:] > 0.9995) if sure else np.all(nees[1:] < 0.0005)


HORIZONS = pytest.mark.parametrize("kind", [CubatureRecedingHorizonKF, CubatureHybridKF])


@HORIZONS
def test_errors_within_the_first_horizon_are_as_large_as_the_filter_says(kind: type[PlanarFilter]) -> None:
    """Truth drawn from the prior of a horizon, on tyres that stay nearly linear over so wide a prior."""
    estimator = kind(GOLF.model_copy(update={"friction": 6.0}), noise=SHARP)
    rng = np.random.default_rng(7)
    drives = [shaken_drive(rng, estimator, 31, HORIZON_PRIOR) for _ in range(RUNS)]
    nees, nis = consistency(estimator, drives=drives, instants=[5, 10, 20, 30])
    assert np.all((nees > 0.0005) & (nees < 0.9995)), nees
    assert 0.0005 < nis < 0.9995


@HORIZONS
def test_errors_once_the_horizon_is_full_are_as_large_as_the_filter_says(kind: type[PlanarFilter]) -> None:
    nees, nis = consistency(kind(GOLF, noise=SHARP), first=31, instants=[40, 80, 120])
    assert np.all((nees > 0.0005) & (nees < 0.9995)), nees
    assert 0.0005 < nis < 0.9995


def test_a_horizon_that_is_too_sure_is_seen() -> None:
    wrong = CubatureRecedingHorizonKF(GOLF, noise=SHARP._replace(v_rate=0.1, ay=0.2))
    nees, nis = consistency(wrong, first=31, instants=[40, 80, 120])
    assert nees.max() > 0.9995
    assert nis > 0.9995


# What else users rely on.


@each_filter
def test_answers_are_finite_and_bounded_whatever_comes(name: str) -> None:
    rng = np.random.default_rng(5)
    wild = rough_drive().samples.copy()
    wild[:, at.AX : at.STEER] *= rng.uniform(0.0, 8.0, (len(wild), 3))
    wild[:, at.STEER] *= 6.0
    wild[:, [at.VFL, at.VFR]] *= rng.uniform(0.0, 2.0, (len(wild), 2))
    wild[300:320, at.VFL] = 0.0  # a locked wheel
    for samples in (rough_drive().samples, wild):
        estimate = FILTERS[name].run(Inputs(DT, samples))
        assert np.isfinite(estimate.beta).all()
        assert np.isfinite(estimate.beta_std).all()
        assert np.all(estimate.beta_std > 0.0)
        assert np.abs(estimate.beta).max() <= MAX_BETA + 1e-9
        assert np.isnan(estimate.nis[250:280]).all(), "nothing is updated at a stop"
        rolling = slip_of_rolling_rear(
            *samples[260, [at.STEER, at.STEER_REAR]], GOLF.cg_to_front_axle, GOLF.cg_to_rear_axle
        )
        assert estimate.beta[260] == rolling


@each_filter
def test_left_and_right_are_alike(name: str) -> None:
    estimate, other = FILTERS[name].run(rough_drive()), FILTERS[name].run(mirrored(rough_drive()))
    # Simplex points are not symmetric themselves.
    tolerance = 0.02 if "simplex" in name or "spherical" in name else 1e-9
    np.testing.assert_allclose(other.beta, -estimate.beta, atol=tolerance)


@each_filter
def test_measured_speed_stands_in_for_missing_wheel_speeds_only(name: str) -> None:
    samples = own_drive("single", 200)[0].samples.copy()
    estimator = FILTERS[name]
    speedless, other_speed = samples.copy(), samples.copy()
    other_speed[50:, at.VX] += 1.0
    # The speed of the first sample starts the horizon of the receding filters.
    same = estimator.run(Inputs(DT, other_speed)).beta[:60], estimator.run(Inputs(DT, samples)).beta[:60]
    if not name.startswith("cubature"):
        np.testing.assert_array_equal(*same)
    speedless[:, at.VFL :] = np.nan
    other_speed[:, at.VFL :] = np.nan
    heard = estimator.run(Inputs(DT, other_speed)).beta, estimator.run(Inputs(DT, speedless)).beta
    assert np.abs(heard[0] - heard[1])[60:].max() > 1e-4
    other_speed[50:, at.VX_HELD] = speedless[50:, at.VX_HELD] = 1.0
    held = estimator.run(Inputs(DT, other_speed)), estimator.run(Inputs(DT, speedless))
    if not name.startswith("cubature"):
        np.testing.assert_array_equal(held[0].beta, held[1].beta)


def test_the_receding_horizon_forgets_all_that_is_older() -> None:
    samples = own_drive("single", 300)[0].samples
    wrong = samples.copy()
    wrong[50:100, at.AY] += 4.0
    estimator = CubatureRecedingHorizonKF(GOLF, horizon=0.2)
    right, misled = estimator.run(Inputs(DT, samples)).beta, estimator.run(Inputs(DT, wrong)).beta
    assert np.abs(right - misled)[50:100].max() > np.radians(0.2)
    np.testing.assert_array_equal(right[121:], misled[121:])
    plain = SqrtCubatureKF(GOLF)
    assert (plain.run(Inputs(DT, samples)).beta != plain.run(Inputs(DT, wrong)).beta)[121:].any()


def test_the_hybrid_lies_between_its_parts_and_follows_the_likelier() -> None:
    inputs = rough_drive()
    hybrid = CubatureHybridKF(GOLF, horizon=0.1, memory=0.2)
    parts = (
        SqrtCubatureKF(GOLF).run(inputs).beta,
        CubatureRecedingHorizonKF(GOLF, horizon=0.1).run(inputs).beta,
    )
    beta = hybrid.run(inputs).beta
    assert np.all((beta >= np.minimum(*parts) - 1e-12) & (beta <= np.maximum(*parts) + 1e-12))
    # A plain filter too sure of a wrong state: the receding one takes over.
    started = hybrid.start(DT)
    samples = own_drive("single", 300)[0].samples
    for k, sample in enumerate(samples):
        *_, nis = hybrid.step(started, sample)
        if k == 100:
            before = started.state.weights[1]
            started.state.plain.mean[1] += 3.0
            started.state.plain.root[:] = 1e-3 * np.eye(3)
        if k == 105:
            assert started.state.weights[1] > max(0.9, before)
    assert started.state.weights.min() >= LEAST_WEIGHT
    assert nis >= 0.0


def test_catalogue_names_and_settings() -> None:
    for name, kind in {"double_track_ekf": DoubleTrackEKF, "simple_ukf": SimpleUKF}.items():
        assert CATALOGUE[name].load() is kind
    assert make_filter("iterated_ekf", GOLF, {"iterations": 2, "track": "double"}).car.wheels == 4
    with pytest.raises(UsageError, match="track"):
        make_filter("simple_ukf", GOLF, {"track": "triple"})
    for name, setting in (("simplex_ukf", "centre_weight"), ("spherical_ukf", "centre_weight")):
        with pytest.raises(UsageError, match="centre_weight"):
            make_filter(name, GOLF, {setting: 1.0}).start(DT)
    with pytest.raises(UsageError, match="alpha"):
        make_filter("general_ukf", GOLF, {"alpha": 0.0}).start(DT)
    assert own_drive("single", 400)[1][:, 0].min() > MIN_SPEED

"""What adaptive filters are made of: tyre laws and the single track with slopes by parameters, Kalman steps."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from crosscomb.filters.algebra.leading import consider_update, propagate_leading
from crosscomb.models import parameter_track as track_model
from crosscomb.models.single_track import single_track, single_track_rates
from crosscomb.models.tyres import (
    dugoff_by_capacity,
    dugoff_tyre,
    modified_dugoff_tyre,
    rational_parameters,
    rational_tyre,
)
from crosscomb.models.vehicle import load_vehicle

GOLF = load_vehicle("golf_gti_2018")


def slope_of(function, at: float, step: float = 1e-6) -> float:
    """Derivative as a central difference."""
    return (function(at + step) - function(at - step)) / (2.0 * step)


# --- tyre laws --------------------------------------------------------------------------------------------


def test_rational_tyre_is_the_printed_law_with_its_derivatives() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        alpha, c1, c2, mu, ratio = rng.uniform([-0.6, 0.001, 5e4, 0.2, 0.6], [0.6, 0.03, 6e5, 1.1, 1.4])
        force, slope, by_c1, by_c2 = rational_tyre(alpha, c1, c2, mu, ratio)
        assert force == pytest.approx(c2 * mu * ratio * alpha * c1 * (mu + 1) / (alpha**2 + c1 * (mu + 1)))
        assert slope == pytest.approx(
            slope_of(lambda a, p=(c1, c2, mu, ratio): rational_tyre(a, *p)[0], alpha), rel=1e-5
        )
        assert by_c1 == pytest.approx(
            slope_of(lambda c, a=alpha, p=(c2, mu, ratio): rational_tyre(a, c, *p)[0], c1, 1e-7), rel=1e-5
        )
        assert by_c2 == pytest.approx(force / c2)


@pytest.mark.parametrize("friction", [0.3, 0.9, 1.1])
def test_default_rational_parameters_keep_the_slope_and_the_peak_of_the_vehicle_file(friction: float) -> None:
    stiffness, load = 110e3, 9e3
    c1, c2 = rational_parameters(stiffness, friction, load)
    alpha = np.linspace(0.0, 1.0, 200_001)
    force = np.array([rational_tyre(a, c1, c2, friction, 1.0)[0] for a in alpha[::20]])
    assert rational_tyre(0.0, c1, c2, friction, 1.0)[1] == pytest.approx(stiffness)
    assert force.max() == pytest.approx(friction * load, rel=1e-6)
    # The published truck tyre: c1, c2 of its front axle have their slope and peak where the law says.
    truck_c1, truck_c2 = 0.01286, 486735.0
    assert rational_tyre(0.0, truck_c1, truck_c2, 1.0, 1.0)[1] == pytest.approx(truck_c2)


def test_modified_dugoff_has_the_given_slope_and_a_peak() -> None:
    stiffness, capacity, mu = 100e3, 8e3, 0.9
    law = lambda a: modified_dugoff_tyre(a, stiffness, capacity, mu)  # noqa: E731
    assert law(0.0)[1] == pytest.approx(stiffness)
    alphas = np.linspace(0.001, 1.2, 400)
    forces = np.array([law(a)[0] for a in alphas])
    peak = forces.argmax()
    assert 0.05 < alphas[peak] < 0.4, "plain Dugoff has no peak at all"
    assert 0.85 * capacity < forces[peak] < 1.1 * capacity
    assert (forces > 0.0).all()
    for alpha in (0.02, 0.1, 0.3, 0.6, 1.1):
        assert law(-alpha)[0] == -law(alpha)[0]
        assert law(alpha)[1] == pytest.approx(slope_of(lambda a: law(a)[0], alpha), rel=1e-5)


def test_dugoff_by_capacity_is_the_derivative() -> None:
    for alpha in (-0.5, -0.1, -0.01, 0.02, 0.08, 0.3):
        expected = slope_of(lambda c, a=alpha: dugoff_tyre(a, 100e3, c)[0], 6e3, 0.1)
        assert dugoff_by_capacity(alpha, 100e3, 6e3) == pytest.approx(expected, abs=1e-6)


# --- single track under parameters ------------------------------------------------------------------------


@pytest.mark.parametrize("law", [track_model.STIFFNESS, track_model.RATIONAL, track_model.FRICTION])
def test_slopes_by_state_and_parameters_are_derivatives(law: int) -> None:
    car = single_track(GOLF)
    first = track_model.first_parameters(law, car)
    slopes, unused, by = (
        np.zeros(track_model.SLOPES_SHAPE),
        np.zeros(track_model.SLOPES_SHAPE),
        np.zeros((4, 2)),
    )
    rng = np.random.default_rng(3)
    for _ in range(200):
        point = np.concatenate(
            [rng.uniform([-0.4, -1.0], [0.4, 1.0])[::-1], first * rng.uniform(0.6, 1.6, len(first))]
        )
        vx, steer, steer_rear = rng.uniform([4.0, -0.3, -0.1], [45.0, 0.3, 0.1])
        fxf, fxr, ax, ay = rng.uniform(-1.0, 1.0, 4) * [4e3, 4e3, 5.0, 5.0]
        rest = (vx, steer, steer_rear, fxf, fxr, ax, ay, law)

        def rates(x: np.ndarray, rest=rest) -> np.ndarray:
            return np.array(track_model.parameter_track_rates(x[0], x[1], *rest, x[2:], car, by, unused))

        track_model.parameter_track_rates(point[0], point[1], *rest, point[2:], car, by, slopes)
        steps = np.concatenate([[1e-6, 1e-6], 1e-6 * first])
        expected = np.stack(
            [(rates(point + s) - rates(point - s)) / (2.0 * s.max()) for s in np.diag(steps)], axis=1
        )
        found = slopes[:, [0, 1, *range(3, 3 + len(first))]]
        scale = np.abs(expected).max(axis=0) + 1e-12
        np.testing.assert_allclose(found / scale, expected / scale, atol=2e-5)


@pytest.mark.parametrize("law", ["linear", "dugoff"])
def test_parameters_of_the_file_give_the_single_track(law: str) -> None:
    car = single_track(GOLF, law)
    number = track_model.LAWS[law]
    slopes, by = np.zeros(track_model.SLOPES_SHAPE), np.zeros((4, 2))
    given = (0.4, 0.05, 18.0, 0.08, 0.01, 500.0, 800.0, 1.0, 6.0)
    found = track_model.parameter_track_rates(
        *given, number, track_model.first_parameters(number, car), car, by, slopes
    )
    (yaw_acceleration, beta_rate), (_, ay), jacobian = single_track_rates(*given, car)
    assert found == pytest.approx((yaw_acceleration, beta_rate, ay))
    assert slopes[:, 0] == pytest.approx(np.array(jacobian)[[0, 1, 3]])
    assert slopes[:, 1] == pytest.approx(np.array(jacobian)[[4, 5, 7]])


def test_lateral_acceleration_from_motion_is_that_of_the_forces() -> None:
    # Di Biase's u (beta_rate + r) is off by ax tan(beta) and by the angle; eq. 39 as corrected is exact.
    car = single_track(GOLF, "dugoff")
    yaw_rate, beta, vx = 0.5, -0.2, 15.0
    rates, (ax, ay), _ = single_track_rates(yaw_rate, beta, vx, 0.1, 0.0, -3000.0, -3000.0, -3.0, 4.0, car)
    found, by_beta, by_rate = track_model.lateral_acceleration(beta, yaw_rate, rates[1], vx, ax)
    assert found == pytest.approx(ay, rel=1e-12)
    assert abs(vx * (rates[1] + yaw_rate) - ay) > 0.3, "the printed form differs here"
    motion = track_model.lateral_acceleration
    assert by_beta == pytest.approx(
        slope_of(lambda b: motion(b, yaw_rate, rates[1], vx, ax)[0], beta), rel=1e-6
    )
    assert by_rate == pytest.approx(
        slope_of(lambda r: motion(beta, r, rates[1], vx, ax)[0], yaw_rate), rel=1e-6
    )


# --- steps with constant states behind --------------------------------------------------------------------


def test_leading_steps_are_the_kalman_filter() -> None:
    rng = np.random.default_rng(4)
    n, m = 6, 3
    root = rng.normal(size=(n, n))
    cov, rows = root @ root.T, rng.normal(size=(m, n))
    full = np.vstack([rows, np.eye(n)[m:]])
    found = cov.copy()
    propagate_leading(found, rows, np.empty((m, n)))
    np.testing.assert_allclose(found, full @ cov @ full.T, rtol=1e-12)

    kf = KalmanFilter(dim_x=n, dim_z=1)
    kf.x, kf.P, kf.H, kf.R = rng.normal(size=(n, 1)), cov.copy(), rng.normal(size=(1, n)), np.array([[0.3]])
    mean, found = kf.x[:, 0].copy(), cov.copy()
    consider_update(mean, found, kf.H[0], 1.7 - kf.H[0] @ mean, 0.3, n, np.empty(n), np.empty(n))
    kf.update(1.7)
    np.testing.assert_allclose(mean, kf.x[:, 0], rtol=1e-10)
    np.testing.assert_allclose(found, kf.P, rtol=1e-9, atol=1e-12)


def test_considered_states_stay_and_their_doubt_counts() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(5, 5))
    cov, h, r = root @ root.T, rng.normal(size=5), 0.2
    mean, found = np.zeros(5), cov.copy()
    consider_update(mean, found, h, 1.0, r, 3, np.empty(5), np.empty(5))
    gain = cov @ h / (h @ cov @ h + r)
    gain[3:] = 0.0
    left = np.eye(5) - np.outer(gain, h)
    np.testing.assert_allclose(found, left @ cov @ left.T + r * np.outer(gain, gain), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(mean, gain)
    np.testing.assert_array_equal(found[3:, 3:], cov[3:, 3:])


def test_the_truck_stands_on_the_published_tyres() -> None:
    """Di Biase 2020, table 1: c1 and c2 of the front and rear axle."""
    car = single_track(load_vehicle("heavy_truck_di_biase"))
    published = [0.01286, 486735.0, 0.00769, 622319.0]
    assert track_model.first_parameters(track_model.RATIONAL, car) == pytest.approx(published, rel=0.01)

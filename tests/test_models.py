"""Vehicle and tyre models: Jacobians, textbook formulas, limits and symmetry."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear, velocity_rates
from crosscomb.models.random_walk import random_walk_jacobian, random_walk_rates
from crosscomb.models.single_track import (
    FRICTION_MARGIN,
    SingleTrack,
    axle_loads,
    body_rates,
    single_track,
    single_track_rates,
    slip_angles,
    stable_substeps,
)
from crosscomb.models.tyres import MAX_SLIP_ANGLE, dugoff_tyre, lateral_capacity, linear_tyre
from crosscomb.models.vehicle import load_vehicle, shipped_vehicles
from crosscomb.signals import GRAVITY

GOLF = load_vehicle("golf_gti_2018")


def rates_and_measurements(state: np.ndarray, given: tuple, car: SingleTrack) -> np.ndarray:
    """Yaw acceleration, slip rate, ax and ay at a state (yaw_rate, beta)."""
    rates, measurements, _ = single_track_rates(*state, *given, car)
    return np.array([*rates, *measurements])


def jacobian_of(function, state: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Derivatives by the state, as central differences."""
    columns = [
        (function(state + step) - function(state - step)) / (2.0 * step[i])
        for i, step in enumerate(np.diag(steps))
    ]
    return np.stack(columns, axis=1)


def saturations(state: np.ndarray, given: tuple, car: SingleTrack) -> tuple[bool, bool]:
    """Tell of both axles whether they are beyond the linear part of Dugoff's law."""
    vx, steer, steer_rear, fxf, fxr, ax_load, ay_seen = given
    front, rear, *_ = slip_angles(*state, vx, steer, steer_rear, car.a, car.b)
    load_f, load_r = axle_loads(ax_load, car)
    friction = max(car.friction, FRICTION_MARGIN * math.hypot(ax_load, ay_seen) / GRAVITY)
    return (
        car.stiffness_front * abs(math.tan(front)) > 0.5 * lateral_capacity(friction, load_f, fxf),
        car.stiffness_rear * abs(math.tan(rear)) > 0.5 * lateral_capacity(friction, load_r, fxr),
    )


@pytest.mark.parametrize("tyre", ["linear", "dugoff"])
def test_single_track_jacobian_is_the_derivative_of_the_rates(tyre: str) -> None:
    car = single_track(GOLF, tyre)
    rng = np.random.default_rng(1)
    seen = set()
    for _ in range(300):
        state = rng.uniform([-1.2, -0.5], [1.2, 0.5])
        vx, steer, steer_rear = rng.uniform([4.0, -0.5, -0.1], [50.0, 0.5, 0.1])
        fxf, fxr, ax, ay = rng.uniform(-1.0, 1.0, 4) * [6e3, 6e3, 8.0, 9.0]
        given = (vx, steer, steer_rear, fxf, fxr, ax, ay)
        seen.add(saturations(state, given, car))
        _, _, jacobian = single_track_rates(*state, *given, car)
        expected = jacobian_of(lambda s, g=given: rates_and_measurements(s, g, car), state, np.full(2, 1e-6))
        np.testing.assert_allclose(np.reshape(jacobian, (2, 4)).T, expected, rtol=1e-6, atol=1e-5)
    assert len(seen) == 4, "the states must lie on both sides of saturation on each axle"


def test_random_walk_jacobian_is_the_derivative_of_the_rates() -> None:
    car = single_track(GOLF)
    rng = np.random.default_rng(2)
    jacobian = np.empty((4, 6))
    for _ in range(100):
        state = rng.uniform(-1.0, 1.0, 6) * [1.0, 0.8, 5e3, 5e3, 9e3, 9e3]
        vx, steer, steer_rear = rng.uniform([4.0, -0.5, -0.1], [50.0, 0.5, 0.1])
        random_walk_jacobian(state, vx, steer, steer_rear, car, jacobian)
        expected = jacobian_of(
            lambda s, g=(vx, steer, steer_rear): np.array(random_walk_rates(s, *g, car)),
            state,
            np.array([1e-4, 1e-5, 1.0, 1.0, 1.0, 1.0]),
        )
        np.testing.assert_allclose(jacobian, expected, rtol=1e-7, atol=1e-8)


def test_both_force_models_are_the_same_body() -> None:
    car = single_track(GOLF, "linear")
    yaw_rate, beta, vx, steer, steer_rear, fxf, fxr = 0.4, -0.1, 17.0, 0.06, -0.02, 900.0, -400.0
    front, rear, *_ = slip_angles(yaw_rate, beta, vx, steer, steer_rear, car.a, car.b)
    state = np.array(
        [yaw_rate, beta, fxf, fxr, car.stiffness_front * front, car.stiffness_rear * rear]
    )
    rates, measurements, _ = single_track_rates(yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, 0.0, 0.0, car)
    np.testing.assert_allclose(
        random_walk_rates(state, vx, steer, steer_rear, car), [*rates, *measurements], rtol=1e-12
    )


@pytest.mark.parametrize("vehicle", shipped_vehicles())
def test_linear_single_track_is_the_textbook_one(vehicle: str) -> None:
    """Mitschke and Wallentowitz 2014, chapter 20; the errata of Atheupe 2023, eq. 26 to 28."""
    car = single_track(load_vehicle(vehicle), "linear")
    m, iz, a, b, cf, cr = car[:6]
    vx = 22.0
    textbook = np.array(
        [
            [-(a**2 * cf + b**2 * cr) / (iz * vx), -(a * cf - b * cr) / iz],
            [-1.0 - (a * cf - b * cr) / (m * vx**2), -(cf + cr) / (m * vx)],
        ]
    )
    _, _, jacobian = single_track_rates(0.0, 0.0, vx, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    np.testing.assert_allclose(np.reshape(jacobian, (2, 4)).T[:2], textbook, rtol=1e-12)

    steer = 1e-5
    yaw_gain = vx / (a + b + m * (b * cr - a * cf) / (cf * cr * (a + b)) * vx**2)
    yaw_rate = yaw_gain * steer
    beta = yaw_rate * (b / vx - m * a * vx / (cr * (a + b)))
    rates, (_, ay), _ = single_track_rates(yaw_rate, beta, vx, steer, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    assert np.abs(rates).max() < 1e-8 * abs(yaw_rate * cf / m), "steady circle: nothing changes"
    assert ay == pytest.approx(vx * yaw_rate, rel=1e-8)


def test_forces_turn_and_push_the_body_as_newton_says() -> None:
    rng = np.random.default_rng(3)
    mass, inertia, a, b = 1400.0, 2100.0, 1.1, 1.5
    for _ in range(50):
        forces = rng.uniform(-8e3, 8e3, 4)
        vx, yaw_rate, beta, front, rear = rng.uniform([4, -1, -1, -0.5, -0.2], [50, 1, 1, 0.5, 0.2])
        fxf, fxr, fyf, fyr = forces
        result = body_rates(
            *forces, vx, yaw_rate, math.cos(front), math.sin(front), math.cos(rear), math.sin(rear),
            math.cos(beta), math.sin(beta), mass, inertia, a, b,
        )  # fmt: skip
        # In the plane as complex numbers, in the axes of the car: x + i y.
        force_f, force_r = complex(fxf, fyf) * np.exp(1j * front), complex(fxr, fyr) * np.exp(1j * rear)
        acceleration = (force_f + force_r) / mass
        moment = (np.conj(a) * force_f).imag + (np.conj(-b) * force_r).imag
        velocity = complex(vx, vx * math.tan(beta))
        slip_rate = ((acceleration - 1j * yaw_rate * velocity) / velocity).imag
        expected = [moment / inertia, slip_rate, acceleration.real, acceleration.imag]
        np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)


def test_signs_are_iso_8855() -> None:
    car = single_track(GOLF)
    straight = (0.0, 0.0, 20.0)
    (yaw, slip), (_, ay), _ = single_track_rates(*straight, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    assert yaw > 0.0, "steering left starts a left turn"
    assert slip > 0.0
    assert ay > 0.0
    (yaw, _), (_, ay), _ = single_track_rates(*straight, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0, car)
    assert yaw < 0.0, "the rear axle steered left turns the car right"
    assert ay > 0.0
    (yaw, slip), (_, ay), _ = single_track_rates(0.0, 0.05, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    assert ay < 0.0, "sliding left is resisted"
    assert slip < 0.0


@pytest.mark.parametrize("tyre", ["linear", "dugoff"])
def test_a_mirrored_car_mirrors_its_motion_exactly(tyre: str) -> None:
    car = single_track(GOLF, tyre)
    rng = np.random.default_rng(4)
    even, odd = [0, 3, 5, 6], [1, 2, 4, 7]  # of the Jacobian: yaw_r slip_r ax_r ay_r yaw_b slip_b ax_b ay_b
    for _ in range(50):
        yaw_rate, beta, steer, steer_rear = rng.uniform(-0.5, 0.5, 4)
        vx, fxf, fxr, ax, ay = rng.uniform([4, -5e3, -5e3, -8, -9], [50, 5e3, 5e3, 8, 9])
        rates, (ax_1, ay_1), jacobian = single_track_rates(
            yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay, car
        )
        mirrored, (ax_2, ay_2), other = single_track_rates(
            -yaw_rate, -beta, vx, -steer, -steer_rear, fxf, fxr, ax, -ay, car
        )
        assert (*mirrored, ax_2, ay_2) == (-rates[0], -rates[1], ax_1, -ay_1)
        del even, odd

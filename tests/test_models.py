"""Vehicle and tyre models: Jacobians, textbook formulas, limits and symmetry."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from crosscomb.models.kinematic import input_gain, rotation, slip_of_rolling_rear, slip_rate, velocity_rates
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
    front, rear, *_ = slip_angles(state[0], math.tan(state[1]), vx, steer, steer_rear, car.a, car.b)
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
    front, rear, *_ = slip_angles(yaw_rate, math.tan(beta), vx, steer, steer_rear, car.a, car.b)
    state = np.array([yaw_rate, beta, fxf, fxr, car.stiffness_front * front, car.stiffness_rear * rear])
    rates, measurements, _ = single_track_rates(
        yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, 0.0, 0.0, car
    )
    np.testing.assert_allclose(
        random_walk_rates(state, vx, steer, steer_rear, car), [*rates, *measurements], rtol=1e-12
    )


@pytest.mark.parametrize("vehicle", shipped_vehicles())
def test_linear_single_track_is_the_textbook_one(vehicle: str) -> None:
    """Rajamani 2012, section 2.3; what Atheupe 2023, eq. 26 to 28, would be without its misprints."""
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
        moment = a * force_f.imag - b * force_r.imag
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
    for _ in range(50):
        yaw_rate, beta, steer, steer_rear = rng.uniform(-0.5, 0.5, 4)
        vx, fxf, fxr, ax, ay = rng.uniform([4, -5e3, -5e3, -8, -9], [50, 5e3, 5e3, 8, 9])
        (yaw_acceleration, slip_rate), (model_ax, model_ay), jacobian = single_track_rates(
            yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay, car
        )
        rates, measurements, mirrored = single_track_rates(
            -yaw_rate, -beta, vx, -steer, -steer_rear, fxf, fxr, ax, -ay, car
        )
        assert rates == (-yaw_acceleration, -slip_rate)
        assert measurements == (model_ax, -model_ay)
        odd = np.array([1.0, 1.0, -1.0, 1.0] * 2)  # ax is even, its derivatives are odd
        np.testing.assert_array_equal(mirrored, odd * jacobian)


@pytest.mark.parametrize("vehicle", shipped_vehicles())
def test_euler_steps_are_stable_at_every_speed(vehicle: str) -> None:
    car = single_track(load_vehicle(vehicle), "linear")
    for vx in np.geomspace(3.01, 20.0, 30):  # beyond, an oversteering car may itself be unstable
        steps = stable_substeps(vx, 0.01, car)
        _, _, jacobian = single_track_rates(0.0, 0.0, vx, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
        modes = np.linalg.eigvals(np.eye(2) + 0.01 / steps * np.reshape(jacobian, (2, 4)).T[:2])
        assert np.abs(modes).max() < 1.0, vx
    assert stable_substeps(30.0, 0.01, car) == 1
    assert stable_substeps(3.01, 0.05, car) > 1


def test_friction_is_at_least_what_the_car_plainly_uses() -> None:
    icy = single_track(GOLF.model_copy(update={"friction": 0.2}))
    sliding = (0.0, -0.3, 20.0, 0.3, 0.0, 0.0, 0.0)
    _, (_, ay_unseen), unseen = single_track_rates(*sliding, 0.0, 0.0, icy)
    _, (_, ay_seen), jacobian = single_track_rates(*sliding, 0.0, 8.0, icy)
    assert ay_unseen < 0.2 * GRAVITY
    assert 8.0 < ay_seen < FRICTION_MARGIN * 8.0, "the tyres can give what was measured"
    assert abs(jacobian[7]) > 10.0 * abs(unseen[7]), "and ay still tells of beta"
    _, quiet, _ = single_track_rates(*sliding, 0.0, 1.0, icy)
    assert quiet[1] == ay_unseen, "a small ay does not lower the friction of the vehicle file"


def test_axle_loads_carry_the_weight_and_shift_with_acceleration() -> None:
    car = single_track(GOLF)
    weight = car.mass * GRAVITY
    for ax in (-9.0, 0.0, 5.0):
        front, rear = axle_loads(ax, car)
        assert front + rear == pytest.approx(weight)
        # Moments about the contact of the front axle: weight at a, inertia force at cg_height.
        assert rear * (car.a + car.b) == pytest.approx(weight * car.a + car.mass * ax * car.cg_height)
    assert min(axle_loads(60.0, car)) > 0.0, "an axle in the air would divide by zero"


def test_dugoff_is_linear_for_small_slip() -> None:
    force, slope = dugoff_tyre(1e-4, 80e3, 5e3)
    expected, stiffness = linear_tyre(1e-4, 80e3)
    assert force == pytest.approx(expected, rel=1e-7)
    assert slope == pytest.approx(stiffness, rel=1e-7)


def test_dugoff_is_smooth_odd_and_bounded_by_its_capacity() -> None:
    stiffness, capacity = 80e3, 5e3
    right = np.linspace(1e-3, 1.4, 1401)
    angles = np.concatenate([-right[::-1], right])
    force, slope = np.array([dugoff_tyre(angle, stiffness, capacity) for angle in angles]).T
    np.testing.assert_array_equal(force, -force[::-1])
    assert np.all(np.diff(force) > 0.0)
    assert 0.98 * capacity < force.max() < capacity
    numeric = [
        (dugoff_tyre(x + 1e-7, stiffness, capacity)[0] - dugoff_tyre(x - 1e-7, stiffness, capacity)[0]) / 2e-7
        for x in angles
    ]
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=0.1)

    at_break = math.atan(0.5 * capacity / stiffness)
    below, above = (dugoff_tyre(at_break + d, stiffness, capacity) for d in (-1e-12, 1e-12))
    assert below[0] == pytest.approx(0.5 * capacity, rel=1e-9)
    assert above == pytest.approx(below, rel=1e-9)


def test_dugoff_pushes_the_right_way_even_backwards() -> None:
    beyond, _ = dugoff_tyre(math.radians(120.0), 80e3, 5e3)
    assert beyond == dugoff_tyre(MAX_SLIP_ANGLE, 80e3, 5e3)[0] > 0.0
    assert dugoff_tyre(math.radians(-120.0), 80e3, 5e3)[0] == -beyond


def test_lateral_capacity_is_the_rest_of_the_friction_circle() -> None:
    assert lateral_capacity(0.8, 5000.0, 0.0) == pytest.approx(4000.0)
    assert lateral_capacity(0.8, 5000.0, -2400.0) == pytest.approx(3200.0)
    assert lateral_capacity(0.8, 5000.0, 9000.0) == pytest.approx(400.0), "a locked wheel keeps a tenth"


@pytest.mark.parametrize("yaw_rate", [0.0, 1e-9, 0.009, 0.011, -0.4, 2.5])
def test_kinematic_step_is_the_exact_solution(yaw_rate: float) -> None:
    dt = 0.01
    # Columns: what vx, vy, ax and ay each contribute to the rates.
    rates = np.array([velocity_rates(*unit[:2], yaw_rate, *unit[2:]) for unit in np.eye(4)]).T
    exact = expm(dt * np.vstack([rates, np.zeros((2, 4))]))[:2]
    np.testing.assert_allclose(np.reshape(rotation(yaw_rate, dt), (2, 2)), exact[:, :2], rtol=1e-12)
    np.testing.assert_allclose(
        np.reshape(input_gain(yaw_rate, dt), (2, 2)), exact[:, 2:], rtol=1e-7, atol=1e-14
    )


def test_kinematic_model_keeps_a_steady_circle() -> None:
    """A point that moves on a circle: constant velocity in the car's axes, acceleration square to it."""
    vx, vy, yaw_rate = 20.0, -2.0, 0.4
    assert velocity_rates(vx, vy, yaw_rate, -yaw_rate * vy, yaw_rate * vx) == (0.0, 0.0)


def test_the_slip_changes_as_the_lateral_velocity_does_over_the_speed():
    for vx, yaw_rate, ay in ((20.0, 0.3, 4.0), (5.0, -0.5, -2.5), (30.0, 0.0, 1.0)):
        assert slip_rate(vx, yaw_rate, ay) == pytest.approx(
            velocity_rates(vx, 0.0, yaw_rate, 0.0, ay)[1] / vx
        )


@pytest.mark.parametrize(("front", "rear"), [(0.3, 0.0), (0.3, -0.1), (-0.2, -0.2), (0.0, 0.0)])
def test_rolling_slip_angle_moves_both_axles_along_their_wheels(front: float, rear: float) -> None:
    a, b = 1.2, 1.5
    beta = slip_of_rolling_rear(front, rear, a, b)
    yaw_per_speed = (math.tan(front) - math.tan(rear)) / (a + b)  # yaw rate over vx
    assert math.tan(beta) + a * yaw_per_speed == pytest.approx(math.tan(front))
    assert math.tan(beta) - b * yaw_per_speed == pytest.approx(math.tan(rear))

"""Planar model and Magic Formula: the printed equations, derivatives, limits and symmetry."""

import math

import numpy as np
import pytest

from crosscomb.models.magic_formula import (
    combined_slip_weight,
    magic_formula,
    magic_formula_bend,
    peak_friction,
)
from crosscomb.models.planar import (
    PEAK,
    STIFFNESS,
    TRACKS,
    Contacts,
    PlanarCar,
    contacts,
    planar_car,
    planar_hessian,
    planar_jacobian,
    planar_rates,
    set_contacts,
)
from crosscomb.models.single_track import axle_loads
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import GRAVITY

GOLF = load_vehicle("golf_gti_2018")
B, C, D, E = 12.0, 1.4, 5000.0, -0.3
each_track = pytest.mark.parametrize("track", TRACKS)


def drawn(rng: np.random.Generator, car: PlanarCar, contact: Contacts) -> tuple[np.ndarray, np.ndarray]:
    """A random state, and the given values of random contacts (steer, steer_rear, fxf, fxr, ax, ay)."""
    given = rng.normal(0.0, [0.15, 0.04, 2500.0, 2500.0, 2.0, 4.0])
    set_contacts(contact, *given, car)
    return np.array([rng.uniform(5.0, 40.0), 3.0 * rng.normal(), 0.5 * rng.normal()]), given


# Tyre.


def test_magic_formula_starts_with_bcd_and_peaks_at_d() -> None:
    assert magic_formula(0.0, B, C, D, E) == (0.0, pytest.approx(B * C * D))
    slips = np.linspace(-0.5, 0.5, 20001)
    forces = np.array([magic_formula(slip, B, C, D, E)[0] for slip in slips])
    assert forces.max() == pytest.approx(D, rel=1e-6)
    np.testing.assert_allclose(forces, -forces[::-1])
    assert np.all(forces[slips > 1e-9] > 0.0), "ISO: a positive slip angle gives a positive force"


@pytest.mark.parametrize("slip", [-0.3, -0.05, 0.0, 0.02, 0.1, 0.4, 1.2])
def test_magic_formula_derivatives(slip: float) -> None:
    step = 1e-5
    (low, slope_low), (high, slope_high) = (magic_formula(slip + s, B, C, D, E) for s in (-step, step))
    slope, bend = magic_formula_bend(slip, B, C, D, E)
    assert slope == pytest.approx(magic_formula(slip, B, C, D, E)[1], rel=1e-12)
    assert slope == pytest.approx((high - low) / (2 * step), rel=1e-6, abs=1e-3)
    assert bend == pytest.approx((slope_high - slope_low) / (2 * step), rel=1e-5, abs=1e-1)


@pytest.mark.parametrize("curvature", [-0.5, 0.0, 0.6])
@pytest.mark.parametrize("slip", [0.0, 0.01, 0.05])
def test_combined_slip_weight_is_the_friction_circle(slip: float, curvature: float) -> None:
    share = magic_formula(slip, B, C, 1.0, curvature)[0]
    weight = combined_slip_weight(slip, B, C, curvature)
    assert weight == pytest.approx(math.sqrt(1.0 - share * share))
    assert combined_slip_weight(-slip, B, C, curvature) == weight


@each_track
def test_tyres_have_the_stiffness_and_friction_of_the_vehicle_file(track: str) -> None:
    car, contact = planar_car(GOLF, track), contacts()
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    wheels = contact.wheels[: car.wheels]
    slopes = wheels[:, STIFFNESS] * car.shape * wheels[:, PEAK]
    front = slopes[: car.wheels // 2].sum(), slopes[car.wheels // 2 :].sum()
    assert front == pytest.approx((GOLF.cornering_stiffness_front, GOLF.cornering_stiffness_rear))
    assert wheels[:, PEAK].sum() == pytest.approx(GOLF.friction * GOLF.mass * GRAVITY)


def test_load_makes_a_tyre_stronger_by_less_than_its_share() -> None:
    car, contact = planar_car(GOLF, "double"), contacts()
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    level = contact.wheels[:, PEAK].copy()
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0, car)
    turning = contact.wheels[:, PEAK]
    # A left turn loads the right wheels; friction mu = a1 Fz + a2 falls there, and the axle loses grip.
    assert np.all(turning[[1, 3]] > level[[1, 3]])
    assert np.all(turning[[0, 2]] < level[[0, 2]])
    assert turning.sum() < level.sum()
    rest = 0.5 * axle_loads(0.0, car)[0]
    transfer = car.roll_share_front * car.mass * 4.0 * car.cg_height / (2.0 * car.half_track_front)
    a1, a2 = -car.friction * car.load_sensitivity / rest, car.friction * (1.0 + car.load_sensitivity)
    assert turning[1] == pytest.approx(peak_friction(rest + transfer, a1, a2) * (rest + transfer))


@each_track
def test_friction_in_use_is_never_below_what_the_car_plainly_uses(track: str) -> None:
    car, contact = planar_car(GOLF, track)._replace(friction=0.3, load_sensitivity=0.0), contacts()
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    slope = contact.wheels[:, STIFFNESS] * contact.wheels[:, PEAK]
    set_contacts(contact, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, car._replace(cg_height=1e-9))
    wheels = contact.wheels
    assert wheels[: car.wheels, PEAK].sum() == pytest.approx(1.2 * 8.0 * car.mass)
    np.testing.assert_allclose(wheels[:, STIFFNESS] * wheels[:, PEAK], slope)


# Motion.


def lateral(wheels: np.ndarray, car: PlanarCar, i: int, slip: float) -> float:
    return magic_formula(slip, wheels[i, STIFFNESS], car.shape, wheels[i, PEAK], car.curvature)[0]


def test_single_track_is_the_printed_one() -> None:
    """D'Inverno 2021, eq. 11 and 14, slip angles in ISO signs; written anew."""
    rng, car, contact = np.random.default_rng(0), planar_car(GOLF), contacts()
    for _ in range(50):
        (u, v, r), (d, _, x1, x2, ax, ay) = drawn(rng, car, contact)
        set_contacts(contact, d, 0.0, x1, x2, ax, ay, car)
        side = v + r * car.a
        front = (side * np.cos(d) - u * np.sin(d)) / abs(u * np.cos(d) + side * np.sin(d))
        y1 = lateral(contact.wheels, car, 0, -np.arctan(front))
        y2 = lateral(contact.wheels, car, 1, -np.arctan((v - r * car.b) / abs(u)))
        expected_ax = (x1 * np.cos(d) - y1 * np.sin(d) + x2) / car.mass
        expected_ay = (y1 * np.cos(d) + x1 * np.sin(d) + y2) / car.mass
        r_dot = (y1 * car.a * np.cos(d) + x1 * car.a * np.sin(d) - y2 * car.b) / car.yaw_inertia
        expected = v * r + expected_ax, -u * r + expected_ay, r_dot, expected_ax, expected_ay
        np.testing.assert_allclose(planar_rates(u, v, r, contact, car), expected, atol=1e-9)


def test_double_track_is_the_printed_one() -> None:
    """Pieralice 2018, eq. 1, with slip angles from the velocity of each contact; written anew."""
    rng, car, contact = np.random.default_rng(1), planar_car(GOLF, "double"), contacts()
    h1, h2 = car.half_track_front, car.half_track_rear
    for _ in range(50):
        (u, v, r), (d, _, xf, xr, ax, ay) = drawn(rng, car, contact)
        set_contacts(contact, d, 0.0, xf, xr, ax, ay, car)
        places = [(car.a, h1, d), (car.a, -h1, d), (-car.b, h2, 0.0), (-car.b, -h2, 0.0)]
        slips = [angle - np.arctan2(v + r * x, u - r * y) for x, y, angle in places]
        y11, y12, y21, y22 = (lateral(contact.wheels, car, i, slip) for i, slip in enumerate(slips))
        x11 = x12 = 0.5 * xf
        x21 = x22 = 0.5 * xr
        c, s = np.cos(d), np.sin(d)
        expected_ax = (x11 * c + x12 * c + x21 + x22 - y11 * s - y12 * s) / car.mass
        expected_ay = (y11 * c + y12 * c + y21 + y22 + x11 * s + x12 * s) / car.mass
        moment = (y11 * c + y12 * c + x11 * s + x12 * s) * car.a - (y21 + y22) * car.b
        moment += (x12 * c - x11 * c) * h1 + (x22 - x21) * h2 + (y11 * s - y12 * s) * h1
        expected = (
            expected_ax + v * r,
            expected_ay - u * r,
            moment / car.yaw_inertia,
            expected_ax,
            expected_ay,
        )
        np.testing.assert_allclose(planar_rates(u, v, r, contact, car), expected, atol=1e-9)


def test_a_double_track_without_width_and_height_is_a_single_track() -> None:
    rng, one, two = np.random.default_rng(2), contacts(), contacts()
    flat = {"half_track_front": 1e-9, "half_track_rear": 1e-9, "cg_height": 0.0}
    single, double = (planar_car(GOLF, track)._replace(**flat) for track in TRACKS)
    for _ in range(50):
        state, given = drawn(rng, single, one)
        set_contacts(two, *given, double)
        np.testing.assert_allclose(
            planar_rates(*state, two, double), planar_rates(*state, one, single), rtol=1e-7, atol=1e-9
        )


@each_track
def test_jacobian_and_hessian_are_the_derivatives(track: str) -> None:
    rng, car, contact = np.random.default_rng(3), planar_car(GOLF, track), contacts()
    jacobian, hessian, ahead, behind = (
        np.empty((5, 3)),
        np.empty((5, 3, 3)),
        np.empty((5, 3)),
        np.empty((5, 3)),
    )
    largest = 0.0
    for _ in range(100):
        state, _ = drawn(rng, car, contact)
        assert planar_jacobian(*state, contact, car, jacobian) == planar_rates(*state, contact, car)
        planar_hessian(*state, contact, car, hessian)
        for k, step in enumerate(1e-5 * np.eye(3)):
            high = planar_jacobian(*(state + step), contact, car, ahead)
            low = planar_jacobian(*(state - step), contact, car, behind)
            np.testing.assert_allclose(jacobian[:, k], (np.array(high) - low) / 2e-5, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(hessian[:, :, k], (ahead - behind) / 2e-5, rtol=1e-5, atol=1e-5)
        largest = max(largest, np.abs(hessian[3:]).max())
    assert largest > 1.0, "tyres that do not bend prove nothing"


@each_track
def test_left_and_right_are_alike(track: str) -> None:
    rng, car, contact = np.random.default_rng(4), planar_car(GOLF, track), contacts()
    for _ in range(20):
        (u, v, r), (d, e, xf, xr, ax, ay) = drawn(rng, car, contact)
        rates = planar_rates(u, v, r, contact, car)
        set_contacts(contact, -d, -e, xf, xr, ax, -ay, car)
        mirrored = planar_rates(u, -v, -r, contact, car)
        np.testing.assert_allclose(np.array(mirrored) * [1, -1, -1, 1, -1], rates, atol=1e-9)


def test_wheel_speeds_are_those_of_a_rigid_body() -> None:
    car, contact = planar_car(GOLF), contacts()
    u, v, r, steer = 20.0, -0.7, 0.5, 0.1
    set_contacts(contact, steer, 0.0, 0.0, 0.0, 0.0, 0.0, car)
    heading = np.array([math.cos(steer), math.sin(steer)])
    for row, y in zip(contact.speed_rows, (car.half_track_front, -car.half_track_front), strict=True):
        assert row @ [u, v, r] == pytest.approx(heading @ [u - r * y, v + r * car.a])
    left, right = contact.speed_rows @ [u, v, r]
    assert right > left, "the outer wheel of a left turn is the faster one"

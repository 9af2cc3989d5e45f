"""The simulation plant obeys the physics a vehicle-dynamics engineer would check first."""

import numpy as np
import pytest

from crosscomb.models.plant import (
    BRAKE,
    DRIVE_COMMAND,
    FRICTION,
    INPUTS,
    ROLL,
    SPIN,
    STATES,
    STEER_COMMAND,
    VX,
    VY,
    YAW_RATE,
    PlantParameters,
    make_plant,
    step,
    wheel_loads,
)
from crosscomb.models.tyres_combined import combined_forces
from crosscomb.models.vehicle import Plant, Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.driver import start, understeer

CAR = Vehicle(
    name="test car",
    mass=1400.0,
    yaw_inertia=2200.0,
    cg_to_front_axle=1.1,
    cg_to_rear_axle=1.5,
    cg_height=0.53,
    track_front=1.52,
    track_rear=1.50,
    wheel_radius=0.31,
    steering_ratio=16.0,
    cornering_stiffness_front=95e3,
    cornering_stiffness_rear=120e3,
    roll_gradient=0.007,
)


def drive(
    p: PlantParameters,
    speed: float,
    steer: float = 0.0,
    torque: float = 0.0,
    brake: float = 0.0,
    friction: float = 0.9,
    seconds: float = 10.0,
    dt: float = 0.001,
) -> np.ndarray:
    """States every 10 ms under constant inputs."""
    x, work, u = start(speed, p), np.zeros((4, STATES)), np.zeros(INPUTS)
    u[STEER_COMMAND], u[DRIVE_COMMAND], u[BRAKE], u[FRICTION] = steer, torque, brake, friction
    out = np.empty((round(seconds / 0.01), STATES))
    for row in out:
        row[:] = x
        for _ in range(round(0.01 / dt)):
            step(x, u, p, dt, work)
    return out


def test_tyre_has_the_stiffness_of_the_vehicle_file():
    p = make_plant(CAR)
    for tyre, axle in (
        (p.tyre_front, CAR.cornering_stiffness_front),
        (p.tyre_rear, CAR.cornering_stiffness_rear),
    ):
        _, force = combined_forces(0.0, 1e-6, tyre.load, 0.9, tyre)
        assert 2.0 * force / 1e-6 == pytest.approx(axle, rel=1e-4)


def test_tyre_force_never_exceeds_friction():
    tyre = make_plant(CAR).tyre_front
    for slip_x in np.linspace(-1.0, 1.0, 21):
        for slip_y in np.linspace(-2.0, 2.0, 41):
            force = np.hypot(*combined_forces(slip_x, slip_y, tyre.load, 0.5, tyre))
            assert force <= 0.5 * tyre.load * (1.0 + 1e-12)


def test_tyre_peak_is_friction_times_load():
    tyre = make_plant(CAR).tyre_front
    peak = max(combined_forces(0.0, slip, tyre.load, 0.8, tyre)[1] for slip in np.linspace(0.0, 1.0, 1001))
    assert peak == pytest.approx(0.8 * tyre.load, rel=1e-4)


def test_braking_takes_lateral_force_from_the_tyre():
    tyre = make_plant(CAR).tyre_front
    free = combined_forces(0.0, 0.1, tyre.load, 0.9, tyre)[1]
    braked = combined_forces(-0.3, 0.1, tyre.load, 0.9, tyre)[1]
    assert 0.0 < braked < 0.6 * free


def test_car_at_rest_stays_at_rest():
    states = drive(make_plant(CAR), 0.0, steer=0.3, brake=2000.0, seconds=5.0)
    assert np.all(states[:, :18] == 0.0)


@pytest.mark.parametrize(
    ("speed", "steer", "torque", "brake"),
    [(20.0, 0.04, 200.0, 0.0), (25.0, 0.2, 0.0, 0.0), (25.0, 0.05, 0.0, 4000.0)],
)
def test_mirrored_steering_gives_mirrored_motion(speed, steer, torque, brake):
    p = make_plant(CAR)
    left = drive(p, speed, steer, torque, brake)
    right = drive(p, speed, -steer, torque, brake)
    assert np.abs(left[:, VY]).max() > 0.1
    for column, sign in ((VX, 1.0), (VY, -1.0), (YAW_RATE, -1.0), (ROLL, -1.0)):
        np.testing.assert_allclose(left[:, column], sign * right[:, column], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(left[:, SPIN], right[:, SPIN + 1], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "steer", "torque", "brake", "friction"),
    [
        (20.0, 0.06, 300.0, 0.0, 0.9),
        (25.0, 0.2, 0.0, 0.0, 0.9),
        (25.0, 0.05, 0.0, 3000.0, 0.9),
        (15.0, 0.1, 500.0, 0.0, 0.3),
    ],
)
def test_half_the_step_changes_nothing(speed, steer, torque, brake, friction):
    p = make_plant(CAR)
    whole = drive(p, speed, steer, torque, brake, friction)
    half = drive(p, speed, steer, torque, brake, friction, dt=0.0005)
    moving = np.hypot(whole[:, VX], whole[:, VY]) > 1.0
    beta, beta_half = (np.degrees(np.arctan2(s[moving, VY], s[moving, VX])) for s in (whole, half))
    assert np.abs(beta).max() > 0.3
    assert np.abs(beta - beta_half).max() < 0.01


@pytest.mark.parametrize("steer", [0.0, 0.05, 0.3])
def test_energy_does_not_grow_when_coasting(steer):
    p = make_plant(CAR)
    states = drive(p, 25.0, steer)
    energy = (
        0.5 * p.mass * (states[:, VX] ** 2 + states[:, VY] ** 2)
        + 0.5 * p.yaw_inertia * states[:, YAW_RATE] ** 2
    )
    energy += 0.5 * p.wheel_inertia * np.sum(states[:, SPIN : SPIN + 4] ** 2, axis=1)
    # Tyres are springs (relaxation): what they hold is given back, a millionth of the whole.
    assert np.diff(energy).max() < 1e-6 * energy[0]
    assert energy[-1] < 0.95 * energy[0]


@pytest.mark.parametrize("speed", [8.0, 15.0, 25.0])
def test_steady_yaw_gain_is_that_of_the_linear_single_track(speed):
    p = make_plant(CAR.model_copy(update={"plant": Plant(drag_area=0.0)}))
    linear = speed / (CAR.wheelbase + understeer(p) * speed**2)
    steer = 0.5 / (linear * speed)
    # The torque balances rolling resistance, so that the speed stays.
    state = drive(p, speed, steer, torque=0.012 * p.mass * GRAVITY * p.wheel_radius, seconds=4.0)[-1]
    gain = state[YAW_RATE] / steer
    at_speed = state[VX] / (CAR.wheelbase + understeer(p) * state[VX] ** 2)
    assert gain == pytest.approx(at_speed, rel=0.02)


@pytest.mark.parametrize("friction", [0.3, 0.6, 0.95])
def test_lateral_acceleration_is_bounded_by_friction(friction):
    p = make_plant(CAR)
    states = drive(p, 25.0, 0.15, torque=200.0, friction=friction)
    ay = np.gradient(states[:, VY], 0.01) + states[:, VX] * states[:, YAW_RATE]
    assert np.abs(ay).max() < 1.03 * friction * GRAVITY
    assert np.abs(ay).max() > 0.8 * friction * GRAVITY


def test_wheel_loads_carry_the_weight():
    p = make_plant(CAR)
    x = start(20.0, p)
    assert sum(wheel_loads(x, p)) == pytest.approx(p.mass * GRAVITY)
    x[ROLL] = 8.0
    left_front, right_front, left_rear, right_rear = wheel_loads(x, p)
    assert left_front + right_front + left_rear + right_rear == pytest.approx(p.mass * GRAVITY)
    # A left turn loads the right wheels; the moment is m h ay.
    moment = 0.5 * CAR.track_front * (right_front - left_front) + 0.5 * CAR.track_rear * (
        right_rear - left_rear
    )
    assert moment == pytest.approx(p.mass * p.cg_height * 8.0)


def test_full_braking_stops_near_the_friction_limit():
    p = make_plant(CAR)
    states = drive(p, 25.0, brake=8000.0, friction=0.9)
    distance = states[-1, 3]
    ideal = 25.0**2 / (2.0 * 0.9 * GRAVITY)
    assert abs(states[-1, VX]) < 0.01
    assert ideal < distance < 1.25 * ideal


def test_anti_lock_keeps_the_wheels_turning():
    for anti_lock, locked in ((True, False), (False, True)):
        p = make_plant(CAR.model_copy(update={"plant": Plant(anti_lock=anti_lock)}))
        states = drive(p, 25.0, brake=12000.0, seconds=1.5)
        rim = states[50:, SPIN : SPIN + 4] * p.wheel_radius
        assert bool(np.any(rim < 0.3 * states[50:, VX, None])) is locked


@pytest.mark.parametrize(("layout", "wheel"), [("front", 0), ("rear", 2)])
def test_driven_wheels_spin_up_from_standstill_on_snow(layout, wheel):
    p = make_plant(CAR.model_copy(update={"plant": Plant(drive=layout)}))
    states = drive(p, 0.0, torque=3000.0, friction=0.3, seconds=3.0)
    assert np.all(np.isfinite(states))
    rim = states[-1, SPIN + wheel] * p.wheel_radius
    undriven = states[-1, SPIN + 2 - wheel] * p.wheel_radius
    assert rim > 1.5 * states[-1, VX]
    assert undriven == pytest.approx(states[-1, VX], rel=0.02)
    assert 2.0 < states[-1, VX] < 0.3 * GRAVITY * 3.0

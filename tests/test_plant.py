"""The simulation plant obeys the physics a vehicle-dynamics engineer would check first."""

import numpy as np
import pytest

from crosscomb.models.plant import (
    BANK,
    BRAKE,
    DIP,
    DRIVE_COMMAND,
    FRICTION,
    HEADING,
    HEAVE,
    INPUTS,
    ROLL,
    SLOPE,
    SPIN,
    STATES,
    STEER,
    STEER_COMMAND,
    STEER_REAR_COMMAND,
    VX,
    VY,
    YAW_RATE,
    PlantParameters,
    X,
    Y,
    make_plant,
    understeer,
)
from crosscomb.models.plant_motion import step, wheel_loads
from crosscomb.models.tyres_combined import combined_forces
from crosscomb.models.vehicle import Plant
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.driver import start
from drives import TEST_CAR as CAR


def drive(
    p: PlantParameters,
    speed: float,
    steer: float = 0.0,
    torque: float = 0.0,
    brake: float = 0.0,
    friction: float = 0.9,
    seconds: float = 10.0,
    dt: float = 0.001,
    others: dict[int, float] | None = None,
) -> np.ndarray:
    """States every 10 ms under constant inputs; `others` are further inputs by number."""
    x, work, u = start(speed, p), np.zeros((4, STATES)), np.zeros(INPUTS)
    u[STEER_COMMAND], u[DRIVE_COMMAND], u[BRAKE] = steer, torque, brake
    u[FRICTION : FRICTION + 4] = friction
    for number, value in (others or {}).items():
        u[number] = value
    out = np.empty((round(seconds / 0.01), STATES))
    for row in out:
        row[:] = x
        for _ in range(round(0.01 / dt)):
            step(x, u, p, dt, work)
    return out


def test_tyre_has_the_stiffness_of_the_vehicle_file():
    p = make_plant(CAR.model_copy(update={"plant": Plant(compliance_front=0.0)}))
    for tyre, axle in (
        (p.tyre_front, CAR.cornering_stiffness_front),
        (p.tyre_rear, CAR.cornering_stiffness_rear),
    ):
        _, force = combined_forces(0.0, 1e-6, tyre.load, 0.9, tyre)
        assert 2.0 * force / 1e-6 == pytest.approx(axle, rel=1e-4)


def test_slippery_ground_makes_the_tyre_softer_as_well():
    tyre = make_plant(CAR).tyre_front
    firm, snow = (combined_forces(0.0, 1e-6, tyre.load, friction, tyre)[1] for friction in (0.9, 0.3))
    assert 0.4 * firm < snow < 0.8 * firm


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
    assert np.all(states[:, :HEAVE] == 0.0)


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
    p = make_plant(CAR.model_copy(update={"plant": Plant(drag_area=0.0, lift_area=0.0)}))
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
    p = make_plant(CAR.model_copy(update={"plant": Plant(drive=layout, traction_control=False)}))
    states = drive(p, 0.0, torque=3000.0, friction=0.3, seconds=3.0)
    assert np.all(np.isfinite(states))
    rim = states[-1, SPIN + wheel] * p.wheel_radius
    undriven = states[-1, SPIN + 2 - wheel] * p.wheel_radius
    assert rim > 1.5 * states[-1, VX]
    assert undriven == pytest.approx(states[-1, VX], rel=0.02)
    assert 2.0 < states[-1, VX] < 0.3 * GRAVITY * 3.0


def test_traction_control_keeps_the_driven_wheels_from_spinning_up():
    p = make_plant(CAR.model_copy(update={"plant": Plant(drive="rear")}))
    states = drive(p, 0.0, torque=3000.0, friction=0.3, seconds=5.0)
    rim = states[200:, SPIN + 2] * p.wheel_radius
    assert np.all(rim < 1.25 * states[200:, VX])
    assert states[-1, VX] > 0.5 * 0.3 * GRAVITY * 5.0 * 0.4


def test_axle_with_compliance_has_the_stiffness_of_the_vehicle_file():
    stiff, soft = (
        make_plant(
            CAR.model_copy(update={"plant": Plant(compliance_front=c, compliance_rear=c, drag_area=0.0)})
        )
        for c in (0.0, 2e-6)
    )
    assert soft.tyre_front.stiffness > 1.1 * stiff.tyre_front.stiffness
    assert understeer(soft) == pytest.approx(understeer(stiff), rel=1e-9)
    turned = [drive(p, 20.0, 0.01, torque=60.0, seconds=4.0)[-1, YAW_RATE] for p in (stiff, soft)]
    assert turned[1] == pytest.approx(turned[0], rel=0.01)


def test_energy_is_kept_on_a_slope_and_a_bank():
    slope, bank = 0.05, -0.03
    p = make_plant(CAR.model_copy(update={"plant": Plant(drag_area=0.0)}))
    states = drive(p, 10.0, steer=0.0, seconds=0.6, others={SLOPE: slope, BANK: bank})
    height = slope * states[:, X] + bank * states[:, Y]
    energy = 0.5 * p.mass * (states[:, VX] ** 2 + states[:, VY] ** 2) + p.mass * GRAVITY * height
    energy += 0.5 * p.yaw_inertia * states[:, YAW_RATE] ** 2
    energy += 0.5 * p.wheel_inertia * np.sum(states[:, SPIN : SPIN + 4] ** 2, axis=1)
    lost = 0.012 * p.mass * GRAVITY * states[-1, X]
    assert energy[0] - energy[-1] == pytest.approx(lost, rel=0.05)


def test_car_rolls_down_a_slope_with_the_acceleration_of_gravity():
    p = make_plant(CAR)
    states = drive(p, 5.0, seconds=2.0, others={SLOPE: -0.1})
    wheels = 4.0 * p.wheel_inertia / p.wheel_radius**2
    expected = p.mass * GRAVITY * (0.1 - 0.012) / (p.mass + wheels)
    assert (states[-1, VX] - 5.0) / 1.99 == pytest.approx(expected, rel=0.02)


def test_bank_pulls_to_its_low_side_and_mirrors():
    p = make_plant(CAR)
    raised_left, raised_right = (drive(p, 20.0, seconds=3.0, others={BANK: b}) for b in (0.05, -0.05))
    assert raised_left[-1, Y] < -0.5
    np.testing.assert_allclose(raised_left[:, Y], -raised_right[:, Y], rtol=0.0, atol=1e-9)


def test_braking_on_split_friction_turns_the_car_to_the_grippy_side():
    p = make_plant(CAR)
    slippery_left = {FRICTION: 0.2, FRICTION + 2: 0.2}
    states = drive(p, 20.0, brake=3000.0, seconds=1.0, others=slippery_left)
    assert states[-1, HEADING] < -0.05
    slippery_right = {FRICTION + 1: 0.2, FRICTION + 3: 0.2}
    mirrored = drive(p, 20.0, brake=3000.0, seconds=1.0, others=slippery_right)
    np.testing.assert_allclose(states[:, HEADING], -mirrored[:, HEADING], rtol=0.0, atol=1e-9)


def test_dip_presses_the_wheels_and_a_crest_frees_them():
    p = make_plant(CAR.model_copy(update={"plant": Plant(lift_area=0.0)}))
    for dip in (0.005, -0.005):
        state = drive(p, 20.0, seconds=3.0, others={DIP: dip})[-1]
        assert sum(wheel_loads(state, p)) == pytest.approx(
            p.mass * (GRAVITY + dip * state[VX] ** 2), rel=0.01
        )


def test_rear_steering_turns_the_other_way_and_in_phase_takes_the_yaw():
    p = make_plant(CAR.model_copy(update={"plant": Plant(max_steer_rear=0.1)}))
    front = drive(p, 15.0, steer=0.02, seconds=3.0)[-1]
    rear = drive(p, 15.0, seconds=3.0, others={STEER_REAR_COMMAND: 0.02})[-1]
    both = drive(p, 15.0, steer=0.02, seconds=3.0, others={STEER_REAR_COMMAND: 0.02})[-1]
    assert rear[YAW_RATE] == pytest.approx(-front[YAW_RATE], rel=0.03)
    assert abs(both[YAW_RATE]) < 0.03 * front[YAW_RATE]
    # The car moves crabwise, along its wheels.
    assert np.arctan2(both[VY], both[VX]) == pytest.approx(0.02, rel=0.05)


def test_free_play_holds_the_road_wheels_back():
    p = make_plant(CAR.model_copy(update={"plant": Plant(steer_free_play=0.01)}))
    assert drive(p, 15.0, steer=0.004, seconds=2.0)[-1, STEER] == 0.0
    assert drive(p, 15.0, steer=0.020, seconds=2.0)[-1, STEER] == pytest.approx(0.015, rel=1e-3)


def test_car_reverses_and_turns_as_geometry_has_it():
    p = make_plant(CAR)
    state = drive(p, -3.0, steer=0.2, torque=-150.0, seconds=4.0)[-1]
    assert state[VX] < -2.0
    assert state[YAW_RATE] == pytest.approx(state[VX] * np.tan(0.2) / CAR.wheelbase, rel=0.05)

"""The plant against an independent one: the multi-body model of commonroad-vehicle-models.

That model (Althoff, Wuersching, "CommonRoad: Vehicle Models", 2020) has 29 states, axles joined to the body
by compliant pins, and Magic Formula tyres with camber but without relaxation or load sensitivity. Its axes
point right and down: its right turn is compared with our left one. It is numerically valid while no wheel
lifts, here up to 0.75 g. Below 0.2 g its transients are those of a sideways push of its tyres that jumps with
the sign of camber: steps are compared from 0.3 g on.
"""

from math import pi, sqrt

import numpy as np
import pytest

from crosscomb.models.plant import (
    DRIVE_COMMAND,
    FRICTION,
    INPUTS,
    STATES,
    STEER_COMMAND,
    VX,
    YAW_RATE,
    make_plant,
)
from crosscomb.models.plant_motion import step
from crosscomb.models.vehicle import Plant, Tyre, Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.driver import start

vehicle_dynamics_mb = pytest.importorskip("vehiclemodels.vehicle_dynamics_mb").vehicle_dynamics_mb
init_mb = pytest.importorskip("vehiclemodels.init_mb").init_mb
setup_vehicle_parameters = pytest.importorskip("vehiclemodels.vehicle_parameters").setup_vehicle_parameters

FORD_ESCORT, BMW_320I = 1, 2
STEP = 0.004  # of the reference [s]; half of it changes the yaw rate by less than 0.1 %
RAMP = 0.1  # time in which the steering is turned [s]
BEGIN = 0.4  # [s]


def vehicle_of(p) -> Vehicle:
    """The parameters of the multi-body model as a vehicle file has them."""
    wheelbase = p.a + p.b
    load_front = GRAVITY * (p.m_s * p.b / wheelbase + p.m_uf)
    load_rear = GRAVITY * (p.m_s * p.a / wheelbase + p.m_ur)
    # Roll about an axis on the ground: springs at the wheels, torsion bars (printed negative), less
    # what the raised weight takes.
    springs = 0.5 * (p.K_sf * p.T_f**2 + p.K_sr * p.T_r**2) - p.K_tsf - p.K_tsr
    roll_stiffness = springs - p.m_s * GRAVITY * p.h_s
    tyres = 0.5 * p.K_zt * (p.T_f**2 + p.T_r**2)
    roll_inertia = p.I_Phi_s + p.m_s * p.h_s**2
    dampers = 0.5 * (p.K_sdf * p.T_f**2 + p.K_sdr * p.T_r**2)
    tyre = p.tire
    # Camber pushes into the turn as so much steering would; the suspension takes part of it back.
    thrust = -tyre.p_hy3 + tyre.p_vy3 / -tyre.p_ky1
    taken = 0.5 * tyres / (tyres + roll_stiffness)
    camber_front, camber_rear = 1.0 + taken * p.D_f * p.T_f, 1.0 + taken * p.D_r * p.T_r
    return Vehicle(
        name="multi-body",
        mass=p.m,
        yaw_inertia=p.I_z,
        cg_to_front_axle=p.a,
        cg_to_rear_axle=p.b,
        cg_height=p.h_cg,
        track_front=p.T_f,
        track_rear=p.T_r,
        wheel_radius=p.R_w,
        steering_ratio=16.0,
        cornering_stiffness_front=-tyre.p_ky1 * load_front,
        cornering_stiffness_rear=-tyre.p_ky1 * load_rear,
        friction=tyre.p_dy1,
        roll_gradient=p.m_s * p.h_s * (1.0 / roll_stiffness + 1.0 / tyres),
        tyre=Tyre(
            model="pacejka",
            shape=tyre.p_cy1,
            curvature=tyre.p_ey1,
            relaxation_length=0.06,
            load_sensitivity=0.0,
            stiffness_peak_load=100.0,
        ),
        plant=Plant(
            drive="front" if p.T_se == 1.0 else "rear",
            drag_area=0.0,
            lift_area=0.0,
            wheel_inertia=p.I_y_w,
            body_frequency=sqrt(roll_stiffness / roll_inertia) / (2.0 * pi),
            body_damping=dampers / (2.0 * sqrt(roll_stiffness * roll_inertia)),
            steer_lag=0.005,
            compliance_front=0.0,
            roll_steer_front=thrust * camber_front,
            roll_steer_rear=-thrust * camber_rear,
        ),
    )


def steering(t: float, size: float) -> float:
    return size * min(max((t - BEGIN) / RAMP, 0.0), 1.0)


def reference_run(p, speed: float, size: float, seconds: float) -> np.ndarray:
    """Time, speed and yaw rate ``(n, 3)`` of the multi-body model."""
    x = np.array(init_mb([0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0], p))
    out, lost = np.empty((round(seconds / STEP), 3)), 0.0

    def rates(state: np.ndarray, inputs: list[float]) -> np.ndarray:
        return np.array(vehicle_dynamics_mb(list(state), inputs, p))

    for k, row in enumerate(out):
        t = k * STEP
        row[:] = t, x[3], x[5]
        lost += (speed - x[3]) * STEP
        inputs = [(steering(t + STEP, size) - x[2]) / STEP, 2.0 * (speed - x[3]) + lost]
        k1 = rates(x, inputs)
        k2 = rates(x + 0.5 * STEP * k1, inputs)
        k3 = rates(x + STEP * (2.0 * k2 - k1), inputs)
        x = x + STEP / 6.0 * (k1 + 4.0 * k2 + k3)
    return out


def plant_run(vehicle: Vehicle, speed: float, size: float, seconds: float) -> np.ndarray:
    """Time, speed and yaw rate ``(n, 3)`` of our plant."""
    p = make_plant(vehicle)
    x, u, work = start(speed, p), np.zeros(INPUTS), np.zeros((4, STATES))
    u[FRICTION : FRICTION + 4] = vehicle.friction
    out, lost = np.empty((round(seconds / 0.001), 3)), 0.0
    for k, row in enumerate(out):
        row[:] = k * 0.001, x[VX], x[YAW_RATE]
        lost += (speed - x[VX]) * 0.001
        u[STEER_COMMAND] = steering(k * 0.001, size)
        u[DRIVE_COMMAND] = p.mass * p.wheel_radius * (2.0 * (speed - x[VX]) + lost)
        step(x, u, p, 0.001, work)
    return out


def steer_for(vehicle: Vehicle, speed: float, turning: float) -> float:
    """Steering [rad] for a lateral acceleration [g] of a car that neither under- nor oversteers."""
    return turning * GRAVITY * vehicle.wheelbase / speed**2


def gain(run: np.ndarray, size: float) -> float:
    return float(run[-1, 2] / size)


def rise_time(run: np.ndarray) -> float:
    """Time [s] from half the steering to 90 % of the final yaw rate (ISO 7401)."""
    return float(run[np.argmax(run[:, 2] > 0.9 * run[-1, 2]), 0] - BEGIN - 0.5 * RAMP)


def overshoot(run: np.ndarray) -> float:
    """Peak of the yaw rate over its final value."""
    return float(run[:, 2].max() / run[-1, 2])


@pytest.mark.parametrize("car", [FORD_ESCORT, BMW_320I])
@pytest.mark.parametrize(("speed", "turning"), [(10.0, 0.2), (20.0, 0.3), (20.0, 0.5), (30.0, 0.5)])
def test_steady_yaw_gain_is_within_5_percent_up_to_half_g(car, speed, turning):
    p = setup_vehicle_parameters(car)
    vehicle = vehicle_of(p)
    size = steer_for(vehicle, speed, turning)
    ours, theirs = plant_run(vehicle, speed, size, 3.0), reference_run(p, speed, size, 3.0)
    assert theirs[-1, 2] * theirs[-1, 1] / GRAVITY == pytest.approx(turning, rel=0.2)
    print(
        f"car {car} {speed} m/s {turning} g: gain {gain(ours, size):.3f}, reference {gain(theirs, size):.3f}"
    )
    assert gain(ours, size) == pytest.approx(gain(theirs, size), rel=0.05)


@pytest.mark.parametrize("car", [FORD_ESCORT, BMW_320I])
@pytest.mark.parametrize(("speed", "turning"), [(15.0, 0.3), (20.0, 0.4), (25.0, 0.3)])
def test_step_steer_rises_and_overshoots_within_10_percent(car, speed, turning):
    p = setup_vehicle_parameters(car)
    vehicle = vehicle_of(p)
    size = steer_for(vehicle, speed, turning)
    ours, theirs = plant_run(vehicle, speed, size, 3.0), reference_run(p, speed, size, 3.0)
    print(
        f"car {car} {speed} m/s {turning} g: rise {rise_time(ours):.3f} s, reference {rise_time(theirs):.3f}"
        f"; peak {overshoot(ours):.3f}, reference {overshoot(theirs):.3f}"
    )
    assert rise_time(ours) == pytest.approx(rise_time(theirs), rel=0.10)
    assert overshoot(ours) == pytest.approx(overshoot(theirs), rel=0.10)

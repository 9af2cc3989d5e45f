"""The simulation plant: a four-wheel car with body roll and pitch, wheel spins and transient tyres.

Equations of motion: Atheupe 2023, appendix B (planar four-wheel car). Transient slip: Pacejka 2012,
section 7.2 (relaxation length), with damping below walking pace as in section 8.6. Roll and pitch are
second-order responses of the sprung body to the accelerations; their spring and damper forces are the load
transfer. The road is flat.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

from numba import njit

from crosscomb.models.tyres_combined import CombinedTyre, combined_forces
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY

AIR_DENSITY = 1.2
ROLLING_RESISTANCE = 0.012

# States. Wheels are in the order front left, front right, rear left, rear right.
VX, VY, YAW_RATE = 0, 1, 2
X, Y, HEADING = 3, 4, 5
SPIN = 6  # four wheel spins [rad/s]
SLIP_X = 10  # four relaxed longitudinal slips [-]
SLIP_Y = 14  # four relaxed lateral slips [-]
SQUAT, SQUAT_RATE = 18, 19  # ax as the suspension carries it [m/s^2], [m/s^3]
ROLL, ROLL_RATE = 20, 21  # ay as the suspension carries it [m/s^2], [m/s^3]; roll angle = roll_gradient * it
STEER = 22  # road-wheel angle [rad]
DRIVE = 23  # drive torque, sum over the wheels [N m]
STATES = 24

# Inputs, in the order of the input array.
STEER_COMMAND, DRIVE_COMMAND, BRAKE, HANDBRAKE, FRICTION = 0, 1, 2, 3, 4
INPUTS = 5

# Below this rolling speed [m/s] slip is taken over this speed: slip is no quotient at standstill.
LOW_SPEED = 0.5
# Below this speed [m/s] the tyre's deflection is damped, or car and wheels would swing on it.
DAMPED_SPEED = 4.0
DAMPING_X, DAMPING_Y = 0.01, 0.05  # [s]
# Coulomb torques are viscous up to their limit: this rate [1/s] is what a 1 ms Runge-Kutta step bears.
STICK_RATE = 1000.0
DRIVE_LAG = 0.08  # [s]
ANTI_LOCK_SPEED = 2.0  # [m/s]
# Below this speed [m/s] torque, not power, is the limit of the drive.
FULL_POWER_SPEED = 8.0


class PlantParameters(NamedTuple):
    """The car as the kernels need it, SI units; `share_front` is the front axle's part of the drive."""

    mass: float
    yaw_inertia: float
    front: float
    rear: float
    half_track_front: float
    half_track_rear: float
    cg_height: float
    wheel_radius: float
    wheel_inertia: float
    drag: float
    share_front: float
    brake_share_front: float
    roll_share_front: float
    power: float
    max_steer: float
    steer_lag: float
    body_rate: float
    body_damping: float
    anti_lock: float
    differential_lock: float
    relaxation_x: float
    relaxation_y: float
    tyre_front: CombinedTyre
    tyre_rear: CombinedTyre


def make_plant(
    vehicle: Vehicle,
    mass_factor: float = 1.0,
    front_stiffness_factor: float = 1.0,
    rear_stiffness_factor: float = 1.0,
) -> PlantParameters:
    """Make the kernels' parameters from a vehicle.

    Parameters
    ----------
    vehicle : Vehicle
    mass_factor : float
        Scales mass and yaw inertia.
    front_stiffness_factor, rear_stiffness_factor : float
        Scale the cornering stiffness of an axle.
    """
    plant, law = vehicle.plant, vehicle.tyre
    mass = vehicle.mass * mass_factor
    weight = mass * GRAVITY / vehicle.wheelbase / 2.0
    tyre_front = CombinedTyre(
        weight * vehicle.cg_to_rear_axle,
        0.5 * vehicle.cornering_stiffness_front * front_stiffness_factor,
        law.shape,
        law.curvature,
        law.load_sensitivity,
    )
    tyre_rear = tyre_front._replace(
        load=weight * vehicle.cg_to_front_axle,
        stiffness=0.5 * vehicle.cornering_stiffness_rear * rear_stiffness_factor,
    )
    return PlantParameters(
        mass=mass,
        yaw_inertia=vehicle.yaw_inertia * mass_factor,
        front=vehicle.cg_to_front_axle,
        rear=vehicle.cg_to_rear_axle,
        half_track_front=vehicle.track_front / 2.0,
        half_track_rear=vehicle.track_rear / 2.0,
        cg_height=vehicle.cg_height,
        wheel_radius=vehicle.wheel_radius,
        wheel_inertia=plant.wheel_inertia,
        drag=0.5 * AIR_DENSITY * plant.drag_area,
        share_front={"front": 1.0, "rear": 0.0, "all": 0.45}[plant.drive],
        brake_share_front=plant.brake_share_front,
        roll_share_front=plant.roll_share_front,
        power=plant.power,
        max_steer=plant.max_steer,
        steer_lag=plant.steer_lag,
        body_rate=2.0 * pi * plant.body_frequency,
        body_damping=plant.body_damping,
        anti_lock=float(plant.anti_lock),
        differential_lock=plant.differential_lock,
        relaxation_x=0.5 * law.relaxation_length,
        relaxation_y=law.relaxation_length,
        tyre_front=tyre_front,
        tyre_rear=tyre_rear,
    )


@njit(cache=True)
def derivatives(x, u, p, dx):
    """Write the time derivative of the states.

    Parameters
    ----------
    x, dx : ndarray
        ``(STATES,)``, SI units.
    u : ndarray
        ``(INPUTS,)`` road-wheel angle asked for [rad], drive torque asked for, brake torque, handbrake torque
        (each the sum over its wheels) [N m], friction coefficient.
    p : PlantParameters
    """
    vx, vy, yaw_rate = x[VX], x[VY], x[YAW_RATE]
    cs, sn = cos(x[STEER]), sin(x[STEER])
    load_fl, load_fr, load_rl, load_rr = wheel_loads(x, p)
    mu = u[FRICTION]

    vy_front, vy_rear = vy + yaw_rate * p.front, vy - yaw_rate * p.rear
    side_front, side_rear = yaw_rate * p.half_track_front, yaw_rate * p.half_track_rear
    tf, tr = p.tyre_front, p.tyre_rear
    fx_fl, fy_fl = _wheel(0, x, vx - side_front, vy_front, cs, sn, load_fl, mu, tf, p, dx)
    fx_fr, fy_fr = _wheel(1, x, vx + side_front, vy_front, cs, sn, load_fr, mu, tf, p, dx)
    fx_rl, fy_rl = _wheel(2, x, vx - side_rear, vy_rear, 1.0, 0.0, load_rl, mu, tr, p, dx)
    fx_rr, fy_rr = _wheel(3, x, vx + side_rear, vy_rear, 1.0, 0.0, load_rr, mu, tr, p, dx)
    _wheel_torques(x, u, load_fl, load_fr, load_rl, load_rr, p, dx)

    # _wheel gives forces in the wheel's axes; the fronts are turned into the body's.
    front_x = (fx_fl + fx_fr) * cs - (fy_fl + fy_fr) * sn
    front_y = (fx_fl + fx_fr) * sn + (fy_fl + fy_fr) * cs
    across = (fx_fr - fx_fl) * cs - (fy_fr - fy_fl) * sn
    ax = (front_x + (fx_rl + fx_rr) - p.drag * vx * abs(vx)) / p.mass
    ay = (front_y + (fy_rl + fy_rr)) / p.mass
    moment = p.front * front_y - p.rear * (fy_rl + fy_rr)
    moment += p.half_track_front * across + p.half_track_rear * (fx_rr - fx_rl)

    dx[VX] = ax + vy * yaw_rate
    dx[VY] = ay - vx * yaw_rate
    dx[YAW_RATE] = moment / p.yaw_inertia
    dx[X] = vx * cos(x[HEADING]) - vy * sin(x[HEADING])
    dx[Y] = vx * sin(x[HEADING]) + vy * cos(x[HEADING])
    dx[HEADING] = yaw_rate
    dx[SQUAT] = x[SQUAT_RATE]
    dx[SQUAT_RATE] = p.body_rate * (p.body_rate * (ax - x[SQUAT]) - 2.0 * p.body_damping * x[SQUAT_RATE])
    dx[ROLL] = x[ROLL_RATE]
    dx[ROLL_RATE] = p.body_rate * (p.body_rate * (ay - x[ROLL]) - 2.0 * p.body_damping * x[ROLL_RATE])
    dx[STEER] = (u[STEER_COMMAND] - x[STEER]) / p.steer_lag
    dx[DRIVE] = (u[DRIVE_COMMAND] - x[DRIVE]) / DRIVE_LAG


@njit(cache=True)
def wheel_loads(x, p):
    """Vertical loads [N] of the four wheels; their sum is the weight, and none is negative."""
    damper = 2.0 * p.body_damping / p.body_rate
    weight = 2.0 * (p.tyre_front.load + p.tyre_rear.load)
    pitch = p.mass * p.cg_height * (x[SQUAT] + damper * x[SQUAT_RATE])
    roll = p.mass * p.cg_height * (x[ROLL] + damper * x[ROLL_RATE])
    front = 2.0 * p.tyre_front.load - pitch / (p.front + p.rear)
    front = min(max(front, 0.02 * weight), 0.98 * weight)
    rear = weight - front
    across_front = 0.5 * roll * p.roll_share_front / p.half_track_front
    across_front = min(max(across_front, -0.5 * front), 0.5 * front)
    across_rear = 0.5 * roll * (1.0 - p.roll_share_front) / p.half_track_rear
    across_rear = min(max(across_rear, -0.5 * rear), 0.5 * rear)
    return (
        0.5 * front - across_front,
        0.5 * front + across_front,
        0.5 * rear - across_rear,
        0.5 * rear + across_rear,
    )


@njit(cache=True)
def _wheel(i, x, vx, vy, cs, sn, load, friction, tyre, p, dx):
    """Forces of wheel i in its own axes [N]; writes the derivative of its relaxed slips."""
    along, across = vx * cs + vy * sn, vy * cs - vx * sn
    rim = x[SPIN + i] * p.wheel_radius
    # The lateral speed bounds the slip of a car that slides sideways, where nothing rolls.
    rolling = max(max(abs(along), abs(rim)), max(LOW_SPEED, 0.3 * abs(across)))
    rate_x = (rim - along - rolling * x[SLIP_X + i]) / p.relaxation_x
    rate_y = (-across - rolling * x[SLIP_Y + i]) / p.relaxation_y
    dx[SLIP_X + i] = rate_x
    dx[SLIP_Y + i] = rate_y
    slip_x, slip_y = x[SLIP_X + i], x[SLIP_Y + i]
    if rolling < DAMPED_SPEED:
        fade = (1.0 - rolling / DAMPED_SPEED) ** 2
        slip_x += fade * DAMPING_X * rate_x
        slip_y += fade * DAMPING_Y * rate_y
    force_x, force_y = combined_forces(slip_x, slip_y, load, friction, tyre)
    dx[SPIN + i] = -force_x * p.wheel_radius / p.wheel_inertia
    return force_x, force_y


@njit(cache=True)
def _wheel_torques(x, u, load_fl, load_fr, load_rl, load_rr, p, dx):
    """Add drive, brake and rolling resistance to the wheels' spin derivatives."""
    spin_front, spin_rear = x[SPIN] + x[SPIN + 1], x[SPIN + 2] + x[SPIN + 3]
    spin = 0.5 * (p.share_front * spin_front + (1.0 - p.share_front) * spin_rear)
    drive = min(x[DRIVE], p.power / max(spin, FULL_POWER_SPEED / p.wheel_radius))
    front, rear = 0.5 * p.share_front * drive, 0.5 * (1.0 - p.share_front) * drive
    # Only a driven axle has a differential whose lock carries torque across.
    lock_front = p.differential_lock * (x[SPIN] - x[SPIN + 1]) if p.share_front > 0.0 else 0.0
    lock_rear = p.differential_lock * (x[SPIN + 2] - x[SPIN + 3]) if p.share_front < 1.0 else 0.0
    roll = ROLLING_RESISTANCE * p.wheel_radius
    brake_front, brake_rear = (
        0.5 * p.brake_share_front * u[BRAKE],
        0.5 * (1.0 - p.brake_share_front) * u[BRAKE],
    )
    hand = 0.5 * u[HANDBRAKE]
    dx[SPIN] += (front - lock_front) / p.wheel_inertia - _held(0, x, brake_front, roll * load_fl, p)
    dx[SPIN + 1] += (front + lock_front) / p.wheel_inertia - _held(1, x, brake_front, roll * load_fr, p)
    dx[SPIN + 2] += (rear - lock_rear) / p.wheel_inertia - _held(2, x, brake_rear, roll * load_rl + hand, p)
    dx[SPIN + 3] += (rear + lock_rear) / p.wheel_inertia - _held(3, x, brake_rear, roll * load_rr + hand, p)


@njit(cache=True)
def _held(i, x, brake, other, p):
    """Spin rate [rad/s^2] that Coulomb torques take from wheel i; viscous about zero spin.

    The anti-lock lets the brake go between 8 and 20 % slip; `other` torques (handbrake, rolling) stay.
    """
    if p.anti_lock > 0.0 and x[VX] > ANTI_LOCK_SPEED:
        brake *= min(max((0.20 + x[SLIP_X + i]) / 0.12, 0.0), 1.0)
    limit = (brake + other) / p.wheel_inertia
    return min(max(STICK_RATE * x[SPIN + i], -limit), limit)


@njit(cache=True)
def step(x, u, p, dt, work):
    """Advance the states by one step of Kutta's third-order method.

    Parameters
    ----------
    x : ndarray
        ``(STATES,)``, changed in place.
    u : ndarray
        ``(INPUTS,)``, held over the step.
    p : PlantParameters
    dt : float
        Step [s]; 0.001 is stable for every state of motion.
    work : ndarray
        ``(4, STATES)``, scratch.
    """
    k1, k2, k3, y = work[0], work[1], work[2], work[3]
    derivatives(x, u, p, k1)
    for i in range(STATES):
        y[i] = x[i] + 0.5 * dt * k1[i]
    derivatives(y, u, p, k2)
    for i in range(STATES):
        y[i] = x[i] + dt * (2.0 * k2[i] - k1[i])
    derivatives(y, u, p, k3)
    for i in range(STATES):
        x[i] += dt / 6.0 * (k1[i] + 4.0 * k2[i] + k3[i])

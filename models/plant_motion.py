"""The motion of the simulation plant: time derivative of the states, and the integration step.

Equations and their sources: docs/plant.md, whose sections the comments name.
"""

from __future__ import annotations

from math import cos, sin, sqrt

from crosscomb.models.compiled import allocating
from crosscomb.models.plant import (
    BANK,
    BRAKE,
    DIP,
    DRIVE,
    DRIVE_COMMAND,
    FRICTION,
    HANDBRAKE,
    HEADING,
    HEAVE,
    HEAVE_RATE,
    ROLL,
    ROLL_RATE,
    SLIP_X,
    SLIP_Y,
    SLOPE,
    SPIN,
    SQUAT,
    SQUAT_RATE,
    STATES,
    STEER,
    STEER_COMMAND,
    STEER_REAR,
    STEER_REAR_COMMAND,
    TOE_FRONT,
    TOE_REAR,
    VX,
    VY,
    YAW_RATE,
    X,
    Y,
)
from crosscomb.models.tyres_combined import combined_forces
from crosscomb.signals import GRAVITY

ROLLING_RESISTANCE = 0.012

# Below this rolling speed [m/s] slip is taken over this speed: slip is no quotient at standstill.
LOW_SPEED = 0.5
# Rate [1/s] at which slip follows at most, whatever the speed of a spinning wheel: what a 1 ms step bears.
FASTEST_SLIP = 800.0
# Below this speed [m/s] the tyre's deflection is damped, or car and wheels would swing on it.
DAMPED_SPEED = 4.0
DAMPING_X, DAMPING_Y = 0.01, 0.05  # [s]
# Coulomb torques are viscous up to their limit: this rate [1/s] is what a 1 ms Runge-Kutta step bears.
STICK_RATE = 1000.0
DRIVE_LAG = 0.08  # [s]
TOE_LAG = 0.015  # bushings [s]
ANTI_LOCK_SPEED = 2.0  # [m/s]
# Slip at which the anti-lock has let go of a brake; the rear wheels must not lock first.
LOCKING, LOCKING_REAR = 0.20, 0.08
# Below this speed [m/s] torque, not power, is the limit of the drive.
FULL_POWER_SPEED = 8.0


@allocating
def derivatives(x, u, p, dx):
    """Write the time derivative of the states; return the specific forces along and across.

    Parameters
    ----------
    x, dx : ndarray
        ``(STATES,)``, SI units.
    u : ndarray
        ``(INPUTS,)`` road-wheel angles asked for [rad], drive torque asked for, brake and handbrake torque
        (each the sum over its wheels) [N m], friction of four wheels, slope, bank and dip of the road.
    p : PlantParameters

    Returns
    -------
    tuple of float
        What accelerometers at the centre of gravity feel along and across the car, parallel to the road
        [m/s^2].
    """
    vx, vy, yaw_rate = x[VX], x[VY], x[YAW_RATE]
    load_fl, load_fr, load_rl, load_rr = wheel_loads(x, p)
    steer = x[STEER] - x[TOE_FRONT] - p.roll_steer_front * x[ROLL]
    steer_rear = x[STEER_REAR] - x[TOE_REAR] + p.roll_steer_rear * x[ROLL]
    # Ackermann: the inner wheel turns further (section 1).
    toe = steer * steer * p.half_track_front / (p.front + p.rear)
    cs_l, sn_l, cs_r, sn_r = cos(steer + toe), sin(steer + toe), cos(steer - toe), sin(steer - toe)
    cs, sn = cos(steer_rear), sin(steer_rear)

    vy_front, vy_rear = vy + yaw_rate * p.front, vy - yaw_rate * p.rear
    side_front, side_rear = yaw_rate * p.half_track_front, yaw_rate * p.half_track_rear
    tf, tr = p.tyre_front, p.tyre_rear
    fx_fl, fy_fl = _wheel(0, x, u, vx - side_front, vy_front, cs_l, sn_l, load_fl, tf, p, dx)
    fx_fr, fy_fr = _wheel(1, x, u, vx + side_front, vy_front, cs_r, sn_r, load_fr, tf, p, dx)
    fx_rl, fy_rl = _wheel(2, x, u, vx - side_rear, vy_rear, cs, sn, load_rl, tr, p, dx)
    fx_rr, fy_rr = _wheel(3, x, u, vx + side_rear, vy_rear, cs, sn, load_rr, tr, p, dx)
    _wheel_torques(x, u, load_fl, load_fr, load_rl, load_rr, p, dx)

    front_y, rear_y = fy_fl + fy_fr, fy_rl + fy_rr
    force_x = (fx_fl + fx_fr) + (fx_rl + fx_rr)
    moment = p.front * front_y - p.rear * rear_y
    moment += p.half_track_front * (fx_fr - fx_fl) + p.half_track_rear * (fx_rr - fx_rl)
    felt_x = (force_x - p.drag * vx * abs(vx)) / p.mass
    felt_y = (front_y + rear_y) / p.mass

    slope, bank = u[SLOPE], u[BANK]
    dx[VX] = felt_x - GRAVITY * slope + vy * yaw_rate
    dx[VY] = felt_y - GRAVITY * bank - vx * yaw_rate
    dx[YAW_RATE] = moment / p.yaw_inertia
    cs, sn = cos(x[HEADING]), sin(x[HEADING])
    dx[X] = vx * cs - vy * sn
    dx[Y] = vx * sn + vy * cs
    dx[HEADING] = yaw_rate
    # The body's springs and dampers carry the accelerations late (section 3).
    pressed = GRAVITY * sqrt(max(1.0 - slope * slope - bank * bank, 0.0)) - vx * yaw_rate * bank
    pressed += vx * vx * (u[DIP] - p.lift / p.mass)
    rate, double = p.body_rate * p.body_rate, 2.0 * p.body_damping * p.body_rate
    dx[SQUAT] = x[SQUAT_RATE]
    dx[SQUAT_RATE] = rate * (force_x / p.mass - x[SQUAT]) - double * x[SQUAT_RATE]
    dx[ROLL] = x[ROLL_RATE]
    dx[ROLL_RATE] = rate * (felt_y - x[ROLL]) - double * x[ROLL_RATE]
    dx[HEAVE] = x[HEAVE_RATE]
    dx[HEAVE_RATE] = rate * (pressed - x[HEAVE]) - double * x[HEAVE_RATE]
    # Within the free play the road wheels stay where they are (section 4).
    lost = u[STEER_COMMAND] - x[STEER]
    lost -= min(max(lost, -p.half_play), p.half_play)
    dx[STEER] = lost / p.steer_lag
    dx[STEER_REAR] = (u[STEER_REAR_COMMAND] - x[STEER_REAR]) / p.steer_lag
    dx[TOE_FRONT] = (p.compliance_front * front_y - x[TOE_FRONT]) / TOE_LAG
    dx[TOE_REAR] = (p.compliance_rear * rear_y - x[TOE_REAR]) / TOE_LAG
    dx[DRIVE] = (u[DRIVE_COMMAND] - x[DRIVE]) / DRIVE_LAG
    return felt_x, felt_y


@allocating
def wheel_loads(x, p):
    """Vertical loads [N] of the four wheels (docs/plant.md, section 3); none is negative."""
    damper = 2.0 * p.body_damping / p.body_rate
    weight = p.mass * max(x[HEAVE] + damper * x[HEAVE_RATE], 0.05 * GRAVITY)
    pitch = p.mass * p.cg_height * (x[SQUAT] + damper * x[SQUAT_RATE])
    roll = p.mass * p.cg_height * (x[ROLL] + damper * x[ROLL_RATE])
    wheelbase = p.front + p.rear
    front = (weight * p.rear - pitch) / wheelbase
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


@allocating
def _wheel(i, x, u, vx, vy, cs, sn, load, tyre, p, dx):
    """Forces of wheel i in the body's axes [N]; writes the derivative of its relaxed slips and its spin."""
    along, across = vx * cs + vy * sn, vy * cs - vx * sn
    rim = x[SPIN + i] * p.wheel_radius
    # The lateral speed bounds the slip of a car that slides sideways, where nothing rolls.
    rolling = max(max(abs(along), abs(rim)), max(LOW_SPEED, 0.3 * abs(across)))
    rate_x = (rim - along - rolling * x[SLIP_X + i]) / max(p.relaxation_x, rolling / FASTEST_SLIP)
    rate_y = (-across - rolling * x[SLIP_Y + i]) / max(p.relaxation_y, rolling / FASTEST_SLIP)
    dx[SLIP_X + i] = rate_x
    dx[SLIP_Y + i] = rate_y
    slip_x, slip_y = x[SLIP_X + i], x[SLIP_Y + i]
    if rolling < DAMPED_SPEED:
        fade = (1.0 - rolling / DAMPED_SPEED) ** 2
        slip_x += fade * DAMPING_X * rate_x
        slip_y += fade * DAMPING_Y * rate_y
    force_x, force_y = combined_forces(slip_x, slip_y, load, u[FRICTION + i], tyre)
    dx[SPIN + i] = -force_x * p.wheel_radius / p.wheel_inertia
    return force_x * cs - force_y * sn, force_x * sn + force_y * cs


@allocating
def _wheel_torques(x, u, load_fl, load_fr, load_rl, load_rr, p, dx):
    """Add drive, brake and rolling resistance to the wheels' spin derivatives (section 5)."""
    spin_front, spin_rear = x[SPIN] + x[SPIN + 1], x[SPIN + 2] + x[SPIN + 3]
    spin = 0.5 * abs(p.share_front * spin_front + (1.0 - p.share_front) * spin_rear)
    most = p.power / max(spin, FULL_POWER_SPEED / p.wheel_radius)
    drive = min(max(x[DRIVE], -most), most)
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
    _torque(0, x, _driven(0, x, front, p) - lock_front, brake_front, LOCKING, roll * load_fl, p, dx)
    _torque(1, x, _driven(1, x, front, p) + lock_front, brake_front, LOCKING, roll * load_fr, p, dx)
    _torque(2, x, _driven(2, x, rear, p) - lock_rear, brake_rear, LOCKING_REAR, roll * load_rl + hand, p, dx)
    _torque(3, x, _driven(3, x, rear, p) + lock_rear, brake_rear, LOCKING_REAR, roll * load_rr + hand, p, dx)


@allocating
def _driven(i, x, torque, p):
    """Drive torque of wheel i [N m]; traction control takes it back between 6 and 18 % slip."""
    if p.traction_control == 0.0:
        return torque
    slip = x[SLIP_X + i] if torque > 0.0 else -x[SLIP_X + i]
    return torque * min(max((0.18 - slip) / 0.12, 0.0), 1.0)


@allocating
def _torque(i, x, drive, brake, locking, other, p, dx):
    """Add torques to the spin of wheel i; Coulomb torques are viscous about zero spin.

    The anti-lock lets the brake go as slip comes near `locking`; `other` torques (handbrake, rolling) stay.
    """
    if p.anti_lock > 0.0 and x[VX] > ANTI_LOCK_SPEED:
        brake *= min(max((locking + x[SLIP_X + i]) / (0.6 * locking), 0.0), 1.0)
    limit = (brake + other) / p.wheel_inertia
    dx[SPIN + i] += drive / p.wheel_inertia - min(max(STICK_RATE * x[SPIN + i], -limit), limit)


@allocating
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

"""Single-track model: yaw rate and sideslip angle under axle forces.

Atheupe 2023, eq. 22 and 23, corrected: the rear lateral force turns the car with -b Fyr, and the slip equation
has the rear longitudinal force. Rear steering is included; without it steer_rear is 0.
The state is (yaw_rate, beta), the speed vx is measured, and the speed of the centre of gravity is vx / cos(beta).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.models.compiled import inlined
from crosscomb.models.linear_single_track import yaw_damping
from crosscomb.models.tyres import TYRE_LAWS, axle_tyre, lateral_capacity
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY

FRICTION_MARGIN = 1.2
"""Friction is taken at least this much above the acceleration in use."""


class SingleTrack(NamedTuple):
    """Parameters of the single-track model as kernels take them."""

    mass: float  # [kg]
    yaw_inertia: float  # [kg m^2]
    a: float  # centre of gravity to front axle [m]
    b: float  # centre of gravity to rear axle [m]
    stiffness_front: float  # [N/rad]
    stiffness_rear: float  # [N/rad]
    friction: float
    cg_height: float  # [m]
    tyre_law: int  # number in `TYRE_LAWS`


def single_track(vehicle: Vehicle, tyre: str = "dugoff") -> SingleTrack:
    """Take the parameters of the single-track model from a vehicle.

    Parameters
    ----------
    vehicle : Vehicle
    tyre : str
        Tyre law of both axles, a name of `TYRE_LAWS`.
    """
    return SingleTrack(
        mass=vehicle.mass,
        yaw_inertia=vehicle.yaw_inertia,
        a=vehicle.cg_to_front_axle,
        b=vehicle.cg_to_rear_axle,
        stiffness_front=vehicle.cornering_stiffness_front,
        stiffness_rear=vehicle.cornering_stiffness_rear,
        friction=vehicle.friction,
        cg_height=vehicle.cg_height,
        tyre_law=TYRE_LAWS[tyre],
    )


@inlined
def axle_loads(ax, car):
    """Vertical load of the front and rear axle with longitudinal load transfer [N].

    Parameters
    ----------
    ax : float [m/s^2]
    car : SingleTrack
    """
    weight = car.mass * GRAVITY
    per_length = 1.0 / (car.a + car.b)
    transfer = car.mass * ax * car.cg_height
    front = (weight * car.b - transfer) * per_length
    rear = (weight * car.a + transfer) * per_length
    least = 0.05 * weight
    return max(front, least), max(rear, least)


@inlined
def sin_cos_tan(beta):
    """Sine, cosine and tangent for |beta| < 90 deg: a root is cheaper than two more series."""
    tangent = math.tan(beta)
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    return tangent * cosine, cosine, tangent


@inlined
def slip_angles(yaw_rate, tangent, vx, steer, steer_rear, a, b):
    """Slip angles of both axles and their slopes (Atheupe 2023, eq. 24, without small angles).

    Parameters
    ----------
    yaw_rate : float [rad/s]
    tangent : float
        Of beta.
    vx : float [m/s]
    steer, steer_rear : float [rad]
    a, b : float [m]

    Returns
    -------
    alpha_f, alpha_r : float [rad]
    alpha_f_r, alpha_f_b, alpha_r_r, alpha_r_b : float
        Derivatives by yaw rate [s] and by beta [-].
    """
    time_front, time_rear = a / vx, b / vx
    front = tangent + time_front * yaw_rate
    rear = tangent - time_rear * yaw_rate
    d_front = -1.0 / (1.0 + front * front)
    d_rear = -1.0 / (1.0 + rear * rear)
    secant2 = 1.0 + tangent * tangent
    return (
        steer - math.atan(front),
        steer_rear - math.atan(rear),
        d_front * time_front,
        d_front * secant2,
        -d_rear * time_rear,
        d_rear * secant2,
    )


@inlined
def body_rates(
    fxf, fxr, fyf, fyr, vx, yaw_rate, cos_f, sin_f, cos_r, sin_r, cos_b, sin_b, mass, yaw_inertia, a, b
):
    """Yaw acceleration, slip rate and accelerations that axle forces give (eq. 22 and 23, corrected).

    Parameters
    ----------
    fxf, fxr, fyf, fyr : float or (n,) [N]
        Axle forces along and across the wheels.
    cos_f, sin_f, cos_r, sin_r : float
        Of the front and rear road-wheel angle.
    cos_b, sin_b : float or (n,)
        Of beta.

    Returns
    -------
    yaw_acceleration [rad/s^2], beta_rate [rad/s], ax, ay [m/s^2]
    """
    # Forces along the axes of the car.
    front_x, front_y = fxf * cos_f - fyf * sin_f, fxf * sin_f + fyf * cos_f
    rear_x, rear_y = fxr * cos_r - fyr * sin_r, fxr * sin_r + fyr * cos_r
    # Reciprocals, as kernels divide by the same numbers again and again.
    per_mass, per_inertia, per_vx = 1.0 / mass, 1.0 / yaw_inertia, 1.0 / vx
    ax = (front_x + rear_x) * per_mass
    ay = (front_y + rear_y) * per_mass
    yaw_acceleration = (a * front_y - b * rear_y) * per_inertia
    beta_rate = (ay * cos_b - ax * sin_b) * cos_b * per_vx - yaw_rate
    return yaw_acceleration, beta_rate, ax, ay


@inlined
def axle_slopes(cos, sin, arm, vx, cos_b, sin_b, mass, yaw_inertia):
    """Derivatives of `body_rates` by the lateral force of an axle, `arm` [m] ahead of the centre of gravity.

    Returns
    -------
    Of yaw_acceleration [rad/s^2/N], beta_rate [rad/s/N], ax and ay [m/s^2/N].
    """
    per_mass, per_inertia, per_vx = 1.0 / mass, 1.0 / yaw_inertia, 1.0 / vx
    by_ax, by_ay = -sin * per_mass, cos * per_mass
    return arm * cos * per_inertia, (by_ay * cos_b - by_ax * sin_b) * cos_b * per_vx, by_ax, by_ay


@inlined
def friction_in_force(friction, ax, ay):
    """Friction of the vehicle file, or `FRICTION_MARGIN` times the acceleration in use [m/s^2] if that is more."""
    return max(friction, FRICTION_MARGIN / GRAVITY * math.sqrt(ax * ax + ay * ay))


@inlined
def slip_rate_slope(ax, ay, cos_b, sin_b, vx):
    """Derivative of beta_rate by beta at constant forces [1/s]."""
    return -(2.0 * ay * sin_b * cos_b + ax * (cos_b * cos_b - sin_b * sin_b)) / vx


@inlined
def single_track_rates(yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax_load, ay_seen, car):
    """Rates, measurements and Jacobian of the single-track model (Atheupe 2023, eq. 22 and 23, corrected).

    Parameters
    ----------
    yaw_rate : float [rad/s]
    beta : float [rad]
    vx : float [m/s]
        Longitudinal speed, positive.
    steer, steer_rear : float [rad]
        Road-wheel angles.
    fxf, fxr : float [N]
        Longitudinal axle forces, known from elsewhere.
    ax_load : float [m/s^2]
        Longitudinal acceleration for the load transfer.
    ay_seen : float [m/s^2]
        Lateral acceleration that the tyres plainly give; 0 where it is not known.
    car : SingleTrack

    Notes
    -----
    The friction in force is the vehicle file's, or what the car plainly uses just now if that is more: a tyre law
    that is saturated below the forces really there has no slope left to hold beta, and the filter would run away.

    Returns
    -------
    rates : yaw_acceleration [rad/s^2], beta_rate [rad/s]
    measurements : ax, ay [m/s^2]
    jacobian : the derivatives of these four by yaw rate, then by beta
    """
    load_f, load_r = axle_loads(ax_load, car)
    friction = friction_in_force(car.friction, ax_load, ay_seen)
    sin_b, cos_b, tangent = sin_cos_tan(beta)
    alpha_f, alpha_r, af_r, af_b, ar_r, ar_b = slip_angles(
        yaw_rate, tangent, vx, steer, steer_rear, car.a, car.b
    )
    fyf, slope_f = axle_tyre(
        car.tyre_law, alpha_f, car.stiffness_front, lateral_capacity(friction, load_f, fxf), friction
    )
    fyr, slope_r = axle_tyre(
        car.tyre_law, alpha_r, car.stiffness_rear, lateral_capacity(friction, load_r, fxr), friction
    )
    cos_f, sin_f = math.cos(steer), math.sin(steer)
    cos_r, sin_r = math.cos(steer_rear), math.sin(steer_rear)
    yaw_acceleration, beta_rate, ax, ay = body_rates(
        fxf, fxr, fyf, fyr, vx, yaw_rate, cos_f, sin_f, cos_r, sin_r,
        cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    yaw_f, slip_f, ax_f, ay_f = axle_slopes(cos_f, sin_f, car.a, vx, cos_b, sin_b, car.mass, car.yaw_inertia)
    yaw_r, slip_r, ax_r, ay_r = axle_slopes(cos_r, sin_r, -car.b, vx, cos_b, sin_b, car.mass, car.yaw_inertia)
    by_rate_f, by_rate_r, by_beta_f, by_beta_r = (
        slope_f * af_r,
        slope_r * ar_r,
        slope_f * af_b,
        slope_r * ar_b,
    )
    return (
        (yaw_acceleration, beta_rate),
        (ax, ay),
        (
            yaw_f * by_rate_f + yaw_r * by_rate_r,
            slip_f * by_rate_f + slip_r * by_rate_r - 1.0,
            ax_f * by_rate_f + ax_r * by_rate_r,
            ay_f * by_rate_f + ay_r * by_rate_r,
            yaw_f * by_beta_f + yaw_r * by_beta_r,
            slip_f * by_beta_f + slip_r * by_beta_r + slip_rate_slope(ax, ay, cos_b, sin_b, vx),
            ax_f * by_beta_f + ax_r * by_beta_r,
            ay_f * by_beta_f + ay_r * by_beta_r,
        ),
    )


@inlined
def stable_substeps(vx, dt, car):
    """Number of Euler steps that keep the stiff low-speed modes stable over dt.

    The eigenvalues of the linear single track are bounded by the sum of its two damping terms (eq. 26, 27).
    """
    lateral = (car.stiffness_front + car.stiffness_rear) / car.mass
    yaw = yaw_damping(car) / car.yaw_inertia
    return 1 + int(dt * (lateral + yaw) / vx)


def axle_use(yaw_rate, yaw_acceleration, beta, vx, vx_rate, ay, steer, steer_rear, vehicle):
    """Slip angles and forces that a measured motion asks of the axles, whatever their tyres are.

    Parameters
    ----------
    yaw_rate, yaw_acceleration, beta, vx, vx_rate, ay, steer, steer_rear : ndarray
        ``(n,)`` SI.
    vehicle : Vehicle

    Returns
    -------
    ndarray
        ``(4, n)`` slip angle [rad] and lateral force over load [-] of the front, then of the rear axle.
    """
    a, b, mass = vehicle.cg_to_front_axle, vehicle.cg_to_rear_axle, vehicle.mass
    transfer = mass * vx_rate * vehicle.cg_height / (a + b)
    load_f, load_r = mass * GRAVITY * b / (a + b) - transfer, mass * GRAVITY * a / (a + b) + transfer
    force_f = (mass * ay * b + vehicle.yaw_inertia * yaw_acceleration) / (a + b) / np.cos(steer)
    force_r = (mass * ay * a - vehicle.yaw_inertia * yaw_acceleration) / (a + b)
    slip_f = steer - np.arctan(np.tan(beta) + a * yaw_rate / vx)
    slip_r = steer_rear - np.arctan(np.tan(beta) - b * yaw_rate / vx)
    return np.stack([slip_f, force_f / load_f, slip_r, force_r / load_r])

"""Single-track model: yaw rate and sideslip angle under axle forces.

Atheupe 2023, eq. 22 and 23, corrected: the rear lateral force turns the car with -b Fyr, and the slip equation
has the rear longitudinal force. Rear steering is included; without it steer_rear is 0.
The state is (yaw_rate, beta), the speed vx is measured, and the speed of the centre of gravity is vx / cos(beta).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

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


@njit(cache=True)
def axle_loads(ax, car):
    """Vertical load of the front and rear axle with longitudinal load transfer [N].

    Parameters
    ----------
    ax : float [m/s^2]
    car : SingleTrack
    """
    wheelbase = car.a + car.b
    weight = car.mass * GRAVITY
    transfer = car.mass * ax * car.cg_height / wheelbase
    front = weight * car.b / wheelbase - transfer
    rear = weight * car.a / wheelbase + transfer
    least = 0.05 * weight
    return max(front, least), max(rear, least)


@njit(cache=True)
def slip_angles(yaw_rate, beta, vx, steer, steer_rear, a, b):
    """Slip angles of both axles and their slopes (Atheupe 2023, eq. 24, without small angles).

    Returns
    -------
    alpha_f, alpha_r : float [rad]
    alpha_f_r, alpha_f_b, alpha_r_r, alpha_r_b : float
        Derivatives by yaw rate [s] and by beta [-].
    """
    tangent = math.tan(beta)
    front = tangent + a * yaw_rate / vx
    rear = tangent - b * yaw_rate / vx
    d_front = -1.0 / (1.0 + front * front)
    d_rear = -1.0 / (1.0 + rear * rear)
    secant2 = 1.0 + tangent * tangent
    return (
        steer - math.atan(front),
        steer_rear - math.atan(rear),
        d_front * a / vx,
        d_front * secant2,
        -d_rear * b / vx,
        d_rear * secant2,
    )


@njit(cache=True)
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
    ax = (front_x + rear_x) / mass
    ay = (front_y + rear_y) / mass
    yaw_acceleration = (a * front_y - b * rear_y) / yaw_inertia
    beta_rate = (ay * cos_b - ax * sin_b) * cos_b / vx - yaw_rate
    return yaw_acceleration, beta_rate, ax, ay


@njit(cache=True)
def body_slopes(dfyf, dfyr, vx, cos_f, sin_f, cos_r, sin_r, cos_b, sin_b, mass, yaw_inertia, a, b):
    """Change of `body_rates` with a state that changes the lateral axle forces by dfyf and dfyr.

    Parameters
    ----------
    dfyf, dfyr : float [N per unit of the state]

    Returns
    -------
    Derivatives of yaw_acceleration, beta_rate, ax, ay; that of beta_rate without what the state does directly.
    """
    d_ax = -(dfyf * sin_f + dfyr * sin_r) / mass
    d_ay = (dfyf * cos_f + dfyr * cos_r) / mass
    d_yaw = (a * dfyf * cos_f - b * dfyr * cos_r) / yaw_inertia
    return d_yaw, (d_ay * cos_b - d_ax * sin_b) * cos_b / vx, d_ax, d_ay


@njit(cache=True)
def slip_rate_slope(ax, ay, cos_b, sin_b, vx):
    """Derivative of beta_rate by beta at constant forces [1/s]."""
    return -(2.0 * ay * sin_b * cos_b + ax * (cos_b * cos_b - sin_b * sin_b)) / vx


@njit(cache=True)
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
    friction = max(car.friction, FRICTION_MARGIN * math.hypot(ax_load, ay_seen) / GRAVITY)
    alpha_f, alpha_r, af_r, af_b, ar_r, ar_b = slip_angles(
        yaw_rate, beta, vx, steer, steer_rear, car.a, car.b
    )
    fyf, slope_f = axle_tyre(
        car.tyre_law, alpha_f, car.stiffness_front, lateral_capacity(friction, load_f, fxf), friction
    )
    fyr, slope_r = axle_tyre(
        car.tyre_law, alpha_r, car.stiffness_rear, lateral_capacity(friction, load_r, fxr), friction
    )
    cos_f, sin_f = math.cos(steer), math.sin(steer)
    cos_r, sin_r = math.cos(steer_rear), math.sin(steer_rear)
    cos_b, sin_b = math.cos(beta), math.sin(beta)
    yaw_acceleration, beta_rate, ax, ay = body_rates(
        fxf, fxr, fyf, fyr, vx, yaw_rate, cos_f, sin_f, cos_r, sin_r,
        cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    yaw_r, slip_r, ax_r, ay_r = body_slopes(
        slope_f * af_r, slope_r * ar_r, vx, cos_f, sin_f, cos_r, sin_r, cos_b, sin_b,
        car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    yaw_b, slip_b, ax_b, ay_b = body_slopes(
        slope_f * af_b, slope_r * ar_b, vx, cos_f, sin_f, cos_r, sin_r, cos_b, sin_b,
        car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    slip_r -= 1.0
    slip_b += slip_rate_slope(ax, ay, cos_b, sin_b, vx)
    return (
        (yaw_acceleration, beta_rate),
        (ax, ay),
        (yaw_r, slip_r, ax_r, ay_r, yaw_b, slip_b, ax_b, ay_b),
    )


@njit(cache=True)
def stable_substeps(vx, dt, car):
    """Number of Euler steps that keep the stiff low-speed modes stable over dt.

    The eigenvalues of the linear single track are bounded by the sum of its two damping terms (eq. 26, 27).
    """
    lateral = (car.stiffness_front + car.stiffness_rear) / (car.mass * vx)
    yaw = (car.a**2 * car.stiffness_front + car.b**2 * car.stiffness_rear) / (car.yaw_inertia * vx)
    return 1 + int(dt * (lateral + yaw))

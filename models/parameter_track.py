"""Single track whose tyre parameters are arguments: what estimators that adapt them need.

The equations are those of `crosscomb.models.single_track`; here the slopes by the parameters come with them.
Three laws: cornering stiffnesses [front, rear] (Di Biase 2020, eq. 7 and 8), rational parameters [c1 front,
c2 front, c1 rear, c2 rear] (eq. 9 and 10), and Dugoff's law with the friction of both axles as its one
parameter.
"""

from __future__ import annotations

import math

import numpy as np

from crosscomb.models.compiled import inlined
from crosscomb.models.single_track import (
    SingleTrack,
    axle_loads,
    axle_slopes,
    body_rates,
    friction_in_force,
    sin_cos_tan,
    slip_angles,
    slip_rate_slope,
)
from crosscomb.models.tyres import (
    dugoff_by_capacity,
    dugoff_tyre,
    lateral_capacity,
    rational_parameters,
    rational_tyre,
)

STIFFNESS = 0
RATIONAL = 1
FRICTION = 2

LAWS = {"linear": STIFFNESS, "rational": RATIONAL, "dugoff": FRICTION}
"""Name of a tyre law to the number of the law with parameters."""

YAW_ACCELERATION, BETA_RATE, LATERAL = range(3)
"""Rows of the slopes."""

BY_YAW_RATE, BY_BETA, BY_STEER, BY_PARAMETER = range(4)
"""Columns of the slopes; the parameters follow from the last one on."""

SLOPES_SHAPE = (3, 7)

SLOPE_BEYOND_PEAK = 0.02
"""Slope of the rational law beyond its peak, in shares of its slope at zero slip."""


def first_parameters(law: int, car: SingleTrack) -> np.ndarray:
    """Parameters ``(p,)`` of a law that follow from the stiffnesses and the friction of the vehicle file.

    Parameters
    ----------
    law : int
        `STIFFNESS`, `RATIONAL` or `FRICTION`.
    car : SingleTrack
    """
    if law == STIFFNESS:
        return np.array([car.stiffness_front, car.stiffness_rear])
    if law == FRICTION:
        return np.array([car.friction])
    front, rear = axle_loads(0.0, car)
    return np.array(
        [
            *rational_parameters(car.stiffness_front, car.friction, front),
            *rational_parameters(car.stiffness_rear, car.friction, rear),
        ]
    )


@inlined
def stiffness_forces(alpha_f, alpha_r, parameters, by):
    """Axle forces and slopes of linear tyres; arguments and results as `tyre_forces`."""
    by[0, 0], by[0, 1] = alpha_f, 0.0
    by[1, 0], by[1, 1] = 0.0, alpha_r
    return parameters[0] * alpha_f, parameters[0], parameters[1] * alpha_r, parameters[1]


@inlined
def rising_rational(alpha, c1, c2, friction, load_ratio):
    """Rational tyre that rises slowly beyond its peak; arguments and results as `rational_tyre`."""
    if alpha * alpha <= c1 * (friction + 1.0):
        return rational_tyre(alpha, c1, c2, friction, load_ratio)
    peak_angle = math.sqrt(c1 * (friction + 1.0))
    force, _, _, by_c2 = rational_tyre(math.copysign(peak_angle, alpha), c1, c2, friction, load_ratio)
    slope = SLOPE_BEYOND_PEAK * c2 * friction * load_ratio
    beyond = alpha - math.copysign(peak_angle, alpha)
    # The peak goes with the root of c1; so does its angle, where the rise begins.
    by_c1 = 0.5 * (force - slope * math.copysign(peak_angle, alpha)) / c1
    return force + slope * beyond, slope, by_c1, by_c2 + slope * beyond / c2


@inlined
def rational_forces(alpha_f, alpha_r, fxf, fxr, ax, friction, parameters, car, by):
    """Axle forces and slopes of rational tyres; arguments and results as `tyre_forces`.

    Two departures from the printed law. Drive and brake forces shrink the whole curve by the share of the
    friction circle they leave. And beyond its peak the curve goes on rising a little: the law falls to 80 %
    at twice the peak's angle, far more than tyres do, and a filter on it takes the car to spin and never
    comes back.
    """
    load_f, load_r = axle_loads(ax, car)
    static_f, static_r = axle_loads(0.0, car)
    left_f = lateral_capacity(friction, load_f, fxf) / (friction * static_f)
    left_r = lateral_capacity(friction, load_r, fxr) / (friction * static_r)
    fyf, slope_f, by1_f, by2_f = rising_rational(alpha_f, parameters[0], parameters[1], friction, left_f)
    fyr, slope_r, by1_r, by2_r = rising_rational(alpha_r, parameters[2], parameters[3], friction, left_r)
    by[:] = 0.0
    by[0, 0], by[1, 0], by[2, 1], by[3, 1] = by1_f, by2_f, by1_r, by2_r
    return fyf, slope_f, fyr, slope_r


@inlined
def friction_axle(alpha, stiffness, friction, load, longitudinal_force, adaptable):
    """Force, slope and derivative by the friction of one Dugoff axle."""
    capacity = lateral_capacity(friction, load, longitudinal_force)
    force, slope = dugoff_tyre(alpha, stiffness, capacity)
    total = friction * load
    floored = total * total - longitudinal_force * longitudinal_force <= 0.01 * total * total
    grows = 0.1 * load if floored else total * load / capacity
    return force, slope, adaptable * grows * dugoff_by_capacity(alpha, stiffness, capacity)


@inlined
def friction_forces(alpha_f, alpha_r, fxf, fxr, ax, used, parameters, car, by):
    """Axle forces and slopes of Dugoff tyres with friction as parameter; results as `tyre_forces`.

    Where the car plainly uses more than the parameter gives, `used` stands in, and the parameter has no
    effect.
    """
    adaptable = 1.0 if parameters[0] > used else 0.0
    friction = max(parameters[0], used)
    load_f, load_r = axle_loads(ax, car)
    fyf, slope_f, by[0, 0] = friction_axle(alpha_f, car.stiffness_front, friction, load_f, fxf, adaptable)
    fyr, slope_r, by[0, 1] = friction_axle(alpha_r, car.stiffness_rear, friction, load_r, fxr, adaptable)
    return fyf, slope_f, fyr, slope_r


@inlined
def tyre_forces(law, alpha_f, alpha_r, fxf, fxr, ax, ay_seen, parameters, car, by):
    """Lateral axle forces, their slopes and their derivatives by the parameters.

    Parameters
    ----------
    law : int
    alpha_f, alpha_r : float [rad]
    fxf, fxr : float [N]
    ax, ay_seen : float [m/s^2]
        Accelerations in use: load transfer, and the least friction that there must be (`single_track_rates`).
    parameters : (p,)
    car : SingleTrack
    by : (4, 2)
        Filled, one row per parameter: derivatives of the front and of the rear force.

    Returns
    -------
    fyf, slope_f, fyr, slope_r : float [N], float [N/rad]
    """
    used = friction_in_force(0.0, ax, ay_seen)
    if law == STIFFNESS:
        return stiffness_forces(alpha_f, alpha_r, parameters, by)
    if law == RATIONAL:
        friction = max(car.friction, used)
        return rational_forces(alpha_f, alpha_r, fxf, fxr, ax, friction, parameters, car, by)
    return friction_forces(alpha_f, alpha_r, fxf, fxr, ax, used, parameters, car, by)


@inlined
def set_slopes(slopes, column, of_f, of_r, front, rear):
    """Write the slopes by what changes the axle forces by `front` and `rear`; `of_f`, `of_r`: `axle_slopes`."""
    slopes[YAW_ACCELERATION, column] = of_f[0] * front + of_r[0] * rear
    slopes[BETA_RATE, column] = of_f[1] * front + of_r[1] * rear
    slopes[LATERAL, column] = of_f[3] * front + of_r[3] * rear


@inlined
def parameter_track_rates(
    yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay_seen, law, parameters, car, by, slopes
):
    """Rates and lateral acceleration of the single track under given tyre parameters, with all slopes.

    Parameters
    ----------
    yaw_rate, beta, vx, steer, steer_rear, fxf, fxr, ax, ay_seen : float
        As in `crosscomb.models.single_track.single_track_rates`.
    law, parameters, car, by
        As in `tyre_forces`.
    slopes : (3, 7)
        Filled: rows yaw_acceleration, beta_rate, ay; columns yaw_rate, beta, the steering angle (through the
        slip angle of the front tyres alone), and the parameters.

    Returns
    -------
    yaw_acceleration, beta_rate, ay : float [rad/s^2], [rad/s], [m/s^2]
    """
    sin_b, cos_b, tangent = sin_cos_tan(beta)
    alpha_f, alpha_r, af_r, af_b, ar_r, ar_b = slip_angles(
        yaw_rate, tangent, vx, steer, steer_rear, car.a, car.b
    )
    fyf, slope_f, fyr, slope_r = tyre_forces(
        law, alpha_f, alpha_r, fxf, fxr, ax, ay_seen, parameters, car, by
    )
    cos_f, sin_f = math.cos(steer), math.sin(steer)
    cos_r, sin_r = math.cos(steer_rear), math.sin(steer_rear)
    yaw_acceleration, beta_rate, body_ax, body_ay = body_rates(
        fxf, fxr, fyf, fyr, vx, yaw_rate, cos_f, sin_f, cos_r, sin_r,
        cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip
    of_f = axle_slopes(cos_f, sin_f, car.a, vx, cos_b, sin_b, car.mass, car.yaw_inertia)
    of_r = axle_slopes(cos_r, sin_r, -car.b, vx, cos_b, sin_b, car.mass, car.yaw_inertia)
    set_slopes(slopes, BY_BETA, of_f, of_r, slope_f * af_b, slope_r * ar_b)
    set_slopes(slopes, BY_YAW_RATE, of_f, of_r, slope_f * af_r, slope_r * ar_r)
    set_slopes(slopes, BY_STEER, of_f, of_r, slope_f, 0.0)
    for i in range(parameters.shape[0]):
        set_slopes(slopes, BY_PARAMETER + i, of_f, of_r, by[i, 0], by[i, 1])
    slopes[BETA_RATE, BY_YAW_RATE] -= 1.0
    slopes[BETA_RATE, BY_BETA] += slip_rate_slope(body_ax, body_ay, cos_b, sin_b, vx)
    return yaw_acceleration, beta_rate, body_ay


@inlined
def lateral_acceleration(beta, yaw_rate, beta_rate, vx, ax):
    """Lateral acceleration from the motion alone, and its slopes; Di Biase 2020, eq. 39, corrected.

    The printed u (beta_rate + r) holds at constant speed and small angles only. From ay = vy_dot + r vx with
    vy = vx tan(beta) and ax = vx_dot - r vy follows ay = vx (beta_rate + r) / cos(beta)^2 + ax tan(beta).

    Parameters
    ----------
    beta : float [rad]
    yaw_rate, beta_rate : float [rad/s]
    vx : float [m/s]
    ax : float [m/s^2]

    Returns
    -------
    ay : float [m/s^2]
    by_beta : float [m/s^2]
    by_rate : float [m/s]
        Derivative by yaw_rate and, the same, by beta_rate.
    """
    tangent = math.tan(beta)
    secant2 = 1.0 + tangent * tangent
    course_rate = beta_rate + yaw_rate
    by_beta = secant2 * (2.0 * vx * course_rate * tangent + ax)
    return vx * course_rate * secant2 + ax * tangent, by_beta, vx * secant2

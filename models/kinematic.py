"""Kinematic model of the planar motion (Atheupe 2023, eq. 18 to 21, with the errata: ax = vx_dot - r vy)."""

from __future__ import annotations

import math

from crosscomb.models.compiled import inlined


@inlined
def velocity_rates(vx, vy, yaw_rate, ax, ay):
    """Rates of the velocity in the turning frame of the car.

    Parameters
    ----------
    vx, vy : float [m/s]
    yaw_rate : float [rad/s]
    ax, ay : float [m/s^2]
        Acceleration of the centre of gravity, without gravity.

    Returns
    -------
    vx_dot, vy_dot : float [m/s^2]
    """
    return ax + yaw_rate * vy, ay - yaw_rate * vx


@inlined
def slip_rate(vx, yaw_rate, ay):
    """Rate of a small sideslip angle at steady speed [rad/s]: that of vy over vx.

    Parameters
    ----------
    vx : float [m/s]
        Positive.
    yaw_rate : float [rad/s]
    ay : float [m/s^2]
    """
    return ay / vx - yaw_rate


@inlined
def rotation(yaw_rate, dt):
    """Exact transition of the velocity over one step: the frame turns by yaw_rate dt under it.

    Returns
    -------
    f11, f12, f21, f22 : float
        Elements of the transition matrix for the state [vx, vy].
    """
    angle = yaw_rate * dt
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine, sine, -sine, cosine


@inlined
def input_gain(yaw_rate, dt):
    """Exact gain from an acceleration held over one step to the velocity at its end.

    Returns
    -------
    g11, g12, g21, g22 : float [s]
        Integral of the transition over the step.
    """
    angle = yaw_rate * dt
    if abs(angle) < 1e-4:  # series: sin(a)/a and (1 - cos(a))/a lose their digits near zero
        along, across = dt * (1.0 - angle * angle / 6.0), 0.5 * dt * angle
    else:
        along, across = dt * math.sin(angle) / angle, dt * (1.0 - math.cos(angle)) / angle
    return along, across, -across, along


@inlined
def rolling_curvature(steer, steer_rear, wheelbase):
    """Curvature of the path of a car that rolls without tyre slip [1/m]: its yaw rate is this times vx."""
    return (math.tan(steer) - math.tan(steer_rear)) / wheelbase


@inlined
def rolling_rear(yaw_rate, steer_rear, cg_to_rear_axle):
    """What holds while the rear axle moves along its wheels, without tyre slip: h vx + vy = rest.

    Parameters
    ----------
    yaw_rate : float [rad/s]
    steer_rear : float [rad]
    cg_to_rear_axle : float [m]

    Returns
    -------
    h : float
    rest : float [m/s]
    """
    return -math.tan(steer_rear), cg_to_rear_axle * yaw_rate


@inlined
def slip_of_rolling_rear(steer, steer_rear, cg_to_front_axle, cg_to_rear_axle):
    """Sideslip angle of a car that rolls without tyre slip, from the steering alone [rad].

    Both axles move along their wheels. The answer at walking speed, where tyre slip is small and dynamic models
    are stiff.
    """
    curvature = rolling_curvature(steer, steer_rear, cg_to_front_axle + cg_to_rear_axle)
    h, rest = rolling_rear(curvature, steer_rear, cg_to_rear_axle)
    return math.atan(rest - h)

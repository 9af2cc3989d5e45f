"""Random-walk force model: the axle forces are states that nothing drives but noise.

Atheupe 2023, eq. 29 with eq. 23, corrected as `crosscomb.models.single_track`; the state is
(yaw_rate, beta, fxf, fxr, fyf, fyr). Needs neither friction nor cornering stiffness.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import inlined
from crosscomb.models.single_track import axle_slopes, body_rates, sin_cos_tan, slip_rate_slope


@inlined
def random_walk_rates(state, vx, steer, steer_rear, car):
    """Rates and measurements of the random-walk model.

    Parameters
    ----------
    state : (6,) [rad/s, rad, N, N, N, N]
        yaw_rate, beta, fxf, fxr, fyf, fyr.
    vx : float [m/s]
    steer, steer_rear : float [rad]
    car : SingleTrack
        Only mass, yaw inertia and axle distances are used.

    Returns
    -------
    yaw_acceleration [rad/s^2], beta_rate [rad/s], ax, ay [m/s^2]
        The rates of the four forces are zero.
    """
    return body_rates(
        state[2], state[3], state[4], state[5], vx, state[0],
        math.cos(steer), math.sin(steer), math.cos(steer_rear), math.sin(steer_rear),
        math.cos(state[1]), math.sin(state[1]), car.mass, car.yaw_inertia, car.a, car.b,
    )  # fmt: skip


@inlined
def random_walk_jacobian(state, vx, steer, steer_rear, car, jacobian):
    """`random_walk_rates` and its derivatives by the state.

    Parameters
    ----------
    state, vx, steer, steer_rear, car
        As in `random_walk_rates`.
    jacobian : (4, 6)
        Filled: rows yaw_acceleration, beta_rate, ax, ay; columns as the state.

    Returns
    -------
    As `random_walk_rates`.
    """
    cos_f, sin_f = math.cos(steer), math.sin(steer)
    cos_r, sin_r = math.cos(steer_rear), math.sin(steer_rear)
    sin_b, cos_b, _ = sin_cos_tan(state[1])
    mass, inertia = car.mass, car.yaw_inertia
    # A longitudinal force is a lateral one turned by -90 deg: (cos, sin) becomes (sin, -cos).
    set_column(jacobian, 2, axle_slopes(sin_f, -cos_f, car.a, vx, cos_b, sin_b, mass, inertia))
    set_column(jacobian, 3, axle_slopes(sin_r, -cos_r, -car.b, vx, cos_b, sin_b, mass, inertia))
    set_column(jacobian, 4, axle_slopes(cos_f, sin_f, car.a, vx, cos_b, sin_b, mass, inertia))
    set_column(jacobian, 5, axle_slopes(cos_r, sin_r, -car.b, vx, cos_b, sin_b, mass, inertia))
    yaw_acceleration, beta_rate, ax, ay = body_rates(
        state[2], state[3], state[4], state[5], vx, state[0], cos_f, sin_f, cos_r, sin_r,
        cos_b, sin_b, mass, inertia, car.a, car.b,
    )  # fmt: skip
    set_column(jacobian, 0, (0.0, -1.0, 0.0, 0.0))
    set_column(jacobian, 1, (0.0, slip_rate_slope(ax, ay, cos_b, sin_b, vx), 0.0, 0.0))
    return yaw_acceleration, beta_rate, ax, ay


@inlined
def set_column(matrix, column, values):
    """Write four values into a column of a matrix ``(4, n)``."""
    matrix[0, column], matrix[1, column], matrix[2, column], matrix[3, column] = values

"""Random-walk force model: the axle forces are states that nothing drives but noise.

Atheupe 2023, eq. 29 with eq. 23, corrected as `crosscomb.models.single_track`; the state is
(yaw_rate, beta, fxf, fxr, fyf, fyr). Needs neither friction nor cornering stiffness.
"""

from __future__ import annotations

import math

from numba import njit

from crosscomb.models.single_track import body_rates, body_slopes, slip_rate_slope


@njit(cache=True)
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


@njit(cache=True)
def random_walk_jacobian(state, vx, steer, steer_rear, car, jacobian):
    """Derivatives of `random_walk_rates` by the state.

    Parameters
    ----------
    state, vx, steer, steer_rear, car
        As in `random_walk_rates`.
    jacobian : (4, 6)
        Filled: rows yaw_acceleration, beta_rate, ax, ay; columns as the state.
    """
    cos_f, sin_f = math.cos(steer), math.sin(steer)
    cos_r, sin_r = math.cos(steer_rear), math.sin(steer_rear)
    cos_b, sin_b = math.cos(state[1]), math.sin(state[1])
    # A longitudinal force is a lateral one turned by -90 deg: (cos, sin) becomes (sin, -cos).
    longitudinal = (sin_f, -cos_f, sin_r, -cos_r)
    lateral = (cos_f, sin_f, cos_r, sin_r)
    for column in range(2, 6):
        cf, sf, cr, sr = longitudinal if column < 4 else lateral
        front = 1.0 if column % 2 == 0 else 0.0
        slopes = body_slopes(
            front, 1.0 - front, vx, cf, sf, cr, sr, cos_b, sin_b, car.mass, car.yaw_inertia, car.a, car.b
        )
        for row in range(4):
            jacobian[row, column] = slopes[row]
    _, _, ax, ay = random_walk_rates(state, vx, steer, steer_rear, car)
    for row in range(4):
        jacobian[row, 0] = jacobian[row, 1] = 0.0
    jacobian[1, 0] = -1.0
    jacobian[1, 1] = slip_rate_slope(ax, ay, cos_b, sin_b, vx)

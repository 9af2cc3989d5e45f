"""Linear single track: small angles, constant speed, linear tyres (Atheupe 2023, eq. 26 to 28, corrected)."""

from __future__ import annotations

from crosscomb.models.compiled import inlined


@inlined
def linear_single_track_rates(yaw_rate, beta, vx, steer, steer_rear, car):
    """Rates, ay and Jacobian of the linear single track.

    Parameters
    ----------
    yaw_rate : float [rad/s]
    beta : float [rad]
    vx : float [m/s]
        Positive.
    steer, steer_rear : float [rad]
        Road-wheel angles.
    car : SingleTrack
        Friction and tyre law are not used.

    Returns
    -------
    rates : yaw_acceleration [rad/s^2], beta_rate [rad/s]
    ay : float [m/s^2]
    jacobian : the derivatives of these three by yaw rate, then by beta
    """
    a, b, front, rear = car.a, car.b, car.stiffness_front, car.stiffness_rear
    fyf = front * (steer - beta - a * yaw_rate / vx)
    fyr = rear * (steer_rear - beta + b * yaw_rate / vx)
    ay = (fyf + fyr) / car.mass
    ay_r, ay_b = (b * rear - a * front) / (car.mass * vx), -(front + rear) / car.mass
    yaw_r = -(a * a * front + b * b * rear) / (car.yaw_inertia * vx)
    yaw_b = (b * rear - a * front) / car.yaw_inertia
    return (
        ((a * fyf - b * fyr) / car.yaw_inertia, ay / vx - yaw_rate),
        ay,
        (yaw_r, ay_r / vx - 1.0, ay_r, yaw_b, ay_b / vx, ay_b),
    )

"""Linear single track: small angles, constant speed, linear tyres (Atheupe 2023, eq. 26 to 28, corrected).

Its two damping terms and its understeer gradient bound, place and judge what nonlinear models do.
"""

from __future__ import annotations

from crosscomb.models.compiled import inlined
from crosscomb.models.kinematic import slip_rate


@inlined
def yaw_damping(car):
    """Yaw damping of the tyres times the speed: a^2 Cf + b^2 Cr [N m^2/rad]."""
    return car.a * car.a * car.stiffness_front + car.b * car.b * car.stiffness_rear


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
    yaw_r = -yaw_damping(car) / (car.yaw_inertia * vx)
    yaw_b = (b * rear - a * front) / car.yaw_inertia
    return (
        ((a * fyf - b * fyr) / car.yaw_inertia, slip_rate(vx, yaw_rate, ay)),
        ay,
        (yaw_r, ay_r / vx - 1.0, ay_r, yaw_b, ay_b / vx, ay_b),
    )


def understeer_gradient(
    mass: float, a: float, b: float, stiffness_front: float, stiffness_rear: float
) -> float:
    """Understeer gradient [rad per m/s^2]: what the steering angle of a bend grows by with its lateral acceleration.

    Parameters
    ----------
    mass : float [kg]
    a, b : float [m]
        From the centre of gravity to the front and the rear axle.
    stiffness_front, stiffness_rear : float [N/rad]
        Of the axles.
    """
    return mass / (a + b) * (b / stiffness_front - a / stiffness_rear)

"""Planar motion of a car on its wheels, state [u, v, r]: single and double track in one set of equations.

    u_dot = v r + X / m        ax = X / m
    v_dot = -u r + Y / m       ay = Y / m
    r_dot = M / Iz

X, Y, M are the sums of all wheel forces and their moment about the centre of gravity. A wheel is a contact
at (x, y) in the car, steered by an angle. The single track (D'Inverno 2021, eq. 6 and 14) has two wheels
with y = 0, the double track (Pieralice 2018, eq. 1) four with y = + and - half a track; with these contacts
the sums are the printed equations. Both front wheels have the same angle. Drag is part of the longitudinal
forces.

Tyres: `crosscomb.models.magic_formula`. Vertical loads are quasi-static, from the measured accelerations, so
they do not depend on the state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crosscomb.models.compiled import inlined
from crosscomb.models.magic_formula import magic_formula, magic_formula_bend, peak_friction
from crosscomb.models.single_track import axle_loads, friction_in_force
from crosscomb.models.tyres import lateral_capacity
from crosscomb.models.vehicle import Vehicle

TRACKS = ("single", "double")

COS, SIN, SIDE_ARM, ROLL_ARM, STIFFNESS, PEAK = range(6)
"""Columns of a wheel. The speed of its contact across and along it is -SIN u + COS v + SIDE_ARM r and
COS u + SIN v + ROLL_ARM r; by duality the arms [m] are also those of the lateral and longitudinal force about
the centre of gravity. STIFFNESS and PEAK are B and D of the Magic Formula."""


class PlanarCar(NamedTuple):
    """Parameters of the planar models as kernels take them."""

    wheels: int  # 2 on the single track, 4 on the double track
    mass: float  # [kg]
    yaw_inertia: float  # [kg m^2]
    a: float  # centre of gravity to front axle [m]
    b: float  # centre of gravity to rear axle [m]
    half_track_front: float  # [m]
    half_track_rear: float  # [m]
    cg_height: float  # [m]
    roll_share_front: float  # share of the lateral load transfer
    stiffness_front: float  # of the axle at its static load [N/rad]
    stiffness_rear: float  # [N/rad]
    friction: float
    shape: float  # C of the Magic Formula
    curvature: float  # E
    load_sensitivity: float  # friction lost per static load added


def planar_car(vehicle: Vehicle, track: str = "single") -> PlanarCar:
    """Take the parameters of the planar models from a vehicle.

    Parameters
    ----------
    vehicle : Vehicle
    track : {"single", "double"}
    """
    return PlanarCar(
        wheels=2 if track == "single" else 4,
        mass=vehicle.mass,
        yaw_inertia=vehicle.yaw_inertia,
        a=vehicle.cg_to_front_axle,
        b=vehicle.cg_to_rear_axle,
        half_track_front=0.5 * vehicle.track_front,
        half_track_rear=0.5 * vehicle.track_rear,
        cg_height=vehicle.cg_height,
        roll_share_front=vehicle.plant.roll_share_front,
        stiffness_front=vehicle.cornering_stiffness_front,
        stiffness_rear=vehicle.cornering_stiffness_rear,
        friction=vehicle.friction,
        shape=vehicle.tyre.shape,
        curvature=vehicle.tyre.curvature,
        load_sensitivity=vehicle.tyre.load_sensitivity,
    )


class Contacts(NamedTuple):
    """What is known of the wheels at one sample, whatever the state; changed in place."""

    wheels: np.ndarray  # (4, 6), the first two rows on the single track
    known: np.ndarray  # (3,) X [N], Y [N], M [N m] of the longitudinal forces
    speed_rows: np.ndarray  # (2, 3) rolling speed of the front left and right wheel over the state


def contacts() -> Contacts:
    """Make contacts to be set by `set_contacts`."""
    return Contacts(np.zeros((4, 6)), np.zeros(3), np.zeros((2, 3)))


@inlined
def set_contacts(contact, steer, steer_rear, fxf, fxr, ax, ay, car):
    """Set the contacts of one sample.

    Friction is the vehicle file's, or `FRICTION_MARGIN` times the acceleration in use if that is more, as in
    `crosscomb.models.single_track`; the stiffness at zero slip stays the file's either way.

    Parameters
    ----------
    contact : Contacts
        Changed in place.
    steer, steer_rear : float [rad]
        Road-wheel angles.
    fxf, fxr : float [N]
        Longitudinal forces of the axles, split evenly between left and right.
    ax, ay : float [m/s^2]
        Measured, for load transfer and friction; 0 where not known.
    car : PlanarCar
    """
    wheels, known, rows = contact.wheels, contact.known, contact.speed_rows
    friction = friction_in_force(car.friction, ax, ay)
    rest_f, rest_r = axle_loads(0.0, car)
    load_f, load_r = axle_loads(ax, car)
    # A left turn, ay > 0, loads the right wheels.
    roll = 0.5 * car.mass * ay * car.cg_height
    half_f, half_r, share = car.half_track_front, car.half_track_rear, car.roll_share_front
    front, rear = (0, 1) if car.wheels == 2 else (0, 2)
    axle = (rest_f, load_f, roll * share, car.stiffness_front, fxf)
    x_f, y_f, moment_f = set_axle(wheels, front, rear, steer, car.a, half_f, axle, friction, car)
    axle = (rest_r, load_r, roll * (1.0 - share), car.stiffness_rear, fxr)
    x_r, y_r, moment_r = set_axle(wheels, rear, car.wheels, steer_rear, -car.b, half_r, axle, friction, car)
    known[0], known[1], known[2] = x_f + x_r, y_f + y_r, moment_f + moment_r
    cos_f, sin_f = wheels[0, COS], wheels[0, SIN]
    # (cos, sin, a sin -/+ t/2 cos); printed with -t/2 on the right as well (D'Inverno 2021, eq. 16).
    for i in range(2):
        y = car.half_track_front if i == 0 else -car.half_track_front
        rows[i, 0], rows[i, 1], rows[i, 2] = cos_f, sin_f, car.a * sin_f - y * cos_f


@inlined
def set_axle(wheels, first, end, angle, x, half_track, axle, friction, car):
    """Set the wheels first to end of an axle at x [m], one in the middle or a left and a right one.

    `axle` holds the axle's load at rest and now [N], roll moment [N m], stiffness [N/rad] and longitudinal force
    [N]. Gives X [N], Y [N] and M [N m] of the longitudinal forces.
    """
    rest, load, roll, stiffness, force = axle
    cos, sin = math.cos(angle), math.sin(angle)
    count = end - first
    part = 1.0 / count
    transfer, y = (roll / half_track, half_track) if count == 2 else (0.0, 0.0)
    factor = stiffness / (car.shape * friction * rest)
    rest, load, force = rest * part, load * part, force * part
    a1, a2 = -friction * car.load_sensitivity / rest, friction * (1.0 + car.load_sensitivity)
    moment = 0.0
    for i in range(first, end):
        wheel_load = max(load - transfer, 0.05 * rest)
        mu = max(peak_friction(wheel_load, a1, a2), 0.5 * friction)
        wheels[i, COS], wheels[i, SIN] = cos, sin
        wheels[i, SIDE_ARM], wheels[i, ROLL_ARM] = x * cos + y * sin, x * sin - y * cos
        wheels[i, STIFFNESS] = factor
        wheels[i, PEAK] = lateral_capacity(mu, wheel_load, force)
        moment += force * wheels[i, ROLL_ARM]
        transfer, y = -transfer, -y
    return count * force * cos, count * force * sin, moment


@inlined
def wheel_slip(u, v, r, wheels, i):
    """Slip angle of a wheel and its derivatives by the contact's speed across and along the wheel.

    Parameters
    ----------
    u, v, r : float [m/s], [m/s], [rad/s]
    wheels : (4, 6)
    i : int
        Number of the wheel.

    Returns
    -------
    slip, by_side, by_roll : float [rad], [rad s/m], [rad s/m]
    side, roll : float [m/s]
        Speeds of the contact across the wheel and, without sign, along it.
    """
    side = -wheels[i, SIN] * u + wheels[i, COS] * v + wheels[i, SIDE_ARM] * r
    roll = wheels[i, COS] * u + wheels[i, SIN] * v + wheels[i, ROLL_ARM] * r
    way = max(abs(roll), 1e-6)
    inverse = 1.0 / (side * side + way * way)
    return -math.atan(side / way), -way * inverse, math.copysign(side, side * roll) * inverse, side, way


@inlined
def planar_rates(u, v, r, contact, car):
    """Rates and accelerations of the planar model.

    Parameters
    ----------
    u, v : float [m/s]
        Velocity of the centre of gravity along and across the car.
    r : float [rad/s]
        Yaw rate.
    contact : Contacts
    car : PlanarCar

    Returns
    -------
    u_dot, v_dot [m/s^2], r_dot [rad/s^2], ax, ay [m/s^2]
    """
    x, y, moment = contact.known[0], contact.known[1], contact.known[2]
    wheels = contact.wheels
    for i in range(car.wheels):
        slip, _, _, _, _ = wheel_slip(u, v, r, wheels, i)
        force, _ = magic_formula(slip, wheels[i, STIFFNESS], car.shape, wheels[i, PEAK], car.curvature)
        x -= force * wheels[i, SIN]
        y += force * wheels[i, COS]
        moment += force * wheels[i, SIDE_ARM]
    ax, ay = x / car.mass, y / car.mass
    return v * r + ax, ay - u * r, moment / car.yaw_inertia, ax, ay


@inlined
def planar_jacobian(u, v, r, contact, car, jacobian):
    """`planar_rates` and its Jacobian, analytically.

    Parameters
    ----------
    u, v, r, contact, car
        As in `planar_rates`.
    jacobian : (5, 3)
        Gets the derivatives of the five answers by u, v and r.

    Returns
    -------
    As `planar_rates`.
    """
    x, y, moment = contact.known[0], contact.known[1], contact.known[2]
    xu, xv, xr, yu, yv, yr, mu, mv, mr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    wheels = contact.wheels
    for i in range(car.wheels):
        cos, sin, arm = wheels[i, COS], wheels[i, SIN], wheels[i, SIDE_ARM]
        slip, by_side, by_roll, _, _ = wheel_slip(u, v, r, wheels, i)
        force, slope = magic_formula(slip, wheels[i, STIFFNESS], car.shape, wheels[i, PEAK], car.curvature)
        du = slope * (by_roll * cos - by_side * sin)
        dv = slope * (by_roll * sin + by_side * cos)
        dr = slope * (by_roll * wheels[i, ROLL_ARM] + by_side * arm)
        x, y, moment = x - force * sin, y + force * cos, moment + force * arm
        xu, xv, xr = xu - du * sin, xv - dv * sin, xr - dr * sin
        yu, yv, yr = yu + du * cos, yv + dv * cos, yr + dr * cos
        mu, mv, mr = mu + du * arm, mv + dv * arm, mr + dr * arm
    mass, inertia = car.mass, car.yaw_inertia
    jacobian[3, 0], jacobian[3, 1], jacobian[3, 2] = xu / mass, xv / mass, xr / mass
    jacobian[4, 0], jacobian[4, 1], jacobian[4, 2] = yu / mass, yv / mass, yr / mass
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = xu / mass, xv / mass + r, xr / mass + v
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = yu / mass - r, yv / mass, yr / mass - u
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = mu / inertia, mv / inertia, mr / inertia
    ax, ay = x / mass, y / mass
    return v * r + ax, ay - u * r, moment / inertia, ax, ay


@inlined
def planar_hessian(u, v, r, contact, car, hessian):
    """Second derivatives of `planar_rates`, analytically.

    Parameters
    ----------
    u, v, r, contact, car
        As in `planar_rates`.
    hessian : (5, 3, 3)
        Gets the second derivatives of the five answers by u, v and r.
    """
    hessian[:] = 0.0
    wheels = contact.wheels
    for i in range(car.wheels):
        cos, sin, arm = wheels[i, COS], wheels[i, SIN], wheels[i, SIDE_ARM]
        slip, by_side, by_roll, side, way = wheel_slip(u, v, r, wheels, i)
        slope, bend = magic_formula_bend(
            slip, wheels[i, STIFFNESS], car.shape, wheels[i, PEAK], car.curvature
        )
        # Second derivatives of -atan(side / |roll|).
        rho4 = (side * side + way * way) ** 2
        twice = 2.0 * way * side / rho4
        mixed = math.copysign(1.0, by_roll * side) * (way * way - side * side) / rho4
        across, along = (-sin, cos, arm), (cos, sin, wheels[i, ROLL_ARM])
        for j in range(3):
            slip_j = by_side * across[j] + by_roll * along[j]
            for k in range(j + 1):
                slip_k = by_side * across[k] + by_roll * along[k]
                second = twice * (across[j] * across[k] - along[j] * along[k])
                second += mixed * (across[j] * along[k] + along[j] * across[k])
                force = bend * slip_j * slip_k + slope * second
                hessian[3, j, k] -= force * sin / car.mass
                hessian[4, j, k] += force * cos / car.mass
                hessian[2, j, k] += force * arm / car.yaw_inertia
    for j in range(3):
        for k in range(j + 1):
            hessian[0, j, k], hessian[1, j, k] = hessian[3, j, k], hessian[4, j, k]
    hessian[0, 2, 1] += 1.0
    hessian[1, 2, 0] -= 1.0
    for row in range(5):
        for j in range(3):
            for k in range(j):
                hessian[row, k, j] = hessian[row, j, k]

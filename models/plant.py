"""The simulation plant: its states, inputs and parameters. The motion itself stands in `plant_motion`.

A four-wheel car: planar body with roll, pitch and heave, wheel spins, transient tyres, steering of both axles
with lag, free play and compliance. Equations and their sources: docs/plant.md.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

from crosscomb.models.linear_single_track import understeer_gradient
from crosscomb.models.tyres_combined import CombinedTyre
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY

AIR_DENSITY = 1.2

# States. Wheels are in the order front left, front right, rear left, rear right.
VX, VY, YAW_RATE = 0, 1, 2
X, Y, HEADING = 3, 4, 5
SPIN = 6  # four wheel spins [rad/s]
SLIP_X = 10  # four relaxed longitudinal slips [-]
SLIP_Y = 14  # four relaxed lateral slips [-]
SQUAT, SQUAT_RATE = 18, 19  # forward acceleration as the suspension carries it [m/s^2], [m/s^3]
ROLL, ROLL_RATE = 20, 21  # the same sideways; the roll angle is roll_gradient times it
HEAVE, HEAVE_RATE = 22, 23  # the same upwards: the load on all wheels is mass times it
STEER, STEER_REAR = 24, 25  # road-wheel angles [rad]
TOE_FRONT, TOE_REAR = 26, 27  # what side force takes from them [rad]
DRIVE = 28  # drive torque, sum over the wheels [N m]
STATES = 29

# Inputs, in the order of the input array.
STEER_COMMAND, STEER_REAR_COMMAND, DRIVE_COMMAND, BRAKE, HANDBRAKE = 0, 1, 2, 3, 4
FRICTION = 5  # four friction coefficients, one per wheel
# Sines of the road's angles along and across the car, and the curvature of a crest or dip [1/m]: uphill, left
# side raised and dip are positive.
SLOPE, BANK, DIP = 9, 10, 11
INPUTS = 12


class PlantParameters(NamedTuple):
    """The car as the kernels need it, SI units; `share_front` is the front axle's part of the drive."""

    mass: float
    yaw_inertia: float
    front: float
    rear: float
    half_track_front: float
    half_track_rear: float
    cg_height: float
    wheel_radius: float
    wheel_inertia: float
    drag: float
    lift: float
    share_front: float
    brake_share_front: float
    roll_share_front: float
    power: float
    max_steer: float
    max_steer_rear: float
    steer_lag: float
    half_play: float
    compliance_front: float
    compliance_rear: float
    roll_steer_front: float
    roll_steer_rear: float
    body_rate: float
    body_damping: float
    anti_lock: float
    traction_control: float
    differential_lock: float
    relaxation_x: float
    relaxation_y: float
    tyre_front: CombinedTyre
    tyre_rear: CombinedTyre


def make_plant(
    vehicle: Vehicle,
    mass_factor: float = 1.0,
    front_stiffness_factor: float = 1.0,
    rear_stiffness_factor: float = 1.0,
) -> PlantParameters:
    """Make the kernels' parameters from a vehicle.

    The cornering stiffness of the vehicle is that of the axle, compliance of its suspension included, so that
    the tyres themselves are stiffer.

    Parameters
    ----------
    vehicle : Vehicle
    mass_factor : float
        Scales mass and yaw inertia.
    front_stiffness_factor, rear_stiffness_factor : float
        Scale the cornering stiffness of an axle.
    """
    plant, law = vehicle.plant, vehicle.tyre
    mass = vehicle.mass * mass_factor
    weight = mass * GRAVITY / vehicle.wheelbase / 2.0
    front = vehicle.cornering_stiffness_front * front_stiffness_factor
    rear = vehicle.cornering_stiffness_rear * rear_stiffness_factor
    tyre_front = CombinedTyre(
        weight * vehicle.cg_to_rear_axle,
        _tyre_stiffness(front, plant.compliance_front),
        law.shape,
        law.curvature,
        law.load_sensitivity,
        law.stiffness_peak_load,
    )
    tyre_rear = tyre_front._replace(
        load=weight * vehicle.cg_to_front_axle,
        stiffness=_tyre_stiffness(rear, plant.compliance_rear),
    )
    return PlantParameters(
        mass=mass,
        yaw_inertia=vehicle.yaw_inertia * mass_factor,
        front=vehicle.cg_to_front_axle,
        rear=vehicle.cg_to_rear_axle,
        half_track_front=vehicle.track_front / 2.0,
        half_track_rear=vehicle.track_rear / 2.0,
        cg_height=vehicle.cg_height,
        wheel_radius=vehicle.wheel_radius,
        wheel_inertia=plant.wheel_inertia,
        drag=0.5 * AIR_DENSITY * plant.drag_area,
        lift=0.5 * AIR_DENSITY * plant.lift_area,
        share_front={"front": 1.0, "rear": 0.0, "all": plant.drive_share_front}[plant.drive],
        brake_share_front=plant.brake_share_front,
        roll_share_front=plant.roll_share_front,
        power=plant.power,
        max_steer=plant.max_steer,
        max_steer_rear=plant.max_steer_rear,
        steer_lag=plant.steer_lag,
        half_play=0.5 * plant.steer_free_play,
        compliance_front=plant.compliance_front,
        compliance_rear=plant.compliance_rear,
        roll_steer_front=plant.roll_steer_front * vehicle.roll_gradient,
        roll_steer_rear=plant.roll_steer_rear * vehicle.roll_gradient,
        body_rate=2.0 * pi * plant.body_frequency,
        body_damping=plant.body_damping,
        anti_lock=float(plant.anti_lock),
        traction_control=float(plant.traction_control),
        differential_lock=min(plant.differential_lock, stiffest_lock(vehicle)),
        relaxation_x=0.5 * law.relaxation_length,
        relaxation_y=law.relaxation_length,
        tyre_front=tyre_front,
        tyre_rear=tyre_rear,
    )


def stiffest_lock(vehicle: Vehicle) -> float:
    """Stiffest differential lock [N m s/rad] that light wheels bear at a step of 1 ms: 1000 1/s."""
    return 500.0 * vehicle.plant.wheel_inertia


def _tyre_stiffness(axle: float, compliance: float) -> float:
    """Stiffness of one tyre [N/rad] from that of the axle; at most what twice the axle's needs."""
    return 0.5 * axle / max(1.0 - compliance * axle, 0.5)


def understeer(p: PlantParameters) -> float:
    """Understeer gradient [rad per m/s^2] of the linear single track."""
    front, rear = (
        2.0 * tyre.stiffness / (1.0 + 2.0 * compliance * tyre.stiffness)
        for tyre, compliance in ((p.tyre_front, p.compliance_front), (p.tyre_rear, p.compliance_rear))
    )
    gradient = understeer_gradient(p.mass, p.front, p.rear, front, rear)
    return gradient + p.roll_steer_front + p.roll_steer_rear


def critical_speed(p: PlantParameters) -> float:
    """Speed [m/s] above which an oversteering car is unstable; infinite for an understeering one."""
    gradient = understeer(p)
    return float(((p.front + p.rear) / -gradient) ** 0.5) if gradient < 0.0 else float("inf")

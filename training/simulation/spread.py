"""How the car on the road differs from its vehicle file: the unknowns of one log, and its driver."""

from __future__ import annotations

import numpy as np

from crosscomb.models.plant import PlantParameters, make_plant, stiffest_lock
from crosscomb.models.vehicle import Vehicle
from crosscomb.training.simulation.manoeuvres import SLIDING
from crosscomb.training.simulation.schedule import Driver

MASS_SPREAD = 0.10
STIFFNESS_SPREAD = 0.15
RELAXATION_SPREAD = 0.25
HEIGHT_SPREAD = 0.05
CG_SPREAD = 0.03  # of the wheelbase
SLIDE_POWER = 120.0
SLIDE_LOCK = 80.0
FREE_PLAY = 0.002
AIDS_OFF = 0.3

SPREADS: dict[str, object] = {
    "mass": MASS_SPREAD,
    "tyre_stiffness_per_axle": STIFFNESS_SPREAD,
    "relaxation_length": RELAXATION_SPREAD,
    "height_of_the_centre_of_gravity": HEIGHT_SPREAD,
    "place_of_the_centre_of_gravity_over_wheelbase": CG_SPREAD,
    "steering_free_play_up_to_rad": FREE_PLAY,
    "share_of_logs_without_anti_lock": AIDS_OFF,
    "share_of_logs_without_traction_control": AIDS_OFF,
    "changed_for_slides": {
        "traction_control": False,
        "least_power_W_per_kg": SLIDE_POWER,
        "least_differential_lock_Nm_s_per_rad": SLIDE_LOCK,
    },
}
"""The card's words for it; plain numbers are relative and uniform to either side."""


def draw_plant(
    vehicle: Vehicle, manoeuvre: str, rng: np.random.Generator, spread: bool = True
) -> PlantParameters:
    """Draw the car of one log; without spread only what the manoeuvre needs is changed.

    Parameters
    ----------
    vehicle : Vehicle
    manoeuvre : str
        A sliding one gets power, a locked differential and no traction control.
    rng : numpy.random.Generator
    spread : bool
    """
    draws = rng.uniform(-1.0, 1.0, 6) * spread
    play, anti_lock, traction_control = rng.uniform(0.0, 1.0, 3)
    plant = make_plant(
        vehicle,
        1.0 + MASS_SPREAD * draws[0],
        1.0 + STIFFNESS_SPREAD * draws[1],
        1.0 + STIFFNESS_SPREAD * draws[2],
    )
    if spread:
        plant = _move_centre(plant, CG_SPREAD * draws[5] * vehicle.wheelbase)
        plant = plant._replace(
            relaxation_x=plant.relaxation_x * (1.0 + RELAXATION_SPREAD * draws[3]),
            relaxation_y=plant.relaxation_y * (1.0 + RELAXATION_SPREAD * draws[3]),
            cg_height=plant.cg_height * (1.0 + HEIGHT_SPREAD * draws[4]),
            half_play=max(plant.half_play, 0.5 * FREE_PLAY * play),
            anti_lock=plant.anti_lock * float(anti_lock > AIDS_OFF),
            traction_control=plant.traction_control * float(traction_control > AIDS_OFF),
        )
    if manoeuvre in SLIDING:
        plant = plant._replace(
            power=max(plant.power, SLIDE_POWER * vehicle.mass),
            differential_lock=max(plant.differential_lock, min(SLIDE_LOCK, stiffest_lock(vehicle))),
            traction_control=0.0,
        )
    return plant


def _move_centre(plant: PlantParameters, back: float) -> PlantParameters:
    """The centre of gravity moved back [m]; the wheels' loads follow, their stiffness stays."""
    front, rear = plant.front + back, plant.rear - back
    return plant._replace(
        front=front,
        rear=rear,
        tyre_front=plant.tyre_front._replace(load=plant.tyre_front.load * rear / plant.rear),
        tyre_rear=plant.tyre_rear._replace(load=plant.tyre_rear.load * front / plant.front),
    )


def draw_driver(rng: np.random.Generator) -> Driver:
    """Draw the habits of a driver."""
    return Driver(
        preview=rng.uniform(0.5, 0.8),
        steer_rate=rng.uniform(0.7, 1.2),
        acceleration=rng.uniform(1.5, 4.0),
        deceleration=rng.uniform(4.0, 7.0),
        wheel_spin=rng.uniform(0.3, 0.8),
    )

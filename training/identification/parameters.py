"""What identification seeks: the parameters, what is believed of them beforehand, and what a fit gives back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from crosscomb.models.linear_single_track import understeer_gradient
from crosscomb.models.plant import PlantParameters, make_plant
from crosscomb.models.tyres_combined import FIRM_GROUND
from crosscomb.models.vehicle import Vehicle
from crosscomb.training.identification.response import Sensing
from crosscomb.training.identification.trace import Trace

OUTPUTS = 3  # yaw rate, ay, beta of the reference


@dataclass(frozen=True)
class Sought:
    """One parameter of the fit.

    Attributes
    ----------
    spread : float
        Standard deviation of the prior; of the logarithm where `positive`.
    """

    name: str
    spread: float
    positive: bool = False
    step: float = 1e-3


CAR = (
    Sought("steering_ratio", 0.35, True),
    Sought("steer_scale", 0.03, True),
    Sought("cornering_stiffness_front", 0.35, True),
    Sought("cornering_stiffness_rear", 0.35, True),
    Sought("yaw_inertia", 0.3, True),
    Sought("friction", 0.25, True),
    Sought("cg_to_rear_axle", 0.05, step=0.005),
    Sought("roll_gradient", 0.006, step=1e-4),
    Sought("position", 1.5, step=0.01),
    Sought("yaw_delay", 0.06, step=0.002),
    Sought("ay_delay", 0.06, step=0.002),
    Sought("beta_delay", 0.06, step=0.002),
    Sought("relaxation_length", 0.15, True, step=0.02),
    Sought("stiffness_peak_load", 0.25, True, step=0.02),
    Sought("roll_share_front", 0.05, step=0.01),
    Sought("differential_lock", 3.0, step=0.3),
)
NUISANCES = {
    "relaxation_length": "tyre",
    "stiffness_peak_load": "tyre",
    "roll_share_front": "plant",
    "differential_lock": "plant",
}
"""What is only sought so that nothing else stands in for it, with the table of the vehicle file that guesses it."""
LOG = (
    Sought("steer_offset", 0.03, step=1e-4),
    Sought("yaw_bias", 0.01, step=1e-4),
    Sought("ay_bias", 0.4, step=1e-2),
    Sought("beta_bias", 0.01, step=1e-4),
)
IN_VEHICLE = {
    "steering_ratio", "cornering_stiffness_front", "cornering_stiffness_rear", "yaw_inertia", "friction",
    "roll_gradient", "cg_to_rear_axle",
}  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """What is fitted to what.

    Attributes
    ----------
    traces : sequence of Trace
    vehicle : Vehicle
        Values before; also what is kept where nothing is sought.
    known : list of dict
        For each log, offsets known from standstill: name to (value, standard deviation).
    fixed : dict
        Values of parameters that are not sought.
    beliefs : tuple of Belief
    errors : ndarray
        ``(logs, OUTPUTS)`` standard deviation of the model's error.
    """

    traces: Sequence[Trace]
    vehicle: Vehicle
    known: list[dict[str, tuple[float, float]]]
    fixed: dict[str, float] = field(default_factory=dict)
    beliefs: tuple[Belief, ...] = ()
    errors: np.ndarray = field(default_factory=lambda: np.zeros((0, OUTPUTS)))

    @property
    def car_sought(self) -> list[Sought]:
        """Parameters of the car that are open."""
        return [one for one in CAR if one.name not in self.fixed]

    @property
    def log_sought(self) -> list[Sought]:
        """Offsets of each log that are open."""
        return [one for one in LOG if one.name not in self.fixed]


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes
    ----------
    car : dict
        Every parameter of the car, sought or fixed.
    logs : list of dict
        Offsets of each log.
    car_std, log_std
        Their standard deviations; of the logarithm where the parameter is positive. Fixed ones are missing.
    """

    car: dict[str, float]
    logs: list[dict[str, float]]
    car_std: dict[str, float]
    log_std: list[dict[str, float]]

    def sensing(self, i: int) -> Sensing:
        """How the sensors of log i see the car."""
        return make_sensing(self.car, self.logs[i])


def make_sensing(car: dict[str, float], offsets: dict[str, float]) -> Sensing:
    """Gather what the sensors do from the parameters of the car and of one log."""
    common = ("steer_scale", "yaw_delay", "ay_delay", "beta_delay", "roll_gradient", "position")
    return Sensing(ratio=car["steering_ratio"], **offsets, **{name: car[name] for name in common})


def tyre_car(vehicle: Vehicle, car: dict[str, float]) -> PlantParameters:
    """The car with the parameters of a fit, as the simulation plant takes it.

    Unlike in the plant, stiffness does not fall with the friction of the road: that on these roads is sought.
    """
    b = car["cg_to_rear_axle"]
    given = {
        name: car[name] for name in ("yaw_inertia", "cornering_stiffness_front", "cornering_stiffness_rear")
    }
    moved = {"cg_to_front_axle": vehicle.wheelbase - b, "cg_to_rear_axle": b}
    inner = {
        table: getattr(vehicle, table).model_copy(
            update={name: car[name] for name, its in NUISANCES.items() if its == table}
        )
        for table in ("tyre", "plant")
    }
    plant = make_plant(vehicle.model_copy(update=given | moved | inner))
    yielding = np.sqrt(min(car["friction"] / FIRM_GROUND, 1.0))
    front, rear = (
        tyre._replace(stiffness=tyre.stiffness / yielding) for tyre in (plant.tyre_front, plant.tyre_rear)
    )
    return plant._replace(tyre_front=front, tyre_rear=rear)


@dataclass(frozen=True)
class Belief:
    """Something known beforehand of the car's parameters together: a value with its standard deviation."""

    of: Callable[[dict[str, float]], float]
    value: float
    std: float


def usual_understeer(vehicle: Vehicle) -> Belief:
    """Road cars understeer by 0 to 3.5 deg per g; without it, driving at one speed confuses this with the ratio."""

    def gradient(car: dict[str, float]) -> float:
        b = car["cg_to_rear_axle"]
        stiffness = car["cornering_stiffness_front"], car["cornering_stiffness_rear"]
        return understeer_gradient(vehicle.mass, vehicle.wheelbase - b, b, *stiffness)

    return Belief(gradient, 0.003, 0.003)


def before_value(vehicle: Vehicle, name: str) -> float:
    """Value before: the vehicle file's, or that of a sensor without fault."""
    if name == "steer_scale":
        return 1.0
    if name in NUISANCES:
        return float(getattr(getattr(vehicle, NUISANCES[name]), name))
    return float(getattr(vehicle, name)) if name in IN_VEHICLE else 0.0

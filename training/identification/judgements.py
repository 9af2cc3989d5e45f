"""From a fit to judgements: which values are taken, with which interval, and in words why others are not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.identification.parameters import CAR, IN_VEHICLE, LOG, NUISANCES, Fit, before_value
from crosscomb.training.identification.tyres import AxleCurve

Z95 = 1.96

IMPLAUSIBLE = 3.0
"""No value is taken that lies further from the vehicle file's than so many standard deviations of the prior. Of the
sensors no file says anything that could be contradicted."""
FRICTION_USED = 0.75
"""Share of the friction that must have been used before its value is believed."""
FRICTION_BEYOND = 1.15
"""Friction assumed over the largest acceleration in use, while it is not known."""


@dataclass(frozen=True)
class Measure:
    """How a parameter is judged.

    Attributes
    ----------
    useful : float
        Half width of the 95 % interval up to which a value is taken; relative where `relative`.
    floor : float
        Standard deviation that the model's own simplicity costs, however long the logs are; likewise.
    """

    unit: str
    useful: float
    floor: float
    relative: bool = False


MEASURES = {
    "steering_ratio": Measure("-", 0.08, 0.006, True),
    "steer_scale": Measure("-", 0.05, 0.006, True),
    "cornering_stiffness_front": Measure("N/rad", 0.25, 0.025, True),
    "cornering_stiffness_rear": Measure("N/rad", 0.25, 0.025, True),
    "yaw_inertia": Measure("kg m^2", 0.30, 0.04, True),
    "friction": Measure("-", 0.20, 0.04, True),
    "roll_gradient": Measure("rad per m/s^2", 0.004, 0.0008),
    "cg_to_rear_axle": Measure("m", 0.08, 0.01),
    "position": Measure("m", 0.35, 0.05),
    "yaw_delay": Measure("s", 0.025, 0.002),
    "ay_delay": Measure("s", 0.025, 0.004),
    "beta_delay": Measure("s", 0.025, 0.0015),
    "steer_offset": Measure("rad", 0.004, 0.0004),
    "yaw_bias": Measure("rad/s", 0.004, 0.0002),
    "ay_bias": Measure("m/s^2", 0.2, 0.01),
    "ax_bias": Measure("m/s^2", 0.2, 0.01),
    # Behind the peak 1 % of the force, which load transfer and compliance cost, is worth 10 % of the shape.
    "tyre.shape": Measure("-", 0.25, 0.06, True),
    "beta_bias": Measure("rad", 0.006, 0.0005),
}

TYRE_UNITS = {"c1": "rad^2", "c2": "N/rad", "B": "1/rad", "C": "-", "D": "-"}

SAID = {
    "steer_scale": "road-wheel angle as measured over the true one",
    "position": "accelerometer ahead of the centre of gravity",
    "yaw_delay": "yaw rate behind the steering angle",
    "ay_delay": "lateral acceleration behind the steering angle",
    "beta_delay": "ground truth behind the steering angle",
    "steer_offset": "road-wheel angle straight ahead",
    "yaw_bias": "offset of the yaw rate",
    "ay_bias": "offset of the lateral acceleration",
    "ax_bias": "offset of the longitudinal acceleration",
    "beta_bias": "offset of the ground truth",
}
"""Plain words for parameters that no vehicle file has."""


@dataclass(frozen=True)
class Judgement:
    """One parameter before and after.

    Attributes
    ----------
    low, high : float
        95 % interval of what the logs say; for an offset, of what it is in any one log.
    taken : bool
        `after` differs from `before` because the logs tell it.
    word : str
        ``found``, ``roughly``, or why the value was left as it was.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float
    high: float
    taken: bool
    word: str


def judge_handling(vehicle: Vehicle, found: Fit, ratio_open: bool) -> dict[str, Judgement]:
    """Judge all that the joint fit sought."""
    judgements = {}
    for one in CAR:
        if one.name in NUISANCES:
            continue
        start = before_value(vehicle, one.name)
        if one.name in found.car_std:
            value = found.car[one.name]
            # A body does not lean into the bend; gravity taken out of ay too well may look so.
            value = max(value, 0.0) if one.name == "roll_gradient" else value
            judgements[one.name] = judge(one.name, start, value, found.car_std[one.name])
            away = (np.log(value / start) if one.positive else value - start) / one.spread
            if one.name in IN_VEHICLE and abs(away) > IMPLAUSIBLE:
                word = "contradicts the vehicle file; check both: left as it was"
                judgements[one.name] = replace(judgements[one.name], after=start, taken=False, word=word)
        elif one.name == "steering_ratio" and not ratio_open:
            word = "the road-wheel angle is measured itself: left as it was"
            judgements[one.name] = Judgement(one.name, "-", start, start, np.nan, np.nan, False, word)
    for one in LOG:
        if one.name in found.log_std[0]:
            values = np.array([offsets[one.name] for offsets in found.logs])
            weights = np.array([1.0 / std[one.name] ** 2 for std in found.log_std])
            weights, least = weights / weights.sum(), 1.0 / weights.sum()
            mean = float(weights @ values)
            # The interval holds what the offset is in any one log.
            scatter = float(weights @ (values - mean) ** 2)
            judgements[one.name] = judge(one.name, 0.0, mean, float(np.sqrt(least + scatter)))
    return judgements


def judge(name: str, start: float, value: float, std: float) -> Judgement:
    """Judge one value.

    Parameters
    ----------
    name : str
        A key of `MEASURES`.
    start : float
        Value before.
    value, std : float
        What the logs say; the standard deviation is that of the logarithm where the measure is relative.
    """
    measure = MEASURES[name]
    half = Z95 * float(np.hypot(std, measure.floor))
    low, high = (
        (value * np.exp(-half), value * np.exp(half)) if measure.relative else (value - half, value + half)
    )
    taken = half <= measure.useful
    if taken:
        word = "found" if half <= 0.5 * measure.useful else "found, roughly"
    elif low <= start <= high:
        word = "not excited by these logs: left as it was"
    else:
        word = "the value before does not fit, but these logs tell no better one: left as it was"
    return Judgement(
        name, measure.unit, start, value if taken else start, float(low), float(high), taken, word
    )


def judge_friction(start: float, fitted: Judgement, used: float, found: Fit) -> Judgement:
    """The friction counts where most of it was used; less than was used it cannot be."""
    used = used / (1.0 + GRAVITY * max(found.car["roll_gradient"], 0.0))
    value = found.car["friction"]
    if value < used <= start:
        word = f"{used:.2f} was used, and the model errs there: left as it was"
        return replace(fitted, after=start, low=used, high=np.nan, taken=False, word=word)
    if value < used:
        word = "at least: so much was used"
        return replace(fitted, after=used, low=used, high=used * FRICTION_BEYOND, taken=True, word=word)
    if used < FRICTION_USED * value:
        word = f"only {100.0 * used / value:.0f} % of it was used: left as it was"
        return replace(fitted, after=start, taken=False, word=word)
    return fitted


def judge_tyres(vehicle: Vehicle, tyres: dict[str, AxleCurve] | None) -> dict[str, Judgement]:
    """What the tyre curves tell: parameters of two laws per axle, and the shape for the vehicle file."""
    judgements: dict[str, Judgement] = {}
    for axle, curve in (tyres or {}).items():
        for law, found in (("rational", curve.rational), ("magic", curve.magic)):
            for name, (value, std) in (found or {}).items():
                low, high = value * np.exp(-Z95 * std), value * np.exp(Z95 * std)
                key = f"{law}_{name}_{axle}"
                judgements[key] = Judgement(
                    key, TYRE_UNITS[name], np.nan, value, low, high, False, "for reference"
                )
    shapes = [curve.magic["C"] for curve in (tyres or {}).values() if curve.magic]
    start = vehicle.tyre.shape
    if not shapes:
        word = "never slid far enough: left as it was"
        return judgements | {
            "tyre.shape": Judgement("tyre.shape", "-", start, start, np.nan, np.nan, False, word)
        }
    values, stds = np.array(shapes).T
    weights = 1.0 / np.maximum(stds, 0.02) ** 2
    mean = float(np.exp(weights @ np.log(values) / weights.sum()))
    return judgements | {"tyre.shape": judge("tyre.shape", start, mean, float(weights.sum() ** -0.5))}


def fitted_vehicle(vehicle: Vehicle, judgements: dict[str, Judgement]) -> Vehicle:
    """The vehicle with what was found, inside what a vehicle file may hold."""
    found = {
        name: judgements[name].after for name in IN_VEHICLE if name in judgements and judgements[name].taken
    }
    if "roll_gradient" in found:
        found["roll_gradient"] = min(found["roll_gradient"], 0.099)
    if "cg_to_rear_axle" in found:
        found["cg_to_front_axle"] = vehicle.wheelbase - found["cg_to_rear_axle"]
    if "friction" in found:
        found["friction"] = min(found["friction"], 3.0)
    return Vehicle(**(vehicle.model_dump() | found))


def fitted_tyre(vehicle: Vehicle, judgements: dict[str, Judgement]) -> Vehicle:
    """The vehicle with the shape of its tyre curve, where that was found."""
    shape = judgements["tyre.shape"]
    if not shape.taken:
        return vehicle
    tyre = vehicle.tyre.model_copy(update={"shape": float(np.clip(shape.after, 1.01, 1.99))})
    return vehicle.model_copy(update={"tyre": tyre})

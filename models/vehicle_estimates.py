"""A vehicle file from the three numbers everybody knows, with a stated estimate for everything else.

The rules are plain proportions. Their constants are read off the shipped real cars. The spread among these
stands in each line: it is what an estimate is worth. A known value always beats the rule.
"""

from __future__ import annotations

import json
from math import isfinite, pi

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle, parse_vehicle
from crosscomb.signals import GRAVITY

CG_HEIGHT_SHARE = 0.20
TRACK_SHARE = 0.59
WHEEL_RADIUS_SHARE = 0.125
INERTIA_FACTOR = 0.9
STEERING_RATIO = 16.0
STIFFNESS_PER_LOAD_FRONT = 15.0
STIFFNESS_PER_LOAD_REAR = 20.0
ROLL_DEG_PER_G = 4.4

# Outside these limits it is no road vehicle: the unit is wrong.
_BASICS = {
    "mass": (50.0, 60_000.0, "give it in kg"),
    "wheelbase": (0.8, 8.0, "give it in m"),
    "front_weight_share": (0.2, 0.8, "give the front axle's share of the weight, such as 0.6"),
}


def vehicle_from_basics(
    name: str,
    mass: float,
    wheelbase: float,
    front_weight_share: float,
    *,
    steering_ratio: float | None = None,
    track: float | None = None,
    cg_height: float | None = None,
    wheel_radius: float | None = None,
) -> tuple[Vehicle, str]:
    """Estimate a whole vehicle from its mass, wheelbase and weight distribution.

    Parameters
    ----------
    name : str
        Name of the car, for reports.
    mass : float
        Mass as driven, with load [kg].
    wheelbase : float
        Distance between the axles [m].
    front_weight_share : float
        Share of the weight on the front axle, 0 to 1 [-].
    steering_ratio : float, optional
        Steering-wheel angle over road-wheel angle [-].
    track : float, optional
        Distance between the wheels of an axle, the same front and rear [m].
    cg_height : float, optional
        Height of the centre of gravity over the road [m].
    wheel_radius : float, optional
        Rolling radius [m].

    Returns
    -------
    Vehicle
        The checked vehicle.
    str
        The same as the text of a vehicle file; each line says if its value was given or how it was estimated.

    Raises
    ------
    UsageError
        A value is not finite or cannot belong to a road vehicle.
    """
    for key, value in (("mass", mass), ("wheelbase", wheelbase), ("front_weight_share", front_weight_share)):
        low, high, mend = _BASICS[key]
        if not (isfinite(value) and low <= value <= high):
            raise UsageError(f"{key}: {value:g} is outside {low:g} to {high:g}: {mend}")
    front = wheelbase * (1.0 - front_weight_share)
    rear = wheelbase * front_weight_share
    weight = mass * GRAVITY
    lines = [
        "# Vehicle file in SI units. An estimate is a rule of thumb: put the true value where you know it.",
        f"name = {json.dumps(name, ensure_ascii=False)}",
        _given("mass", mass, "[kg]"),
        _estimate(
            "yaw_inertia",
            INERTIA_FACTOR * mass * front * rear,
            0,
            f"[kg m^2]: {INERTIA_FACTOR} mass times both axle distances (cars: 0.7 to 1.2)",
        ),
        f"cg_to_front_axle = {round(front, 6)}  # [m] from wheelbase and weight share",
        f"cg_to_rear_axle = {round(rear, 6)}  # [m] from wheelbase and weight share",
        _length("cg_height", cg_height, CG_HEIGHT_SHARE, wheelbase, "cars: 0.19 to 0.21"),
        _length("track_front", track, TRACK_SHARE, wheelbase, "cars: 0.55 to 0.63"),
        _length("track_rear", track, TRACK_SHARE, wheelbase, "cars: 0.55 to 0.63"),
        _length("wheel_radius", wheel_radius, WHEEL_RADIUS_SHARE, wheelbase, "cars: 0.12 to 0.14"),
        _estimate("steering_ratio", STEERING_RATIO, 1, "[-]: cars have 12 to 18")
        if steering_ratio is None
        else _given("steering_ratio", steering_ratio, "[-]"),
        _estimate(
            "cornering_stiffness_front",
            STIFFNESS_PER_LOAD_FRONT * weight * front_weight_share,
            0,
            f"[N/rad] per axle: {STIFFNESS_PER_LOAD_FRONT:g} times its weight (cars: 11 to 24)",
        ),
        _estimate(
            "cornering_stiffness_rear",
            STIFFNESS_PER_LOAD_REAR * weight * (1.0 - front_weight_share),
            0,
            f"[N/rad] per axle: {STIFFNESS_PER_LOAD_REAR:g} times its weight (cars: 16 to 27)",
        ),
        _estimate("friction", 0.9, 1, "[-]: good tyres on dry asphalt; wet about 0.7, snow 0.3"),
        _estimate(
            "roll_gradient",
            ROLL_DEG_PER_G * pi / 180.0 / GRAVITY,
            5,
            f"[rad per m/s^2]: {ROLL_DEG_PER_G:g} deg per g (cars: 4 to 5); 0 where ay holds no gravity",
        ),
    ]
    text = "\n".join(lines) + "\n"
    return parse_vehicle(text, name), text


def _given(key: str, value: float, unit: str) -> str:
    return f"{key} = {float(value)!r}  # given {unit}"


def _estimate(key: str, value: float, digits: int, rule: str) -> str:
    return f"{key} = {round(value, digits)!r}  # estimate {rule}"


def _length(key: str, given: float | None, share: float, wheelbase: float, spread: str) -> str:
    """The given length, else its usual share of the wheelbase."""
    if given is not None:
        return _given(key, given, "[m]")
    return _estimate(key, share * wheelbase, 3, f"[m]: {share:g} wheelbase ({spread})")

"""Find a car's parameters and its sensors' errors in logs, each with an interval or with a word why not.

Order of the work: what standstill says of the offsets; what the ground truth, where there is any, says of the
accelerometer and the latencies; then a joint fit of car and sensors. What the logs turn out not to tell keeps its
value from before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY, REFERENCES, Signals
from crosscomb.training.identify_drive import RATE, Drive, make_drive, settled
from crosscomb.training.identify_handling import (
    CAR,
    IN_VEHICLE,
    LOG,
    Belief,
    Fit,
    Problem,
    before,
    before_value,
    fit,
    usual_understeer,
)
from crosscomb.training.identify_sensors import Kinematics, Known, ax_bias, kinematics, still_biases
from crosscomb.training.identify_tyres import AxleCurve, tyre_curves
from crosscomb.training.recordings import Recording

Z95 = 1.96
LEAST_DRIVING = 5.0
"""Seconds of gentle driving below which a log says nothing of the handling."""
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
    "tyre.shape": Measure("-", 0.25, 0.03, True),
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
class Finding:
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


@dataclass(frozen=True)
class Identification:
    """What was found, with what pictures need.

    Attributes
    ----------
    vehicle : Vehicle
        With the values found.
    findings : dict of str to Finding
    fit, first : Fit
        After and before.
    problem : Problem
        Drives and model errors.
    ratio_open : bool
        The steering ratio was sought: the steering angle was that of the hand wheel.
    kinematics : Kinematics, optional
        What the ground truth alone said of the sensors.
    references : tuple of str
        Columns of ground truth in the logs.
    tyres : dict of str to AxleCurve, optional
        ``front`` and ``rear``.
    """

    vehicle: Vehicle
    findings: dict[str, Finding]
    fit: Fit
    first: Fit
    problem: Problem
    ratio_open: bool
    kinematics: Kinematics | None
    references: tuple[str, ...]
    tyres: dict[str, AxleCurve] | None


def identified_vehicle(
    recordings: Sequence[Recording], vehicle: Vehicle, use_reference: bool = True
) -> Vehicle:
    """The vehicle with what the recordings tell of it; the same vehicle where they tell nothing.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one car.
    vehicle : Vehicle
        Values before.
    use_reference : bool
        Use the ground truth of the recordings.
    """
    try:
        return identify([recording.signals for recording in recordings], vehicle, use_reference).vehicle
    except UsageError:
        return vehicle


def identify(logs: Sequence[Signals], vehicle: Vehicle, use_reference: bool = True) -> Identification:
    """Find the parameters of one car and its sensors.

    Parameters
    ----------
    logs : sequence of Signals
        As measured. Without speed they count for the offsets at standstill only.
    vehicle : Vehicle
        Values before; mass, wheelbase, tracks and the rest are believed, the centre of gravity to 5 cm.
    use_reference : bool
        Use ground truth where a log has it.

    Raises
    ------
    UsageError
        No log holds enough driving.
    """
    still = still_biases(logs)
    made = [(make_drive(log, vehicle, use_reference), known) for log, known in zip(logs, still, strict=True)]
    pairs = [
        (drive, known)
        for drive, known in made
        if drive is not None and settled(drive.wild).sum() > LEAST_DRIVING * RATE
    ]
    if not pairs:
        raise UsageError(
            f"{logs[0].source if logs else 'no log'}: no log holds {LEAST_DRIVING:g} s of driving above "
            f"walking pace: record a longer drive with bends to both sides"
        )
    drives = [drive for drive, _ in pairs]
    known = [own for _, own in pairs]
    ratio_open = all(drive.ratio_open for drive in drives)
    truth = kinematics(drives, known, vehicle)
    used = max(_strongest(drive) for drive in drives) / GRAVITY
    # What is sought begins at the least friction that may have been enough.
    enough = vehicle.model_copy(update={"friction": max(vehicle.friction, FRICTION_BEYOND * used)})
    problem = Problem(
        drives, enough, [_offsets(own) for own in known], _closed(vehicle, drives, ratio_open),
        (usual_understeer(vehicle), *_kinematic_beliefs(truth)),
    )  # fmt: skip
    first = before(problem)
    found, fitted = fit(problem)
    findings = _findings(vehicle, found, ratio_open)
    findings["friction"] = _friction_finding(vehicle.friction, findings["friction"], used, found)
    along = ax_bias(drives, known)
    if along is not None:
        findings["ax_bias"] = _finding("ax_bias", 0.0, along[0], along[1])
    references = tuple(name for name in REFERENCES if any(log.has(name) for log in logs))
    fitted_vehicle = _fitted(vehicle, findings)
    tyres = tyre_curves(drives, fitted_vehicle, found)
    findings |= _tyre_findings(fitted_vehicle, tyres)
    return Identification(
        _fitted_tyre(fitted_vehicle, findings), findings, found, first, fitted, ratio_open, truth, references, tyres
    )  # fmt: skip


def _tyre_findings(vehicle: Vehicle, tyres: dict[str, AxleCurve] | None) -> dict[str, Finding]:
    """What the tyre curves tell: parameters of two laws per axle, and the shape for the vehicle file."""
    findings: dict[str, Finding] = {}
    for axle, curve in (tyres or {}).items():
        for law, found in (("rational", curve.rational), ("magic", curve.magic)):
            for name, (value, std) in (found or {}).items():
                low, high = value * np.exp(-Z95 * std), value * np.exp(Z95 * std)
                key = f"{law}_{name}_{axle}"
                findings[key] = Finding(
                    key, TYRE_UNITS[name], np.nan, value, low, high, False, "for reference"
                )
    shapes = [curve.magic["C"] for curve in (tyres or {}).values() if curve.magic]
    start = vehicle.tyre.shape
    if not shapes:
        word = "never slid far enough: left as it was"
        return findings | {
            "tyre.shape": Finding("tyre.shape", "-", start, start, np.nan, np.nan, False, word)
        }
    values, stds = np.array(shapes).T
    weights = 1.0 / np.maximum(stds, 0.02) ** 2
    mean = float(np.exp(weights @ np.log(values) / weights.sum()))
    return findings | {"tyre.shape": _finding("tyre.shape", start, mean, float(weights.sum() ** -0.5))}


def _fitted_tyre(vehicle: Vehicle, findings: dict[str, Finding]) -> Vehicle:
    shape = findings["tyre.shape"]
    if not shape.taken:
        return vehicle
    tyre = vehicle.tyre.model_copy(update={"shape": float(np.clip(shape.after, 1.01, 1.99))})
    return vehicle.model_copy(update={"tyre": tyre})


def _offsets(own: Known) -> Known:
    return {name: own[key] for name, key in (("yaw_bias", "yaw_rate"), ("ay_bias", "ay")) if key in own}


def _closed(vehicle: Vehicle, drives: Sequence[Drive], ratio_open: bool) -> dict[str, float]:
    """What is not sought, with the values taken instead."""
    # One of the two scales the steering angle; with both kinds of logs the measured angle is believed.
    closed = {"steer_scale": 1.0} if ratio_open else {"steering_ratio": vehicle.steering_ratio}
    if not any(np.isfinite(drive.beta).any() for drive in drives):
        closed |= {"beta_delay": 0.0, "beta_bias": 0.0}
    return closed


def _strongest(drive: Drive) -> float:
    """Lateral acceleration [m/s^2] that is passed for a few tenths of a second only."""
    rows = settled(drive.wild)
    return float(np.percentile(np.abs(drive.ay[rows]), 99.0)) if rows.any() else 0.0


def _kinematic_beliefs(truth: Kinematics | None) -> tuple[Belief, ...]:
    """What the ground truth said of the sensors, for the joint fit."""
    if truth is None:
        return ()

    def behind(name: str) -> Callable[[dict[str, float]], float]:
        return lambda car: car[name] - car["beta_delay"]

    known = (
        (lambda car: car["position"], truth.position, 0.01),
        (lambda car: car["roll_gradient"], truth.roll_gradient, 5e-4),
        (behind("yaw_delay"), truth.yaw_delay, 2e-3),
        (behind("ay_delay"), truth.ay_delay, 2e-3),
    )
    return tuple(Belief(of, value, float(np.hypot(std, floor))) for of, (value, std), floor in known)


def _findings(vehicle: Vehicle, found: Fit, ratio_open: bool) -> dict[str, Finding]:
    """Every finding of the joint fit."""
    findings = {}
    for one in CAR:
        start = before_value(vehicle, one.name)
        if one.name in found.car_std:
            findings[one.name] = _finding(one.name, start, found.car[one.name], found.car_std[one.name])
        elif one.name == "steering_ratio" and not ratio_open:
            word = "the road-wheel angle is measured itself: left as it was"
            findings[one.name] = Finding(one.name, "-", start, start, np.nan, np.nan, False, word)
    for one in LOG:
        if one.name in found.log_std[0]:
            values = np.array([offsets[one.name] for offsets in found.logs])
            weights = np.array([1.0 / std[one.name] ** 2 for std in found.log_std])
            weights, least = weights / weights.sum(), 1.0 / weights.sum()
            mean = float(weights @ values)
            # The interval holds what the offset is in any one log.
            scatter = float(weights @ (values - mean) ** 2)
            findings[one.name] = _finding(one.name, 0.0, mean, float(np.sqrt(least + scatter)))
    return findings


def _finding(name: str, start: float, value: float, std: float) -> Finding:
    measure = MEASURES[name]
    half = Z95 * float(np.hypot(std, measure.floor))
    low, high = (
        (value * np.exp(-half), value * np.exp(half)) if measure.relative else (value - half, value + half)
    )
    taken = half <= measure.useful
    if taken:
        word = "found" if half <= 0.5 * measure.useful else "found, roughly"
    else:
        word = "not excited by these logs: left as it was"
    return Finding(name, measure.unit, start, value if taken else start, float(low), float(high), taken, word)


def _friction_finding(start: float, finding: Finding, used: float, found: Fit) -> Finding:
    """The friction counts where most of it was used; less than was used it cannot be."""
    used = used / (1.0 + GRAVITY * max(found.car["roll_gradient"], 0.0))
    value = found.car["friction"]
    if value < used <= start:
        word = f"{used:.2f} was used, and the model errs there: left as it was"
        return replace(finding, after=start, low=used, high=np.nan, taken=False, word=word)
    if value < used:
        word = "at least: so much was used"
        return replace(finding, after=used, low=used, high=used * FRICTION_BEYOND, taken=True, word=word)
    if used < FRICTION_USED * value:
        word = f"only {100.0 * used / value:.0f} % of it was used: left as it was"
        return replace(finding, after=start, taken=False, word=word)
    return finding


def _fitted(vehicle: Vehicle, findings: dict[str, Finding]) -> Vehicle:
    """The vehicle with what was found, inside what a vehicle file may hold."""
    found = {name: findings[name].after for name in IN_VEHICLE if name in findings and findings[name].taken}
    if "roll_gradient" in found:
        found["roll_gradient"] = float(np.clip(found["roll_gradient"], 0.0, 0.099))
    if "cg_to_rear_axle" in found:
        found["cg_to_front_axle"] = vehicle.wheelbase - found["cg_to_rear_axle"]
    if "friction" in found:
        found["friction"] = min(found["friction"], 3.0)
    return Vehicle(**(vehicle.model_dump() | found))

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
from crosscomb.training.identification.handling import before, fit, shown_motion
from crosscomb.training.identification.judgements import (
    FRICTION_BEYOND,
    Judgement,
    fitted_tyre,
    fitted_vehicle,
    judge,
    judge_friction,
    judge_handling,
    judge_tyres,
)
from crosscomb.training.identification.parameters import Belief, Fit, Problem, usual_understeer
from crosscomb.training.identification.sensors import Kinematics, Known, ax_bias, kinematics, still_biases
from crosscomb.training.identification.trace import RATE, Trace, make_trace, settled
from crosscomb.training.identification.tyres import AxleCurve, tyre_curves
from crosscomb.training.recordings import Recording

LEAST_DRIVING = 5.0
"""Seconds of driving below which a log says nothing of the handling."""
SLIDING = (0.05, 1.0)
"""Error of the fitted model, in yaw rate [rad/s] and ay [m/s^2], above which a log is one of slides: real driving
below the limit leaves a third of it."""


@dataclass(frozen=True)
class Identification:
    """What was found, with what pictures need.

    Attributes
    ----------
    vehicle : Vehicle
        With the values found.
    judgements : dict of str to Judgement
    fit, first : Fit
        After and before.
    problem : Problem
        Traces and model errors.
    ratio_open : bool
        The steering ratio was sought: the steering angle was that of the hand wheel.
    kinematics : Kinematics, optional
        What the ground truth alone said of the sensors.
    references : tuple of str
        Columns of ground truth in the logs.
    tyres : dict of str to AxleCurve, optional
        ``front`` and ``rear``.
    left_out : tuple of str
        Logs of slides, in which the model cannot follow the car.
    """

    vehicle: Vehicle
    judgements: dict[str, Judgement]
    fit: Fit
    first: Fit
    problem: Problem
    ratio_open: bool
    kinematics: Kinematics | None
    references: tuple[str, ...]
    tyres: dict[str, AxleCurve] | None
    left_out: tuple[str, ...]


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
    made = [(make_trace(log, vehicle, use_reference), known) for log, known in zip(logs, still, strict=True)]
    pairs = [
        (trace, known)
        for trace, known in made
        if trace is not None and settled(trace.wild).sum() > LEAST_DRIVING * RATE
    ]
    if not pairs:
        raise UsageError(
            f"{logs[0].source if logs else 'no log'}: no log holds {LEAST_DRIVING:g} s of driving above "
            f"walking pace: record a longer drive with bends to both sides"
        )
    traces = [trace for trace, _ in pairs]
    known = [own for _, own in pairs]
    ratio_open = all(trace.ratio_open for trace in traces)
    truth = kinematics(traces, known, vehicle)
    used = max(_strongest(trace) for trace in traces) / GRAVITY
    # What is sought begins at the least friction that may have been enough.
    enough = vehicle.model_copy(update={"friction": max(vehicle.friction, FRICTION_BEYOND * used)})
    problem = Problem(
        traces, enough, [_offsets(own) for own in known], _closed(vehicle, traces, ratio_open),
        (usual_understeer(vehicle), *_kinematic_beliefs(truth)),
    )  # fmt: skip
    first = before(problem)
    found, fitted = fit(problem)
    calm = [i for i, error in enumerate(fitted.errors) if error[0] < SLIDING[0] and error[1] < SLIDING[1]]
    left_out = tuple(trace.name for i, trace in enumerate(traces) if i not in calm)
    if left_out and calm:
        # What a car does in a slide would be taken for its handling.
        problem = replace(problem, traces=[traces[i] for i in calm], known=[problem.known[i] for i in calm])
        traces, known, first = list(problem.traces), [known[i] for i in calm], before(problem)
        found, fitted = fit(problem)
    judgements = judge_handling(vehicle, found, ratio_open)
    judgements["friction"] = judge_friction(vehicle.friction, judgements["friction"], used, found)
    along = ax_bias(traces, known, [_turning(fitted, found, i) for i in range(len(traces))])
    if along is not None:
        judgements["ax_bias"] = judge("ax_bias", 0.0, along[0], along[1])
    references = tuple(name for name in REFERENCES if any(log.has(name) for log in logs))
    car = fitted_vehicle(vehicle, judgements)
    tyres = tyre_curves(traces, car, found)
    judgements |= judge_tyres(car, tyres)
    car = fitted_tyre(car, judgements)
    return Identification(
        car, judgements, found, first, fitted, ratio_open, truth, references, tyres, left_out
    )


def _turning(problem: Problem, found: Fit, i: int) -> np.ndarray:
    """What turning adds to ax in a trace ``(n,) [m/s^2]``."""
    trace = problem.traces[i]
    beta = shown_motion(problem, found, i)[2] - found.logs[i]["beta_bias"]
    lever = found.car["position"] * trace.yaw_rate**2
    return -trace.vx * np.tan(beta) * trace.yaw_rate - lever


def _offsets(own: Known) -> Known:
    return {name: own[key] for name, key in (("yaw_bias", "yaw_rate"), ("ay_bias", "ay")) if key in own}


def _closed(vehicle: Vehicle, traces: Sequence[Trace], ratio_open: bool) -> dict[str, float]:
    """What is not sought, with the values taken instead."""
    # One of the two scales the steering angle; with both kinds of logs the measured angle is believed.
    closed = {"steer_scale": 1.0} if ratio_open else {"steering_ratio": vehicle.steering_ratio}
    if not any(np.isfinite(trace.beta).any() for trace in traces):
        closed |= {"beta_delay": 0.0, "beta_bias": 0.0}
    return closed


def _strongest(trace: Trace) -> float:
    """Lateral acceleration [m/s^2] that is passed for a few tenths of a second only."""
    rows = settled(trace.wild)
    return float(np.percentile(np.abs(trace.ay[rows]), 99.0)) if rows.any() else 0.0


def _kinematic_beliefs(truth: Kinematics | None) -> tuple[Belief, ...]:
    """What the ground truth said of the sensors, for the joint fit."""
    if truth is None:
        return ()

    def behind(name: str) -> Callable[[dict[str, float]], float]:
        return lambda car: car[name] - car["beta_delay"]

    def belief(of: Callable[[dict[str, float]], float], seen: tuple[float, float], floor: float) -> Belief:
        return Belief(of, seen[0], float(np.hypot(seen[1], floor)))

    return (
        belief(lambda car: car["position"], truth.position, 0.01),
        belief(lambda car: car["roll_gradient"], truth.roll_gradient, 5e-4),
        belief(behind("yaw_delay"), truth.yaw_delay, 2e-3),
        belief(behind("ay_delay"), truth.ay_delay, 2e-3),
    )

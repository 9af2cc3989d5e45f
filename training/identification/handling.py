"""Handling parameters and sensor errors of one car, fitted jointly to what its sensors showed on many drives.

Output-error fit of the nonlinear single track (`response`). What belongs to the car is common to all logs; offsets are
each log's own. All that is sought is held near what is known already by a wide prior, so that a parameter without
excitation keeps its value and shows a wide interval instead of running away.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from crosscomb.models.vehicle import Vehicle
from crosscomb.training.identification.fit import Dependence, Rows, covariance, solve
from crosscomb.training.identification.parameters import (
    CAR,
    LOG,
    OUTPUTS,
    Fit,
    Problem,
    before_value,
    make_sensing,
    tyre_car,
)
from crosscomb.training.identification.response import Response, Sensing, run_model, sensed
from crosscomb.training.identification.trace import RATE, Trace, settled

FIRST_ERROR = (0.02, 0.4, 0.01)  # of the model before it is known [rad/s, m/s^2, rad]
LEAST_ERROR = (0.004, 0.06, 0.002)
THIN = 10
"""Every fifth row is compared: the channels hold nothing faster."""
BLOCK = int(2.0 * RATE)
"""Rows whose errors are taken as dependent on each other for the intervals."""
LINEAR_AY = 4.0
"""Above this ay [m/s^2] errors count as larger by the square of the excess: there the tyre law errs first."""
TIGHT_BEND = 0.12
"""Road-wheel angle [rad] that the bend asks for, above which errors count as larger by the square of the excess: there
the geometry of the steering errs, and the speed that wheels at an angle tell."""
STRAIGHT_AY = 0.7
STRAIGHT_ERROR = 4.0
"""In straight driving, below this ay [m/s^2] for two seconds, errors count as so much larger: there the play and
friction of the steering, and the road, decide what the car does."""


class _Runner:
    """Residuals of one log; the last responses are kept, as most parameters only concern the sensors."""

    def __init__(self, trace: Trace, vehicle: Vehicle, running: np.ndarray, errors: np.ndarray) -> None:
        self.trace, self.vehicle, self.running, self.errors = trace, vehicle, running, errors
        rows = settled(running)
        rows[np.arange(len(rows)) % THIN != 0] = False
        self.rows = [rows, rows, rows & np.isfinite(trace.beta)]
        straight = maximum_filter1d(np.abs(trace.ay), int(2.0 * RATE)) < STRAIGHT_AY
        near_limit = np.maximum(1.0, (trace.ay / LINEAR_AY) ** 2)
        bend = np.abs(vehicle.wheelbase * trace.yaw_rate / trace.vx)
        tight = np.maximum(1.0, (maximum_filter1d(bend, int(RATE)) / TIGHT_BEND) ** 2)
        self.unsure = np.where(straight, STRAIGHT_ERROR, near_limit * tight)
        self.kept: dict[tuple, Response] = {}

    def response(self, car: dict[str, float], sensing: Sensing) -> Response:
        single = tyre_car(self.vehicle, car)
        steering = (sensing.ratio, sensing.steer_scale, sensing.steer_offset)
        key = (single, car["friction"], *steering, sensing.yaw_bias, sensing.yaw_delay)
        if key not in self.kept:
            if len(self.kept) > 1:
                self.kept.pop(next(reversed(self.kept)))
            self.kept[key] = run_model(self.trace, self.running, single, car["friction"], sensing)
        return self.kept[key]

    def residuals(self, car: dict[str, float], offsets: dict[str, float]) -> np.ndarray:
        sensing = make_sensing(car, offsets)
        shown = sensed(self.response(car, sensing), self.trace, sensing, self.vehicle)
        measured = (self.trace.yaw_rate, self.trace.ay, self.trace.beta)
        parts = [
            (shown[i][rows] - measured[i][rows]) / (self.errors[i] * self.unsure[rows])
            for i, rows in enumerate(self.rows)
        ]
        return np.nan_to_num(np.concatenate(parts), nan=50.0, posinf=50.0, neginf=-50.0)

    def fresh(self) -> None:
        """Forget the responses of other parameters."""
        self.kept.clear()


def fit(problem: Problem, start: Fit | None = None) -> tuple[Fit, Problem]:
    """Fit once with guessed model errors, then with those that were found.

    Parameters
    ----------
    problem : Problem
        Its errors may be empty.
    start : Fit, optional
        Where to begin.

    Returns
    -------
    Fit, Problem
        The problem with the model errors that were found.
    """
    x = _first(problem, start)
    if len(problem.errors) == 0:
        problem = replace(problem, errors=np.tile(FIRST_ERROR, (len(problem.traces), 1)))
        x = _solve(problem, x)[0]
    problem = replace(problem, errors=_model_errors(problem, x))
    x, spread = _solve(problem, x)
    return _result(problem, x, np.sqrt(np.diag(spread))), problem


def before(problem: Problem) -> Fit:
    """The values before any fit, with what standstill says of the offsets."""
    return _result(problem, _first(problem, None), None)


def shown_motion(problem: Problem, found: Fit, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Yaw rate, ay and beta ``(n,)`` that the sensors of log i show if the fit is right; SI, NaN where not run."""
    trace = problem.traces[i]
    runner = _Runner(trace, problem.vehicle, trace.normal, np.ones(OUTPUTS))
    sensing = found.sensing(i)
    return sensed(runner.response(found.car, sensing), trace, sensing, problem.vehicle)


def _first(problem: Problem, start: Fit | None) -> np.ndarray:
    """Start vector: the parameters of the car, then the offsets log by log; logarithms of positive ones."""
    values = []
    for one in problem.car_sought:
        value = start.car[one.name] if start else before_value(problem.vehicle, one.name)
        values.append(np.log(value) if one.positive else value)
    for i, known in enumerate(problem.known):
        for one in problem.log_sought:
            values.append(start.logs[i][one.name] if start else known.get(one.name, (0.0, 0.0))[0])
    return np.array(values)


def _split(problem: Problem, x: np.ndarray) -> tuple[dict[str, float], list[dict[str, float]]]:
    car = {one.name: before_value(problem.vehicle, one.name) for one in CAR} | {
        name: value for name, value in problem.fixed.items() if name not in {one.name for one in LOG}
    }
    sought, own = problem.car_sought, problem.log_sought
    for one, value in zip(sought, x, strict=False):
        car[one.name] = float(np.exp(np.clip(value, -20.0, 20.0)) if one.positive else value)
    logs = []
    for i in range(len(problem.traces)):
        part = x[len(sought) + i * len(own) :][: len(own)]
        offsets = {one.name: problem.fixed.get(one.name, 0.0) for one in LOG}
        logs.append(offsets | {one.name: float(v) for one, v in zip(own, part, strict=True)})
    return car, logs


def _prior(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Expected values and standard deviations of the parameter vector."""
    centre = _first(problem, None)
    spread = [one.spread for one in problem.car_sought]
    for known in problem.known:
        spread += [known.get(one.name, (0.0, one.spread))[1] for one in problem.log_sought]
    return centre, np.array(spread)


def _solve(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solution ``(p,)`` and its covariance ``(p, p)``."""
    runners = [
        _Runner(trace, problem.vehicle, trace.normal, errors)
        for trace, errors in zip(problem.traces, problem.errors, strict=True)
    ]
    centre, spread = _prior(problem)
    steps = [one.step for one in problem.car_sought]
    own = [one.step for one in problem.log_sought]
    count = len(steps)

    def each(x: np.ndarray) -> list[np.ndarray]:
        car, logs = _split(problem, x)
        for runner in runners:
            runner.fresh()
        return [runner.residuals(car, offsets) for runner, offsets in zip(runners, logs, strict=True)]

    def slopes(x: np.ndarray) -> Rows:
        base = each(x)
        rows = np.cumsum([0, *(len(part) for part in base)])
        jacobian = np.zeros((rows[-1], len(x)))
        for j in range(count + len(own)):
            for i, runner in enumerate(runners):
                # An offset of one log moves the residuals of that log only.
                column = j if j < count else j + i * len(own)
                moved = x.copy()
                moved[column] += steps[j] if j < count else own[j - count]
                car, logs = _split(problem, moved)
                change = runner.residuals(car, logs[i]) - base[i]
                jacobian[rows[i] : rows[i + 1], column] = change / (moved[column] - x[column])
        return np.concatenate(base), jacobian

    def beliefs(x: np.ndarray) -> Rows:
        known = [(belief.of(_split(problem, x)[0]) - belief.value) / belief.std for belief in problem.beliefs]
        change = np.zeros((len(known), len(x)))
        for j, step in enumerate(steps):
            moved = x.copy()
            moved[j] += step
            car = _split(problem, moved)[0]
            for i, belief in enumerate(problem.beliefs):
                change[i, j] = ((belief.of(car) - belief.value) / belief.std - known[i]) / step
        return np.concatenate([(x - centre) / spread, known]), np.vstack([np.diag(1.0 / spread), change])

    x = solve(lambda x: np.concatenate(each(x)), slopes, beliefs, x)
    z, jacobian = slopes(x)
    return x, covariance(z, jacobian, beliefs(x)[1], _dependence(runners))


def _dependence(runners: list[_Runner]) -> Dependence:
    blocks, series, begin, first = [], [], 0, 0
    for runner in runners:
        for rows in runner.rows:
            blocks.append(first + np.flatnonzero(rows) // BLOCK)
            series.append(slice(begin, begin + int(rows.sum())))
            begin = series[-1].stop
        first += len(runner.running) // BLOCK + 1
    return Dependence(np.concatenate(blocks), series)


def _model_errors(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Standard deviation of each log's residuals ``(logs, OUTPUTS)``, outliers left aside."""
    car, logs = _split(problem, x)
    errors = []
    for trace, old, offsets in zip(problem.traces, problem.errors, logs, strict=True):
        runner = _Runner(trace, problem.vehicle, trace.normal, old)
        parts = np.split(runner.residuals(car, offsets), np.cumsum([rows.sum() for rows in runner.rows])[:-1])
        own = [1.48 * float(np.median(np.abs(part))) if len(part) else 1.0 for part in parts]
        errors.append(
            [max(size * before, least) for size, before, least in zip(own, old, LEAST_ERROR, strict=True)]
        )
    return np.array(errors)


def _result(problem: Problem, x: np.ndarray, std: np.ndarray | None) -> Fit:
    car, logs = _split(problem, x)
    sought, own = problem.car_sought, problem.log_sought
    if std is None:
        return Fit(car, logs, {}, [{} for _ in logs])
    car_std = {one.name: float(value) for one, value in zip(sought, std, strict=False)}
    log_std = []
    for i in range(len(logs)):
        part = std[len(sought) + i * len(own) :][: len(own)]
        log_std.append({one.name: float(value) for one, value in zip(own, part, strict=True)})
    return Fit(car, logs, car_std, log_std)

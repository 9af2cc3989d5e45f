"""From rows to answers, live or from a log: one row, a chunk or everything, with the same answers bit for bit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.logs.grid import MAX_GAP, Grid, next_points, start_grid, stretch_starts
from crosscomb.logs.prepare import Completion, next_rows
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.drive import Drive, make_filters, name_filters, next_seen, start_drive
from crosscomb.run.handling import STATES, Handling, HandlingState, handling_of, start_handling
from crosscomb.run.motion import Motion, PointVelocity, motion_of, point_velocity, start_motion, velocity_at
from crosscomb.run.status import INVALID, TEXTS, start_ages, status_codes
from crosscomb.run.tuned import Tuned, with_tuned
from crosscomb.selection.answer import Answer, Selection, select, start_selection
from crosscomb.selection.artefact import Artefact
from crosscomb.selection.seen import Seen
from crosscomb.signals import COLUMN, MIN_SPEED, UNITS, Signals

_T = COLUMN["t"]


@dataclass(frozen=True)
class LogEstimate:
    """Answer at each row of a log.

    Attributes
    ----------
    signals : Signals
        The log, completed.
    beta, beta_std : (n,) [rad]
    active : (n,) str
        Name of the filter that is active.
    status : (n,) str
        ``ok``, or words joined by ``+``.
    filters : dict of str to (n,) [rad]
        beta of each filter.
    motion : Motion
        Speed and curvature, from which `at` makes the velocity of any point of the car.
    handling : Handling
        Slip angles of both axles and whether the car understeers or oversteers.
    extras : dict of str to (n,)
        What the filters tell beside beta, by ``<filter> <quantity> [unit]``; empty where nobody asked.
    """

    signals: Signals
    beta: np.ndarray
    beta_std: np.ndarray
    active: np.ndarray
    status: np.ndarray
    filters: dict[str, np.ndarray]
    motion: Motion
    handling: Handling
    extras: dict[str, np.ndarray]

    def table(self) -> pd.DataFrame:
        """Columns of the estimate file: t, beta, beta_std, active, status and beta of each filter."""
        columns = {"t": self.signals.t, "beta": self.beta, "beta_std": self.beta_std}
        filters = {f"beta_{name}": beta for name, beta in self.filters.items()}
        return pd.DataFrame({**columns, "active": self.active, "status": self.status, **filters})

    def at(self, x: float, y: float = 0.0) -> PointVelocity:
        """Velocity of the point x [m] ahead and y [m] to the left of the centre of gravity, at each row."""
        return velocity_at(self.beta, self.beta_std, self.motion, x, y)

    def point_table(self, x: float, y: float = 0.0) -> pd.DataFrame:
        """Columns of the file of a point: t, vx, vy, beta and beta_std."""
        return pd.DataFrame({"t": self.signals.t, **self.at(x, y)._asdict()})

    def handling_table(self) -> pd.DataFrame:
        """Columns of the handling file: t, slip_front, slip_rear, understeer and state."""
        return pd.DataFrame({"t": self.signals.t, **self.handling._asdict()})

    def extras_table(self) -> pd.DataFrame:
        """Columns of the file of what the filters tell beside beta: t and each of `extras`."""
        return pd.DataFrame({"t": self.signals.t, **self.extras})

    def handling_shares(self) -> dict[str, float]:
        """Share of the time above `MIN_SPEED` in each state of handling; all 0 where the car never was that fast."""
        steps = np.minimum(np.diff(self.signals.t, append=self.signals.t[-1]), MAX_GAP)
        steps[self.motion.vx <= MIN_SPEED] = 0.0
        total = max(float(steps.sum()), 1e-9)
        return {state: float(steps[self.handling.state == state].sum()) / total for state in STATES}


class StreamEstimate(NamedTuple):
    """Answer at one sample.

    Attributes
    ----------
    t : float [s]
    beta, beta_std : float [rad]
    active : str
        Name of the filter that is active.
    status : str
        ``ok``, or words joined by ``+``.
    filters : dict of str to float [rad]
        beta of each filter.
    vy : float [m/s]
        Of the centre of gravity.
    motion : Motion
        Of floats.
    handling : Handling
        Of floats and the word.
    """

    t: float
    beta: float
    beta_std: float
    active: str
    status: str
    filters: dict[str, float]
    vy: float
    motion: Motion
    handling: Handling

    def at(self, x: float, y: float = 0.0) -> PointVelocity:
        """Velocity of the point x [m] ahead and y [m] to the left of the centre of gravity."""
        return PointVelocity(*point_velocity(self.beta, self.beta_std, *self.motion, float(x), float(y)))


class Answers(NamedTuple):
    """Answers at some grid points or rows, packed: to cut and join two tables is cheap, also for a single sample."""

    numbers: (
        np.ndarray
    )  # (n, 8 + filters + e) beta, beta_std, motion, slips, understeer, beta of each filter, extras
    codes: np.ndarray  # (n, 3) int: active filter, status, state of handling


def _joined(parts: Sequence[Answers]) -> Answers:
    return Answers(*(np.concatenate(tables) for tables in zip(*parts, strict=True)))


def _taken(answers: Answers, at: Any) -> Answers:
    return Answers(answers.numbers[at], answers.codes[at])


@dataclass(frozen=True)
class Plan:
    """What a run is made of: the filters that run, and those of them that the artefact switches."""

    vehicle: Vehicle
    artefact: Artefact
    names: list[str]
    filters: list[KernelFilter]
    members: list[int]
    switched: bool
    extras: list[str]  # names of what the filters tell beside beta, where somebody asked


def make_plan(
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
    extras: bool = False,
) -> Plan:
    """Make the filters of a run; see `crosscomb.run.estimate.estimate_log` for what the arguments mean."""
    names = list(filters or artefact.filter_names)
    made = make_filters(with_tuned(name_filters(names, artefact), tuned), vehicle)
    switched = all(name in names for name in artefact.filter_names)
    members = [names.index(name) for name in (artefact.filter_names if switched else names[:1])]
    told = [f"{name} {extra}" for name, one in zip(names, made, strict=True) for extra in one.extras]
    if extras and not told:
        others = [name for name, entry in CATALOGUE.items() if entry.load().extras]
        raise UsageError(
            f"--extras: {', '.join(names)}: no more than beta to tell: name by --filters one of {', '.join(others)}"
        )
    return Plan(vehicle, artefact, names, made, members, switched, told if extras else [])


@dataclass
class Stretch:
    """Rows without a long gap on their way to answers; everything in it begins anew after a gap."""

    plan: Plan
    grid: Grid
    drive: Drive
    selection: Selection
    ages: np.ndarray = field(default_factory=start_ages)
    yaw: np.ndarray = field(default_factory=start_motion)
    handling: HandlingState = field(default_factory=start_handling)
    newest: Answers | None = None  # of the newest grid point


def start_stretch(plan: Plan, t_start: float) -> Stretch:
    """Make the state before the first row, which is at t_start [s]."""
    rate, window = plan.artefact.rate, plan.artefact.window
    return Stretch(
        plan,
        start_grid(t_start, rate, list(UNITS)),
        start_drive(plan.vehicle, plan.filters, rate, window, bool(plan.extras)),
        start_selection(plan.artefact),
    )


def next_answers(stretch: Stretch, rows: np.ndarray) -> Answers:
    """Answers at the next rows of a stretch ``(n, columns)``: the newest at or before each of them."""
    first, known = int(stretch.grid.state.closed[0]), stretch.newest
    points, newest = next_points(stretch.grid, rows[:, _T], rows)
    if known is not None:
        first -= 1
    if len(points):
        made = _answers_at(stretch, next_seen(stretch.drive, points))
        stretch.newest = _taken(made, slice(-1, None))
        known = made if known is None else _joined([known, made])
    assert known is not None, "the first row of a stretch closes its first grid point"
    return _taken(known, newest - first)


def _answers_at(stretch: Stretch, seen: Seen) -> Answers:
    """Answers at grid points: selection, status, motion and handling."""
    plan, samples, dt = stretch.plan, seen.inputs.samples, seen.inputs.dt
    if plan.switched:
        answer = select(stretch.selection, seen.only(plan.members))
    else:
        nothing = np.zeros(len(samples), dtype=np.int64)
        answer = Answer(seen.beta[:, 0], seen.beta_std[:, 0], nothing, nothing > 0, nothing)
    status = status_codes(stretch.ages, samples, answer.outside, dt)
    motion = motion_of(stretch.yaw, samples, plan.vehicle, dt)
    valid = status & INVALID == 0
    handling = handling_of(
        stretch.handling, samples, answer.beta, answer.beta_std, motion, valid, plan.vehicle, dt
    )
    *slips, state = handling
    numbers = np.column_stack([answer.beta, answer.beta_std, *motion, *slips, seen.beta, *seen.extras])
    return Answers(numbers, np.column_stack([np.array(plan.members)[answer.active], status, state]))


@dataclass
class Stream:
    """Completed rows on their way to answers; a long gap begins a new stretch."""

    plan: Plan
    t: float = -math.inf  # of the newest row [s]
    stretch: Stretch | None = None


def advance(stream: Stream, rows: np.ndarray) -> Answers:
    """Answers at the next rows ``(n, columns)``, at least one, completed and in order of time."""
    t, parts = rows[:, _T], []
    starts = stretch_starts(t, stream.t)
    stream.t = float(t[-1])
    for begin, end in pairwise([*sorted({0, *starts}), len(t)]):
        if stream.stretch is None or begin in starts:
            stream.stretch = start_stretch(stream.plan, float(t[begin]))
        parts.append(next_answers(stream.stretch, rows[begin:end]))
    return parts[0] if len(parts) == 1 else _joined(parts)


def to_estimate(plan: Plan, signals: Signals, answers: Answers) -> LogEstimate:
    """Put names to the answers at the rows of a completed log."""
    beta, beta_std, vx, curvature, doubt, front, rear, understeer, *others = answers.numbers.T.copy()
    active, status, state = answers.codes.T
    return LogEstimate(
        signals,
        beta,
        beta_std,
        np.array(plan.names)[active],
        TEXTS[status],
        dict(zip(plan.names, others[: len(plan.names)], strict=True)),
        Motion(vx, curvature, doubt),
        Handling(front, rear, understeer, np.array(STATES, dtype=object)[state]),
        dict(zip(plan.extras, others[len(plan.names) :], strict=True)),
    )


@dataclass
class StreamingEstimator:
    """Sideslip angle live: one sample in, one estimate out.

    The answers are those of `crosscomb.run.estimate.estimate_log` for the log of the same samples, bit for bit, also
    when they come in chunks. A sample is a mapping from column names (`crosscomb.signals.UNITS`) to SI values; what
    is left out, None or NaN is "no measurement". t is needed and increases; after more than a second without a
    sample everything begins anew.

    Parameters
    ----------
    vehicle : Vehicle
    artefact : Artefact
    filters : sequence of str, optional
        Estimators to run instead of the artefact's, see `estimate_log`.
    tuned : Tuned, optional
        Noise that takes the place of the filters' own.

    Examples
    --------
    >>> from crosscomb.selection.artefact import load_artefact
    >>> from crosscomb.models.vehicle import load_vehicle
    >>> live = StreamingEstimator(load_vehicle("generic_compact"), load_artefact())
    >>> live.step({"t": 0.0, "vx": 20.0, "ax": 0.0, "ay": 0.0, "yaw_rate": 0.0, "steer": 0.0}).status
    'ok'
    """

    vehicle: Vehicle
    artefact: Artefact
    filters: Sequence[str] | None = None
    tuned: Tuned | None = None

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything that came so far: the next sample is the first one of a new log."""
        self._stream = Stream(make_plan(self.vehicle, self.artefact, self.filters, self.tuned))
        self._completion = Completion(self.vehicle)

    def step(self, sample: Mapping[str, float] | pd.Series) -> StreamEstimate:
        """Take one sample.

        Raises
        ------
        UsageError
            An unknown column, a value that is no number, t missing or not later than the one before.
        """
        row = sample_row(sample)
        answers = self._take(row[None, :])
        plan = self._stream.plan
        beta, beta_std, vx, curvature, doubt, front, rear, understeer, *filters = answers.numbers[0].tolist()
        active, status, state = answers.codes[0].tolist()
        return StreamEstimate(
            float(row[_T]),
            beta,
            beta_std,
            plan.names[active],
            TEXTS[status],
            dict(zip(plan.names, filters, strict=True)),
            point_velocity(beta, beta_std, vx, curvature, doubt, 0.0, 0.0)[1],
            Motion(vx, curvature, doubt),
            Handling(front, rear, understeer, STATES[state]),
        )

    def take(self, chunk: Signals | pd.DataFrame) -> LogEstimate:
        """Take a chunk of a log: rows that follow on those before.

        Raises
        ------
        UsageError
            As in `step`.
        """
        if isinstance(chunk, Signals):
            signals = chunk
        else:
            _require_known(chunk.columns)
            columns = [name for name in UNITS if name in chunk]
            try:
                frame = chunk[columns].astype(np.float64).reset_index(drop=True)
            except (TypeError, ValueError) as error:
                raise UsageError(
                    f"chunk: holds something that is no number ({error}): pass SI values"
                ) from None
            signals = Signals("chunk", frame.replace([np.inf, -np.inf], np.nan))
        if not len(signals):
            raise UsageError("chunk: has no rows: pass at least one")
        rows = signals.rows()
        answers = self._take(rows)
        made = {name: rows[:, COLUMN[name]].copy() for name in ("steer", "vx", "ax")}
        return to_estimate(self._stream.plan, signals.with_columns("", **made), answers)

    def _take(self, rows: np.ndarray) -> Answers:
        """Check and complete rows in place, and take them."""
        steps = np.diff(rows[:, _T], prepend=self._stream.t)
        wrong = np.flatnonzero(~(steps > 0.0))
        if wrong.size:
            _refuse_time(rows[:, _T], int(wrong[0]), self._stream.t)
        next_rows(self._completion, rows)
        return advance(self._stream, rows)


def _refuse_time(t: np.ndarray, row: int, newest: float) -> None:
    before = float(t[row - 1]) if row else newest
    if not math.isfinite(t[row]):
        raise UsageError("sample, column t: no time there: give t [s] with every sample")
    what = "repeats" if t[row] == before else "goes backwards"
    raise UsageError(
        f"sample, column t: time {what} ({before:.10g} then {t[row]:.10g} s): "
        f"pass samples in order, or reset() before a new log"
    )


def _require_known(names: Any) -> None:
    for name in names:
        if name not in UNITS:
            raise UsageError(f"sample, column {name}: unknown: take of {', '.join(UNITS)}, in SI units")


def sample_row(sample: Mapping[str, Any] | pd.Series) -> np.ndarray:
    """One sample as a row ``(columns,)`` of `Signals.rows`; infinite values are no measurements.

    Raises
    ------
    UsageError
        An unknown column, a value that is no number, or no t.
    """
    if not isinstance(sample, Mapping | pd.Series):
        raise UsageError(f"sample: is a {type(sample).__name__}: pass column names with values, as a dict")
    _require_known(sample.keys())
    row = np.full(len(UNITS), np.nan)
    for name, value in dict(sample).items():
        try:
            number = math.nan if value is None else float(value)
        except (TypeError, ValueError):
            raise UsageError(
                f"sample, column {name}: {value!r} is no number: pass it in {UNITS[name]}"
            ) from None
        row[COLUMN[name]] = number if math.isfinite(number) else math.nan
    return row

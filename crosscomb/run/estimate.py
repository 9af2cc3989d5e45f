"""One log end to end: filters in parallel, selector, switch, and the answer at each row of the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from crosscomb.logs.grid import MAX_GAP
from crosscomb.logs.prepare import Completion, next_rows
from crosscomb.logs.watch import reasons
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.answers import Plan, Stream, advance, make_plan
from crosscomb.run.handling import STATES, Handling
from crosscomb.run.health import with_health
from crosscomb.run.motion import Motion, PointVelocity, velocity_at
from crosscomb.run.status import TEXTS
from crosscomb.run.tuned import Tuned
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import COLUMN, MIN_SPEED, Signals


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
    reason : (n,) str
        Which channels and filters are bad and how, such as ``ay spike; filter dynamic_ekf diverged``; empty where
        none is.
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
    reason: np.ndarray

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
        """Columns of the file of what the filters tell beside beta: t, each of `extras`, and `reason`."""
        return pd.DataFrame({"t": self.signals.t, **self.extras, "reason": self.reason})

    def handling_shares(self) -> dict[str, float]:
        """Share of the time above `MIN_SPEED` in each state of handling; all 0 where the car never was that fast."""
        shares = Shares()
        shares.take(self)
        return shares.of_time()


@dataclass
class Shares:
    """Time above `MIN_SPEED` in each state of handling, gathered piece by piece."""

    times: np.ndarray = field(default_factory=lambda: np.zeros(len(STATES)))  # [s]
    newest: tuple[float, str] | None = None  # t [s] and state of the newest row, where it was fast enough

    def take(self, estimate: LogEstimate) -> None:
        """Take the next rows: a state lasts until the next row, but not across a gap."""
        t, state, fast = estimate.signals.t, estimate.handling.state, estimate.motion.vx > MIN_SPEED
        steps = np.minimum(np.diff(t, append=t[-1]), MAX_GAP)
        steps[~fast] = 0.0
        self.times += [float(steps[state == each].sum()) for each in STATES]
        if self.newest:
            self.times[STATES.index(self.newest[1])] += min(float(t[0]) - self.newest[0], MAX_GAP)
        self.newest = (float(t[-1]), state[-1]) if fast[-1] else None

    def of_time(self) -> dict[str, float]:
        """Share of each state; all 0 where the car never was fast enough."""
        return dict(zip(STATES, (self.times / max(self.times.sum(), 1e-9)).tolist(), strict=True))


def estimate_log(
    signals: Signals,
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
    extras: bool = False,
) -> LogEstimate:
    """Estimate the sideslip angle at each row of a log.

    A row holds the newest estimate at or before its time; none is made from later samples.

    Parameters
    ----------
    signals : Signals
        As read from a file.
    vehicle : Vehicle
    artefact : Artefact
    filters : sequence of str, optional
        Estimators to run instead of the artefact's. With all of the artefact's among them its switch works as ever,
        and the others stand beside it; else the first named one is the answer, and nothing is switched.
    tuned : Tuned, optional
        Noise that takes the place of the filters' own.
    extras : bool
        Also give what the estimators tell beside beta: innovations, forces, yaw moment, friction in use, tyre
        parameters, shares.

    Raises
    ------
    UsageError
        Extras are wanted, and none of the estimators tells more than beta.
    """
    run = start_run(vehicle, artefact, filters, tuned, extras)
    result = next_estimate(run, signals)
    return replace(result, signals=replace(result.signals, notes=(*signals.notes, *run.notes())))


@dataclass
class Run:
    """A log on its way to estimates, in pieces of any length with the same result bit for bit."""

    stream: Stream
    completion: Completion

    def notes(self) -> list[str]:
        """What was done to the rows so far, in words for the user."""
        notes, plan = [*self.completion.notes().values()], self.stream.plan
        if not plan.switched:
            needed = ", ".join(plan.artefact.filter_names)
            notes.append(f"{plan.names[0]} is the answer: the selector needs all of {needed}")
        return notes


def start_run(
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
    extras: bool = False,
) -> Run:
    """Make the state before the first row of a log; arguments and errors are those of `estimate_log`."""
    plan = make_plan(vehicle, artefact, filters, tuned, extras)
    return Run(Stream(plan), Completion(vehicle))


def next_estimate(run: Run, signals: Signals) -> LogEstimate:
    """Answers at the next rows of a log, in order of time."""
    rows = signals.rows()
    faults = next_rows(run.completion, rows)
    made = {name: rows[:, COLUMN[name]].copy() for name in ("steer", "vx", "ax")}
    return to_estimate(run.stream.plan, signals.with_columns("", **made), advance(run.stream, rows, faults))


def to_estimate(plan: Plan, signals: Signals, answers: np.ndarray) -> LogEstimate:
    """Put names to the answers at the rows of a completed log."""
    told = {name: answers[name].T.copy() for name in plan.record.names or ()}
    slips = told["slip_front"], told["slip_rear"], told["understeer"]
    return LogEstimate(
        signals,
        told["beta"],
        told["beta_std"],
        np.array(plan.names)[told["active"]],
        TEXTS[told["status"]],
        dict(zip(plan.names, told["filters"], strict=True)),
        Motion(*(told[name] for name in Motion._fields)),
        Handling(*slips, np.array(STATES, dtype=object)[told["state"]]),
        dict(zip(plan.extras, told["extras"], strict=True)),
        with_health(reasons(told["faults"]), plan.watched, answers["health"]),
    )

"""From rows to answers: one row, a chunk or everything, with the same answers bit for bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.logs.grid import Grid, next_points, start_grid, stretch_starts
from crosscomb.logs.watch import degrading
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.doubt import next_doubt, start_doubt
from crosscomb.run.drive import Drive, make_filters, name_filters, next_seen, start_drive
from crosscomb.run.handling import Handling, HandlingState, handling_of, start_handling
from crosscomb.run.health import next_told
from crosscomb.run.motion import Motion, motion_of, start_motion
from crosscomb.run.status import DEGRADED, INVALID, start_ages, status_codes
from crosscomb.run.tuned import Tuned, with_tuned
from crosscomb.selection.answer import Answer, Selection, select, start_selection
from crosscomb.selection.artefact import Artefact
from crosscomb.selection.health import HEALTHY, HealthState, start_health
from crosscomb.selection.seen import Seen
from crosscomb.signals import COLUMN, UNITS

_T = COLUMN["t"]


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
    record: np.dtype  # of one answer, see `record_of`

    @property
    def watched(self) -> list[str]:
        """Names of the filters whose health is told."""
        return [self.names[member] for member in self.members]


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
            f"{', '.join(names)}: no more than beta to tell: name in `filters` one of {', '.join(others)}"
        )
    told = told if extras else []
    return Plan(
        vehicle,
        artefact,
        names,
        made,
        members,
        switched,
        told,
        record_of(len(names), len(members), len(told)),
    )


def record_of(filters: int, members: int, extras: int) -> np.dtype:
    """Type of the record of one answer: one table of them is cheap to cut and to join, also for a single sample.

    Active filter, status and state are codes: places in the plan's names, `status.TEXTS` and `handling.STATES`; faults
    are those of the row, see `crosscomb.logs.watch`, health that of the members, see `crosscomb.selection.health`.
    """
    numbers = ("beta", "beta_std", *Motion._fields, *Handling._fields[:-1])
    wide = [
        ("filters", np.float64, (filters,)),
        ("extras", np.float64, (extras,)),
        ("health", np.int64, (members,)),
    ]
    codes = ("active", "status", "state", "faults")
    return np.dtype([*((name, np.float64) for name in numbers), *wide, *((name, np.int64) for name in codes)])


@dataclass
class Stretch:
    """Rows without a long gap on their way to answers; everything in it begins anew after a gap."""

    plan: Plan
    grid: Grid
    drive: Drive
    selection: Selection
    health: HealthState
    newest: np.ndarray  # (1,) answer at the newest grid point
    ages: np.ndarray = field(default_factory=start_ages)
    yaw: np.ndarray = field(default_factory=start_motion)
    handling: HandlingState = field(default_factory=start_handling)
    doubt: np.ndarray = field(default_factory=start_doubt)


def start_stretch(plan: Plan, t_start: float) -> Stretch:
    """Make the state before the first row, which is at t_start [s]."""
    rate, window = plan.artefact.rate, plan.artefact.window
    return Stretch(
        plan,
        start_grid(t_start, rate, list(UNITS)),
        start_drive(plan.vehicle, plan.filters, rate, window, bool(plan.extras)),
        start_selection(plan.artefact),
        start_health(len(plan.members)),
        np.zeros(1, plan.record),
    )


def next_answers(stretch: Stretch, rows: np.ndarray) -> np.ndarray:
    """Answers at the next rows of a stretch ``(n, columns)``: the newest at or before each of them."""
    before = int(stretch.grid.state.closed[0]) - 1  # the newest grid point so far; the first row closes one
    points, newest = next_points(stretch.grid, rows[:, _T], rows)
    known = np.empty(1 + len(points), stretch.plan.record)
    known[:1] = stretch.newest
    if len(points):
        _answers_at(stretch, next_seen(stretch.drive, points), known[1:])
        stretch.newest = known[-1:].copy()
    return known[newest - before]


def _answers_at(stretch: Stretch, seen: Seen, out: np.ndarray) -> None:
    """Write the answers at grid points: health of the filters, selection, status, motion and handling."""
    plan, samples, dt = stretch.plan, seen.inputs.samples, seen.inputs.dt
    told = next_told(stretch.health, stretch.drive, seen, plan.members)
    if plan.switched:
        answer = select(stretch.selection, told.seen, told.healthy)
    else:
        nothing = np.zeros(len(samples), dtype=np.int64)
        answer = Answer(told.seen.beta[:, 0], told.seen.beta_std[:, 0], nothing, nothing > 0, nothing)
    std = answer.beta_std.copy()
    recovering = next_doubt(stretch.doubt, samples, answer.beta, std, dt)
    status = status_codes(stretch.ages, samples, answer.outside, recovering, answer.beta, std, dt)
    status |= DEGRADED * (told.codes != HEALTHY).any(axis=1) | INVALID * told.lost
    motion = motion_of(stretch.yaw, samples, plan.vehicle, dt)
    valid = status & INVALID == 0
    handling = handling_of(stretch.handling, samples, answer.beta, std, motion, valid, plan.vehicle, dt)
    out["beta"], out["beta_std"], out["status"] = answer.beta, std, status
    out["active"], out["health"], out["filters"] = (
        np.array(plan.members)[answer.active],
        told.codes,
        seen.beta,
    )
    lost = ~np.isfinite(seen.beta[:, plan.members])
    if lost.any():  # told of one that is not finite is what the healthy ones say
        out["filters"][:, plan.members] = np.where(lost, told.seen.beta, seen.beta[:, plan.members])
    for name, values in (motion._asdict() | handling._asdict()).items():
        out[name] = values
    if plan.extras:
        out["extras"] = np.hstack(seen.extras)


@dataclass
class Stream:
    """Completed rows on their way to answers; a long gap begins a new stretch."""

    plan: Plan
    t: float = -math.inf  # of the newest row [s]
    stretch: Stretch | None = None
    newest: np.ndarray = field(default_factory=lambda: np.empty(0))  # (1,) answer at the newest row


def advance(stream: Stream, rows: np.ndarray, faults: np.ndarray) -> np.ndarray:
    """Answers at the next rows ``(n, columns)``, completed and in order of time.

    Parameters
    ----------
    stream : Stream
        Changed in place.
    rows : (n, columns)
    faults : (n,) int
        Of the rows, as `crosscomb.logs.prepare.next_rows` gives them with the rows.

    Returns
    -------
    (n,) records
        See `record_of`.
    """
    if not len(rows):
        return np.empty(0, stream.plan.record)
    t, parts = rows[:, _T], []
    starts = stretch_starts(t, stream.t)
    stream.t = float(t[-1])
    for begin, end in pairwise([*sorted({0, *starts}), len(t)]):
        if stream.stretch is None or begin in starts:
            before = stream.stretch
            stream.stretch = start_stretch(stream.plan, float(t[begin]))
            if before is not None:
                stream.stretch.doubt = start_doubt(float(before.newest["beta_std"][0]))
        parts.append(next_answers(stream.stretch, rows[begin:end]))
    answers = parts[0] if len(parts) == 1 else np.concatenate(parts)
    answers["faults"] = faults
    answers["status"][degrading(faults, stream.plan.artefact.sees_all)] |= DEGRADED
    stream.newest = answers[-1:].copy()
    return answers

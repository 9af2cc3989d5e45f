"""Runs of the campaign of faults: one fault in one log, judged beside the sound run."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.estimate import Run, estimate_log, next_estimate, start_run
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import Signals, make_signals
from crosscomb.training.recordings import Recording
from crosscomb.training.suites.fault_criteria import CRITERIA, NOT_JUDGED, judge
from crosscomb.training.suites.fault_results import Figures, Outcome, figures_of
from crosscomb.training.suites.fault_trials import Answers, Trial, answers_of, at_rows, same
from crosscomb.training.suites.faults import (
    DIVERGING,
    VEHICLE_FAULTS,
    WHEELS,
    Fault,
    signal_faults,
    unsigned_speed,
)

AFTER = 5.0
"""A run ends so long after the return of what was faulty [s]."""
UNNEEDED = 5.0
"""A wheel speed is not at fault for longer [s]: no answer may need it."""
WHOLE = 20.0
"""Faults that are there from the begin are run for so long [s]."""


@dataclass(frozen=True)
class Setup:
    """What is put to the test."""

    artefact: Artefact
    filters: tuple[str, ...] = ()  # instead of the artefact's, as in `estimate_log`
    kinds: tuple[str, ...] = tuple(CRITERIA)  # of faults

    def start(self, vehicle: Vehicle) -> Run:
        """Make the state before the first row."""
        return start_run(vehicle, self.artefact, self.filters or None)

    def answers(self, log: Signals, vehicle: Vehicle) -> Answers:
        """Answer at each row of a log."""
        return answers_of(estimate_log(log, vehicle, self.artefact, self.filters or None))


def copy_of(run: Run) -> Run:
    """Copy a run under way; what does not change in it is shared."""
    plan = run.stream.plan
    kept = (plan, plan.artefact, plan.filters, plan.vehicle)
    return deepcopy(run, {id(each): each for each in kept})


def part(log: Signals, rows: np.ndarray | slice) -> Signals:
    """Some rows of a log."""
    return replace(log, frame=log.frame[rows].reset_index(drop=True))


@dataclass(frozen=True)
class Bench:
    """A log at the onset of its fault: what was answered before, and the sound answers."""

    recording: Recording
    simulated: bool
    setup: Setup
    onset: float  # [s]
    before: Run
    sound: Answers
    causal: bool  # rows before the onset are answered the same, whatever comes after


def make_bench(recording: Recording, simulated: bool, onset: float, setup: Setup) -> Bench:
    """Run a sound log to its end, and up to the onset of its fault."""
    log = recording.signals
    run = setup.start(recording.vehicle)
    before = answers_of(next_estimate(run, part(log, log.t < onset)))
    sound = setup.answers(log, recording.vehicle)
    causal = same(before, at_rows(sound, log.t < onset))
    return Bench(recording, simulated, setup, onset, run, sound, causal)


def try_faults(bench: Bench) -> list[Outcome]:
    """Put every fault of the signals into the log of a bench."""
    faults = signal_faults(bench.recording.signals)
    return [try_fault(bench, fault) for fault in faults if fault.kind in bench.setup.kinds]


def try_fault(bench: Bench, fault: Fault) -> Outcome:
    """Put a fault into the log of a bench and judge what comes of it."""
    of = bench.recording.name, bench.simulated, fault.kind, fault.channel
    if not bench.causal:
        return Outcome(*of, "rows before the fault change", Figures())
    try:
        trial = _trial_of(bench, fault)
        return _judged(*of, trial) if trial else Outcome(*of, NOT_JUDGED, Figures())
    except UsageError as error:
        return Outcome(*of, f"refused: {error}", Figures())
    except Exception as error:  # a campaign of faults goes on after a crash, and says so
        return Outcome(*of, f"crash: {type(error).__name__}: {error}", Figures())


def _trial_of(bench: Bench, fault: Fault) -> Trial | None:
    """The log with a fault and what came of it; None where the fault leaves nothing of the log."""
    log, end = bench.recording.signals, fault.lasts + AFTER
    if fault.channel in WHEELS:
        end = min(end, UNNEEDED)
    logged = fault.change(log, bench.onset)
    faulty = make_signals(logged.frame, log.name, log.source)
    there = (faulty.t >= bench.onset) & (faulty.t <= bench.onset + end)
    if not there.any():
        return None
    tail = part(faulty, there)
    # Rows that moved in time are the same rows where none is missing, else rows are known by their stamps.
    rows = np.flatnonzero(there)
    if len(faulty) != len(log):
        rows = np.searchsorted(log.t, tail.t).clip(max=len(log) - 1)
    return _trial(
        log,
        rows,
        at_rows(bench.sound, rows),
        answers_of(next_estimate(copy_of(bench.before), tail)),
        lasts=fault.lasts,
        dropped=len(logged) - len(faulty),
        notes=faulty.notes,
        onset=bench.onset,
    )


def _trial(
    log: Signals, rows: np.ndarray, sound: Answers, faulty: Answers, onset: float, **others: Any
) -> Trial:
    """A trial on some rows of a log."""
    columns = log.beta_ref, log.column("vx"), log.column("ay")
    return Trial(log.t[rows] - onset, sound, faulty, *(column[rows] for column in columns), **others)


def try_others(bench: Bench) -> Iterator[Outcome]:
    """Put faults of the car's file and of the filters into a log, from its begin."""
    recording, setup = bench.recording, bench.setup
    log = part(recording.signals, recording.signals.t < recording.signals.t[0] + WHOLE)
    rows, car = np.arange(len(log)), recording.vehicle
    others = [(kind, "vehicle", change(car), setup) for kind, change in VEHICLE_FAULTS.items()]
    if not setup.filters:
        for name in DIVERGING:
            artefact = diverging(setup.artefact, name)
            if artefact is not None:
                others.append(("filter diverges", name, car, Setup(artefact)))
    for kind, channel, vehicle, given in others:
        if kind not in setup.kinds:
            continue
        answers = given.answers(log, vehicle)
        trial = _trial(log, rows, at_rows(bench.sound, rows), answers, float(log.t[0]))
        yield _judged(recording.name, bench.simulated, kind, channel, trial)


def _judged(log: str, simulated: bool, kind: str, channel: str, trial: Trial) -> Outcome:
    figures = figures_of(trial.t, trial.faulty, trial.truth, trial.vx)
    # No answer needs a wheel speed that changes nothing.
    needed = channel not in WHEELS or not same(trial.faulty, trial.sound)
    return Outcome(log, simulated, kind, channel, judge(kind, trial) if needed else NOT_JUDGED, figures)


def diverging(artefact: Artefact, name: str) -> Artefact | None:
    """The artefact with noise that makes one of its filters run away; None where it does not have that filter."""
    if name not in artefact.filter_names:
        return None
    filters = []
    for entry in artefact.filters:
        settings = dict(entry.settings)
        if entry.name == name:
            settings["noise"] = {**settings.get("noise", {}), **DIVERGING[name]}
        filters.append(entry.model_copy(update={"settings": settings}))
    return artefact.model_copy(update={"filters": filters})


def try_scene(kind: str, recording: Recording, simulated: bool, setup: Setup) -> Outcome:
    """Judge a way of driving that is a fault by itself."""
    log = recording.signals
    answers = setup.answers(unsigned_speed(log) if "unsigned" in kind else log, recording.vehicle)
    trial = _trial(log, np.arange(len(log)), answers, answers, float(log.t[0]))
    return _judged(recording.name, simulated, kind, "", trial)

"""The campaign of faults: every fault on every log, judged beside the sound run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.logs.grid import MAX_GAP
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.estimate import LogEstimate, Run, estimate_log, next_estimate, start_run
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import MIN_SPEED, Signals, make_signals
from crosscomb.training.metrics import countable
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.simulation.simulate import simulate_recording
from crosscomb.training.suites.fault_criteria import (
    ALARMS,
    NOT_JUDGED,
    PASSED,
    WRONG,
    Answers,
    Trial,
    holds,
    judge,
)
from crosscomb.training.suites.faults import (
    DIVERGING,
    VEHICLE_FAULTS,
    WHEELS,
    Fault,
    signal_faults,
    unsigned_speed,
)

MANOEUVRES = {
    "country_road": "dry",
    "slalom_limit": "wet",
    "lap": "dry",
    "road_slide": "snow",
    "double_lane_change": "dry",
    "town": "dry",
}
"""Manoeuvres that faults are put into, each with its surface."""

SCENES = (
    ("standstill", "stop_and_go", "dry"),
    ("reversing", "reversing", "dry"),
    ("reversing, unsigned speed", "reversing", "dry"),
    ("spin", "handbrake_turn", "wet"),
)
"""Kinds that are a way of driving, with manoeuvre and surface."""

CAR = "generic_compact"
SEED = 140_014
"""Far from the seeds that people choose, so that no training has seen these logs."""
SEEDS = 5
DURATION, ONSET = 32.0, 12.0
"""Length of a simulated log and the time of its fault [s]."""
LONGEST = 60.0
"""Faults are put into the middle so much [s] of a longer real log."""
AFTER = 8.0
"""A run ends so long after the return of what was faulty [s]."""


@dataclass(frozen=True)
class Setup:
    """What is put to the test."""

    artefact: Artefact
    filters: tuple[str, ...] = ()  # instead of the artefact's, as in `estimate_log`

    def start(self, vehicle: Vehicle) -> Run:
        """Make the state before the first row."""
        return start_run(vehicle, self.artefact, self.filters or None)


@dataclass(frozen=True)
class Figures:
    """Sums over rows with ground truth above walking speed, and alarms over all rows.

    Attributes
    ----------
    wrong, seconds : float
        Time with an error over 3 deg while the status is ok, and time altogether [s].
    inside, rows : int
        Rows whose truth lies within 1.96 beta_std, and all.
    alarms : int
        Onsets of degraded, invalid or extrapolating.
    length : float
        Of the log [s].
    """

    wrong: float = 0.0
    seconds: float = 0.0
    inside: int = 0
    rows: int = 0
    alarms: int = 0
    length: float = 0.0

    def __add__(self, other: Figures) -> Figures:
        mine, others = vars(self), vars(other)
        return Figures(**{name: mine[name] + others[name] for name in mine})


@dataclass(frozen=True)
class Outcome:
    """One run: why it failed, or that it passed or could not be judged, and its figures."""

    log: str
    simulated: bool
    kind: str
    channel: str
    failure: str
    figures: Figures

    @property
    def judged(self) -> bool:
        """Whether the log holds what the criterion asks about."""
        return self.failure != NOT_JUDGED

    @property
    def passed(self) -> bool:
        """Whether the criterion holds."""
        return self.failure == PASSED


@dataclass(frozen=True)
class Campaign:
    """All runs.

    Attributes
    ----------
    outcomes : list of Outcome
        With a fault.
    sound : dict of str to Figures
        Without any, by log; simulated ones first.
    simulated : list of str
        Logs of `sound` that are.
    drifts : dict of str to Figures
        Without any fault, of the folder of drifts.
    notes : list of str
    """

    outcomes: list[Outcome]
    sound: dict[str, Figures]
    simulated: list[str]
    drifts: dict[str, Figures] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def answers_of(estimate: LogEstimate, rows: slice | np.ndarray = slice(None)) -> Answers:
    """Columns of an estimate that criteria look at."""
    return Answers(*(getattr(estimate, name)[rows] for name in Answers._fields))


def figures_of(t: np.ndarray, answers: Answers, truth: np.ndarray, vx: np.ndarray) -> Figures:
    """Figures of an estimate beside the truth; all arrays ``(n,)``, vx as the sound log has it."""
    counted = countable(truth, vx)
    steps = np.minimum(np.diff(t, append=t[-1]), MAX_GAP)
    error = np.abs(answers.beta - truth)
    wrong = counted & ~(error <= WRONG) & (answers.status == "ok")
    alarm = np.any([holds(answers.status, word) for word in ALARMS], axis=0)
    return Figures(
        float(steps[wrong].sum()),
        float(steps[counted].sum()),
        int(np.sum(error[counted] <= 1.96 * answers.beta_std[counted])),
        int(counted.sum()),
        int(np.sum(np.diff(alarm.astype(int), prepend=0) > 0)),
        float(steps.sum()),
    )


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
    """A log at the onset of its fault: what was answered before, and the sound answers from there on."""

    recording: Recording
    simulated: bool
    onset: float  # [s]
    before: Run
    rest: Signals
    sound: LogEstimate
    causal: bool  # rows before the onset are answered the same, whatever comes after


def make_bench(recording: Recording, simulated: bool, onset: float, setup: Setup) -> Bench:
    """Run a sound log up to the onset of its fault, and to its end."""
    log = recording.signals
    after = log.t >= onset
    run = setup.start(recording.vehicle)
    first = next_estimate(run, part(log, ~after))
    whole = estimate_log(log, recording.vehicle, setup.artefact, setup.filters or None)
    causal = np.array_equal(first.beta, whole.beta[~after]) and np.array_equal(
        first.status, whole.status[~after]
    )
    rest = part(log, after)
    return Bench(recording, simulated, onset, run, rest, next_estimate(copy_of(run), rest), causal)


def try_fault(bench: Bench, fault: Fault) -> Outcome:
    """Put a fault into the log of a bench and judge what comes of it."""

    def outcome(failure: str, figures: Figures = Figures()) -> Outcome:
        return Outcome(bench.recording.name, bench.simulated, fault.kind, fault.channel, failure, figures)

    if not bench.causal:
        return outcome("rows before the fault change")
    try:
        trial = _trial_of(bench, fault)
    except UsageError as error:
        return outcome(f"refused: {error}")
    except Exception as error:  # a campaign of faults goes on after a crash, and says so
        return outcome(f"crash: {type(error).__name__}: {error}")
    figures = figures_of(trial.t, trial.faulty, trial.truth, trial.vx)
    if fault.channel in WHEELS and _same(trial):
        return outcome(NOT_JUDGED, figures)  # no answer needs this channel
    return outcome(judge(fault.kind, trial), figures)


def _same(trial: Trial) -> bool:
    """Tell whether a fault changes nothing."""
    return all(np.array_equal(mine, other) for mine, other in zip(trial.faulty, trial.sound, strict=True))


def _trial_of(bench: Bench, fault: Fault) -> Trial:
    log = bench.recording.signals
    logged = fault.change(log, bench.onset)
    faulty = make_signals(logged.frame, log.name, log.source)
    dropped, aligned = len(logged) - len(faulty), len(faulty) == len(log)
    tail = part(faulty, (faulty.t >= bench.onset) & (faulty.t <= bench.onset + fault.lasts + AFTER))
    answers = next_estimate(copy_of(bench.before), tail)
    sound_t = bench.rest.t
    rows = np.arange(len(tail)) if aligned else np.searchsorted(sound_t, tail.t).clip(max=len(sound_t) - 1)
    return Trial(
        sound_t[rows] - bench.onset,
        answers_of(bench.sound, rows),
        answers_of(answers),
        bench.rest.beta_ref[rows],
        bench.rest.column("vx")[rows],
        bench.rest.column("ay")[rows],
        fault.lasts,
        dropped,
        faulty.notes,
    )


def try_other(recording: Recording, setup: Setup) -> Iterator[Outcome]:
    """Put faults of the car's file and of the filters into a simulated log, from its begin to its end."""
    log, car = recording.signals, recording.vehicle
    sound = answers_of(estimate_log(log, car, setup.artefact, setup.filters or None))
    others = [(kind, "vehicle", change(car), setup) for kind, change in VEHICLE_FAULTS.items()]
    if not setup.filters:
        for name in DIVERGING:
            artefact = diverging(setup.artefact, name)
            if artefact is not None:
                others.append(("filter diverges", name, car, Setup(artefact)))
    for kind, channel, vehicle, given in others:
        faulty = answers_of(estimate_log(log, vehicle, given.artefact, given.filters or None))
        columns = log.beta_ref, log.column("vx"), log.column("ay")
        trial = Trial(log.t - log.t[0], sound, faulty, *columns)
        figures = figures_of(log.t, faulty, log.beta_ref, log.column("vx"))
        yield Outcome(recording.name, True, kind, channel, judge(kind, trial), figures)


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
    speed = log.column("vx")
    given = unsigned_speed(log) if "unsigned" in kind else log
    answers = answers_of(estimate_log(given, recording.vehicle, setup.artefact, setup.filters or None))
    trial = Trial(log.t - log.t[0], answers, answers, log.beta_ref, speed, log.column("ay"))
    figures = figures_of(log.t, answers, log.beta_ref, np.abs(speed))
    return Outcome(recording.name, simulated, kind, "", judge(kind, trial), figures)


Done = tuple[list[Outcome], dict[str, Figures]]
Job = Callable[[Setup], Done]


def _simulated(manoeuvre: str, surface: str, seed: int, setup: Setup) -> Done:
    """All faults on one simulated log."""
    place = list(MANOEUVRES).index(manoeuvre)
    name = f"{manoeuvre}_{surface}_{seed}"
    options = {"duration": DURATION, "surface": surface, "name": name}
    recording = simulate_recording(load_vehicle(CAR), manoeuvre, (SEED, place, seed), **options)
    bench = make_bench(recording, True, ONSET, setup)
    outcomes = [try_fault(bench, fault) for fault in signal_faults(recording.signals)]
    return [*outcomes, *try_other(recording, setup)], {name: _sound(recording, setup)}


def _scene(kind: str, manoeuvre: str, surface: str, seed: int, setup: Setup) -> Done:
    name = f"{manoeuvre}_{surface}_{seed}"
    place = 100 + [scene[1] for scene in SCENES].index(manoeuvre)
    options = {"duration": DURATION, "surface": surface, "name": name}
    recording = simulate_recording(load_vehicle(CAR), manoeuvre, (SEED, place, seed), **options)
    return [try_scene(kind, recording, True, setup)], {}


def _real(recording: Recording, setup: Setup) -> Done:
    """All faults on the middle of one real log, about the middle of its driving."""
    log = recording.signals
    moving = log.t[log.column("vx") > MIN_SPEED]
    sound = {recording.name: _sound(recording, setup)}
    if not moving.size:
        return [try_scene("standstill", recording, False, setup)], sound
    onset = float(moving[len(moving) // 2])
    near = part(log, np.abs(log.t - onset) <= 0.5 * LONGEST)
    bench = make_bench(replace(recording, signals=near), False, onset, setup)
    return [try_fault(bench, fault) for fault in signal_faults(near)], sound


def _sound(recording: Recording, setup: Setup) -> Figures:
    log = recording.signals
    answers = answers_of(estimate_log(log, recording.vehicle, setup.artefact, setup.filters or None))
    return figures_of(log.t, answers, log.beta_ref, log.column("vx"))


def _drift(recording: Recording, setup: Setup) -> Done:
    return [], {recording.name: _sound(recording, setup)}


def _do(job: Job, setup: Setup) -> Done:
    return job(setup)


def jobs_of(seeds: int, real: Sequence[Recording]) -> list[Job]:
    """The work of a campaign, log by log."""
    numbers = range(seeds)
    simulated = [partial(_simulated, *pair, seed) for pair in MANOEUVRES.items() for seed in numbers]
    scenes = [partial(_scene, *scene, seed) for scene in SCENES for seed in numbers]
    return [*simulated, *scenes, *(partial(_real, recording) for recording in real)]


def run_campaign(
    setup: Setup,
    data: Path | None = None,
    drift: Path | None = None,
    seeds: int = SEEDS,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
) -> Campaign:
    """Put every fault into simulated logs, and into the real logs of a folder.

    Parameters
    ----------
    setup : Setup
    data : Path, optional
        Folder of real logs; those that cannot be scored take part.
    drift : Path, optional
        Folder of real drifts, which are run without faults.
    seeds : int
        Simulated logs of each manoeuvre.
    jobs : int
        Processes.
    progress : callable, optional
        Called after each log.

    Raises
    ------
    UsageError
        A folder holds no log, or a broken one.
    """
    real, notes = read_recordings(data, unscored=True) if data else ([], [])
    slides, more = read_recordings(drift) if drift else ([], [])
    work = [*jobs_of(seeds, real), *(partial(_drift, recording) for recording in slides)]
    done = in_parallel(_do, [(job, setup) for job in work], jobs, progress)
    split = len(done) - len(slides)
    outcomes = [outcome for part_of, _ in done for outcome in part_of]
    sound = {name: figures for _, each in done[:split] for name, figures in each.items()}
    drifts = {name: figures for _, each in done[split:] for name, figures in each.items()}
    simulated = [name for name in sound if name not in {recording.name for recording in real}]
    return Campaign(outcomes, sound, simulated, drifts, [*notes, *more])

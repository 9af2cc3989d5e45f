"""The campaign of faults: every fault on every log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import MIN_SPEED
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.simulation.simulate import simulate_recording
from crosscomb.training.suites.fault_results import Campaign, Figures, Outcome, figures_of, lost_rows
from crosscomb.training.suites.fault_runs import Setup, make_bench, part, try_faults, try_others, try_scene
from crosscomb.training.suites.fault_trials import Answers

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
    ("unsigned reversing", "reversing", "dry"),
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


Done = tuple[list[Outcome], dict[str, Figures]]
Job = Callable[[Setup], Done]


def _simulated(manoeuvre: str, surface: str, seed: int, setup: Setup) -> Done:
    """All faults on one simulated log."""
    place = list(MANOEUVRES).index(manoeuvre)
    name = f"{manoeuvre}_{surface}_{seed}"
    options = {"duration": DURATION, "surface": surface, "name": name}
    recording = simulate_recording(load_vehicle(CAR), manoeuvre, (SEED, place, seed), **options)
    bench = make_bench(recording, True, ONSET, setup)
    return [*try_faults(bench), *try_others(bench)], {name: _figures(recording, bench.sound)}


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
        still = [try_scene("standstill", recording, False, setup)] if "standstill" in setup.kinds else []
        return still, sound
    onset = float(moving[len(moving) // 2])
    near = part(log, np.abs(log.t - onset) <= 0.5 * LONGEST)
    bench = make_bench(replace(recording, held=near), False, onset, setup)
    return try_faults(bench), sound


def _figures(recording: Recording, answers: Answers) -> Figures:
    log = recording.signals
    return figures_of(log.t, answers, log.beta_ref, log.column("vx"), lost_rows(log))


def _sound(recording: Recording, setup: Setup) -> Figures:
    return _figures(recording, setup.answers(recording.signals, recording.vehicle))


def _drift(recording: Recording, setup: Setup) -> Done:
    return [], {recording.name: _sound(recording, setup)}


def _do(job: Job, setup: Setup) -> Done:
    return job(setup)


def jobs_of(seeds: int, kinds: Sequence[str], real: Sequence[Recording] = ()) -> list[Job]:
    """The work of a campaign, log by log."""
    numbers = range(seeds)
    simulated = [partial(_simulated, *pair, seed) for pair in MANOEUVRES.items() for seed in numbers]
    scenes = [partial(_scene, *scene, seed) for scene in SCENES if scene[0] in kinds for seed in numbers]
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
    work = [*jobs_of(seeds, setup.kinds, real), *(partial(_drift, recording) for recording in slides)]
    done = in_parallel(_do, [(job, setup) for job in work], jobs, progress)
    split = len(done) - len(slides)
    outcomes = [outcome for part_of, _ in done for outcome in part_of]
    sound = {name: figures for _, each in done[:split] for name, figures in each.items()}
    drifts = {name: figures for _, each in done[split:] for name, figures in each.items()}
    simulated = [name for name in sound if name not in {recording.name for recording in real}]
    return Campaign(outcomes, sound, simulated, drifts, [*notes, *more])

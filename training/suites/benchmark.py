"""Accuracy and speed of all estimators, on real and on simulated logs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.drive import make_filters
from crosscomb.selection.artefact import Artefact, FilterSettings
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.selectors.bank import run_bank
from crosscomb.training.selectors.evaluate import Evaluation, evaluate, filter_scores, scores_table
from crosscomb.training.simulation.simulate import simulate_data_set, simulate_recording
from crosscomb.training.suites.speed import timed

SHARED_SET = (
    "kth_volvo_s90/slalom_30kph",
    "kth_volvo_s90/stepsteer_left_100kph",
    "kth_volvo_v40/slalom_35kph",
    "kth_volvo_v40/sine_with_dwell_80kph",
    "revs_ferrari_250lm/targa66_20140222_01_part1",
    "stanford_gti_2018/oval_aa",
    "stanford_gti_2018/oval_ab",
    "stanford_gti_2018/oval_ad",
    "stanford_gti_2019/high_speed_1",
    "stanford_gti_2019/low_speed",
    "stanford_gti_2019/double_lane_change_1",
    "stanford_gti_2019/double_lane_change_2",
)
"""The real recordings that results are compared on; others are reported beside them."""

SIMULATED_LOGS = 24
SIMULATED_SEED = 987_654
"""Far from the seeds that people choose, so that no training has seen these logs."""


@dataclass(frozen=True)
class Benchmark:
    """Scores on a set of recordings.

    Attributes
    ----------
    evaluation : Evaluation
    summaries : dict of str to list of str
        Named sets of recordings to take the mean over.
    notes : list of str
    """

    evaluation: Evaluation
    summaries: dict[str, list[str]]
    notes: list[str]


def benchmark_real(
    folder: Path,
    artefact: Artefact,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    filters: Sequence[FilterSettings] = (),
) -> Benchmark:
    """Score all estimators on every recording with ground truth in a folder of real logs.

    `progress` is called when a log is read and when it is filtered.

    Raises
    ------
    UsageError
        The folder holds no recording that can be scored, or a broken log.
    """
    recordings, notes = read_recordings(folder, progress=progress)
    if not recordings:
        raise UsageError(f"{folder}: no recording has ground truth and a vehicle.toml: nothing can be scored")
    evaluation = _evaluate(recordings, artefact, jobs, progress, filters)
    names = [recording.name for recording in recordings]
    shared = [name for name in SHARED_SET if name in names]
    if len(shared) == len(SHARED_SET):
        others = [name for name in names if name not in shared]
        summaries = {f"shared set ({len(shared)})": shared, f"others ({len(others)})": others}
    else:
        summaries = {f"all ({len(names)})": names}
    return Benchmark(evaluation, {text: members for text, members in summaries.items() if members}, notes)


def benchmark_simulated(
    artefact: Artefact,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    filters: Sequence[FilterSettings] = (),
) -> Benchmark:
    """Score all estimators on freshly simulated logs of the generic compact car."""
    with tempfile.TemporaryDirectory() as folder:
        simulate_data_set(
            load_vehicle("generic_compact"), Path(folder), SIMULATED_SEED, SIMULATED_LOGS, jobs=jobs
        )
        recordings, notes = read_recordings(Path(folder))
    evaluation = _evaluate(recordings, artefact, jobs, progress, filters)
    return Benchmark(evaluation, {f"all ({len(recordings)})": [r.name for r in recordings]}, notes)


def _evaluate(
    recordings: list[Recording],
    artefact: Artefact,
    jobs: int,
    progress: Callable[[], None] | None,
    filters: Sequence[FilterSettings],
) -> Evaluation:
    """Score the artefact, and beside it filters that are not in it."""
    entries = [*artefact.filters, *filters]
    banks = run_bank(recordings, entries, artefact.rate, artefact.window, jobs, progress)
    members = range(len(artefact.filters))
    evaluation = evaluate([bank.only(members) for bank in banks], artefact)
    if not filters:
        return evaluation
    scores = {bank.name: filter_scores(bank) for bank in banks}
    beside = scores_table(scores, [entry.name for entry in entries]).iloc[:, 2 * len(artefact.filters) :]
    return replace(evaluation, table=pd.concat([evaluation.table, beside], axis=1))


def filter_speeds(
    artefact: Artefact, filters: Sequence[FilterSettings] = (), repeats: int = 3
) -> dict[str, float]:
    """Time of each filter per sample [us], the best of some runs over a simulated minute."""
    vehicle = load_vehicle("generic_compact")
    inputs, _, _ = next(simulate_recording(vehicle, "slalom", 1, duration=60.0).stretches(artefact.rate))
    speeds = {}
    entries = [*artefact.filters, *filters]
    for entry, estimator in zip(entries, make_filters(entries, vehicle), strict=True):
        speeds[entry.name] = timed(partial(estimator.run, inputs), repeats)[1] / len(inputs.samples) * 1e6
    return speeds

"""Tune a bank of filters before a selector is trained on it, cheaply: on a few short recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from crosscomb.filters.catalogue import make_filter, settings_of
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.tuned import Tuned
from crosscomb.selection.artefact import FilterSettings
from crosscomb.training.recordings import Recording
from crosscomb.training.tuning.scores import ERROR, TuneLog, errors_of, losses, prepare
from crosscomb.training.tuning.tune import is_tunable, tune

MOST_RECORDINGS = 10
LONGEST = 60.0  # [s] of each
FOLDS = 2
WINDOW = 100
"""Samples over which the bank's best filter is chosen when tuned ones are judged: over less, jitter would pay."""


def tuned_entries(
    recordings: Sequence[Recording],
    entries: Sequence[FilterSettings],
    rate: float,
    evaluations: int,
    seed: int = 0,
    jobs: int = 1,
    leave: Tuned | None = None,
) -> list[FilterSettings]:
    """Filters with tuned noise where that helps on recordings it was not tuned on, and the bank as a whole.

    Parameters
    ----------
    recordings : sequence of Recording
        Those that may be learnt from; at most ten of them are drawn at random, and a minute of each taken.
    entries : sequence of FilterSettings
    rate : float [Hz]
    evaluations : int
        Of each search.
    seed, jobs : int
        The result depends on the seed only.
    leave : Tuned, optional
        Filters named in it keep what they have.
    """
    chosen = np.random.default_rng(seed).permutation(len(recordings))[:MOST_RECORDINGS]
    done = [entry.name for entry in leave.filters] if leave else []
    wanted = [entry for entry in entries if entry.name not in done and is_tunable(entry.name, ERROR)]
    if not wanted or len(chosen) < FOLDS:
        return list(entries)
    # Held, so that none is read twice.
    some = [replace(recordings[i], held=recordings[i].signals) for i in sorted(chosen)]
    tuning = tune(
        some, wanted, rate, ERROR, evaluations, rounds=1, folds=FOLDS, seed=seed, jobs=jobs, longest=LONGEST
    )
    logs = prepare(some, rate, ERROR, LONGEST)
    return keep_what_complements(list(entries), [each.kept for each in tuning.filters], logs)


def keep_what_complements(
    bank: list[FilterSettings], tuned: Sequence[FilterSettings], logs: Sequence[TuneLog]
) -> list[FilterSettings]:
    """Take tuned filters into a bank one by one, where the best choice in each window does not become worse by it.

    A filter that alone becomes better by following another has nothing left to add to it.

    Parameters
    ----------
    bank : list of FilterSettings
    tuned : sequence of FilterSettings
        The same filters, or some of them, with other noise.
    logs : sequence of TuneLog
        With ground truth.
    """
    errors = [_window_errors(entry, logs) for entry in bank]
    before = _oracle(errors)
    for entry in tuned:
        i = [other.name for other in bank].index(entry.name)
        if entry == bank[i]:
            continue
        tried = [*errors[:i], _window_errors(entry, logs), *errors[i + 1 :]]
        after = _oracle(tried)
        if float(np.mean(losses(after, before, ERROR))) <= 0.0:
            bank, errors, before = [*bank[:i], entry, *bank[i + 1 :]], tried, after
    return bank


def _window_errors(entry: FilterSettings, logs: Sequence[TuneLog]) -> list[np.ndarray]:
    """Mean squared error in each window of the scored samples, log by log ``(windows,) [deg^2]``."""
    errors = []
    for squared in (np.degrees(error) ** 2 for error in errors_of(entry, logs)):
        windows = np.arange(0, len(squared), WINDOW)
        errors.append(np.add.reduceat(squared, windows) / np.minimum(WINDOW, len(squared) - windows))
    return errors


def _oracle(errors: Sequence[list[np.ndarray]]) -> np.ndarray:
    """RMSE [deg] on each log of choosing the best filter in every window."""
    return np.array([np.sqrt(np.mean(np.min(each, axis=0))) for each in zip(*errors, strict=True)])


def say_tuned(entries: Sequence[FilterSettings], evaluations: int) -> list[str]:
    """Lines that tell which filters of a training have noise of their own."""
    car = load_vehicle("generic_compact")
    lines = []
    for entry in entries:
        noise, default = entry.settings.get("noise"), settings_of(make_filter(entry.name, car))["noise"]
        if noise is not None and noise != default:
            lines.append(f"{entry.name}: noise {json.dumps(noise)}")
    if evaluations > 0:
        lines.append(
            f"noise tuned in {evaluations} evaluations on at most {MOST_RECORDINGS} recordings of the training part; "
            f"kept where it helps on those it was not tuned on, and the bank as a whole (`tune_budget` 0: not tuned)"
        )
    return lines

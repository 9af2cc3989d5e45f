"""Tune a bank of filters before a selector is trained on it, cheaply: on a few short recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from crosscomb.artefact import FilterSettings
from crosscomb.filters.catalogue import make_filter, settings_of
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.recordings import Recording
from crosscomb.training.tune import is_tunable, tune
from crosscomb.training.tune_scores import ERROR
from crosscomb.tuned import Tuned

MOST_RECORDINGS = 10
LONGEST = 60.0  # [s] of each
FOLDS = 2


def tuned_entries(
    recordings: Sequence[Recording],
    entries: Sequence[FilterSettings],
    rate: float,
    evaluations: int,
    seed: int = 0,
    jobs: int = 1,
    leave: Tuned | None = None,
) -> list[FilterSettings]:
    """Filters with tuned noise where it also helps on recordings it was not tuned on, else as they were.

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
    tuning = tune(
        [recordings[i] for i in sorted(chosen)], wanted, rate, ERROR, evaluations, rounds=1, folds=FOLDS,
        seed=seed, jobs=jobs, longest=LONGEST,
    )  # fmt: skip
    kept = {each.entry.name: each.kept for each in tuning.filters}
    return [kept.get(entry.name, entry) for entry in entries]


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
            f"noise tuned in {evaluations} evaluations on the training part, at most {MOST_RECORDINGS} recordings, and "
            f"kept where it also helped on those it was not tuned on (--tune-budget 0 leaves it as it is)"
        )
    return lines

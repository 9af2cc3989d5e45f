"""Tune the noise of filters on recordings, and keep what also helps on recordings it was not tuned on.

The way of D'Inverno 2021, sections 2 and 5: surrogate optimisation of the estimation error. Beyond it: the loss is
robust, so that no recording rules the others; noise is pulled gently to where it was; and folds by recording decide
whether the tuned noise is kept. Without ground truth the likelihood of the measurements takes the error's place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.catalogue import CATALOGUE, make_filter, require_listed, settings_of
from crosscomb.models.vehicle import load_vehicle
from crosscomb.selection.artefact import FilterSettings
from crosscomb.training.folds import grouped_folds
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording
from crosscomb.training.tuning.noise import NoiseSpace, noise_space
from crosscomb.training.tuning.scores import ERROR, LIKELIHOOD, TuneLog, losses, prepare, score_logs
from crosscomb.training.tuning.surrogate import minimise

EVALUATIONS = 50
"""Of each round of the search (D'Inverno 2021, section 5)."""

PULL = 0.02
"""Loss of a setting at the end of its range, a factor of 100 away: what brings less than that stays where it was."""

LEAST_GAIN = 0.01
"""Loss that tuned noise must save on held-out recordings: about one percent of the error."""

SEARCH_PARTICLES = 250
"""Particles while searching; what is found is judged with all of them."""


@dataclass(frozen=True)
class FilterTuning:
    """What tuning one filter gave.

    Attributes
    ----------
    entry : FilterSettings
        As before.
    noise : dict
        Tuned on all recordings.
    accepted : bool
        Whether folds by recording found it to help.
    before, after, held_out : (recordings,)
        Score of each recording as it was, tuned on all recordings, and tuned on other recordings only: RMSE [deg], or
        minus the log likelihood per sample.
    factors : dict of str to float
        Tuned over earlier value of each setting that was tuned.
    evaluations : int
        Of the search on all recordings.
    """

    entry: FilterSettings
    noise: dict[str, Any]
    accepted: bool
    before: np.ndarray
    after: np.ndarray
    held_out: np.ndarray
    factors: dict[str, float]
    evaluations: int

    @property
    def kept(self) -> FilterSettings:
        """The filter to go on with: tuned where that was accepted, else as before."""
        if not self.accepted:
            return self.entry
        return self.entry.model_copy(update={"settings": {**self.entry.settings, "noise": self.noise}})


@dataclass(frozen=True)
class Tuning:
    """What a tuning gave, filter by filter.

    Attributes
    ----------
    by : str
        `ERROR` or `LIKELIHOOD`.
    recordings : list of str
    filters : list of FilterTuning
    """

    by: str
    recordings: list[str]
    filters: list[FilterTuning]


def tune(
    recordings: Sequence[Recording],
    entries: Sequence[FilterSettings],
    rate: float,
    by: str = ERROR,
    evaluations: int = EVALUATIONS,
    rounds: int = 2,
    folds: int = 3,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    longest: float = np.inf,
) -> Tuning:
    """Tune the noise of each filter by itself.

    Parameters
    ----------
    recordings : sequence of Recording
        At least two; with ground truth unless by likelihood.
    entries : sequence of FilterSettings
        The search begins at their noise.
    rate : float [Hz]
    by : str
        `ERROR` or `LIKELIHOOD`.
    evaluations, rounds : int
        Of each search; see `crosscomb.training.tuning.surrogate.minimise`.
    folds : int
        At most one per recording. Each recording is judged by the noise tuned without its fold.
    seed : int
        The same seed gives the same noise bit for bit.
    jobs : int
        Processes; the result does not depend on it.
    progress : callable, optional
        Called after each search, `searches` times in all.
    longest : float [s]
        As in `prepare`.

    Raises
    ------
    UsageError
        There are too few recordings, or a filter has no noise to tune this way.
    """
    if len(recordings) < 2:
        raise UsageError(
            f"{recordings[0].path.parent if recordings else 'tune'}: {len(recordings)} recording to tune on, it "
            f"needs at least two, as one must be held out: add logs"
        )
    for entry in entries:
        require_tunable(entry.name, by)
    logs = prepare(recordings, rate, by, longest)
    pairs = grouped_folds(list(range(len(logs))), folds, seed)
    members = [list(range(len(logs))), *(fit for fit, _ in pairs)]
    tasks = [
        (entry, [logs[i] for i in chosen], by, evaluations, rounds, seed + number)
        for entry in entries
        for number, chosen in enumerate(members)
    ]
    found = in_parallel(_search, tasks, jobs, progress)
    size = len(members)
    judged = [(entry, found[i * size : (i + 1) * size], logs, pairs, by) for i, entry in enumerate(entries)]
    return Tuning(by, [log.name for log in logs], in_parallel(_judge, judged, jobs))


def searches(filters: int, recordings: int, folds: int = 3) -> int:
    """How often `tune` reports progress: after each filter's search on all recordings and on each fold's."""
    return filters * (1 + min(folds, recordings))


def require_tunable(name: str, by: str) -> None:
    """Refuse a filter without noise that can be tuned.

    Raises
    ------
    UsageError
    """
    require_listed(f"`filters` {name}", name)
    if is_tunable(name, by):
        return
    if by == LIKELIHOOD:
        able = [key for key in CATALOGUE if is_tunable(key, by)]
        raise UsageError(
            f"`filters` {name}: can only be tuned against ground truth: without it take of {', '.join(able)}"
        )
    raise UsageError(f"`filters` {name}: no noise setting changes its answer: leave it out")


def is_tunable(name: str, by: str) -> bool:
    """Tell whether a filter of the catalogue has noise that can be tuned this way."""
    return _space(FilterSettings(name=name), by).dimensions > 0


def _space(entry: FilterSettings, by: str) -> NoiseSpace:
    """What is tuned of a filter, around its settings; those left out of them have their defaults."""
    made = make_filter(entry.name, load_vehicle("generic_compact"), entry.settings)
    return noise_space(settings_of(made)["noise"], made.told_by_likelihood if by == LIKELIHOOD else None)


def _search(
    entry: FilterSettings, logs: Sequence[TuneLog], by: str, evaluations: int, rounds: int, seed: int
) -> tuple[dict[str, Any], dict[str, float], int]:
    """Noise with the least loss on some logs, its factors, and the number of evaluations."""
    space = _space(entry, by)
    settings = dict(entry.settings)
    if settings.get("particles", 0) > SEARCH_PARTICLES:
        settings["particles"] = SEARCH_PARTICLES

    def at(point: np.ndarray) -> np.ndarray:
        tried = FilterSettings(name=entry.name, settings={**settings, "noise": space.noise_at(point)})
        return score_logs(tried, logs, by)

    before = at(np.zeros(space.dimensions))

    def loss(point: np.ndarray) -> float:
        return float(np.mean(losses(at(point), before, by)) + PULL * np.sum(point**2))

    found = minimise(loss, space.dimensions, evaluations, seed, rounds)
    point, value, count = found.point.copy(), found.value, found.evaluations + 1
    # What does not pay goes back to where it was, the least moved first.
    for i in np.argsort(np.abs(point), kind="stable"):
        back = point.copy()
        back[i] = 0.0
        without = loss(back)
        count += 1
        if without <= value + LEAST_GAIN / 10.0:
            point, value = back, without
    return space.noise_at(point), space.factors_at(point), count


def _judge(
    entry: FilterSettings,
    found: list[tuple[dict[str, Any], dict[str, float], int]],
    logs: list[TuneLog],
    pairs: list[tuple[list[int], list[int]]],
    by: str,
) -> FilterTuning:
    """Judge each log by the noise of the fold that left it out, and decide."""
    before = score_logs(entry, logs, by)
    held_out = np.empty(len(logs))
    for (noise, _, _), (_, test) in zip(found[1:], pairs, strict=True):
        held_out[test] = score_logs(_with(entry, noise), [logs[i] for i in test], by)
    noise, factors, count = found[0]
    accepted = float(np.mean(losses(held_out, before, by))) <= -LEAST_GAIN
    if by == ERROR:
        accepted = accepted and float(held_out.mean()) <= float(before.mean())
    after = score_logs(_with(entry, noise), logs, by)
    return FilterTuning(entry, noise, accepted, before, after, held_out, factors, count)


def _with(entry: FilterSettings, noise: dict[str, Any]) -> FilterSettings:
    return entry.model_copy(update={"settings": {**entry.settings, "noise": noise}})

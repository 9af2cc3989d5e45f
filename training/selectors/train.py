"""Train a selector: split, folds, evaluation, and the artefact refitted on all recordings."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.files import file_hash, versions
from crosscomb.filters.catalogue import DEFAULT_FILTERS, make_filter, settings_of
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.drive import require_known
from crosscomb.run.tuned import Tuned, with_tuned
from crosscomb.selection.artefact import Artefact, FilterSettings
from crosscomb.training.folds import Parts, grouped_folds, split_recordings
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording, common_vehicle
from crosscomb.training.selectors.evaluate import Evaluation, evaluate, pool
from crosscomb.training.selectors.fit import SELECTORS, Fitter
from crosscomb.training.selectors.fit_tree import TreeShape
from crosscomb.training.selectors.shelf import Kept, banks_of, fill_shelf, windows_of
from crosscomb.training.tuning.first import tuned_entries

RATE = 100.0
"""Default working rate [Hz]."""


@dataclass(frozen=True)
class Training:
    """What a training gave.

    Attributes
    ----------
    artefact : Artefact
        Fitted on all recordings; none of the evaluations below is of this tree.
    folds : Evaluation
        Each recording of the training part, judged by the selector of the fold that left it out; everything that
        was chosen or calibrated was so inside that fold.
    validation, test : Evaluation
        The 15 % and 10 % parts, judged by the tree of the 75 % part.
    parts : Parts
    shape : TreeShape
        Of the tree in the artefact.
    """

    artefact: Artefact
    folds: Evaluation
    validation: Evaluation
    test: Evaluation
    parts: Parts
    shape: TreeShape

    @property
    def evaluations(self) -> dict[str, Evaluation]:
        """The three evaluations by name."""
        return {"folds": self.folds, "validation": self.validation, "test": self.test}


def train(
    recordings: Sequence[Recording],
    selector: str = "tree",
    folds: int = 5,
    seed: int = 0,
    rate: float = RATE,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    filters: Sequence[str] = DEFAULT_FILTERS,
    tuned: Tuned | None = None,
    tune_budget: int = 0,
) -> Training:
    """Train a selector on recordings with ground truth.

    Parameters
    ----------
    recordings : sequence of Recording
        At least seven.
    selector : str
        Key of `crosscomb.training.selectors.fit.SELECTORS`.
    folds : int
    seed : int
        The same seed gives the same artefact bit for bit.
    rate : float
        Working rate [Hz].
    jobs : int
        Processes for the filters.
    progress : callable, optional
        Called `steps` times in all.
    filters : sequence of str
        Names of the estimators to select from; at least two.
    tuned : Tuned, optional
        Noise that takes the place of the filters' defaults; these filters are not tuned again.
    tune_budget : int
        Evaluations to tune the other filters' noise with, on the training part only; 0 leaves them as they are.

    Raises
    ------
    UsageError
        One filter is the best in every window, or a recording has no window that can be judged.
    """
    entries = with_tuned(default_filters(recordings[0].vehicle, filters), tuned)
    if tune_budget > 0:
        learning = [recordings[i] for i in split_recordings(len(recordings), seed).training]
        entries = tuned_entries(learning, entries, rate, tune_budget, seed, jobs, leave=tuned)
    with tempfile.TemporaryDirectory() as folder:
        fitter = make_fitter(recordings, selector, entries, Path(folder), seed, rate, jobs, progress)
        parts = split_recordings(len(recordings), seed)
        # The largest first, so that no process waits long for another at the end.
        tasks = [
            (list(range(len(recordings))), []),
            (parts.training, [parts.validation, parts.test]),
            *((fit, [left]) for fit, left in grouped_folds(parts.training, folds, seed)),
        ]
        fits = in_parallel(fit_and_judge, [(fitter, *task) for task in tasks], jobs, progress)
    (whole, shape, _), (_, _, (validation, test)) = fits[:2]
    cross = pool([judged for _, _, (judged,) in fits[2:]])
    record = _record(recordings, parts, seed, folds, shape, cross, validation, test)
    artefact = whole.model_copy(update={"training": record})
    return Training(artefact, cross, validation, test, parts, shape)


def make_fitter(
    recordings: Sequence[Recording],
    selector: str,
    entries: list[FilterSettings],
    folder: Path,
    seed: int,
    rate: float = RATE,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
) -> Fitter:
    """Run the filters over recordings and label their windows, into files of a folder that must outlive the fitter.

    See `train` for the other arguments and errors.
    """
    kind = SELECTORS[selector]
    kept = fill_shelf(recordings, entries, rate, [(kind.window, kind.needs_all)], folder, jobs, progress)
    _require_choice(recordings, [one.rmse[0] for one in kept], entries)
    return fitter_on(kept, selector, entries, rate, common_vehicle(list(recordings)), seed)


def fitter_on(
    kept: Sequence[Kept],
    selector: str,
    entries: list[FilterSettings],
    rate: float,
    vehicle: Vehicle | None,
    seed: int,
    kind: int = 0,
) -> Fitter:
    """Fitter of a selector on recordings that were kept with its windows as the kind at this place."""
    banks, windows = banks_of(kept, SELECTORS[selector].window), windows_of(kept, kind)
    rmse, simulated = [one.rmse[kind] for one in kept], [one.is_simulated for one in kept]
    return Fitter(selector, rate, entries, vehicle, seed, banks, windows, rmse, simulated)


def fit_and_judge(
    fitter: Fitter, members: Sequence[int], others: Sequence[Sequence[int]]
) -> tuple[Artefact, TreeShape, list[Evaluation]]:
    """Fit on some recordings, and judge that on each group of others."""
    artefact, shape = fitter.fit(members)
    return artefact, shape, [evaluate((fitter.banks[i] for i in group), artefact) for group in others]


def steps(recordings: Sequence[Recording], folds: int) -> int:
    """How often `train` reports progress: after each recording and after each fit."""
    training = len(split_recordings(len(recordings), 0).training)
    return len(recordings) + min(folds, training) + 2


def _require_choice(
    recordings: Sequence[Recording], rmse: Sequence[np.ndarray], filters: Sequence[FilterSettings]
) -> None:
    """Refuse recordings whose windows cannot be labelled, or leave nothing to select.

    Raises
    ------
    UsageError
    """
    for recording, of_windows in zip(recordings, rmse, strict=True):
        if len(of_windows) == 0:
            raise UsageError(
                f"{recording.path}: nowhere fast enough for one whole window beside ground truth: "
                f"take it out of the folder"
            )
    best = np.unique(np.argmin(np.concatenate(list(rmse)), axis=1))
    if len(best) == 1:
        folder = os.path.commonpath([recording.path.parent for recording in recordings])
        raise UsageError(
            f"{folder}: {filters[best[0]].name} is best in every window, there is nothing to select: "
            f"add recordings of other driving (slides, straights, cornering)"
        )


def default_filters(vehicle: Vehicle, names: Sequence[str] = DEFAULT_FILTERS) -> list[FilterSettings]:
    """Filters with all their settings written out; by default the paper's three."""
    return [FilterSettings(name=name, settings=settings_of(make_filter(name, vehicle))) for name in names]


def require_filters(names: Sequence[str]) -> None:
    """Refuse a bank of filters that cannot be selected from.

    Raises
    ------
    UsageError
        A name is unknown or stands twice, or there is only one.
    """
    require_known(names)
    if len(names) < 2:
        raise UsageError(f"`filters` {', '.join(names)}: there is nothing to select from: name at least two")


def _record(
    recordings: Sequence[Recording],
    parts: Parts,
    seed: int,
    folds: int,
    shape: TreeShape,
    cross: Evaluation,
    validation: Evaluation,
    test: Evaluation,
) -> dict[str, object]:
    """Record of a training for the artefact."""
    names = [recording.name for recording in recordings]
    return {
        "seed": seed,
        "folds": folds,
        "depth": shape.depth,
        "leaf": shape.leaf,
        "versions": versions(),
        "data": {recording.name: file_hash(recording.path) for recording in recordings},
        "parts": {
            part: [names[i] for i in getattr(parts, part)] for part in ("training", "validation", "test")
        },
        "rmse_deg": {
            part: {str(k): round(float(v), 4) for k, v in evaluation.overall["rmse"].items()}
            for part, evaluation in (("folds", cross), ("validation", validation), ("test", test))
        },
    }

"""All selectors on the same recordings under the same rules, so that no figure flatters."""

from __future__ import annotations

import itertools
import json
import tempfile
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.filters.catalogue import DEFAULT_FILTERS
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import FilterSettings
from crosscomb.training.folds import grouped_folds
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import CARD, Recording, common_vehicle
from crosscomb.training.selectors.evaluate import SWITCH, Evaluation, pool, scores_table
from crosscomb.training.selectors.fit import SELECTORS, Fitter
from crosscomb.training.selectors.fit_tree import fit_tree, to_tree
from crosscomb.training.selectors.labels import Windows, concatenate
from crosscomb.training.selectors.shelf import Kept, fill_shelf
from crosscomb.training.selectors.train import default_filters, fit_and_judge, fitter_on

REFERENCES = ("imm", "mmae")
"""Published ways to combine models, run beside the selectors as they are."""

KINDS = tuple(
    (window, any(kind.needs_all for kind in SELECTORS.values() if kind.window == window))
    for window in dict.fromkeys(kind.window for kind in SELECTORS.values())
)
"""Windows that the selectors look at, and whether one of them takes all features beside."""

DRAWS = 2000
"""Bootstrap samples of recordings."""


@dataclass(frozen=True)
class Comparison:
    """Selectors side by side.

    Attributes
    ----------
    summary : pandas.DataFrame
        One row per selector and scheme: ratio to the best single filter with its 95 % interval over recordings, RMSE,
        regret, largest errors, coverage, switches.
    references : pandas.DataFrame
        Mean RMSE and largest error of single estimators [deg].
    by_manoeuvre, by_band : pandas.DataFrame
        RMSE [deg] of the folds per kind of driving and per range of the true beta; selectors as columns.
    leakage : pandas.DataFrame
        RMSE over windows [deg] of the default tree when windows are dealt out at random, and by recording.
    """

    summary: pd.DataFrame
    references: pd.DataFrame
    by_manoeuvre: pd.DataFrame
    by_band: pd.DataFrame
    leakage: pd.DataFrame

    def to_json(self) -> str:
        """All tables for programs."""
        names = ("summary", "references", "by_manoeuvre", "by_band", "leakage")
        tables = {
            name: json.loads(getattr(self, name).to_json(orient="split", double_precision=6))
            for name in names
        }
        return json.dumps(tables, indent=1) + "\n"


def driving_of(recording: Recording) -> tuple[str, str]:
    """Manoeuvre and surface of a simulated recording, from the card beside it; empty for others."""
    card = recording.path.with_name(CARD)
    if not card.is_file():
        return "", ""
    name = recording.name.rsplit("/", 1)[-1]
    try:
        logs = json.loads(card.read_text(encoding="utf-8"))["logs"]
        entry: dict[str, object] = next((one for one in logs if one["log"] == name), {})
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # no card of ours
        return "", ""
    return str(entry.get("manoeuvre", "")), str(entry.get("surface", ""))


def leave_one_out(groups: Sequence[str]) -> list[tuple[list[int], list[int]]]:
    """Pairs of (recordings to fit on, recordings to test on), one per group; none where there is only one group."""
    names = sorted(set(groups))
    if len(names) < 2 or "" in names:
        return []
    return [
        (
            [i for i, group in enumerate(groups) if group != name],
            [i for i, group in enumerate(groups) if group == name],
        )
        for name in names
    ]


def schemes_of(
    recordings: Sequence[Recording], folds: int, seed: int
) -> dict[str, list[tuple[list[int], list[int]]]]:
    """Ways to leave recordings out: folds, one vehicle, one surface."""
    schemes = {
        f"{folds} folds": grouped_folds(list(range(len(recordings))), folds, seed),
        "leave one vehicle out": leave_one_out([one.vehicle.name for one in recordings]),
        "leave one surface out": leave_one_out([driving_of(one)[1] for one in recordings]),
    }
    return {name: pairs for name, pairs in schemes.items() if pairs}


def comparison_steps(recordings: Sequence[Recording], folds: int, seed: int) -> int:
    """How often `compare` reports progress."""
    return len(recordings) + sum(len(pairs) for pairs in schemes_of(recordings, folds, seed).values())


def compare(
    recordings: Sequence[Recording],
    folds: int = 5,
    seed: int = 0,
    rate: float = 100.0,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    filters: Sequence[str] = DEFAULT_FILTERS,
) -> Comparison:
    """Judge every selector on recordings it was not fitted on.

    Parameters
    ----------
    recordings : sequence of Recording
    folds, seed, rate, jobs, progress, filters
        As in `crosscomb.training.selectors.train.train`; `progress` is called `comparison_steps` times.
    """
    entries = default_filters(recordings[0].vehicle, filters)
    beside = default_filters(recordings[0].vehicle, [name for name in REFERENCES if name not in filters])
    schemes = schemes_of(recordings, folds, seed)
    with tempfile.TemporaryDirectory() as folder:
        kept = fill_shelf(recordings, entries, rate, KINDS, Path(folder), jobs, progress, beside)
        fitters = fitters_of(kept, entries, rate, common_vehicle(list(recordings)), seed)
        tasks = [(fitters, fit, test) for pairs in schemes.values() for fit, test in pairs]
        judged = iter(in_parallel(judge_all, tasks, jobs, progress))
        leaks = leakage([windows.plain for windows in fitters[0].windows], folds, seed, jobs)
    references = scores_table(
        {one.name: one.scores for one in kept}, [one.name for one in [*entries, *beside]]
    )
    of_scheme = {
        scheme: dict(
            zip(SELECTORS, map(pool, zip(*itertools.islice(judged, len(pairs)), strict=True)), strict=True)
        )
        for scheme, pairs in schemes.items()
    }
    of_folds = next(iter(of_scheme.values()))
    rows = [
        {"selector": selector, "scheme": scheme, **summary_of(of_scheme[scheme][selector], seed)}
        for selector in SELECTORS
        for scheme in schemes
    ]
    driving = pd.Series({one.name: driving_of(one)[0] or one.vehicle.name for one in recordings})
    return Comparison(
        summary=pd.DataFrame(rows).set_index(["selector", "scheme"]),
        references=pd.DataFrame(
            {
                "rmse": references.xs("rmse", axis=1, level=1).mean(),
                "max": references.xs("max", axis=1, level=1).max(),
            }
        ),
        by_manoeuvre=_together(of_folds, lambda one: one.rmse.groupby(driving).mean()),
        by_band=_together(of_folds, lambda one: one.by_band),
        leakage=leaks,
    )


def fitters_of(
    kept: Sequence[Kept], entries: list[FilterSettings], rate: float, vehicle: Vehicle | None, seed: int
) -> list[Fitter]:
    """One fitter for each selector, on recordings kept with `KINDS`; they share the trees that they fit."""
    known: dict[tuple[Hashable, ...], Any] = {}
    windows = [settings for settings, _ in KINDS]
    return [
        replace(
            fitter_on(kept, selector, entries, rate, vehicle, seed, windows.index(kind.window)), known=known
        )
        for selector, kind in SELECTORS.items()
    ]


def judge_all(fitters: Sequence[Fitter], members: Sequence[int], others: Sequence[int]) -> list[Evaluation]:
    """Fit every selector on some recordings, and judge it on others."""
    judged = [fit_and_judge(fitter, members, [others])[2][0] for fitter in fitters]
    fitters[0].known.clear()  # shared by all; no other fold asks for these trees
    return judged


def summary_of(evaluation: Evaluation, seed: int) -> dict[str, float]:
    """What counts of an evaluation, on one line."""
    low, high = bootstrap_ratio(evaluation, seed)
    table, single = evaluation.table, evaluation.best_single
    return {
        "ratio": evaluation.ratio,
        "ratio low": low,
        "ratio high": high,
        "RMSE [deg]": float(evaluation.rmse[SWITCH].mean()),
        "RMSE / oracle": float(evaluation.rmse[SWITCH].mean() / evaluation.rmse["oracle"].mean()),
        "regret [deg]": evaluation.regret,
        "accuracy": float(np.trace(evaluation.confusion) / max(evaluation.confusion.sum(), 1)),
        "largest error / best single": float(
            evaluation.largest[SWITCH].mean() / evaluation.largest[single].mean()
        ),
        "coverage": float(table[SWITCH, "coverage"].mean()),
        "switches per minute": float(table[SWITCH, "switches_per_minute"].mean()),
        "largest jump [deg]": float(table[SWITCH, "largest_jump"].max()),
    }


def bootstrap_ratio(evaluation: Evaluation, seed: int) -> tuple[float, float]:
    """95 % interval of the ratio to the best single filter, over draws of recordings."""
    rmse = evaluation.rmse
    ours, single = rmse[SWITCH].to_numpy(), rmse[evaluation.best_single].to_numpy()
    draws = np.random.default_rng(seed).integers(0, len(ours), (DRAWS, len(ours)))
    low, high = np.quantile(ours[draws].mean(axis=1) / single[draws].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def leakage(parts: Sequence[Windows], folds: int, seed: int, jobs: int = 1) -> pd.DataFrame:
    """RMSE over windows [deg] of the default tree under random folds and under folds by recording.

    Random folds put windows a tenth of a second apart on both sides: what they promise is not kept on a new log.
    """
    windows, owner = (
        concatenate(list(parts)),
        np.repeat(np.arange(len(parts)), [len(part.rmse) for part in parts]),
    )
    dealt = np.random.default_rng(seed).integers(0, folds, len(owner))
    by_recording = np.empty(len(owner), dtype=np.int64)
    for fold, (_, test) in enumerate(grouped_folds(list(range(len(parts))), folds, seed)):
        by_recording[np.isin(owner, test)] = fold
    rows = {}
    for name, fold_of in (("windows at random (leaks)", dealt), ("by recording", by_recording)):
        left_out = [fold_of == fold for fold in np.unique(fold_of)]
        picks = in_parallel(_picks, [(windows, out, seed) for out in left_out], jobs)
        picked = np.zeros(len(owner), dtype=np.int64)
        for out, some in zip(left_out, picks, strict=True):
            picked[out] = some
        error = windows.rmse[np.arange(len(owner)), picked]
        rows[name] = {
            "RMSE [deg]": float(np.degrees(np.sqrt(np.mean(error**2)))),
            "accuracy": float(np.mean(picked == windows.label)),
        }
    return pd.DataFrame(rows).T


def _picks(windows: Windows, left_out: np.ndarray, seed: int) -> np.ndarray:
    """What the default tree of all other windows picks in the windows left out ``(w,) bool``."""
    part = windows.where(~left_out)
    fitted = fit_tree(part.features, part, True, SELECTORS["tree"].shape, seed)
    return to_tree(fitted, part.features, windows.rmse.shape[1]).predict(windows.features[left_out])


def _together(
    evaluations: dict[str, Evaluation], table_of: Callable[[Evaluation], pd.DataFrame]
) -> pd.DataFrame:
    """Estimators of the first evaluation, and the switch of each as the selector's column."""
    first = table_of(next(iter(evaluations.values())))
    columns = {str(name): first[name] for name in first.columns if name != SWITCH}
    return pd.DataFrame({**columns, **{name: table_of(one)[SWITCH] for name, one in evaluations.items()}})

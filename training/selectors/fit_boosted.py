"""Fit boosted trees on all signals that foretell which filter to take."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import softmax

from crosscomb.errors import UsageError
from crosscomb.selection.boosted import Boosted
from crosscomb.selection.choice import Choice
from crosscomb.selection.features import layout
from crosscomb.training.selectors.labels import Windows

if TYPE_CHECKING:
    from lightgbm import Booster

ITERATIONS = 40
"""Rounds of the trees that choose; on simulated logs more brought nothing."""

SETTINGS = {
    "objective": "regression", "num_leaves": 31, "learning_rate": 0.2, "lambda_l2": 1.0, "min_data_in_leaf": 40,
    # On simulated logs a third of the features and 63 bins err as little as all of them, in a tenth of the time.
    "feature_fraction": 0.3, "max_bin": 63,
    # The bins are laid by a part of the windows: to sort them all took as long as the trees.
    "bin_construct_sample_cnt": 10_000,
    # Bit for bit the same on any number of processes; and no node asks whether a value is missing.
    "deterministic": True, "force_row_wise": True, "num_threads": 1, "use_missing": False, "verbosity": -1,
}  # fmt: skip

TEMPERATURES = tuple(float(one) for one in np.geomspace(0.02, 5.0, 25))

MOST_WINDOWS = 20_000
"""So many windows train at most, evenly thinned: neighbours are near copies.

Drawing by size of the gradient instead (GOSS) erred the same on simulated logs and took longer.
"""


def fit_trees(
    features: np.ndarray,
    targets: Sequence[np.ndarray],
    seed: int,
    iterations: int,
    weight: np.ndarray | None = None,
) -> list[Booster]:
    """Fit one sum of regression trees for each target.

    Parameters
    ----------
    features : (w, f) float32
    targets : sequence of (w,)
    seed : int
    iterations : int
    weight : (w,), optional

    Raises
    ------
    UsageError
        LightGBM does not load.
    """
    try:
        import lightgbm
    except (ImportError, OSError) as error:  # OSError: its library does not find the OpenMP runtime
        raise UsageError(
            f"LightGBM, which trains boosted trees, does not load ({error}): install lightgbm, and the OpenMP runtime "
            f"of your system if that is what is missing (libgomp on Linux, libomp on macOS)"
        ) from None
    settings = {**SETTINGS, "seed": seed}
    data = lightgbm.Dataset(features, weight=weight, params=settings, free_raw_data=False)
    models = []
    for target in targets:
        data.set_label(target)
        models.append(lightgbm.train(settings, data, iterations))
    return models


def to_boosted(models: Sequence[Booster]) -> Boosted:
    """Take fitted models over, one output each; where one stopped early, trees that add nothing stand in."""
    columns: dict[str, Any] = {name: [] for name in ("feature", "threshold", "left", "right", "value")}
    roots = []
    dumps = [[tree["tree_structure"] for tree in model.dump_model()["tree_info"]] for model in models]
    for stage in itertools.zip_longest(*dumps, fillvalue={"leaf_value": 0.0}):
        for tree in stage:
            start = len(columns["value"])
            roots.append(start)
            for row in _nodes(tree, start):
                for name, value in zip(columns, row, strict=True):
                    columns[name].append(value)
    return Boosted(baseline=[0.0] * len(models), roots=roots, **columns)


def _nodes(tree: dict[str, Any], start: int) -> Iterator[tuple[int, float, int, int, float]]:
    """Nodes of a tree whose first one gets the number `start`: feature, threshold, children and value."""
    found = [tree]
    for node in found:  # grows while it is walked
        if "leaf_value" in node:
            yield -1, 0.0, -1, -1, node["leaf_value"]
        else:
            left = start + len(found)
            found += [node["left_child"], node["right_child"]]
            yield node["split_feature"], node["threshold"], left, left + 1, 0.0


def mirror_signs(filters: list[str]) -> np.ndarray:
    """Sign of each feature in the mirrored drive ``(f,) float32``."""
    return np.where(layout(filters).odd, -1.0, 1.0).astype(np.float32)


def with_mirrored(features: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Features of the drives and of their mirror images ``(2 w, f)``."""
    return np.concatenate([features, features * signs])


def fit_choice(windows: Windows, filters: list[str], seed: int, seen: np.ndarray | None = None) -> Boosted:
    """Fit trees that foretell how much worse than the best one each filter is.

    Their outputs are the excess RMSE with its sign turned [deg], so that the temperature is in degrees too.

    Parameters
    ----------
    windows : Windows
        With all features.
    filters : list of str
    seed : int
    seen : (f,) bool, optional
        Features that the trees may look at; all where left out.
    """
    windows = windows.thinned(MOST_WINDOWS)
    # No tree asks for what is the same everywhere.
    everything = windows.everything if seen is None else windows.everything * seen
    features = with_mirrored(everything, mirror_signs(filters))
    excess = np.degrees(windows.rmse - windows.rmse.min(axis=1, keepdims=True))
    models = fit_trees(features, [np.tile(-each, 2) for each in excess.T], seed, ITERATIONS)
    return to_boosted(models)


def fit_temperature(choices: Sequence[Choice], left_out: Sequence[Windows]) -> float:
    """Temperature [deg] at which blends err least on the windows that each choice was not fitted on."""
    cases = []
    for choice, windows in zip(choices, left_out, strict=True):
        known = np.isfinite(windows.beta_ref)
        cases.append(
            (choice.trees.predict(windows.everything[known]), windows.beta[known], windows.beta_ref[known])
        )

    def error(temperature: float) -> float:
        total = 0.0
        for scores, beta, truth in cases:
            total += float(np.sum(((softmax(scores / temperature, axis=1) * beta).sum(axis=1) - truth) ** 2))
        return total

    return min(TEMPERATURES, key=error)

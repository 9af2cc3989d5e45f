"""Fit boosted trees on all signals that foretell which filter to take."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import softmax
from sklearn.ensemble import HistGradientBoostingRegressor

from crosscomb.selection.boosted import Boosted
from crosscomb.selection.choice import Choice
from crosscomb.selection.features import layout
from crosscomb.training.selectors.labels import Windows

ITERATIONS, LEAVES, LEARNING_RATE = 80, 31, 0.1
"""Of the trees; on simulated logs more brought nothing."""

TEMPERATURES = tuple(float(one) for one in np.geomspace(0.02, 5.0, 25))

MOST_WINDOWS = 30_000
"""So many windows train at most, evenly thinned: neighbours are near copies."""


def fit_trees(
    features: np.ndarray, target: np.ndarray, seed: int, iterations: int, weight: np.ndarray | None = None
) -> HistGradientBoostingRegressor:
    """Fit one sum of regression trees.

    Parameters
    ----------
    features : (w, f) float32
    target : (w,)
    seed : int
    iterations : int
    weight : (w,), optional
    """
    model = HistGradientBoostingRegressor(
        max_iter=iterations, max_leaf_nodes=LEAVES, learning_rate=LEARNING_RATE, l2_regularization=1.0,
        min_samples_leaf=40, max_features=0.3, early_stopping=False, random_state=seed,
    )  # fmt: skip
    return model.fit(features, target, sample_weight=weight)


def to_boosted(models: Sequence[HistGradientBoostingRegressor]) -> Boosted:
    """Take fitted models of equal size over, one output each."""
    columns: dict[str, list[np.ndarray]] = {
        name: [] for name in ("feature", "threshold", "left", "right", "value")
    }
    roots, start = [], 0
    for stage in zip(*(model._predictors for model in models), strict=True):
        for (predictor,) in stage:
            nodes = predictor.nodes
            leaf = nodes["is_leaf"].astype(bool)
            roots.append(start)
            columns["feature"].append(np.where(leaf, -1, nodes["feature_idx"].astype(np.int64)))
            columns["threshold"].append(np.where(leaf, 0.0, nodes["num_threshold"]))
            columns["left"].append(np.where(leaf, -1, start + nodes["left"].astype(np.int64)))
            columns["right"].append(np.where(leaf, -1, start + nodes["right"].astype(np.int64)))
            columns["value"].append(np.where(leaf, nodes["value"], 0.0))
            start += len(nodes)
    arrays = {name: np.concatenate(parts).tolist() for name, parts in columns.items()}
    baseline = [float(np.ravel(model._baseline_prediction)[0]) for model in models]
    return Boosted(baseline=baseline, roots=roots, **arrays)


def mirror_signs(filters: list[str]) -> np.ndarray:
    """Sign of each feature in the mirrored drive ``(f,) float32``."""
    return np.where(layout(filters).odd, -1.0, 1.0).astype(np.float32)


def with_mirrored(features: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Features of the drives and of their mirror images ``(2 w, f)``."""
    return np.concatenate([features, features * signs])


def fit_choice(
    windows: Windows, filters: list[str], soft: bool, seed: int, seen: np.ndarray | None = None
) -> Choice:
    """Fit trees that foretell how much worse than the best one each filter is.

    Their outputs are the excess RMSE with its sign turned [deg], so that the temperature is in degrees too.

    Parameters
    ----------
    windows : Windows
        With all features.
    filters : list of str
    soft : bool
    seed : int
    seen : (f,) bool, optional
        Features that the trees may look at; all where left out.
    """
    windows = windows.thinned(MOST_WINDOWS)
    # No tree asks for what is the same everywhere.
    everything = windows.everything if seen is None else windows.everything * seen
    features = with_mirrored(everything, mirror_signs(filters))
    excess = np.degrees(windows.rmse - windows.rmse.min(axis=1, keepdims=True))
    models = [fit_trees(features, np.tile(-excess[:, i], 2), seed, ITERATIONS) for i in range(len(filters))]
    return Choice(trees=to_boosted(models), soft=soft)


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

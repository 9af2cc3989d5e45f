"""Fit boosted trees on all signals: which filter to take, how to correct the best one, and how far off that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import softmax
from sklearn.ensemble import HistGradientBoostingRegressor

from crosscomb.boosted import Boosted
from crosscomb.choice import Choice
from crosscomb.correction import Correction
from crosscomb.features import layout
from crosscomb.training.labels import Windows

ITERATIONS, LEAVES, LEARNING_RATE = 150, 31, 0.1
"""Of the trees that correct; on simulated logs more brought nothing."""

TEMPERATURES = tuple(float(one) for one in np.geomspace(0.02, 5.0, 25))

CHOICE_ITERATIONS = 80
DOUBT_ITERATIONS = 60

LEAST_DOUBT = np.radians(0.05)
"""No error is called smaller than this [rad]: references are not better."""

BOUND_QUANTILE = 0.999
"""Share of the training windows whose correction fits into the bound."""


def fit_trees(
    features: np.ndarray, target: np.ndarray, iterations: int, seed: int
) -> HistGradientBoostingRegressor:
    """Fit one sum of regression trees.

    Parameters
    ----------
    features : (w, f) float32
    target : (w,)
    iterations : int
    seed : int
    """
    model = HistGradientBoostingRegressor(
        max_iter=iterations, max_leaf_nodes=LEAVES, learning_rate=LEARNING_RATE, l2_regularization=1.0,
        min_samples_leaf=40, max_features=0.3, early_stopping=False, random_state=seed,
    )  # fmt: skip
    return model.fit(features, target)


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


def fit_choice(windows: Windows, filters: list[str], soft: bool, seed: int) -> Choice:
    """Fit trees that foretell how much worse than the best one each filter is.

    Their outputs are the excess RMSE with its sign turned [deg], so that the temperature is in degrees too.

    Parameters
    ----------
    windows : Windows
        With all features.
    filters : list of str
    soft : bool
    seed : int
    """
    features = with_mirrored(windows.everything, mirror_signs(filters))
    excess = np.degrees(windows.rmse - windows.rmse.min(axis=1, keepdims=True))
    models = [
        fit_trees(features, np.tile(-excess[:, i], 2), CHOICE_ITERATIONS, seed) for i in range(len(filters))
    ]
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


def fit_correction(windows: Windows, filters: list[str], anchor: int, seed: int) -> Correction:
    """Fit the trees that correct a filter; its doubt is yet to be learned from recordings left out.

    Parameters
    ----------
    windows : Windows
        With all features.
    filters : list of str
    anchor : int
        Index of the filter that is corrected.
    seed : int
    """
    known = np.isfinite(windows.beta_ref)
    signs = mirror_signs(filters)
    features = with_mirrored(windows.everything[known], signs)
    missing = (windows.beta_ref - windows.beta[:, anchor])[known]
    model = fit_trees(features, np.concatenate([missing, -missing]), ITERATIONS, seed)
    return Correction(
        anchor=filters[anchor],
        trees=to_boosted([model]),
        doubt=Boosted(
            baseline=[float(np.log(LEAST_DOUBT))],
            roots=[],
            feature=[],
            threshold=[],
            left=[],
            right=[],
            value=[],
        ),
        bound=float(min(max(np.quantile(np.abs(missing), BOUND_QUANTILE), LEAST_DOUBT), 1.5)),
        odd=(signs < 0.0).tolist(),
        lowest=features.min(axis=0).astype(float).tolist(),
        highest=features.max(axis=0).astype(float).tolist(),
    )


def fit_doubt(parts: Sequence[tuple[np.ndarray, np.ndarray]], signs: np.ndarray, seed: int) -> Boosted:
    """Fit the logarithm of the standard deviation on errors of recordings left out.

    Its scale is calibrated on each part by the trees of the others: they know the errors they were fitted on.

    Parameters
    ----------
    parts : sequence of ((w, f) float32, (w,) [rad])
        Features and errors; at least two, of different recordings.
    signs : (f,)
        Of the features in the mirrored drive.
    seed : int
    """
    ratios = []
    for i, (features, error) in enumerate(parts):
        others = _doubt_trees([part for j, part in enumerate(parts) if j != i], signs, seed)
        foretold = 0.5 * (others.predict(features) + others.predict(features * signs))[:, 0]
        ratios.append(error / np.exp(foretold))
    doubt = _doubt_trees(parts, signs, seed)
    every = np.concatenate(ratios)
    scale = conformal_scale(every, np.ones(len(every)))
    return doubt.model_copy(update={"baseline": [doubt.baseline[0] + float(np.log(scale))]})


def _doubt_trees(parts: Sequence[tuple[np.ndarray, np.ndarray]], signs: np.ndarray, seed: int) -> Boosted:
    features, errors = (np.concatenate(column) for column in zip(*parts, strict=True))
    size = np.log(np.maximum(np.abs(errors), LEAST_DOUBT))
    return to_boosted([fit_trees(with_mirrored(features, signs), np.tile(size, 2), DOUBT_ITERATIONS, seed)])


def conformal_scale(error: np.ndarray, beta_std: np.ndarray) -> float:
    """Factor on beta_std that makes +- 1.96 beta_std hold 95 % of the errors (split conformal).

    Parameters
    ----------
    error, beta_std : (n,) [rad]
        Of samples the estimate was not fitted on.
    """
    rank = min(1.0, 0.95 * (1.0 + 1.0 / len(error)))
    return float(np.quantile(np.abs(error) / beta_std, rank) / 1.96)

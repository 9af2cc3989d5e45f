"""Fit the networks and trees that correct a filter, and the one that says how far off the corrected answer is."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from crosscomb.selection.choice import Choice
from crosscomb.selection.correction import LEAST_DOUBT, MOST_DOUBT, Correction
from crosscomb.selection.features import layout
from crosscomb.selection.network import FAR, Member, Network
from crosscomb.selection.trust import Trust
from crosscomb.training.selectors.fit_boosted import fit_trees, mirror_signs, to_boosted, with_mirrored
from crosscomb.training.selectors.fit_trust import fit_trust
from crosscomb.training.selectors.labels import Windows, thinning


class Size(NamedTuple):
    """Networks of an ensemble, the neurons of their layers, steps of each at most, and rounds of the trees beside."""

    members: int
    hidden: tuple[int, int]
    steps: int
    rounds: int = 0


FULL = Size(2, (64, 32), 4500, 300)
"""What corrects; on fresh simulated logs one network of 2,800 steps and 150 rounds erred by three percent more."""

FEW = Size(1, (64, 32), 1200, 150)
"""The same in the fits that only show what is left over on other recordings."""

DOUBT = Size(1, (32, 16), 800)

SHARE = 0.8
"""Share of the corrected filter in the answer, the rest is the blend's.

On simulated logs anything from 0.8 to 1 errs the same; the smaller, the less goes wrong on cars unlike those.
"""

MOST_WINDOWS = 200_000
"""So many windows train at most, evenly thinned: neighbours are near copies."""

BATCH, EPOCHS = 512, 20
"""Windows per step, and passes over the windows at most."""

PHASES = ((4e-3, 0.7), (1e-3, 0.15), (2.5e-4, 0.15))
"""Learning rates and their shares of the passes.

On simulated logs a rate that falls erred as little in ten passes as one rate (2e-3) in fifteen.
"""

MOST_ROWS = 150_000
"""So many windows and mirrored ones train the trees at most."""

UNIT = np.radians(1.0)
"""The networks answer in this unit [rad]."""

EVEN_ERROR = np.radians(0.3)
"""Recordings count by 1 / (RMSE of the corrected filter + this) [rad].

What is judged is the mean RMSE of recordings: without weights the slides alone would be learned.
"""

LEAST_ERROR = np.exp(LEAST_DOUBT)
"""No error is called smaller than this [rad]: references are not better."""

BOUND_QUANTILE = 0.999
"""Share of the training windows whose correction fits into the bound."""


class Part(NamedTuple):
    """Windows of recordings that a correction was not fitted on.

    Attributes
    ----------
    features : (w, f) float32
    error : (w,) [rad]
        Truth less corrected answer.
    beta : (w, filters) [rad]
    weight : (w,)
    """

    features: np.ndarray
    error: np.ndarray
    beta: np.ndarray
    weight: np.ndarray


def recording_weights(rmse: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Weight of each window ``(w,)`` by the error of a filter in its recording, see `EVEN_ERROR`.

    Parameters
    ----------
    rmse : (w,) [rad]
        Of the filter in each window.
    owner : (w,) int
        Recording of each window.
    """
    counts = np.maximum(np.bincount(owner), 1)
    weight = 1.0 / (np.sqrt(np.bincount(owner, rmse**2) / counts) + EVEN_ERROR)
    return weight[owner] / weight[owner].mean()


def fit_network(
    features: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    filters: list[str],
    anchor: int,
    size: Size,
    seed: int,
) -> Network:
    """Fit networks that differ only in their first weights, and trees on the same inputs.

    They look at the drive and at what the filters say; sideslip angles count from the anchor's.

    Parameters
    ----------
    features : (w, f) float32
    target : (w,)
        In units of one.
    weight : (w,)
    filters : list of str
    anchor : int
        Index of the filter that sideslip angles count from.
    size : Size
    seed : int
    """
    places = layout(filters)
    columns = np.flatnonzero(places.plain)
    relative = places.relative_to(anchor)[columns]
    seen = features[:, columns] - np.where(relative >= 0, features[:, relative], np.float32(0.0))
    # An odd feature and its mirror image have mean zero.
    mean = np.where(places.odd[columns], 0.0, seen.mean(axis=0))
    scale = np.maximum(np.sqrt(np.mean((seen - mean) ** 2, axis=0)), 1e-6)
    inputs = np.clip((seen - mean) / scale, -FAR, FAR).astype(np.float32)
    members = [fit_member(inputs, target, weight, size, seed + member) for member in range(size.members)]
    trees = None
    if size.rounds:
        some = slice(None, None, thinning(len(inputs), MOST_ROWS))
        trees = to_boosted(fit_trees(inputs[some], [target[some]], seed, size.rounds, weight[some]))
    return Network(
        columns=columns.tolist(), relative=relative.tolist(), mean=_short(mean), scale=_short(scale), unit=1.0,
        members=members, trees=trees,
    )  # fmt: skip


def fit_member(inputs: np.ndarray, target: np.ndarray, weight: np.ndarray, size: Size, seed: int) -> Member:
    """Fit one network to scaled inputs ``(w, i) float32``."""
    passes = min(EPOCHS, max(3, size.steps * BATCH // len(inputs)))
    # Mixed once: to pick every batch from all over the table anew would cost a quarter of the time.
    order = np.random.default_rng(seed).permutation(len(inputs))
    inputs, target, weight = inputs[order], target[order].astype(np.float32), weight[order].astype(np.float32)
    # It goes on from phase to phase and never stops early.
    regressor = MLPRegressor(
        hidden_layer_sizes=size.hidden, alpha=1e-3, batch_size=min(BATCH, len(inputs)), random_state=seed,
        shuffle=False, warm_start=True, tol=0.0, n_iter_no_change=10 * EPOCHS,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # these passes are meant to be the end
        for rate, share in PHASES:
            regressor.set_params(learning_rate_init=rate, max_iter=max(1, round(share * passes)))
            regressor.fit(inputs, target, sample_weight=weight)
    return to_member(regressor)


def to_member(fitted: MLPRegressor) -> Member:
    """Take a fitted network with two hidden layers over."""
    (first, second, last), (first_bias, second_bias, last_bias) = fitted.coefs_, fitted.intercepts_
    return Member(
        first=[_short(row) for row in first],
        first_bias=_short(first_bias),
        second=[_short(row) for row in second],
        second_bias=_short(second_bias),
        output=_short(last[:, 0]),
        output_bias=_short(last_bias)[0],
    )


def _short(values: np.ndarray) -> list[float]:
    """Numbers with six digits: all that single precision tells apart in these sums, in half the file."""
    return [float(f"{value:.6g}") for value in values]


def fit_correction(
    windows: Windows, weight: np.ndarray, filters: list[str], anchor: int, seed: int, size: Size
) -> Correction:
    """Fit the networks that correct a filter; its doubt is yet to be learned from recordings left out.

    Parameters
    ----------
    windows : Windows
        With all features.
    weight : (w,)
        Of each window.
    filters : list of str
    anchor : int
        Index of the filter that is corrected.
    seed : int
    size : Size
    """
    known = np.isfinite(windows.beta_ref)
    signs = mirror_signs(filters)
    missing = (windows.beta_ref - windows.beta[:, anchor])[known]
    every = np.arange(len(missing))[:: thinning(len(missing), MOST_WINDOWS)]
    seen = windows.everything[known]
    low, high = seen.min(axis=0), seen.max(axis=0)
    reach = np.maximum(-low, high)
    network = fit_network(
        with_mirrored(seen[every], signs),
        np.concatenate([missing[every], -missing[every]]) / UNIT,
        np.tile(weight[known][every], 2), filters, anchor, size, seed,
    )  # fmt: skip
    return Correction(
        anchor=filters[anchor],
        network=network.model_copy(update={"unit": float(UNIT)}),
        doubt=constant_doubt(float(LEAST_DOUBT)),
        share=SHARE,
        bound=float(min(max(np.quantile(np.abs(missing), BOUND_QUANTILE), LEAST_ERROR), 1.5)),
        odd=(signs < 0.0).tolist(),
        lowest=np.where(signs < 0.0, -reach, low).astype(float).tolist(),
        highest=np.where(signs < 0.0, reach, high).astype(float).tolist(),
    )


def constant_doubt(value: float) -> Network:
    """A network that answers `value` to everything."""
    silent = Member(
        first=[[0.0]], first_bias=[0.0], second=[[0.0]], second_bias=[0.0], output=[0.0], output_bias=value
    )
    return Network(columns=[0], relative=[-1], mean=[0.0], scale=[1.0], unit=1.0, members=[silent])


def left_over(
    correction: Correction, choice: Choice, windows: Windows, weight: np.ndarray, filters: list[str]
) -> Part:
    """What a correction and the blend beside it leave on windows of other recordings.

    Parameters
    ----------
    correction : Correction
    choice : Choice
    windows : Windows
    weight : (w,)
    filters : list of str
    """
    known = np.isfinite(windows.beta_ref)
    seen, beta = windows.everything[known], windows.beta[known]
    corrected = beta[:, filters.index(correction.anchor)] + correction.predict(seen)
    blended = (choice.probabilities(seen) * beta).sum(axis=1)
    answer = correction.share * corrected + (1.0 - correction.share) * blended
    return Part(seen, windows.beta_ref[known] - answer, beta, weight[known])


def fit_doubt(parts: Sequence[Part], filters: list[str], anchor: int, seed: int) -> tuple[Network, Trust]:
    """Fit the logarithm of the standard deviation on errors of recordings left out, and its calibration.

    It is calibrated on each part with the network of the others: it knows the errors it was fitted on.

    Parameters
    ----------
    parts : sequence of Part
        At least two, of different recordings.
    filters : list of str
    anchor : int
    seed : int
    """
    signs = mirror_signs(filters)
    foretold = []
    for i, part in enumerate(parts):
        others = _doubt(parts[:i] + parts[i + 1 :], filters, anchor, seed)  # type: ignore[operator]
        both = others.predict(part.features) + others.predict(part.features * signs)
        foretold.append(np.exp(np.clip(0.5 * both, LEAST_DOUBT, MOST_DOUBT)))
    error, beta = (np.concatenate([getattr(part, name) for part in parts]) for name in ("error", "beta"))
    return _doubt(parts, filters, anchor, seed), fit_trust(error, np.concatenate(foretold), beta)


def _doubt(parts: Sequence[Part], filters: list[str], anchor: int, seed: int) -> Network:
    features, errors, _, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    step = thinning(len(errors), MOST_WINDOWS)
    size = np.log(np.maximum(np.abs(errors[::step]), LEAST_ERROR))
    seen = with_mirrored(features[::step], mirror_signs(filters))
    return fit_network(seen, np.tile(size, 2), np.tile(weights[::step], 2), filters, anchor, DOUBT, seed)

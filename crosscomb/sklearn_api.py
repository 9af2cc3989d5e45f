"""Selector and estimator as scikit-learn estimators, for notebooks, pipelines and cross-validation.

Imported only on demand: everything else works without loading scikit-learn.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, ClassifierMixin, RegressorMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from crosscomb.errors import UsageError
from crosscomb.filters.catalogue import DEFAULT_FILTERS
from crosscomb.logs.intake import require_plausible
from crosscomb.logs.plausibility import check_units
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import Artefact
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import Signals, make_signals
from crosscomb.training.metrics import countable, score
from crosscomb.training.recordings import Recording, require_enough
from crosscomb.training.selectors.bank import run_bank
from crosscomb.training.selectors.fit import SELECTORS
from crosscomb.training.selectors.fit_tree import TreeShape, fit_tree, to_tree
from crosscomb.training.selectors.labels import Windows
from crosscomb.training.selectors.train import RATE, default_filters, make_fitter, require_filters

Log = Signals | pd.DataFrame


class SelectorClassifier(ClassifierMixin, BaseEstimator):
    """Decision tree that tells from a window which filter is the best there, evaluated as at run time.

    Parameters
    ----------
    depth : int
        Largest depth.
    leaf : float
        Least share of the weight in a leaf.
    pruning : float
        Cost-complexity pruning.
    random_state : int
        Breaks ties between splits.

    Attributes
    ----------
    tree_ : crosscomb.selection.tree.Tree
        The tree as it stands in an artefact.
    classes_ : (classes,)
    n_features_in_ : int
    """

    def __init__(self, depth: int = 4, leaf: float = 0.01, pruning: float = 1e-4, random_state: int = 0):
        self.depth = depth
        self.leaf = leaf
        self.pruning = pruning
        self.random_state = random_state

    def fit(self, X: Any, y: Any, errors: pd.DataFrame | None = None) -> SelectorClassifier:
        """Grow the tree (Atheupe 2023, eq. 34 to 36).

        Parameters
        ----------
        X : (windows, features)
            Raw windows of ay and yaw rate ``(windows, 20)``, their statistics, or anything else; see `window_data`.
        y : (windows,)
            The best filter of each window (eq. 33).
        errors : DataFrame (windows, filters), optional
            RMSE of each filter in each window, columns named as the classes. With it a window speaks for each filter
            with what that filter saves over the worst one: a tie weighs nothing.
        """
        X, y = validate_data(self, X, y, dtype=np.float32)
        check_classification_targets(y)
        self.classes_, label = np.unique(y, return_inverse=True)
        classes = len(self.classes_)
        rmse = 1.0 - np.eye(classes)[label] if errors is None else self._errors(errors, len(X))
        nothing = np.empty((len(X), 0))
        windows = Windows(X, rmse, nothing, nothing, np.empty(len(X)))
        shape = TreeShape(self.depth, self.leaf, self.pruning)
        by_regret = errors is not None and classes > 1
        self.tree_ = to_tree(fit_tree(X, windows, by_regret, shape, self.random_state), X, classes)
        return self

    def _errors(self, errors: pd.DataFrame, rows: int) -> np.ndarray:
        if not set(self.classes_) <= set(errors.columns) or len(errors) != rows:
            raise ValueError(
                f"errors must have {rows} rows and a column for each of the classes {list(self.classes_)}"
            )
        return errors[list(self.classes_)].to_numpy(dtype=np.float64)

    def _features(self, X: Any) -> np.ndarray:
        check_is_fitted(self)
        return validate_data(self, X, dtype=np.float32, reset=False)

    def predict(self, X: Any) -> np.ndarray:
        """Filter ``(windows,)`` to take in each window."""
        features = self._features(X)
        return self.classes_[self.tree_.predict(features)]

    def predict_proba(self, X: Any) -> np.ndarray:
        """Share of each class ``(windows, classes)`` in the leaf of each window."""
        features = self._features(X)
        return np.array(self.tree_.shares)[self.tree_.leaves(features)]


class SideslipRegressor(RegressorMixin, BaseEstimator):
    """Sideslip angle of whole logs: filters, selector and switch in one estimator.

    X is a list of logs (DataFrames with the columns of `crosscomb.signals.UNITS`, or Signals), as each log is one
    sample: cross-validation then leaves whole recordings out.

    Parameters
    ----------
    vehicle : str, Path or Vehicle
        Name of a shipped vehicle, a vehicle file, or a vehicle.
    selector : str
        One of those of `crosscomb train --selector`.
    filters : sequence of str
        Names of the estimators to select from.
    rate : float
        Working rate [Hz].
    random_state : int
        The same one gives the same artefact bit for bit.

    Attributes
    ----------
    artefact_ : crosscomb.selection.artefact.Artefact
        For `crosscomb.selection.artefact.save_artefact`, `estimate_log` and the streaming estimator.
    """

    def __init__(
        self,
        vehicle: str | Path | Vehicle = "generic_compact",
        selector: str = "tree",
        filters: Sequence[str] = DEFAULT_FILTERS,
        rate: float = RATE,
        random_state: int = 0,
    ):
        self.vehicle = vehicle
        self.selector = selector
        self.filters = filters
        self.rate = rate
        self.random_state = random_state

    def __sklearn_tags__(self) -> Any:
        """Say that X is no matrix."""
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.target_tags.required = False
        tags.no_validation = True
        return tags

    def fit(self, X: Sequence[Log], y: Sequence[np.ndarray] | None = None) -> SideslipRegressor:
        """Train the selector.

        Parameters
        ----------
        X : list of logs
            At least seven.
        y : list of (n,) [rad], optional
            True beta at each row of each log; else the logs' own beta_ref, or vx_ref and vy_ref.

        Raises
        ------
        UsageError
            Too few logs, one without ground truth, or nothing to select.
        """
        if self.selector not in SELECTORS:
            raise UsageError(f"selector {self.selector!r}: unknown: take one of {', '.join(SELECTORS)}")
        require_filters(list(self.filters))
        car = self._car()
        recordings = as_recordings(X, car, y)
        require_enough(recordings, Path("X"))
        entries = default_filters(car, self.filters)
        with tempfile.TemporaryDirectory() as folder:
            fitter = make_fitter(
                recordings, self.selector, entries, Path(folder), self.random_state, self.rate
            )
            self.artefact_: Artefact = fitter.fit(range(len(recordings)))[0]
        return self

    def predict(self, X: Sequence[Log]) -> list[np.ndarray]:
        """Estimate beta ``(n,) [rad]`` at each row of each log."""
        check_is_fitted(self)
        car = self._car()
        return [
            estimate_log(signals, car, self.artefact_).beta
            for signals in (_as_signals(log, f"log {i}", car) for i, log in enumerate(X))
        ]

    def score(self, X: Sequence[Log], y: Sequence[np.ndarray] | None = None) -> float:  # type: ignore[override]
        """Mean RMSE over the logs [rad] where the car is fast enough to be judged, negative: more is better."""
        recordings = as_recordings(X, self._car(), y)
        errors = []
        for recording, beta in zip(recordings, self.predict(X), strict=True):
            truth = recording.signals.beta_ref
            errors.append(score(beta, truth, countable(truth, recording.signals.column("vx"))).rmse)
        return -float(np.mean(errors))

    def _car(self) -> Vehicle:
        return self.vehicle if isinstance(self.vehicle, Vehicle) else load_vehicle(self.vehicle)


class WindowData(NamedTuple):
    """Labelled windows of some logs.

    Attributes
    ----------
    X : (windows, features) float32
    y : (windows,) str
        Name of the best filter.
    errors : DataFrame (windows, filters) [rad]
        RMSE of each filter.
    groups : (windows,) int
        Log of each window: for grouped folds. Windows of one log are near copies.
    """

    X: np.ndarray
    y: np.ndarray
    errors: pd.DataFrame
    groups: np.ndarray


def window_data(
    logs: Sequence[Log],
    vehicle: str | Path | Vehicle = "generic_compact",
    settings: WindowSettings | None = None,
    filters: Sequence[str] = DEFAULT_FILTERS,
    rate: float = RATE,
) -> WindowData:
    """Cut and label the windows of logs with ground truth, for `SelectorClassifier`.

    Parameters
    ----------
    logs : list of logs
        DataFrames or Signals.
    vehicle : str, Path or Vehicle
    settings : WindowSettings, optional
        Raw samples or statistics; statistics by default.
    filters : sequence of str
    rate : float
        Working rate [Hz].
    """
    car = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    settings = settings or WindowSettings()
    banks = run_bank(as_recordings(logs, car), default_filters(car, filters), rate, settings)
    parts = [bank.windows(settings) for bank in banks]
    errors = pd.DataFrame(np.concatenate([part.rmse for part in parts]), columns=list(filters))
    y = np.array(list(filters))[np.concatenate([part.label for part in parts])]
    groups = np.repeat(np.arange(len(parts)), [len(part.rmse) for part in parts])
    return WindowData(np.concatenate([part.features for part in parts]), y, errors, groups)


def as_recordings(
    logs: Sequence[Log], car: Vehicle, truth: Sequence[np.ndarray] | None = None
) -> list[Recording]:
    """Take logs in memory as recordings with ground truth.

    Raises
    ------
    UsageError
        A log is broken or has no ground truth above `crosscomb.signals.MIN_SPEED`.
    """
    if truth is not None and len(truth) != len(logs):
        raise UsageError(f"y: has {len(truth)} entries for {len(logs)} logs: give beta of each log")
    recordings = []
    for i, log in enumerate(logs):
        signals = _as_signals(log, f"log {i}", car)
        if truth is not None:
            beta = np.asarray(truth[i], dtype=np.float64)
            if beta.shape != (len(signals),):
                raise UsageError(f"y: entry {i} has shape {beta.shape}, its log {len(signals)} rows")
            signals = signals.with_columns(beta_ref=beta)
        signals = complete(signals, car)
        if not signals.has_reference:
            raise UsageError(f"log {i}: no ground truth above walking speed: add beta_ref, or pass it as y")
        recordings.append(Recording(f"log {i}", Path(f"log {i}"), car, signals))
    return recordings


def _as_signals(log: Log, name: str, car: Vehicle) -> Signals:
    if isinstance(log, pd.DataFrame):
        log = make_signals(log, name)
    if not isinstance(log, Signals):
        raise UsageError(f"{name}: is a {type(log).__name__}: pass each log as a DataFrame or Signals")
    require_plausible(log.source, check_units(log, car))
    return log

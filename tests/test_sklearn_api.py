"""The scikit-learn classes keep scikit-learn's rules and give what the commands give."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone, is_classifier, is_regressor
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, GroupKFold, ShuffleSplit, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import (
    check_estimator,
    check_estimator_cloneable,
    check_estimator_repr,
    check_get_params_invariance,
    check_no_attributes_set_in_init,
    check_parameters_default_constructible,
    check_set_params,
)

from crosscomb.errors import UsageError
from crosscomb.filters.catalogue import DEFAULT_FILTERS
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import Signals
from crosscomb.sklearn_api import SelectorClassifier, SideslipRegressor, WindowData, window_data


@pytest.fixture(scope="module")
def windows(simulated: list[Signals], car: Vehicle) -> WindowData:
    return window_data([log.frame for log in simulated], car)


@pytest.fixture(scope="module")
def regressor(simulated: list[Signals], car: Vehicle) -> SideslipRegressor:
    return SideslipRegressor(car).fit(simulated)


# The classifier


def test_the_classifier_passes_every_check_of_scikit_learn():
    check_estimator(SelectorClassifier())


def test_windows_are_labelled_with_the_filter_of_least_error(windows):
    assert set(windows.y) <= set(DEFAULT_FILTERS)
    best = windows.errors.to_numpy().min(axis=1)
    labelled = windows.errors.to_numpy()[
        np.arange(len(best)), [list(windows.errors).index(name) for name in windows.y]
    ]
    np.testing.assert_array_equal(labelled, best)
    assert len(windows.X) == len(windows.y) == len(windows.groups)
    assert set(windows.groups) == set(range(10))


def test_raw_windows_have_the_papers_twenty_features(simulated, car):
    raw = window_data(simulated[:2], car, WindowSettings(features="raw"))
    assert raw.X.shape[1] == 20
    assert np.mean(SelectorClassifier(depth=8).fit(raw.X, raw.y).predict(raw.X) == raw.y) > 0.5


def test_it_beats_the_commonest_class(windows):
    model = SelectorClassifier(depth=6).fit(windows.X, windows.y)
    assert model.score(windows.X, windows.y) > pd.Series(windows.y).value_counts(normalize=True).max()
    places = [list(windows.errors).index(name) for name in model.predict(windows.X)]
    switched = windows.errors.to_numpy()[np.arange(len(places)), places]
    assert switched.mean() < windows.errors.mean().min()


def test_with_errors_a_large_loss_outweighs_many_small_ones():
    """`often` is a little better in three of four windows, `sound` much better in the fourth."""
    rare = np.arange(400) % 4 == 0
    errors = pd.DataFrame({"often": np.where(rare, 0.5, 0.010), "sound": np.where(rare, 0.1, 0.013)})
    y, X = np.where(rare, "sound", "often"), np.zeros((400, 1))
    assert set(SelectorClassifier().fit(X, y).predict(X)) == {"often"}
    assert set(SelectorClassifier().fit(X, y, errors=errors[["sound", "often"]]).predict(X)) == {"sound"}


def test_the_tree_is_the_one_of_the_artefact(windows):
    """Inference is that of the run time, on the arrays of a `Tree`."""
    model = SelectorClassifier().fit(windows.X, windows.y)
    assert len(model.tree_.lowest) == model.n_features_in_ == windows.X.shape[1]
    shares = model.predict_proba(windows.X)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    np.testing.assert_array_equal(model.classes_[shares.argmax(axis=1)], model.predict(windows.X))


def test_it_works_in_pipelines_and_grid_searches_with_grouped_folds(windows):
    search = GridSearchCV(
        make_pipeline(StandardScaler(), SelectorClassifier()),
        {"selectorclassifier__depth": [1, 4]},
        cv=GroupKFold(3),
    )
    search.fit(windows.X, windows.y, groups=windows.groups)
    assert search.best_params_["selectorclassifier__depth"] in (1, 4)


def test_errors_must_fit_the_windows(windows):
    for wrong in (windows.errors.iloc[:5], windows.errors.drop(columns=windows.y[0])):
        with pytest.raises(ValueError, match="a column for each of the classes"):
            SelectorClassifier().fit(windows.X, windows.y, errors=wrong)


# The regressor: X is a list of logs, so the checks of scikit-learn that pass a matrix cannot apply


@pytest.mark.parametrize(
    "check",
    [
        check_estimator_cloneable,
        check_estimator_repr,
        check_get_params_invariance,
        check_no_attributes_set_in_init,
        check_parameters_default_constructible,
        check_set_params,
    ],
    ids=lambda check: check.__name__,
)
def test_the_regressor_passes_the_checks_that_need_no_matrix(check):
    check("SideslipRegressor", SideslipRegressor())


def test_it_is_cloned_unfitted_and_says_so(regressor, simulated):
    copy = clone(regressor)
    assert copy.get_params() == regressor.get_params()
    with pytest.raises(NotFittedError):
        copy.predict(simulated)
    assert is_regressor(copy)
    assert is_classifier(SelectorClassifier())


def test_it_gives_what_estimate_gives(regressor, simulated, car):
    betas = regressor.predict([log.frame for log in simulated[:3]])
    for beta, log in zip(betas, simulated, strict=False):
        np.testing.assert_array_equal(beta, estimate_log(log, car, regressor.artefact_).beta)


def test_its_score_is_the_negative_rmse(regressor, simulated):
    errors = []
    for beta, log in zip(regressor.predict(simulated), simulated, strict=True):
        counted = np.isfinite(log.beta_ref) & (log.column("vx") > 3.0)
        errors.append(np.sqrt(np.mean((beta - log.beta_ref)[counted] ** 2)))
    assert regressor.score(simulated) == pytest.approx(-np.mean(errors))


def test_truth_may_come_as_y(regressor, simulated, car):
    truth = [log.beta_ref for log in simulated]
    blind = [log.frame.drop(columns=["vx_ref", "vy_ref", "beta_ref"], errors="ignore") for log in simulated]
    again = SideslipRegressor(car).fit(blind, truth)
    assert again.artefact_ == regressor.artefact_
    assert again.score(blind, truth) == regressor.score(simulated)


def test_logs_are_neither_changed_nor_needed_in_order(regressor, simulated):
    before = [log.frame.copy() for log in simulated]
    backwards = regressor.predict(simulated[::-1])[::-1]
    for one, other in zip(backwards, regressor.predict(simulated), strict=True):
        np.testing.assert_array_equal(one, other)
    for frame, log in zip(before, simulated, strict=True):
        pd.testing.assert_frame_equal(frame, log.frame)


def test_cross_validation_leaves_whole_logs_out(simulated, car):
    split = ShuffleSplit(n_splits=1, test_size=2, random_state=0)
    (score,) = cross_val_score(SideslipRegressor(car), [log.frame for log in simulated], cv=split)
    assert -np.radians(30.0) < score < 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda logs: logs[:3], ("X", "3 recordings", "at least 7")),
        (
            lambda logs: [logs[0].drop(columns=["beta_ref", "vx_ref", "vy_ref"]), *logs[1:]],
            ("log 0", "no ground truth"),
        ),
        (lambda logs: [*logs[:-1], logs[0].to_numpy()], ("log 9", "ndarray", "DataFrame")),
        (lambda logs: [logs[0].drop(columns="ay"), *logs[1:]], ("log 0", "column ay")),
    ],
)
def test_wrong_logs_are_refused_in_one_line(simulated, car, change, words):
    with pytest.raises(UsageError) as error:
        SideslipRegressor(car).fit(change([log.frame for log in simulated]))
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "wrong", [{"selector": "magic"}, {"filters": ["kinematic_kf"]}, {"filters": ["a", "b"]}]
)
def test_wrong_settings_are_refused(simulated, car, wrong):
    with pytest.raises(UsageError):
        SideslipRegressor(car, **wrong).fit(simulated)


def test_y_must_fit_the_logs(simulated, car):
    truth = [log.beta_ref for log in simulated]
    for wrong in (truth[:-1], [truth[0][:-1], *truth[1:]]):
        with pytest.raises(UsageError, match=r"^y: "):
            SideslipRegressor(car).fit(simulated, wrong)


def test_estimating_does_not_load_scikit_learn():
    code = "import sys, crosscomb.run.stream, crosscomb.run.estimate; sys.exit('sklearn' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0

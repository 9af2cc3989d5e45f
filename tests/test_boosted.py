"""Boosted trees and the choice by them: scikit-learn's sums without scikit-learn."""

import numpy as np
import pytest
from pydantic import ValidationError

from crosscomb.selection.boosted import Boosted
from crosscomb.selection.choice import LEAD, Choice, blend
from crosscomb.training.selectors.fit_boosted import fit_trees, to_boosted

SOUND = {
    "baseline": [0.5],
    "roots": [0, 3],
    "feature": [0, -1, -1, 1, -1, -1],
    "threshold": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
    "left": [1, -1, -1, 4, -1, -1],
    "right": [2, -1, -1, 5, -1, -1],
    "value": [0.0, 1.0, 2.0, 0.0, 10.0, 20.0],
}
BROKEN = {
    "cycle": {"left": [0, -1, -1, 4, -1, -1]},
    "child out of range": {"right": [2, -1, -1, 6, -1, -1]},
    "huge child": {"right": [10**30, -1, -1, 5, -1, -1]},
    "leaf with a child": {"left": [1, 2, -1, 4, -1, -1]},
    "root that is not there": {"roots": [0, 6]},
    "uneven arrays": {"value": [0.0]},
    "NaN value": {"value": [0.0, float("nan"), 2.0, 0.0, 10.0, 20.0]},
    "no output": {"baseline": []},
    "unknown feature": {"feature": [-2, -1, -1, 1, -1, -1]},
}


@pytest.fixture(scope="module")
def table() -> tuple[np.ndarray, np.ndarray]:
    """Features ``(4000, 6)`` and a target with a kink, a step and noise."""
    rng = np.random.default_rng(0)
    features = rng.standard_normal((4000, 6)).astype(np.float32)
    target = abs(features[:, 0]) + (features[:, 3] > 0.5) + 0.1 * rng.standard_normal(4000)
    return features, target


def test_sums_by_hand():
    rows = np.array([[0.0, 1.0], [0.1, 1.0], [0.0, 1.1]])
    assert Boosted(**SOUND).predict(rows)[:, 0].tolist() == [11.5, 12.5, 21.5]
    two = Boosted(**{**SOUND, "baseline": [0.5, -0.5]})
    assert two.predict(rows).tolist() == [[1.5, 9.5], [2.5, 9.5], [1.5, 19.5]]


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_trees_are_refused(fault):
    with pytest.raises(ValidationError):
        Boosted(**{**SOUND, **BROKEN[fault]})


def test_predictions_equal_those_of_the_library(table):
    features, target = table
    models = fit_trees(features, [target, -target, 0.0 * target], 0, 30)
    rng = np.random.default_rng(1)
    wild = (rng.standard_normal((3000, 6)) * 10.0 ** rng.integers(-30, 30, (3000, 1))).astype(np.float32)
    for rows in (features, wild):
        ours = to_boosted(models).predict(rows)
        for i, model in enumerate(models):
            np.testing.assert_allclose(ours[:, i], model.predict(rows), rtol=1e-12, atol=1e-12)


def test_trees_learn_the_target(table):
    features, target = table
    fitted = to_boosted(fit_trees(features[:3000], [target[:3000]], 0, 150))
    error = fitted.predict(features[3000:])[:, 0] - target[3000:]
    assert np.sqrt(np.mean(error**2)) < 0.2 < 0.5 * target.std()


def test_a_blend_is_the_mean_under_the_probabilities():
    rng = np.random.default_rng(2)
    shares = rng.dirichlet(np.ones(3), 500)
    beta, beta_std = rng.standard_normal((500, 3)), 0.1 + rng.random((500, 3))
    mean, std, active = blend(shares, np.full(3, -1.0), np.zeros(2, dtype=np.int64), beta, beta_std, 1.0, 0)
    np.testing.assert_allclose(mean, (shares * beta).sum(axis=1))
    second = (shares * (beta_std**2 + beta**2)).sum(axis=1)
    np.testing.assert_allclose(std**2, second - mean**2)
    largest = shares.max(axis=1)
    assert np.all(shares[np.arange(500), active] >= largest - LEAD)
    clear = largest - np.partition(shares, -2, axis=1)[:, -2] > LEAD
    np.testing.assert_array_equal(active[clear], np.argmax(shares, axis=1)[clear])


def test_a_lost_filter_has_no_part_in_a_blend():
    beta = np.array([[1.0, np.nan, 3.0]])
    mean, std, active = blend(
        np.array([[0.2, 0.6, 0.2]]),
        np.full(3, -1.0),
        np.zeros(2, dtype=np.int64),
        beta,
        np.full((1, 3), 0.1),
        1.0,
        0,
    )
    assert mean[0] == pytest.approx(2.0)
    assert np.isfinite(std[0])
    assert active[0] in (0, 2)


def test_a_low_temperature_takes_the_likeliest():
    trees = Boosted(baseline=[0.0, 1.0, 0.5], roots=[], feature=[], threshold=[], left=[], right=[], value=[])
    rows = np.zeros((2, 1))
    cold, warm = Choice(trees=trees, temperature=0.01), Choice(trees=trees, temperature=100.0)
    np.testing.assert_allclose(cold.probabilities(rows), [[0.0, 1.0, 0.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(warm.probabilities(rows), 1.0 / 3.0, atol=0.01)


def test_noise_makes_no_leader_flicker():
    """Two filters that lead in turn: the name changes at most once in `hold` samples."""
    shares = np.tile([[0.6, 0.4], [0.4, 0.6]], (500, 1))
    beta, leading = np.zeros((1000, 2)), np.zeros(2, dtype=np.int64)
    _, _, active = blend(shares, np.full(2, -1.0), leading, beta, np.full((1000, 2), 0.1), 1.0, 50)
    assert np.all(np.diff(np.flatnonzero(np.diff(active))) >= 50)

"""Boosted trees, choice and correction: scikit-learn's sums without scikit-learn, and manners outside the training."""

import numpy as np
import pytest
from pydantic import ValidationError

from crosscomb.boosted import Boosted
from crosscomb.choice import Choice, blend
from crosscomb.correction import FADE, Correction, correct, inside_weight, make_correction_state
from crosscomb.training.fit_boosted import conformal_scale, fit_doubt, fit_trees, to_boosted

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


def test_predictions_equal_scikit_learn(table):
    features, target = table
    models = [fit_trees(features, sign * target, 30, 0) for sign in (1.0, -1.0)]
    rng = np.random.default_rng(1)
    wild = (rng.standard_normal((3000, 6)) * 10.0 ** rng.integers(-30, 30, (3000, 1))).astype(np.float32)
    for rows in (features, wild):
        ours = to_boosted(models).predict(rows)
        for i, model in enumerate(models):
            np.testing.assert_allclose(ours[:, i], model.predict(rows), rtol=1e-12, atol=1e-12)


def test_trees_learn_the_target(table):
    features, target = table
    fitted = to_boosted([fit_trees(features[:3000], target[:3000], 80, 0)])
    error = fitted.predict(features[3000:])[:, 0] - target[3000:]
    assert np.sqrt(np.mean(error**2)) < 0.2 < 0.5 * target.std()


def test_a_blend_is_the_mean_under_the_probabilities():
    rng = np.random.default_rng(2)
    shares = rng.dirichlet(np.ones(3), 500)
    beta, beta_std = rng.standard_normal((500, 3)), 0.1 + rng.random((500, 3))
    mean, std, active = blend(shares, np.full(3, -1.0), beta, beta_std, 1.0)
    np.testing.assert_allclose(mean, (shares * beta).sum(axis=1))
    second = (shares * (beta_std**2 + beta**2)).sum(axis=1)
    np.testing.assert_allclose(std**2, second - mean**2)
    np.testing.assert_array_equal(active, np.argmax(shares, axis=1))


def test_a_lost_filter_has_no_part_in_a_blend():
    beta = np.array([[1.0, np.nan, 3.0]])
    mean, std, active = blend(np.array([[0.2, 0.6, 0.2]]), np.full(3, -1.0), beta, np.full((1, 3), 0.1), 1.0)
    assert mean[0] == pytest.approx(2.0)
    assert np.isfinite(std[0])
    assert active[0] in (0, 2)


def test_a_low_temperature_takes_the_likeliest():
    trees = Boosted(baseline=[0.0, 1.0, 0.5], roots=[], feature=[], threshold=[], left=[], right=[], value=[])
    rows = np.zeros((2, 1))
    cold, warm = Choice(trees=trees, temperature=0.01), Choice(trees=trees, temperature=100.0)
    np.testing.assert_allclose(cold.probabilities(rows), [[0.0, 1.0, 0.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(warm.probabilities(rows), 1.0 / 3.0, atol=0.01)


# The correction


@pytest.fixture(scope="module")
def correction() -> Correction:
    """Learned on two features, the first one odd: the truth is 0.05 tanh(x0) where x1 > 0, else 0."""
    rng = np.random.default_rng(3)
    features = rng.uniform(-2.0, 2.0, (4000, 2)).astype(np.float32)
    target = 0.05 * np.tanh(features[:, 0]) * (features[:, 1] > 0.0)
    flat = Boosted(baseline=[np.log(0.01)], roots=[], feature=[], threshold=[], left=[], right=[], value=[])
    return Correction(
        anchor="dynamic_ekf",
        trees=to_boosted([fit_trees(features, target, 60, 0)]),
        doubt=flat,
        bound=0.03,
        lag=0.0,
        odd=[True, False],
        lowest=[-2.0, -2.0],
        highest=[2.0, 2.0],
    )


def corrected(correction: Correction, features: np.ndarray, switched: float = 0.5) -> np.ndarray:
    """Answers to one drive whose corrected filter says 0.1 rad and whose switch says something else."""
    n = len(features)
    state = make_correction_state(features.shape[1])
    anchor, answer = np.full(n, 0.1), np.full(n, switched)
    return correct(correction, state, features, anchor, answer, np.full(n, 0.2), 0.01)[0]


def test_inside_the_training_the_filter_is_corrected(correction):
    rows = np.array([[0.4, 1.0], [-0.4, 1.0], [0.4, -1.0]], dtype=np.float32)
    expected = 0.1 + 0.05 * np.tanh([0.4, -0.4, 0.0])
    np.testing.assert_allclose(corrected(correction, rows), expected, atol=0.004)


def test_a_mirrored_drive_gets_the_mirrored_answer(correction):
    rng = np.random.default_rng(4)
    rows = rng.uniform(-2.0, 2.0, (300, 2)).astype(np.float32)
    mirrored = rows * np.float32([-1.0, 1.0])
    np.testing.assert_allclose(
        corrected(correction, rows) - 0.1, -(corrected(correction, mirrored) - 0.1), atol=1e-15
    )


def test_the_correction_is_bounded(correction):
    rows = np.array([[2.0, 2.0], [-2.0, 2.0]], dtype=np.float32)
    np.testing.assert_allclose(corrected(correction, rows) - 0.1, [0.03, -0.03], atol=1e-12)


def test_outside_the_training_the_answer_fades_to_the_switch(correction):
    steps = np.linspace(2.0, 2.0 + 6.0 * FADE, 60, dtype=np.float32)
    rows = np.stack([np.ones(60, dtype=np.float32), steps], axis=1)
    answer = corrected(correction, rows)
    assert answer[0] == pytest.approx(0.13, abs=0.01)
    assert (np.diff(answer) >= -1e-12).all()  # no jump on the way
    assert np.diff(answer).max() < 0.02
    assert answer[-1] == 0.5
    far = np.array([[1e6, -1e6]], dtype=np.float32)
    assert corrected(correction, far).tolist() == [0.5]
    assert inside_weight(far[0], np.full(2, -2.0), np.full(2, 2.0), np.full(2, 1.0)) == 0.0


def test_pieces_make_the_same_answers(correction):
    smooth = correction.model_copy(update={"lag": 0.2})
    rng = np.random.default_rng(5)
    rows = rng.uniform(-3.0, 3.0, (200, 2)).astype(np.float32)
    whole, state, parts = corrected(smooth, rows), make_correction_state(2), []
    for start in range(0, 200, 7):
        cut = rows[start : start + 7]
        n = len(cut)
        parts.append(correct(smooth, state, cut, np.full(n, 0.1), np.full(n, 0.5), np.full(n, 0.2), 0.01)[0])
    np.testing.assert_array_equal(whole, np.concatenate(parts))


# Trust


def test_the_conformal_scale_covers_new_samples():
    rng = np.random.default_rng(6)
    beta_std = rng.uniform(0.5, 2.0, 40_000)
    error = 3.0 * beta_std * rng.standard_t(4, 40_000)
    scale = conformal_scale(error[:20_000], beta_std[:20_000])
    covered = np.mean(np.abs(error[20_000:]) <= 1.96 * scale * beta_std[20_000:])
    assert covered == pytest.approx(0.95, abs=0.01)


def test_the_doubt_follows_the_errors():
    rng = np.random.default_rng(7)
    features = rng.uniform(-1.0, 1.0, (8000, 2)).astype(np.float32)
    size = np.where(features[:, 1] > 0.0, 0.05, 0.005)
    error = size * rng.standard_normal(8000)
    parts = [(features[i : i + 2000], error[i : i + 2000]) for i in (0, 2000, 4000)]
    doubt = fit_doubt(parts, np.float32([-1.0, 1.0]), 0)
    foretold = np.exp(doubt.predict(features[6000:])[:, 0])
    wide = features[6000:, 1] > 0.0
    assert 5.0 < np.median(foretold[wide]) / np.median(foretold[~wide]) < 20.0
    for part in (wide, ~wide):
        covered = np.mean(np.abs(error[6000:][part]) <= 1.96 * foretold[part])
        assert 0.91 < covered < 0.98

"""Networks and the correction: scikit-learn's answers without scikit-learn, and manners outside the training."""

import numpy as np
import pytest
from pydantic import ValidationError
from sklearn.neural_network import MLPRegressor

from crosscomb.selection.correction import FADE, Correction, correct, inside_weight, make_correction_state
from crosscomb.selection.features import MEMORIES, layout
from crosscomb.selection.network import FAR, Network
from crosscomb.selection.trust import Trust
from crosscomb.training.selectors.fit_boosted import fit_trees, to_boosted
from crosscomb.training.selectors.fit_correction import (
    Part,
    Size,
    constant_doubt,
    fit_doubt,
    fit_network,
    to_member,
)
from crosscomb.training.selectors.fit_trust import conformal_scale

FILTERS = ["kinematic_kf", "dynamic_ekf"]
PLACES = layout(FILTERS)
WIDTH = len(PLACES.names)
SIGNS = np.where(PLACES.odd, -1.0, 1.0).astype(np.float32)


def network_of(fitted: MLPRegressor, inputs: int, **changes: object) -> Network:
    """A network that hands its inputs on as they are."""
    plain = {
        "columns": list(range(inputs)),
        "relative": [-1] * inputs,
        "mean": [0.0] * inputs,
        "scale": [1.0] * inputs,
    }
    return Network(**{**plain, "unit": 1.0, "members": [to_member(fitted)], **changes})


@pytest.fixture(scope="module")
def fitted() -> MLPRegressor:
    """A small network of two inputs that knows x0 |x1|."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(-2.0, 2.0, (2000, 2)).astype(np.float32)
    model = MLPRegressor(hidden_layer_sizes=(16, 8), max_iter=60, random_state=0, tol=0.0)
    return model.fit(rows, (rows[:, 0] * abs(rows[:, 1])).astype(np.float32))


# The network


@pytest.mark.filterwarnings("ignore")
def test_predictions_equal_scikit_learn(fitted):
    rows = np.random.default_rng(1).uniform(-4.0, 4.0, (3000, 2)).astype(np.float32)
    np.testing.assert_allclose(
        network_of(fitted, 2).predict(rows), fitted.predict(rows), rtol=1e-4, atol=1e-4
    )


def test_inputs_are_shifted_scaled_and_held_near(fitted):
    plain, rows = network_of(fitted, 2), np.array([[1.0, -2.0], [0.5, 3.0]], dtype=np.float32)
    moved = network_of(
        fitted, 2, columns=[3, 1], relative=[0, -1], mean=[1.0, -1.0], scale=[2.0, 0.5], unit=3.0
    )
    wide = np.zeros((2, 4), dtype=np.float32)
    wide[:, 0] = 7.0
    wide[:, 3] = 7.0 + 1.0 + 2.0 * rows[:, 0]
    wide[:, 1] = -1.0 + 0.5 * rows[:, 1]
    np.testing.assert_allclose(moved.predict(wide), 3.0 * plain.predict(rows), rtol=1e-5)
    far = np.array([[1e20, -1e20]], dtype=np.float32)
    assert plain.predict(far) == plain.predict(np.array([[FAR, -FAR]], dtype=np.float32))


def test_members_answer_in_the_mean(fitted):
    rows = np.array([[1.0, -2.0]], dtype=np.float32)
    other = to_member(fitted).model_copy(update={"output_bias": 100.0 + to_member(fitted).output_bias})
    two = network_of(fitted, 2, members=[to_member(fitted), other])
    assert two.predict(rows) == pytest.approx(network_of(fitted, 2).predict(rows) + 50.0, rel=1e-5)


def test_trees_beside_count_as_much_as_all_members(fitted):
    """They look at the scaled inputs; the library says what they answer."""
    rng = np.random.default_rng(2)
    rows = rng.uniform(-2.0, 2.0, (3000, 2)).astype(np.float32)
    (trees,) = fit_trees(rows, [rows[:, 1] ** 2], 0, 20)
    scaled = {"scale": [2.0, 0.5], "unit": 3.0}
    wide = rows * np.float32([2.0, 0.5])
    plain = network_of(fitted, 2, **scaled).predict(wide)
    both = network_of(fitted, 2, **scaled, trees=to_boosted([trees])).predict(wide)
    np.testing.assert_allclose(both, 0.5 * (plain + 3.0 * trees.predict(rows)), rtol=1e-4, atol=1e-4)


def test_trees_that_do_not_fit_the_inputs_are_refused(fitted):
    rows = np.random.default_rng(2).uniform(-2.0, 2.0, (500, 3)).astype(np.float32)
    (trees,) = fit_trees(rows, [rows.sum(axis=1)], 0, 5)
    for wrong in ([trees], [trees, trees]):
        with pytest.raises(ValidationError):
            network_of(fitted, 2, trees=to_boosted(wrong))


@pytest.mark.parametrize(
    "changes",
    [
        {"scale": [1.0]},
        {"scale": [1.0, 0.0]},
        {"columns": [0, -1]},
        {"relative": [-2, 0]},
        {"columns": [0, 10**30]},
        {"unit": 0.0},
        {"mean": [0.0, float("nan")]},
        {"members": []},
    ],
)
def test_broken_networks_are_refused(fitted, changes):
    with pytest.raises(ValidationError):
        network_of(fitted, 2, **changes)


@pytest.mark.parametrize("layer", ["first", "second", "first_bias", "second_bias", "output"])
def test_layers_that_do_not_fit_are_refused(fitted, layer):
    member = to_member(fitted).model_dump()
    member[layer] = member[layer][:-1]
    with pytest.raises(ValidationError):
        network_of(fitted, 2, members=[member])


# The correction


@pytest.fixture(scope="module")
def correction() -> Correction:
    """Learned on two features, the first one odd: the truth is 0.05 tanh(x0) where x1 > 0, else 0."""
    rng = np.random.default_rng(3)
    features = rng.uniform(-2.0, 2.0, (8000, 2)).astype(np.float32)
    target = 5.0 * np.tanh(features[:, 0]) * (features[:, 1] > 0.0)
    model = MLPRegressor(hidden_layer_sizes=(32, 16), max_iter=60, random_state=0, tol=0.0)
    return Correction(
        anchor="dynamic_ekf",
        network=network_of(model.fit(features, target.astype(np.float32)), 2, unit=0.01),
        doubt=constant_doubt(np.log(0.01)),
        bound=0.03,
        lag=0.0,
        fade=0.0,
        odd=[True, False],
        lowest=[-2.0, -2.0],
        highest=[2.0, 2.0],
    )


def corrected(correction: Correction, features: np.ndarray, switched: float = 0.5) -> np.ndarray:
    """Answers to one drive whose corrected filter says 0.1 rad and whose switch says something else."""
    n = len(features)
    state = make_correction_state(correction)
    beta, answer = np.full((n, 1), 0.1), np.full(n, switched)
    return correct(correction, state, features, 0, beta, answer, np.full(n, 0.2), 0.01)[0]


def test_inside_the_training_the_filter_is_corrected(correction):
    rows = np.array([[0.4, 1.0], [-0.4, 1.0], [0.4, -1.0]], dtype=np.float32)
    expected = 0.1 + 0.05 * np.tanh([0.4, -0.4, 0.0])
    np.testing.assert_allclose(corrected(correction, rows), expected, atol=0.006)


def test_a_share_of_the_switch_stays_and_the_doubt_is_calibrated(correction):
    trust = Trust(disagreement=0.5, floor=0.0, scale=2.0)
    mixed = correction.model_copy(update={"share": 0.75, "trust": trust})
    rows = np.array([[0.4, 1.0], [-0.4, 1.0]], dtype=np.float32)
    beta, switched = np.array([[0.1, 0.16], [0.1, 0.02]]), np.array([0.5, 0.3])
    whole, mix = (
        correct(one, make_correction_state(one), rows, 0, beta, switched, np.full(2, 0.2), 0.01)
        for one in (correction, mixed)
    )
    np.testing.assert_allclose(mix[0], 0.75 * whole[0] + 0.25 * switched)
    np.testing.assert_allclose(whole[1], 0.01)
    np.testing.assert_allclose(mix[1], 2.0 * np.hypot(0.01, 0.5 * np.array([0.06, 0.08])))
    assert mix[2].tolist() == [1.0, 1.0]


def test_a_mirrored_drive_gets_the_mirrored_answer(correction):
    rng = np.random.default_rng(4)
    rows = rng.uniform(-2.0, 2.0, (300, 2)).astype(np.float32)
    mirrored = rows * np.float32([-1.0, 1.0])
    np.testing.assert_allclose(
        corrected(correction, rows) - 0.1, -(corrected(correction, mirrored) - 0.1), atol=1e-9
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
    assert inside_weight(far[0], np.arange(2), np.full(2, -2.0), np.full(2, 2.0), np.full(2, 1.0)) == 0.0


def test_a_correction_does_not_leave_in_a_jump(correction):
    """From one sample to the next the input is far outside; the answer takes its time."""
    slow = correction.model_copy(update={"fade": 0.2})
    rows = np.array([[1.0, 1.0]] * 50 + [[1.0, 1e6]] * 150, dtype=np.float32)
    answer = corrected(slow, rows)
    assert answer[0] == pytest.approx(0.13, abs=0.01)
    assert answer[-1] == pytest.approx(0.5, abs=0.001)
    assert np.abs(np.diff(answer)).max() < 0.06 * (0.5 - 0.13)


def test_pieces_make_the_same_answers(correction):
    smooth = correction.model_copy(update={"lag": 0.2, "fade": 0.3})
    rng = np.random.default_rng(5)
    rows = rng.uniform(-3.0, 3.0, (200, 2)).astype(np.float32)
    whole, state, parts = corrected(smooth, rows), make_correction_state(correction), []
    for start in range(0, 200, 7):
        cut = rows[start : start + 7]
        n = len(cut)
        beta, answer = np.full((n, 1), 0.1), np.full(n, 0.5)
        parts.append(correct(smooth, state, cut, 0, beta, answer, np.full(n, 0.2), 0.01)[0])
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
    features = rng.uniform(-1.0, 1.0, (8000, WIDTH)).astype(np.float32)
    told = PLACES.names.index("vx [m/s]")
    size = np.where(features[:, told] > 0.0, 0.05, 0.005)
    error = size * rng.standard_normal(8000)
    beta, cuts = np.zeros((8000, 2)), [slice(i, i + 2000) for i in (0, 2000, 4000)]
    parts = [Part(features[cut], error[cut], beta[cut], np.ones(2000)) for cut in cuts]
    doubt, trust = fit_doubt(parts, FILTERS, 1, 0)
    foretold = trust.widen(np.exp(doubt.predict(features[6000:])), beta[6000:])
    wide = features[6000:, told] > 0.0
    assert 4.0 < np.median(foretold[wide]) / np.median(foretold[~wide]) < 25.0
    covered = np.mean(np.abs(error[6000:]) <= 1.96 * foretold)
    assert 0.92 < covered < 0.98


# What the networks look at


def test_slips_count_from_the_anchor_at_the_same_memory():
    channels = WIDTH // len(MEMORIES)
    relative = PLACES.relative_to(1)
    for i in np.flatnonzero(relative >= 0):
        assert "beta" in PLACES.names[i] or "slip" in PLACES.names[i]
        assert relative[i] // channels == i // channels
        assert PLACES.names[relative[i]].removeprefix("mean(").startswith("beta dynamic_ekf")
    assert relative[PLACES.names.index("beta dynamic_ekf [rad]")] == -1
    assert np.count_nonzero(relative >= 0) == 2 * len(MEMORIES)


def test_a_fit_finds_what_is_there_and_no_side():
    """The truth is half of what parts the filters; the network sees them only as a difference."""
    rng = np.random.default_rng(8)
    features = rng.normal(0.0, 0.05, (6000, WIDTH)).astype(np.float32)
    kf, ekf = (PLACES.names.index(f"beta {name} [rad]") for name in FILTERS)
    features[:, ekf] += np.float32(10.0)  # a common offset says nothing
    features[:, kf] += np.float32(10.0)
    target = 0.5 * (features[:, kf] - features[:, ekf]) / 0.01
    network = fit_network(features, target, np.ones(6000), FILTERS, 1, Size(1, (16, 8), 3200), 0)
    error = network.predict(features) - target
    assert np.sqrt(np.mean(error**2)) < 0.2 * target.std()

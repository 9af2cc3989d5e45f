"""The tree at run time: scikit-learn's decisions without scikit-learn, on any sample."""

import numpy as np
import pytest
from pydantic import ValidationError
from sklearn.tree import DecisionTreeClassifier

from crosscomb.selection.tree import Tree
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.bank import run_bank
from crosscomb.training.selectors.fit import SELECTORS
from crosscomb.training.selectors.fit_tree import TreeShape, fit_tree, to_tree, without_idle_questions
from crosscomb.training.selectors.labels import TIE, Windows, concatenate
from crosscomb.training.selectors.train import default_filters

CLASSES = 3
DEPTHS = (1, 3, 8)


@pytest.fixture(scope="module", params=["tree", "paper"])
def table(request, recordings: list[Recording]) -> tuple[str, Windows, np.ndarray]:
    """Kind of selector, its training windows, and the features of every sample of all logs."""
    kind = SELECTORS[request.param]
    banks = run_bank(recordings, default_filters(recordings[0].vehicle), 100.0, kind.window)
    windows = concatenate([bank.windows(kind.window) for bank in banks])
    samples = np.concatenate([bank.joined(lambda run: run.windows) for bank in banks])
    assert len(windows.features) > 500
    assert len(samples) > 10_000
    return request.param, windows, samples


@pytest.fixture(scope="module")
def fitted(table) -> list[tuple[DecisionTreeClassifier, Tree]]:
    """Trees of scikit-learn and what was taken over of them."""
    kind = SELECTORS[table[0]]
    shapes = [TreeShape(depth, 0.01) for depth in DEPTHS]
    made = [fit_tree(table[1].features, table[1], kind.by_regret, shape, 0) for shape in shapes]
    free = DecisionTreeClassifier(criterion="entropy", random_state=0).fit(table[1].features, table[1].label)
    assert free.get_depth() > max(DEPTHS)
    return [(tree, to_tree(tree, table[1].features, CLASSES)) for tree in (*made, free)]


def grow(windows: Windows, by_regret: bool, depth: int) -> Tree:
    """A tree of some depth, as crosscomb keeps it."""
    shape = TreeShape(depth, 0.01)
    return to_tree(fit_tree(windows.features, windows, by_regret, shape, 0), windows.features, CLASSES)


def assert_same(one: DecisionTreeClassifier, other: Tree, features: np.ndarray) -> None:
    np.testing.assert_array_equal(one.apply(features), other.leaves(features))
    np.testing.assert_array_equal(one.predict(features), other.predict(features))


def test_predictions_equal_scikit_learn_on_every_sample(table, fitted):
    for one, other in fitted:
        assert_same(one, other, table[2])
        assert len(np.unique(other.leaves(table[2]))) > 1


def test_predictions_equal_scikit_learn_at_the_edges_of_every_threshold(table, fitted):
    """The comparison is of a float32 with a float64: next to a threshold a sloppy one goes the other way."""
    samples = table[2]
    for one, other in fitted:
        visited = one.decision_path(samples).tocsc()
        edges = []
        for node in np.flatnonzero(np.array(other.left) >= 0):
            rows = visited.indices[visited.indptr[node] : visited.indptr[node + 1]][:3]
            near = np.float32(other.threshold[node])
            around = [near, np.nextafter(near, np.float32(np.inf)), np.nextafter(near, np.float32(-np.inf))]
            for value in around:
                changed = samples[rows].copy()
                changed[:, other.feature[node]] = value
                edges.append(changed)
        features = np.concatenate(edges)
        assert len(features) >= 3
        assert_same(one, other, features)


def test_predictions_equal_scikit_learn_far_outside_the_training(table, fitted):
    rng = np.random.default_rng(0)
    wild = (rng.standard_normal((5000, table[2].shape[1])) * 10.0 ** rng.integers(-30, 30, (5000, 1))).astype(
        np.float32
    )
    for one, other in fitted:
        assert_same(one, other, wild)


def test_shares_of_a_leaf_are_those_of_its_windows(table):
    kind, windows, _ = table
    if SELECTORS[kind].by_regret:
        weights = windows.saved
    else:
        weights = np.eye(CLASSES)[windows.label]
    tree = grow(windows, SELECTORS[kind].by_regret, 4)
    leaves = tree.leaves(windows.features)
    for leaf in np.unique(leaves):
        total = weights[leaves == leaf].sum(axis=0)
        np.testing.assert_allclose(tree.shares[leaf], total / total.sum(), atol=1e-9)


@pytest.mark.parametrize("table", ["tree"], indirect=True)
def test_a_leaf_by_regret_picks_the_filter_with_the_least_regret(table):
    _, windows, _ = table
    tree = grow(windows, True, 6)
    leaves, chosen = tree.leaves(windows.features), tree.predict(windows.features)
    assert len(np.unique(leaves)) > 4
    for leaf in np.unique(leaves):
        inside = leaves == leaf
        assert chosen[inside][0] == np.argmin(np.maximum(windows.rmse[inside], TIE).sum(axis=0))


@pytest.mark.parametrize("by_regret", [True, False])
def test_a_filter_that_is_never_best_is_never_chosen(by_regret):
    rng = np.random.default_rng(0)
    features = rng.standard_normal((300, 2)).astype(np.float32)
    rmse = np.where(features[:, :1] > 0.3, [[0.1, 0.9, 0.2]], [[0.3, 0.9, 0.2]])
    windows = Windows(features, rmse, features, rmse, rmse[:, 0])
    fitted = fit_tree(features, windows, by_regret, TreeShape(4, 0.01), 0)
    tree = to_tree(fitted, features, CLASSES)
    assert tree.n_classes == CLASSES
    np.testing.assert_array_equal(tree.predict(features), windows.label)
    assert set(windows.label) == {0, 2}
    assert_same(fitted, tree, features)


def test_training_range_and_what_lies_outside_it(table, fitted):
    _, windows, _ = table
    tree = fitted[0][1]
    assert not tree.outside(windows.features).any()
    np.testing.assert_array_equal(np.float32(tree.lowest), windows.features.min(axis=0))
    inside = np.median(windows.features, axis=0)
    for feature in range(windows.features.shape[1]):
        width = tree.highest[feature] - tree.lowest[feature]
        for value in (tree.highest[feature] + 0.2 * width, tree.lowest[feature] - 0.2 * width):
            row = inside.copy()
            row[feature] = value
            assert tree.outside(row[None, :]).tolist() == [True]
        row[feature] = tree.highest[feature] + 0.05 * width
        assert tree.outside(row[None, :]).tolist() == [False]


SOUND = {
    "feature": [0, 1, -1, -1, -1],
    "threshold": [0.5, -0.5, 0.0, 0.0, 0.0],
    "left": [1, 2, -1, -1, -1],
    "right": [4, 3, -1, -1, -1],
    "shares": [[0.5, 0.5], [0.6, 0.4], [1.0, 0.0], [0.2, 0.8], [0.0, 1.0]],
    "picks": [0, 0, 0, 1, 1],
    "lowest": [-1.0, -1.0],
    "highest": [1.0, 1.0],
}
BROKEN = {
    "cycle": {"left": [1, 0, -1, -1, -1]},
    "own child": {"right": [4, 1, -1, -1, -1]},
    "child out of range": {"right": [5, 3, -1, -1, -1]},
    "one child only": {"left": [1, -1, -1, -1, -1]},
    "negative child": {"left": [1, 2, -1, -1, -2]},
    "huge child": {"left": [10**30, 2, -1, -1, -1]},
    "unknown feature": {"feature": [0, 2, -1, -1, -1]},
    "inner node without feature": {"feature": [-1, 1, -1, -1, -1]},
    "NaN threshold": {"threshold": [float("nan"), -0.5, 0.0, 0.0, 0.0]},
    "infinite threshold": {"threshold": [0.5, float("inf"), 0.0, 0.0, 0.0]},
    "missing threshold": {"threshold": [0.5, -0.5, 0.0, 0.0]},
    "uneven classes": {"shares": [[0.5, 0.5], [0.6, 0.4], [1.0, 0.0], [0.2], [0.0, 1.0]]},
    "NaN share": {"shares": [[0.5, 0.5], [0.6, 0.4], [1.0, 0.0], [0.2, float("nan")], [0.0, 1.0]]},
    "missing pick": {"picks": [0, 0, 0, 1]},
    "unknown pick": {"picks": [0, 0, 2, 1, 1]},
    "negative pick": {"picks": [0, 0, 0, -1, 1]},
    "uneven range": {"highest": [1.0]},
    "no nodes": {key: [] for key in ("feature", "threshold", "left", "right", "shares", "picks")},
    "text for a number": {"feature": ["ay", 1, -1, -1, -1]},
    "unknown key": {"gain": [1.0]},
}


def test_a_sound_tree_decides_by_hand():
    tree = Tree(**SOUND)
    rows = np.array([[0.5, -0.5], [0.5, -0.4], [0.51, -0.5], [-9.0, 0.0]])
    assert tree.leaves(rows).tolist() == [2, 3, 4, 3]
    assert tree.predict(rows).tolist() == [0, 1, 1, 1]


def test_equal_shares_go_to_the_first_filter():
    features = np.zeros((4, 1), dtype=np.float32)
    fitted = DecisionTreeClassifier(criterion="entropy").fit(features, [1, 0, 0, 1])
    tree = to_tree(fitted, features, CLASSES)
    assert tree.shares == [[0.5, 0.5, 0.0]]
    assert tree.predict(features).tolist() == [0, 0, 0, 0]


def test_a_leaf_decides_by_its_pick_not_by_its_shares():
    """Training may keep the safe filter in a leaf where another one's gain is in doubt."""
    rows = np.array([[0.5, -0.5], [0.5, -0.4], [0.51, -0.5]])
    assert Tree(**{**SOUND, "picks": [0, 0, 1, 0, 1]}).predict(rows).tolist() == [1, 0, 1]


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_tree_is_refused(fault):
    with pytest.raises(ValidationError):
        Tree(**{**SOUND, **BROKEN[fault]})


@pytest.mark.parametrize("seed", range(20))
def test_questions_that_change_nothing_are_left_out(seed):
    """Random trees with random picks decide the same with fewer nodes, and no question is left idle."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((400, 3)).astype(np.float32)
    fitted = DecisionTreeClassifier(max_depth=5, random_state=seed).fit(rows, rng.integers(0, 3, 400))
    tree = to_tree(fitted, rows, 3)
    tree = tree.model_copy(update={"picks": rng.integers(0, 2, len(tree.picks)).tolist()})
    fewer = without_idle_questions(tree)
    assert Tree(**fewer.model_dump()) == fewer
    np.testing.assert_array_equal(fewer.predict(rows), tree.predict(rows))
    assert len(fewer.feature) <= len(tree.feature)
    for left, right in zip(fewer.left, fewer.right, strict=True):
        if left >= 0 and fewer.left[left] < 0 and fewer.left[right] < 0:
            assert fewer.picks[left] != fewer.picks[right]

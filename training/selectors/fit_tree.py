"""Fit the decision tree that selects a filter, and let it depart from the best one only where that surely pays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sklearn.tree import DecisionTreeClassifier

from crosscomb.selection.tree import Tree
from crosscomb.training.selectors.labels import Windows, thinning

MOST_VALUES = 2_500_000
"""So many values of features train a tree at most, windows evenly thinned: neighbours are near copies."""

LEVELS = 128
"""Values of a feature that a tree tells apart in training; on simulated logs 64 erred more, all of them no less."""

SMALL = 5_000
"""So many windows are sorted fast as they are."""


@dataclass(frozen=True)
class TreeShape:
    """How large a tree may grow.

    Attributes
    ----------
    depth : int
    leaf : float
        Least share of the weight in a leaf: fewer windows come from one or two recordings only.
    pruning : float
        Cost-complexity pruning: a branch must bring this much.
    """

    depth: int
    leaf: float
    pruning: float = 1e-4


def fit_tree(
    features: np.ndarray,
    windows: Windows,
    by_regret: bool,
    shape: TreeShape,
    seed: int,
    weight: np.ndarray | None = None,
) -> DecisionTreeClassifier:
    """Fit the entropy tree (Atheupe 2023, eq. 34 to 36, sons weighted by their shares).

    Parameters
    ----------
    features : (w, f) float32
    windows : Windows
    by_regret : bool
        A window speaks for every filter with what that filter saves over the worst one there.
    shape : TreeShape
    seed : int
    weight : (w,), optional
        Of each window.
    """
    saved = windows.saved if weight is None else windows.saved * weight[:, None]
    every = slice(None, None, thinning(features.size, MOST_VALUES))
    features, label, saved = to_levels(features[every]), windows.label[every], saved[every]
    classes = saved.shape[1]
    tree = DecisionTreeClassifier(
        criterion="entropy", max_depth=shape.depth, min_weight_fraction_leaf=shape.leaf, ccp_alpha=shape.pruning,
        random_state=seed,
    )  # fmt: skip
    if not by_regret:
        return tree.fit(features, label)
    votes = np.tile(np.arange(classes), len(label))
    return tree.fit(np.repeat(features, classes, axis=0), votes, sample_weight=saved.ravel())


def to_levels(features: np.ndarray) -> np.ndarray:
    """Each value ``(w, f) float32`` as the nearest of its feature's quantiles: few different values sort fast.

    Thresholds lie halfway between two levels, where a value goes to the one or the other: the tree asks the same of
    the values themselves.
    """
    if len(features) < SMALL:
        return features
    levels = np.quantile(features, np.linspace(0.0, 1.0, LEVELS), axis=0, method="nearest")
    halfway = 0.5 * (levels[1:] + levels[:-1])
    columns = range(features.shape[1])
    return np.stack([levels[np.searchsorted(halfway[:, j], features[:, j]), j] for j in columns], axis=1)


def to_tree(fitted: DecisionTreeClassifier, features: np.ndarray, n_filters: int) -> Tree:
    """Take a fitted scikit-learn tree over; a filter that is never best gets a share of zero."""
    arrays = fitted.tree_
    shares = np.zeros((arrays.node_count, n_filters))
    shares[:, fitted.classes_] = arrays.value[:, 0, :] / arrays.value[:, 0, :].sum(axis=1, keepdims=True)
    leaf = arrays.children_left < 0
    return Tree(
        feature=np.where(leaf, -1, arrays.feature).tolist(),
        threshold=np.where(leaf, 0.0, arrays.threshold).tolist(),
        left=arrays.children_left.tolist(),
        right=arrays.children_right.tolist(),
        shares=shares.tolist(),
        picks=np.argmax(shares, axis=1).tolist(),
        lowest=features.min(axis=0).astype(float).tolist(),
        highest=features.max(axis=0).astype(float).tolist(),
    )


SURE = 2.0
"""A leaf departs from the safe filter where its gain is this many standard errors, over recordings."""

LEAST_WITNESSES = 3
"""And where at least so many recordings speak for it."""


def keep_what_is_sure(
    tree: Tree, leaves: np.ndarray, windows: Windows, owner: np.ndarray, safe: int, sure: float = SURE
) -> Tree:
    """Let a leaf pick another filter than the safe one only where that pays beyond doubt.

    Windows of one recording say the same thing many times: what counts is in how many recordings a leaf gains.

    Parameters
    ----------
    tree : Tree
    leaves : (w,) int
        Leaf of each window.
    windows : Windows
    owner : (w,) int
        Recording of each window.
    safe : int
        Safe filter: nearly right in most driving.
    sure : float
        Standard errors.
    """
    picks, counts = np.array(tree.picks), np.bincount(owner)
    for leaf in np.unique(leaves):
        inside = np.flatnonzero(leaves == leaf)
        best, gained = safe, 0.0
        for other in range(tree.n_classes):
            saved = windows.rmse[inside, safe] - windows.rmse[inside, other]
            # What it takes off the mean error of each recording that comes here.
            each = np.bincount(owner[inside], saved, len(counts))[np.unique(owner[inside])]
            each = each / counts[np.unique(owner[inside])]
            if other == safe or len(each) < LEAST_WITNESSES:
                continue
            gain = each.mean() - sure * each.std(ddof=1) / np.sqrt(len(each))
            if gain > gained:
                best, gained = other, gain
        picks[leaf] = best
    return tree.model_copy(update={"picks": picks.tolist()})


def without_idle_questions(tree: Tree) -> Tree:
    """The same picks with fewer nodes: a question whose answers all pick the same is not asked.

    Parameters
    ----------
    tree : Tree
    """
    idle = [left < 0 for left in tree.left]
    picks = list(tree.picks)
    for node in reversed(range(len(idle))):  # children come later than their parent
        left, right = tree.left[node], tree.right[node]
        if left >= 0 and idle[left] and idle[right] and picks[left] == picks[right]:
            idle[node], picks[node] = True, picks[left]
    return ending_at(tree.model_copy(update={"picks": picks}), idle)


def cut(tree: Tree, depth: int) -> Tree:
    """The same tree no deeper than `depth` questions: what a node would have asked next, its larger share decides."""
    depths = [0] * len(tree.feature)
    for node, (left, right) in enumerate(zip(tree.left, tree.right, strict=True)):
        if left >= 0:
            depths[left] = depths[right] = depths[node] + 1
    ends = [left < 0 or deep >= depth for left, deep in zip(tree.left, depths, strict=True)]
    return ending_at(tree, ends)


def ending_at(tree: Tree, ends: list[bool]) -> Tree:
    """Keep of a tree what is reached when the walk ends at the nodes so marked."""
    kept: list[int] = []

    def keep(node: int) -> None:
        kept.append(node)
        if not ends[node]:
            keep(tree.left[node])
            keep(tree.right[node])

    keep(0)
    place = {node: i for i, node in enumerate(kept)}

    def child(side: list[int]) -> list[int]:
        return [-1 if ends[node] else place[side[node]] for node in kept]

    return tree.model_copy(
        update={
            "feature": [-1 if ends[node] else tree.feature[node] for node in kept],
            "threshold": [0.0 if ends[node] else tree.threshold[node] for node in kept],
            "left": child(tree.left),
            "right": child(tree.right),
            "shares": [tree.shares[node] for node in kept],
            "picks": [tree.picks[node] for node in kept],
        }
    )

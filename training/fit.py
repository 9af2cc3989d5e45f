"""Fit a decision tree on labelled windows and take it over into crosscomb's own arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sklearn.tree import DecisionTreeClassifier

from crosscomb.selector import Tree
from crosscomb.training.labels import Windows
from crosscomb.windows import WindowSettings


@dataclass(frozen=True)
class SelectorKind:
    """A way to train a selector.

    Attributes
    ----------
    summary : str
    window : WindowSettings
    by_regret : bool
        Weigh every choice in a window by the error it saves, instead of one plain label per window.
    depths : tuple of int
        Depths to choose from by the folds; one only is taken as it is.
    """

    summary: str
    window: WindowSettings
    by_regret: bool
    depths: tuple[int, ...]


SELECTORS: dict[str, SelectorKind] = {
    "tree": SelectorKind(
        "decision tree on statistics of ay and yaw-rate windows, trained for the cost of a wrong choice",
        WindowSettings(features="statistics"),
        by_regret=True,
        depths=(2, 4, 6, 8),
    ),
    "paper": SelectorKind(
        "decision tree on the raw ay and yaw-rate windows with plain labels, as in Atheupe 2023",
        WindowSettings(features="raw"),
        by_regret=False,
        depths=(8,),
    ),
}

MIN_LEAF_SHARE = 0.01
"""A leaf holds at least this share of the weight: fewer windows come from one or two recordings only."""


def fit_tree(windows: Windows, kind: SelectorKind, depth: int, seed: int) -> DecisionTreeClassifier:
    """Fit the entropy tree (Atheupe 2023, eq. 34 to 36, sons weighted by their shares)."""
    label = windows.label
    tree = DecisionTreeClassifier(
        criterion="entropy", max_depth=depth, min_weight_fraction_leaf=MIN_LEAF_SHARE, random_state=seed
    )
    if not kind.by_regret:
        return tree.fit(windows.features, label)
    # A window speaks for every filter with what that filter saves over the worst one there. The heaviest class of
    # a leaf is then the one with the least squared error in it, and a tie between filters weighs nothing.
    saved = windows.saved
    classes = saved.shape[1]
    features = np.repeat(windows.features, classes, axis=0)
    return tree.fit(features, np.tile(np.arange(classes), len(label)), sample_weight=saved.ravel())


def to_tree(fitted: DecisionTreeClassifier, windows: Windows, n_filters: int) -> Tree:
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
        lowest=windows.features.min(axis=0).astype(float).tolist(),
        highest=windows.features.max(axis=0).astype(float).tolist(),
    )

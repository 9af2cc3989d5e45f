"""The trained tree that picks the active filter, evaluated from its arrays."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import model_validator

from crosscomb.checked import Finite, Index, Record
from crosscomb.models.compiled import allocating


class Tree(Record):
    """Decision tree as arrays over its nodes; node 0 is the root, a leaf has no children (-1).

    Attributes
    ----------
    feature : list of int
        Feature that a node asks for.
    threshold : list of float
        A sample goes left where its feature is at most this.
    left, right : list of int
        Children; always later in the list than their parent.
    shares : list of list of float
        Share of each class in a node.
    picks : list of int
        Class that a leaf picks: mostly that of the largest share, see
        `crosscomb.training.selectors.fit_tree.keep_what_is_sure`.
    lowest, highest : list of float
        Range of each feature in training.
    """

    kind: Literal["tree"] = "tree"
    feature: list[int]
    threshold: list[Finite]
    left: list[Index]
    right: list[Index]
    shares: list[list[Finite]]
    picks: list[Index]
    lowest: list[Finite]
    highest: list[Finite]

    @model_validator(mode="after")
    def _sound(self) -> Tree:
        nodes, features = len(self.feature), len(self.lowest)
        lengths = {len(self.threshold), len(self.left), len(self.right), len(self.shares), len(self.picks)}
        if nodes == 0 or lengths != {nodes}:
            raise ValueError("the arrays of the tree differ in length or are empty")
        if len(self.highest) != features or len({len(row) for row in self.shares}) > 1:
            raise ValueError("the tree's classes or feature ranges are of uneven length")
        if any(not 0 <= pick < self.n_classes for pick in self.picks):
            raise ValueError(f"the tree picks a class that is none of its {self.n_classes}")
        for node in range(nodes):
            children = (self.left[node], self.right[node])
            if children == (-1, -1):
                continue
            # Later than the parent: no walk can go round in circles.
            if not all(node < child < nodes for child in children):
                raise ValueError(f"node {node} of the tree has broken child indices {children}")
            if not 0 <= self.feature[node] < features:
                raise ValueError(
                    f"node {node} of the tree asks for feature {self.feature[node]} of {features}"
                )
        return self

    @property
    def n_classes(self) -> int:
        """Number of filters the tree tells apart."""
        return len(self.shares[0])

    def leaves(self, features: np.ndarray) -> np.ndarray:
        """Leaf ``(n,)`` that each row of features ``(n, f)`` falls into."""
        return _walk(
            np.asarray(features, dtype=np.float32),
            np.array(self.feature),
            np.array(self.threshold),
            np.array(self.left),
            np.array(self.right),
        )

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Class ``(n,)`` that the leaf of each row of features ``(n, f)`` picks."""
        return np.array(self.picks)[self.leaves(features)]

    def outside(self, features: np.ndarray, margin: float = 0.1) -> np.ndarray:
        """Tell per row ``(n,)`` whether a feature lies beyond its training range by more than a share of it."""
        lowest, highest = np.array(self.lowest), np.array(self.highest)
        slack = margin * (highest - lowest)
        return np.any((features < lowest - slack) | (features > highest + slack), axis=1)


@allocating
def _walk(features, feature, threshold, left, right):
    out = np.empty(features.shape[0], dtype=np.int64)
    for row in range(features.shape[0]):
        node = 0
        while left[node] >= 0:
            # scikit-learn compares the float32 feature with the float64 threshold
            if np.float64(features[row, feature[node]]) <= threshold[node]:
                node = left[node]
            else:
                node = right[node]
        out[row] = node
    return out

"""Boosted regression trees, evaluated from their arrays."""

from __future__ import annotations

from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from crosscomb.checked import LARGEST, Finite, Index, Record
from crosscomb.models.compiled import allocating


class Grove(NamedTuple):
    """The arrays of boosted trees as kernels take them."""

    feature: np.ndarray  # (nodes,)
    threshold: np.ndarray  # (nodes,)
    left: np.ndarray  # (nodes,)
    right: np.ndarray  # (nodes,)
    value: np.ndarray  # (nodes,)
    roots: np.ndarray  # (trees,)
    baseline: np.ndarray  # (outputs,)


class Boosted(Record):
    """Sum of many small regression trees; their nodes lie in one list, one tree after the other.

    Attributes
    ----------
    baseline : list of float
        Start of each output; tree i adds to output i modulo their number.
    roots : list of int
        First node of each tree.
    feature : list of int
        Feature that a node asks for; -1 in a leaf.
    threshold : list of float
        A sample goes left where its feature is at most this.
    left, right : list of int
        Children; always later in the list than their parent.
    value : list of float
        What a leaf adds.
    """

    kind: Literal["boosted"] = "boosted"
    baseline: list[Finite] = Field(min_length=1)
    roots: list[Index]
    feature: list[Index]
    threshold: list[Finite]
    left: list[Index]
    right: list[Index]
    value: list[Finite]

    @model_validator(mode="after")
    def _sound(self) -> Boosted:
        nodes = len(self.feature)
        if {len(self.threshold), len(self.left), len(self.right), len(self.value)} != {nodes}:
            raise ValueError("the arrays of the boosted trees differ in length")
        if any(not 0 <= root < nodes for root in self.roots):
            raise ValueError("a boosted tree starts at a node that is not there")
        for node, children in enumerate(zip(self.left, self.right, strict=True)):
            if self.feature[node] == -1:
                if children != (-1, -1):
                    raise ValueError(f"leaf {node} of the boosted trees has children")
            # Later than the parent: no walk can go round in circles.
            elif self.feature[node] < 0 or not all(node < child < nodes for child in children):
                raise ValueError(f"node {node} of the boosted trees has broken child indices {children}")
        if not self.largest <= LARGEST:
            raise ValueError("the values of the boosted trees add up to more than a number holds")
        return self

    @property
    def largest(self) -> float:
        """No output is larger than this, with either sign."""
        return max(map(abs, self.baseline)) + len(self.roots) * max(map(abs, self.value), default=0.0)

    @property
    def n_features(self) -> int:
        """Least number of features that the trees need."""
        return max(self.feature, default=-1) + 1

    @cached_property
    def grove(self) -> Grove:
        """The arrays as kernels take them."""
        return Grove(
            np.array(self.feature, np.int32), np.array(self.threshold, float), np.array(self.left, np.int32),
            np.array(self.right, np.int32), np.array(self.value, float), np.array(self.roots, np.int64),
            np.array(self.baseline, float),
        )  # fmt: skip

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Outputs ``(n, outputs)`` for rows of features ``(n, f) float32``."""
        out = np.empty((len(features), len(self.baseline)))
        _run(self.grove, np.ascontiguousarray(features, dtype=np.float32), out)
        return out


@allocating
def boosted_at(grove, features, out):
    """Write the outputs ``(outputs,)`` for one row of features ``(f,) float32``."""
    outputs = out.size
    for j in range(outputs):
        out[j] = grove.baseline[j]
    for i in range(grove.roots.size):
        node = grove.roots[i]
        while grove.feature[node] >= 0:
            # Trees were fitted in double precision.
            if np.float64(features[grove.feature[node]]) <= grove.threshold[node]:
                node = grove.left[node]
            else:
                node = grove.right[node]
        out[i % outputs] += grove.value[node]


@allocating
def _run(grove, features, out):
    for row in range(features.shape[0]):
        boosted_at(grove, features[row], out[row])

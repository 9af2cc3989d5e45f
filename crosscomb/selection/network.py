"""Small feed-forward networks and trees that answer together, evaluated from their weights."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from crosscomb.checked import LARGEST, Finite, Record
from crosscomb.models.compiled import allocating
from crosscomb.selection.boosted import Boosted, Grove, boosted_at

FAR = np.float32(5.0)
"""An input counts as no further off its mean than this many standard deviations."""

NO_TREES = Boosted(baseline=[0.0], roots=[], feature=[], threshold=[], left=[], right=[], value=[])


class Member(Record):
    """One network: two hidden layers of rectified linear neurons and a linear output.

    Attributes
    ----------
    first, second : list of list of float
        Weights from each input to each neuron of a layer.
    first_bias, second_bias : list of float
    output : list of float
    output_bias : float
    """

    first: list[list[Finite]]
    first_bias: list[Finite]
    second: list[list[Finite]]
    second_bias: list[Finite]
    output: list[Finite]
    output_bias: Finite


class Network(Record):
    """Mean of some networks that look at the same features, and of boosted trees beside them.

    Networks follow smooth relations; trees never answer beyond what they were taught. Their errors differ.

    Attributes
    ----------
    columns : list of int
        Features that it looks at.
    relative : list of int
        Feature that is taken off each of them first, -1 for none.
    mean, scale : list of float
        An input is (feature - mean) / scale.
    unit : float
        One of the networks' output in the unit of the answer.
    members : list of Member
    trees : Boosted or None
        On the scaled inputs; they count as much as all members together.
    """

    columns: list[int] = Field(min_length=1)
    relative: list[int]
    mean: list[Finite]
    scale: list[Finite]
    unit: float = Field(gt=0.0)
    members: list[Member] = Field(min_length=1)
    trees: Boosted | None = None

    @model_validator(mode="after")
    def _sound(self) -> Network:
        inputs = len(self.columns)
        if {len(self.relative), len(self.mean), len(self.scale)} != {inputs}:
            raise ValueError("the inputs of the network are of uneven length")
        if any(not 0 <= column < 2**31 for column in self.columns):
            raise ValueError("the network asks for a feature that is none")
        if any(not -1 <= column < 2**31 for column in self.relative):
            raise ValueError("the network takes off a feature that is none")
        if any(not 1.0 / LARGEST <= scale <= LARGEST / 4.0 for scale in self.scale):
            raise ValueError("a scale of the network is not positive, or too small or large")
        if self.trees is not None and (len(self.trees.baseline) != 1 or self.trees.n_features > inputs):
            raise ValueError("the trees beside the network do not fit its inputs")
        one = self.members[0]
        for member in self.members:
            _require_shape("first", member.first, inputs, len(one.first_bias))
            _require_shape("second", member.second, len(one.first_bias), len(one.second_bias))
            lengths = (len(member.first_bias), len(member.second_bias), len(member.output))
            if lengths != (len(one.first_bias), len(one.second_bias), len(one.second_bias)):
                raise ValueError("the layers of the network do not fit each other")
        if not self.unit * max(map(_largest, self.members)) <= LARGEST:
            raise ValueError("the weights of the network are so large that its answers overflow")
        if self.trees is not None and not self.unit * self.trees.largest <= LARGEST:
            raise ValueError("the trees beside the network are so large that its answers overflow")
        return self

    @property
    def n_features(self) -> int:
        """Least number of features that the network needs."""
        return max(*self.columns, *self.relative) + 1

    @cached_property
    def weights(self) -> Weights:
        """The network as kernels take it."""

        def stack(name: str) -> np.ndarray:
            return np.array([getattr(member, name) for member in self.members], np.float32)

        return Weights(
            columns=np.array(self.columns, np.int64),
            relative=np.array(self.relative, np.int64),
            mean=np.array(self.mean, np.float32),
            over_scale=np.array(1.0 / np.array(self.scale), np.float32),
            unit=self.unit,
            first=stack("first"),
            first_bias=stack("first_bias"),
            second=stack("second"),
            second_bias=stack("second_bias"),
            output=stack("output"),
            output_bias=stack("output_bias"),
            trees=(self.trees or NO_TREES).grove,
        )

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Answers ``(n,)`` for rows of features ``(n, f) float32``."""
        out = np.empty(len(features))
        _run(self.weights, make_scratch(self.weights), np.ascontiguousarray(features, dtype=np.float32), out)
        return out


def _largest(member: Member) -> float:
    """No value inside a network is larger than this, with either sign; infinite where one may overflow."""
    reach = np.full(len(member.first), float(FAR))
    peaks = []
    for weights, bias in (
        (member.first, member.first_bias),
        (member.second, member.second_bias),
        ([[weight] for weight in member.output], [member.output_bias]),
    ):
        reach = np.abs(bias) + reach @ np.abs(np.array(weights).reshape(len(reach), len(bias)))
        peaks.append(reach.max(initial=0.0))
    largest = float(max(peaks))
    return largest if largest <= LARGEST else float("inf")


def _require_shape(name: str, weights: list[list[float]], rows: int, columns: int) -> None:
    if len(weights) != rows or any(len(row) != columns for row in weights):
        raise ValueError(f"the {name} layer of the network is not {rows} by {columns}")


class Weights(NamedTuple):
    """The arrays of networks and trees as kernels take them; the leading axis counts the members."""

    columns: np.ndarray  # (inputs,)
    relative: np.ndarray  # (inputs,)
    mean: np.ndarray  # (inputs,) float32
    over_scale: np.ndarray  # (inputs,) float32
    unit: float
    first: np.ndarray  # (members, inputs, h1) float32
    first_bias: np.ndarray  # (members, h1) float32
    second: np.ndarray  # (members, h1, h2) float32
    second_bias: np.ndarray  # (members, h2) float32
    output: np.ndarray  # (members, h2) float32
    output_bias: np.ndarray  # (members,) float32
    trees: Grove


class Scratch(NamedTuple):
    """Room for the values of the layers."""

    inputs: np.ndarray  # (inputs,) float32
    first: np.ndarray  # (h1,) float32
    second: np.ndarray  # (h2,) float32
    trees: np.ndarray  # (1,)


def make_scratch(weights: Weights) -> Scratch:
    """Make room for one evaluation at a time."""
    return Scratch(
        inputs=np.empty(weights.columns.size, np.float32),
        first=np.empty(weights.first_bias.shape[1], np.float32),
        second=np.empty(weights.second_bias.shape[1], np.float32),
        trees=np.empty(1),
    )


@allocating
def _layer(inputs, weights, bias, out):
    """Rectified linear neurons; input by input, so that the sums go through vector instructions."""
    for j in range(out.size):
        out[j] = bias[j]
    for i in range(inputs.size):
        value = inputs[i]
        if value != 0.0:
            for j in range(out.size):
                out[j] += value * weights[i, j]
    for j in range(out.size):
        out[j] = max(out[j], np.float32(0.0))


@allocating
def network_at(weights, scratch, features):
    """Answer for one row of features ``(f,) float32``."""
    inputs = scratch.inputs
    for i in range(inputs.size):
        value = features[weights.columns[i]]
        if weights.relative[i] >= 0:
            value -= features[weights.relative[i]]
        inputs[i] = min(max((value - weights.mean[i]) * weights.over_scale[i], -FAR), FAR)
    total, members = 0.0, weights.output_bias.size
    for m in range(members):
        _layer(inputs, weights.first[m], weights.first_bias[m], scratch.first)
        _layer(scratch.first, weights.second[m], weights.second_bias[m], scratch.second)
        total += weights.output_bias[m]
        for j in range(scratch.second.size):
            total += scratch.second[j] * weights.output[m, j]
    answer = total / members
    if weights.trees.roots.size > 0:
        boosted_at(weights.trees, inputs, scratch.trees)
        answer = 0.5 * (answer + scratch.trees[0])
    return weights.unit * answer


@allocating
def _run(weights, scratch, features, out):
    for row in range(features.shape[0]):
        out[row] = network_at(weights, scratch, features[row])

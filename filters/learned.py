"""Three-layer neural network on ay, yaw rate, steering angle and speed, with and without delayed feedback.

    beta = beta_scale (w2 . s(W1 z + b1) + b2),   s(x) = 1 / (1 + exp(-x)),   z = (inputs - mean) / scale

(Chindamo 2018, section 3 and figures 3 and 4). With feedback the network's own beta of 8 samples ago at 100
Hz (0.08 s) is a fifth input (Melzi and Sabbioni 2011). The network knows no car: it holds for the cars and
roads it was trained on (`crosscomb.training.selectors.fit_network`), and says nothing sure about others.

beta_std is a stated measure, no posterior: the RMS error on the training recordings, widened where an input
lies outside three standard deviations of the training's and while an input is missing (its last value is
held). There is no NIS.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from importlib import resources
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import MAX_BETA, KernelFilter, starting
from crosscomb.models.compiled import kernel

COLUMNS = (at.AY, at.YAW_RATE, at.STEER, at.VX)
"""Columns of a sample that are the network's inputs, in order."""

FEEDBACK_DELAY = 0.08
"""Age of the fed-back beta [s]."""

PAST = 512
"""Samples of beta that are kept for the feedback."""


class Neurons(NamedTuple):
    """A trained network as plain numbers, as it stands in a JSON file."""

    mean: tuple[float, ...]  # of the inputs, in SI units
    scale: tuple[float, ...]
    hidden: tuple[tuple[float, ...], ...]  # weights of each hidden neuron
    hidden_bias: tuple[float, ...]
    output: tuple[float, ...]
    output_bias: float
    beta_scale: float  # [rad]
    largest: float  # |beta| in training [rad]; the answer is held inside
    error: float  # RMS on the training recordings [rad]
    delay: float  # of the fed-back beta [s]; 0 without feedback


class NetworkNoise(NamedTuple):
    """Settings of the stated error."""

    outside: float = 0.02  # added per standard deviation beyond three, of each input [rad]
    missing: float = 0.05  # added per second without ay, yaw rate or steering angle, for at most 5 s [rad/s]


class NetworkCar(NamedTuple):
    """The network and the car's geometry as the kernels take them."""

    a: float  # centre of gravity to front axle [m]
    b: float  # centre of gravity to rear axle [m]
    mean: np.ndarray  # (inputs,)
    scale: np.ndarray  # (inputs,)
    hidden: np.ndarray  # (neurons, inputs)
    hidden_bias: np.ndarray  # (neurons,)
    output: np.ndarray  # (neurons,)
    output_bias: float
    beta_scale: float
    largest: float
    error: float
    delay: float


class NetworkState(NamedTuple):
    """What the network remembers, changed in place by its kernel."""

    inputs: np.ndarray  # (5,) ay, yaw_rate, steer, vx as last measured, and the delayed beta
    past: np.ndarray  # (PAST,) beta of the last samples, in a ring
    at: np.ndarray  # (1,) place of the next one
    missing: np.ndarray  # (1,) time without some input [s]
    running: np.ndarray  # (1,)


@kernel
def evaluate(inputs, net):
    """Output of the network [rad] and how far its inputs lie outside the training, in standard deviations."""
    total, outside = net.output_bias, 0.0
    for neuron in range(net.hidden.shape[0]):
        activation = net.hidden_bias[neuron]
        for i in range(net.hidden.shape[1]):
            activation += net.hidden[neuron, i] * ((inputs[i] - net.mean[i]) / net.scale[i])
        total += net.output[neuron] / (1.0 + math.exp(-min(max(activation, -700.0), 700.0)))
    for i in range(net.hidden.shape[1]):
        outside += max(abs(inputs[i] - net.mean[i]) / net.scale[i] - 3.0, 0.0)
    return net.beta_scale * total, outside


@kernel
def remember(state, beta):
    """Keep an answer for the feedback."""
    state.past[state.at[0]] = beta
    state.at[0] = (state.at[0] + 1) % PAST


@kernel
def take_inputs(state, sample, net, dt):
    """Take the inputs that are there, keep the others, and fetch the fed-back beta."""
    inputs, complete = state.inputs, sample[at.STEER_HELD] == 0.0
    for i in range(4):
        value = sample[COLUMNS[i]]
        if math.isfinite(value):
            inputs[i] = value
        else:
            complete = False
    state.missing[0] = 0.0 if complete else min(state.missing[0] + dt, 5.0)
    age = min(max(round(net.delay / dt), 1), PAST)
    inputs[4] = state.past[(state.at[0] - age) % PAST]


@kernel
def network_step(state, sample, net, noise, dt, out):
    """One sample of the network; `out` ``(3,)`` gets beta, its stated error and NaN."""
    take_inputs(state, sample, net, dt)
    if not starting(state.running, sample, net, out):
        beta, outside = evaluate(state.inputs, net)
        out[at.BETA] = min(max(beta, -net.largest), net.largest)
        out[at.BETA_STD] = math.hypot(net.error, noise.outside * outside + noise.missing * state.missing[0])
        out[at.NIS] = math.nan
    remember(state, out[at.BETA])


@kernel
def network_run(state, samples, net, noise, dt, out):
    """All samples of the network."""
    for k in range(samples.shape[0]):
        network_step(state, samples[k], net, noise, dt, out[k])


def parse_network(where: str, value: Any, feedback: bool) -> Neurons:
    """Check a network from a settings table.

    Parameters
    ----------
    where : str
        Names the setting in messages.
    value : mapping
        Keys as the fields of `Neurons`.
    feedback : bool
        Whether it must have the fed-back input.

    Raises
    ------
    UsageError
        A key is missing or unknown, a value is no finite number, or the sizes do not match.
    """
    if not isinstance(value, Mapping) or set(value) != set(Neurons._fields):
        raise UsageError(f"{where}: must be a table of {', '.join(Neurons._fields)}")
    try:
        arrays = {key: np.array(part, dtype=np.float64) for key, part in value.items()}
    except (TypeError, ValueError):
        raise UsageError(f"{where}: holds something that is no number: train it anew") from None
    inputs, neurons = 5 if feedback else 4, arrays["output"].size
    shapes = dict.fromkeys(Neurons._fields, ()) | {
        "mean": (inputs,), "scale": (inputs,), "hidden": (neurons, inputs),
        "hidden_bias": (neurons,), "output": (neurons,),
    }  # fmt: skip
    for key, shape in shapes.items():
        if arrays[key].shape != shape or not np.isfinite(arrays[key]).all():
            raise UsageError(f"{where}.{key}: must be finite numbers of shape {shape}: train it anew")
    if not (arrays["scale"] > 0.0).all() or not 0.0 < arrays["largest"] <= MAX_BETA or arrays["error"] <= 0.0:
        raise UsageError(f"{where}: scale, largest and error must be positive: train it anew")
    if (arrays["delay"] > 0.0) != feedback:
        raise UsageError(
            f"{where}.delay: must be {'positive' if feedback else '0'}: take the other network filter"
        )
    plain: dict[str, Any] = {key: tuple(a.tolist()) if a.ndim else float(a) for key, a in arrays.items()}
    plain["hidden"] = tuple(tuple(row) for row in arrays["hidden"].tolist())
    return Neurons(**plain)


def parse_plain_network(where: str, value: Any) -> Neurons:
    """Check a network without feedback from a settings table; see `parse_network`."""
    return parse_network(where, value, feedback=False)


def parse_feedback_network(where: str, value: Any) -> Neurons:
    """Check a network with feedback from a settings table; see `parse_network`."""
    return parse_network(where, value, feedback=True)


@cache
def shipped_network(name: str) -> Neurons:
    """Network that comes with the package: ``network`` or ``network_feedback``."""
    text = (resources.files("crosscomb") / "data" / "network.json").read_text(encoding="utf-8")
    return parse_network(f"network.json: {name}", json.loads(text)[name], name == "network_feedback")


@dataclass(frozen=True)
class NeuralNetwork(KernelFilter):
    """Three-layer network; `tyre` is not used."""

    noise: NetworkNoise = NetworkNoise()
    network: Neurons = field(default_factory=partial(shipped_network, "network"))

    run_kernel = staticmethod(network_run)
    tables: ClassVar = {"network": parse_plain_network}

    @cached_property
    def car(self) -> Any:
        """Network and geometry as the kernels take them."""
        net = self.network
        return NetworkCar(
            self.vehicle.cg_to_front_axle, self.vehicle.cg_to_rear_axle,
            np.array(net.mean), np.array(net.scale), np.array(net.hidden), np.array(net.hidden_bias),
            np.array(net.output), net.output_bias, net.beta_scale, net.largest, net.error, net.delay,
        )  # fmt: skip

    def make_state(self) -> Any:
        """Make the memory before the first sample."""
        counter = np.zeros(1, dtype=np.int64)
        return NetworkState(np.zeros(5), np.zeros(PAST), counter, np.zeros(1), counter.copy())


@dataclass(frozen=True)
class FeedbackNetwork(NeuralNetwork):
    """Three-layer network with its own delayed answer as an input."""

    network: Neurons = field(default_factory=partial(shipped_network, "network_feedback"))

    tables: ClassVar = {"network": parse_feedback_network}

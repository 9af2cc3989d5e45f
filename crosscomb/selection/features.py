"""What the richer selectors see: all signals, the filters' answers, and their exponential means.

A few channels are made at every sample, and of each the mean over several memories is kept. One kernel makes one
sample of them, so training, batch and streaming see the same bit for bit, and nothing depends on the rate or on
how a log was cut.

Half of the channels are odd: they change sign when the drive is mirrored (left for right), as beta does; the
others are even. A correction can so be made exactly odd, and nothing is learned of the side a car was driven on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.models.compiled import allocating
from crosscomb.models.kinematic import slip_rate
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.seen import Seen
from crosscomb.signals import MIN_SPEED

MEMORIES = (0.0, 0.1, 0.4, 1.5, 5.0)
"""Time constants of the means [s]; 0 is the sample itself."""

DIFFERENTIATION = 0.05
"""Time over which the yaw acceleration is the change of the yaw rate [s]."""

MOST_NIS = 100.0
"""A larger normalised innovation says no more than this one."""

MOST_INNOVATION = 10.0
"""A larger innovation says no more than this one, in its own unit."""

STEADY_SLIP = "steady slip of the linear rear tyre [rad]"
SPREAD = "spread of beta [rad]"

ODD = (
    "ay [m/s^2]",
    "yaw_rate [rad/s]",
    "steer [rad]",
    "steer vx / wheelbase - yaw_rate [rad/s]",
    "ay / vx - yaw_rate [rad/s]",
    "yaw rate of the rear wheels - yaw_rate [rad/s]",
    STEADY_SLIP,
    "yaw acceleration [rad/s^2]",
)
EVEN = (
    "vx [m/s]",
    "ax [m/s^2]",
    "abs ay [m/s^2]",
    "abs yaw_rate [rad/s]",
    "abs(ay / vx - yaw_rate) [rad/s]",
    "rear / front wheel speed - 1",
    "ay yaw_rate [m rad/s^3]",
    "ay steer [m rad/s^2]",
    "ay mean beta [m rad/s^2]",
    SPREAD,
)
BETAS = len(ODD) + len(EVEN)
"""Channel of the first filter's beta."""


class Layout(NamedTuple):
    """Where the features stand: memory by memory the channels of the signals, then those of the filters.

    Of filters beta, then NIS, then beta_std, then the innovations of those that give any.

    Attributes
    ----------
    names : tuple of str
    odd : (f,) bool
        Features that change sign in a mirrored drive.
    plain : (f,) bool
        Features of the drive and of the filters' beta. The others are what filters say of themselves: on real cars
        they say it otherwise than in simulation, and a correction that has seen them there does not carry over.
    slip : (f,) bool
        Features that are sideslip angles.
    """

    names: tuple[str, ...]
    odd: np.ndarray
    plain: np.ndarray
    slip: np.ndarray

    def relative_to(self, anchor: int) -> np.ndarray:
        """The anchor's beta at the memory of each other sideslip angle ``(f,) int``; -1 for what is none.

        Parameters
        ----------
        anchor : int
            Index of a filter.
        """
        channels = len(self.names) // len(MEMORIES)
        anchors = np.arange(len(self.names)) // channels * channels + BETAS + anchor
        others = self.slip & (np.arange(len(self.names)) != anchors)
        return np.where(others, anchors, -1)


class Memory(NamedTuple):
    """State of the features of one drive, changed in place by the kernel."""

    means: np.ndarray  # (memories, channels)
    held: np.ndarray  # (5,) last ay, yaw_rate, ax, 1 after the first sample, yaw_rate a moment ago


class FeatureCar(NamedTuple):
    """What the features take of a vehicle."""

    wheelbase: float  # [m]
    b: float  # centre of gravity to rear axle [m]
    track_rear: float  # [m]
    rear_slip: float  # slip of the linear rear tyre over ay [rad s^2/m]


def innovations_of(filters: Sequence[str]) -> list[tuple[str, str]]:
    """Filter and innovation of each innovation that filters of the catalogue give, in order."""
    return [(name, innovation) for name in filters for innovation in CATALOGUE[name].load().innovations()]


def layout(filters: list[str]) -> Layout:
    """Names of the features in order, and which are odd.

    Parameters
    ----------
    filters : list of str
        Names of the filters.
    """
    innovations = innovations_of(filters)
    channels = (
        *ODD, *EVEN, *(f"beta {name} [rad]" for name in filters), *(f"NIS {name}" for name in filters),
        *(f"beta_std {name} [rad]" for name in filters),
        *(innovation.replace(" ", f" {name} ") for name, innovation in innovations),
    )  # fmt: skip
    odd, plain, slip = np.zeros((3, len(channels)), dtype=bool)
    odd[: len(ODD)] = True
    odd[BETAS : BETAS + len(filters)] = True
    plain[: BETAS + len(filters)] = True
    plain[channels.index(SPREAD)] = False
    first = len(channels) - len(innovations)
    odd[first:] = [innovation in CATALOGUE[name].load().odd_innovations for name, innovation in innovations]
    slip[ODD.index(STEADY_SLIP)] = True
    slip[BETAS : BETAS + len(filters)] = True
    names = (
        channel if memory == 0.0 else f"mean({channel}, {memory} s)"
        for memory in MEMORIES
        for channel in channels
    )
    return Layout(tuple(names), *(np.tile(which, len(MEMORIES)) for which in (odd, plain, slip)))


def feature_car(vehicle: Vehicle) -> FeatureCar:
    """Take from a vehicle what the features need."""
    rear_load = vehicle.mass * vehicle.cg_to_front_axle / vehicle.wheelbase
    return FeatureCar(
        vehicle.wheelbase,
        vehicle.cg_to_rear_axle,
        vehicle.track_rear,
        rear_load / vehicle.cornering_stiffness_rear,
    )


def make_memory(n_filters: int, n_innovations: int) -> Memory:
    """Make the state before the first sample."""
    channels = BETAS + 3 * n_filters + n_innovations
    return Memory(np.zeros((len(MEMORIES), channels)), np.zeros(5))


@allocating
def _hold(value, held, i):
    """Give a measured value, or while it is missing the last one."""
    if math.isfinite(value):
        held[i] = value
    return held[i]


@allocating
def _rear_wheels(sample, yaw_rate, speed, track_rear):
    """Yaw rate of the rear wheels less that of the car, and rear over front wheel speed less 1; 0 where unknown."""
    turn, slip = 0.0, 0.0
    rear, front = sample[at.VRL] + sample[at.VRR], sample[at.VFL] + sample[at.VFR]
    if math.isfinite(rear):
        turn = (sample[at.VRR] - sample[at.VRL]) / track_rear - yaw_rate
        if math.isfinite(front):
            slip = (rear - front) / max(front, 2.0 * MIN_SPEED)
    return turn, slip


@allocating
def _channels(held, sample, beta, beta_std, nis, innovations, car, lead, out):
    """Write the channels of one sample."""
    ay, yaw_rate = _hold(sample[at.AY], held, 0), _hold(sample[at.YAW_RATE], held, 1)
    ax, speed, steer = _hold(sample[at.AX], held, 2), max(sample[at.VX], MIN_SPEED), sample[at.STEER]
    wheels_turn, wheels_slip = _rear_wheels(sample, yaw_rate, speed, car.track_rear)
    turned = slip_rate(speed, yaw_rate, ay)
    filters = beta.size
    mean, least, largest = 0.0, math.inf, -math.inf
    for i in range(filters):
        if math.isfinite(beta[i]):  # else it stays what it was
            out[BETAS + i] = beta[i]
        mean += out[BETAS + i] / filters
        least, largest = min(least, out[BETAS + i]), max(largest, out[BETAS + i])
    out[0], out[1], out[2] = ay, yaw_rate, steer
    out[3] = (steer - sample[at.STEER_REAR]) * speed / car.wheelbase - yaw_rate
    out[4], out[5] = turned, wheels_turn
    out[6] = sample[at.STEER_REAR] + car.b * yaw_rate / speed - car.rear_slip * ay
    if held[3] == 0.0:
        held[4] = yaw_rate
    held[4] += lead * (yaw_rate - held[4])
    out[7] = (yaw_rate - held[4]) / DIFFERENTIATION
    out[8], out[9], out[10], out[11] = sample[at.VX], ax, abs(ay), abs(yaw_rate)
    out[12], out[13] = abs(turned), wheels_slip
    out[14], out[15], out[16], out[17] = ay * yaw_rate, ay * steer, ay * mean, largest - least
    for i in range(filters):
        out[BETAS + filters + i] = min(nis[i], MOST_NIS) if math.isfinite(nis[i]) else 1.0
        if math.isfinite(beta_std[i]):
            out[BETAS + 2 * filters + i] = beta_std[i]
    for i in range(innovations.size):
        known = min(max(innovations[i], -MOST_INNOVATION), MOST_INNOVATION)
        out[BETAS + 3 * filters + i] = known if math.isfinite(innovations[i]) else 0.0


@allocating
def features_step(memory, sample, beta, beta_std, nis, innovations, car, gains, out):
    """Write the features of one sample.

    Parameters
    ----------
    memory : Memory
        Changed in place.
    sample : (17,)
        As in `crosscomb.filters.base.Inputs`.
    beta, beta_std, nis : (filters,) [rad], [rad], [-]
    innovations : (m,)
        Of all the filters in order; one that is missing counts as 0.
    car : FeatureCar
    gains : (memories + 1,)
        Share of the new sample in each mean, and in the yaw rate that its change is counted from.
    out : (features,) float32
    """
    means = memory.means
    levels, channels = means.shape
    _channels(memory.held, sample, beta, beta_std, nis, innovations, car, gains[levels], means[0])
    fresh = memory.held[3] == 0.0
    memory.held[3] = 1.0
    for level in range(levels):
        gain = 1.0 if fresh else gains[level]
        for i in range(channels):
            means[level, i] += gain * (means[0, i] - means[level, i])
            out[level * channels + i] = means[level, i]


@allocating
def _features_run(memory, samples, beta, beta_std, nis, innovations, car, gains, out):
    for k in range(samples.shape[0]):
        features_step(memory, samples[k], beta[k], beta_std[k], nis[k], innovations[k], car, gains, out[k])


def memory_gains(dt: float) -> np.ndarray:
    """Share of a new sample in each mean and in the yaw rate a moment ago, for samples dt [s] apart."""
    times = (*MEMORIES, DIFFERENTIATION)
    return np.array([1.0 if time == 0.0 else -math.expm1(-dt / time) for time in times])


def all_features(seen: Seen, memory: Memory | None = None) -> np.ndarray:
    """Features of the next samples of a drive.

    Parameters
    ----------
    seen : Seen
    memory : Memory, optional
        Changed in place; without it the drive begins here.

    Returns
    -------
    (n, features) float32
    """
    samples = seen.inputs.samples
    innovations = np.ascontiguousarray(np.hstack(seen.innovations))
    memory = memory or make_memory(seen.beta.shape[1], innovations.shape[1])
    out = np.empty((len(samples), memory.means.size), dtype=np.float32)
    _features_run(
        memory, samples, np.ascontiguousarray(seen.beta), np.ascontiguousarray(seen.beta_std),
        np.ascontiguousarray(seen.nis), innovations, feature_car(seen.vehicle), memory_gains(seen.inputs.dt), out,
    )  # fmt: skip
    return out

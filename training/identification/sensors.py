"""Sensor errors that show without a tyre model: at standstill, along the car, and against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY, Signals
from crosscomb.training.identification.fit import Dependence, Rows, cost, covariance, solve
from crosscomb.training.identification.response import lean
from crosscomb.training.identification.trace import RATE, Trace, settled, standstill

STILL_CHANNELS = ("ax", "ay", "yaw_rate")
STILL_FLOOR = {"ax": 0.06, "ay": 0.06, "yaw_rate": 0.0004}
"""What a parking place's slope, and the drift until the drive, add to a mean at standstill (standard deviation)."""
OTHER_LOG = {"ax": 0.06, "ay": 0.12, "yaw_rate": 0.001}
"""The same for the mean at standstill of another log."""
KINEMATIC_ERROR = 0.3  # [m/s^2] of ay against the ground truth, before it is known
THIN = 10
BLOCK = int(2.0 * RATE)

Known = dict[str, tuple[float, float]]
"""Name of a channel to (mean, standard deviation)."""


def still_biases(logs: Sequence[Signals]) -> list[Known]:
    """Offsets at standstill of each log: its own, else those of the other logs, less surely.

    Parameters
    ----------
    logs : sequence of Signals

    Returns
    -------
    list of dict
        Keys of `STILL_CHANNELS` where there is any standstill [m/s^2 and rad/s].
    """
    own: list[Known] = []
    for log in logs:
        rows = standstill(log)
        means: Known = {}
        for name in STILL_CHANNELS:
            values = log.column(name)[rows]
            values = values[np.isfinite(values)]
            if len(values) >= 20:
                means[name] = (float(values.mean()), STILL_FLOOR[name])
        own.append(means)
    pooled = {name: [means[name][0] for means in own if name in means] for name in STILL_CHANNELS}
    other: Known = {
        name: (float(np.mean(found)), float(np.hypot(OTHER_LOG[name], np.std(found))))
        for name, found in pooled.items()
        if found
    }
    return [other | means for means in own]


def ax_bias(
    traces: Sequence[Trace], known: Sequence[Known], turning: Sequence[np.ndarray]
) -> tuple[float, float] | None:
    """Offset of ax and its standard deviation [m/s^2]; None where nothing tells it.

    From ax = bias + k d(vx)/dt + turning over all driving, where k holds the pitch of the body, together with
    standstill. A road's slope counts as a lasting error.

    Parameters
    ----------
    traces, known : sequence
        Logs and their offsets at standstill.
    turning : sequence of ndarray
        What turning adds to ax in each trace ``(n,) [m/s^2]``: -vy yaw_rate, and the lever arm; NaN if unknown.
    """
    values, weights = [], []
    for trace, own, added in zip(traces, known, turning, strict=True):
        rows = np.flatnonzero(trace.normal & np.isfinite(trace.ax - added))[::THIN]
        if len(rows) > 50:
            pull = np.gradient(trace.vx, trace.t)[rows]
            design = np.column_stack([np.ones(len(rows)), pull])
            solution, *_ = np.linalg.lstsq(design, (trace.ax - added)[rows], rcond=None)
            left = (trace.ax - added)[rows] - design @ solution
            _, group = np.unique(rows // BLOCK, return_inverse=True)
            means = np.bincount(group, left) / np.bincount(group)
            values.append(float(solution[0]))
            weights.append(1.0 / (0.03**2 + float(means.var()) / max(len(means) - 1, 1)))
        if "ax" in own:
            values.append(own["ax"][0])
            weights.append(1.0 / own["ax"][1] ** 2)
    if not values:
        return None
    share = np.array(weights) / np.sum(weights)
    mean = float(share @ values)
    scatter = float(share @ (np.array(values) - mean) ** 2)
    return mean, float(np.sqrt(1.0 / np.sum(weights) + scatter / len(values)))


@dataclass(frozen=True)
class Kinematics:
    """What the ground truth alone says of the sensors, each as (value, standard deviation).

    Attributes
    ----------
    position : [m]
        Of the accelerometer ahead of the centre of gravity.
    roll_gradient : [rad per m/s^2]
    yaw_delay, ay_delay : [s]
        Behind the ground truth.
    """

    position: tuple[float, float]
    roll_gradient: tuple[float, float]
    yaw_delay: tuple[float, float]
    ay_delay: tuple[float, float]


KINEMATIC_START = np.array([0.0, 0.0, 0.0, 0.0])  # position, roll gradient, yaw delay, ay delay
PLACES = (-1.2, 0.0, 1.2)
"""Where the search for the accelerometer begins [m]."""
KINEMATIC_SPREAD = np.array([1.5, 0.006, 0.06, 0.06])
KINEMATIC_STEP = np.array([0.01, 1e-4, 0.002, 0.002])


def kinematics(traces: Sequence[Trace], known: Sequence[Known], vehicle: Vehicle) -> Kinematics | None:
    """Fit ay = true + g roll_gradient lean(true) + position d(yaw_rate)/dt + bias.

    true is d(vy)/dt + vx yaw_rate, vy is vx tan(beta) of the ground truth, so that no tyre matters. Each
    channel has its own delay.

    Parameters
    ----------
    traces : sequence of Trace
    known : sequence of dict
        Of `still_biases`: offsets of ay and yaw rate.
    vehicle : Vehicle
        How its body follows ay in roll.
    """
    rows = [settled(trace.wild & np.isfinite(trace.beta)) for trace in traces]
    picked = [np.flatnonzero(mask & (np.arange(len(mask)) % THIN == 0)) for mask in rows]
    used = [i for i, one in enumerate(picked) if len(one) > 50]
    if not used:
        return None
    truths = [_Truth(traces[i], picked[i], vehicle) for i in used]
    offsets = [known[i] for i in used]
    centre = np.concatenate(
        [KINEMATIC_START, *([_mean(own, "yaw_rate"), _mean(own, "ay")] for own in offsets)]
    )
    spread = np.concatenate(
        [KINEMATIC_SPREAD, *([_std(own, "yaw_rate", 0.01), _std(own, "ay", 0.4)] for own in offsets)]
    )
    error = np.full(len(used), KINEMATIC_ERROR)

    def part(i: int, x: np.ndarray) -> np.ndarray:
        return truths[i].residuals(x[:4], x[4 + 2 * i], x[5 + 2 * i]) / error[i]

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([part(i, x) for i in range(len(truths))])

    def slopes(x: np.ndarray) -> Rows:
        base = residuals(x)
        steps = np.concatenate([KINEMATIC_STEP, np.tile([1e-4, 1e-2], len(truths))])
        change = [
            (residuals(x + step * one) - base) / step for step, one in zip(steps, np.eye(len(x)), strict=True)
        ]
        return base, np.column_stack(change)

    def beliefs(x: np.ndarray) -> Rows:
        return (x - centre) / spread, np.diag(1.0 / spread)

    # At one speed a lever arm looks much like a delay: from one start alone the fit may end in the wrong one.
    starts = [centre + place * np.eye(len(centre))[0] for place in PLACES]
    ends = [solve(residuals, slopes, beliefs, start) for start in starts]
    x = min(ends, key=lambda x: cost(residuals(x), beliefs(x)[0]))
    error = np.array([1.48 * np.median(np.abs(part(i, x) * error[i])) for i in range(len(truths))])
    x = solve(residuals, slopes, beliefs, x)
    z, jacobian = slopes(x)
    bounds = np.cumsum([0, *(len(truth.rows) for truth in truths)])
    series = [slice(int(a), int(b)) for a, b in pairwise(bounds)]
    blocks = np.concatenate([i * 1_000_000 + truth.rows // BLOCK for i, truth in enumerate(truths)])
    std = np.sqrt(np.diag(covariance(z, jacobian, beliefs(x)[1], Dependence(blocks, series))))
    return Kinematics(*((float(value), float(own)) for value, own in zip(x[:4], std[:4], strict=True)))


def _mean(own: Known, name: str) -> float:
    return own.get(name, (0.0, 0.0))[0]


def _std(own: Known, name: str, otherwise: float) -> float:
    return own.get(name, (0.0, otherwise))[1]


class _Truth:
    """The lateral acceleration of one log that its ground truth and yaw rate ask for."""

    def __init__(self, trace: Trace, rows: np.ndarray, vehicle: Vehicle) -> None:
        self.trace, self.rows, self.vehicle = trace, rows, vehicle
        self.lateral = np.gradient(trace.vx * np.tan(trace.beta), trace.t)
        self.turning = np.gradient(trace.yaw_rate, trace.t)

    def residuals(self, sensor: np.ndarray, yaw_bias: float, ay_bias: float) -> np.ndarray:
        position, roll_gradient, yaw_delay, ay_delay = sensor
        trace, t = self.trace, self.trace.t
        yaw_rate = np.interp(t + yaw_delay, t, trace.yaw_rate) - yaw_bias
        asked = self.lateral + trace.vx * yaw_rate
        leaning = lean(np.where(np.isfinite(asked), asked, trace.ay), self.vehicle)
        felt = asked + GRAVITY * roll_gradient * leaning + ay_bias
        felt = felt + position * np.interp(t + yaw_delay, t, self.turning)
        return (felt - np.interp(t + ay_delay, t, trace.ay))[self.rows]

"""Windows of lateral acceleration and yaw rate, and what the selector sees of them.

The one place for features: training and run time call the same kernels, sample by sample, so a decision at
sample k sees samples up to k only and does not depend on how the log was cut into pieces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from pydantic import Field

from crosscomb.checked import Record
from crosscomb.models.compiled import kernel

LEAST_YAW_RATE = 0.01
"""Below this yaw rate [rad/s] the slope of ay over yaw rate means nothing and goes to 0."""

FAR = 1e18
"""Larger samples, which no sensor means, count as this: the features, products of two, stay within float32."""


class WindowSettings(Record):
    """How windows are cut.

    Attributes
    ----------
    length : int
        Samples in a window at the working rate.
    history : int
        Windows before and with the present one that the statistics also look at.
    hop : int
        Samples from one training window to the next. At run time every sample gets a decision.
    features : {"raw", "statistics"}
        The samples themselves as in the paper, or their statistics.
    """

    length: int = Field(default=10, ge=2, le=1000)
    history: int = Field(default=10, ge=1, le=100)
    hop: int = Field(default=10, ge=1, le=1000)
    features: Literal["raw", "statistics"] = "statistics"

    @cached_property
    def names(self) -> list[str]:
        """Name of each feature with its unit, in order."""
        if self.features == "raw":
            return [
                f"{channel}[{k - self.length + 1}] [{unit}]"
                for channel, unit in (("ay", "m/s^2"), ("yaw_rate", "rad/s"))
                for k in range(self.length)
            ]
        channels = (("ay", "m/s^2"), ("yaw_rate", "rad/s"))
        statistics = ("abs mean", "mean abs", "std", "max abs")
        names = []
        for span in (self.length, self.length * self.history):
            names += [
                f"{one}({name}, {span} samples) [{unit}]" for name, unit in channels for one in statistics
            ]
            names += [
                f"mean(ay yaw_rate, {span} samples) [m rad/s^3]",
                f"slope(ay over yaw_rate, {span} samples) [m/s]",
                f"rms(ay - slope yaw_rate, {span} samples) [m/s^2]",
            ]
        return names

    @property
    def memory(self) -> int:
        """Samples that the features of one sample look at."""
        return self.length if self.features == "raw" else self.length * self.history


@kernel
def _statistics(ay, yaw_rate, start, stop, out):
    """Statistics of both channels [start:stop], and what ties them; all sums in one pass keep the processor busy.

    Of each channel the magnitude of the mean, mean magnitude, standard deviation and largest magnitude: magnitudes, so
    that a turn to the left and its mirror image look the same. Of both the mean product, slope of ay over yaw rate, and
    what the slope leaves over: while vy is steady, ay = vx yaw_rate: the slope is the speed, and what is left over is
    the rate of vy.
    """
    n = stop - start
    total, magnitude, largest, own = 0.0, 0.0, 0.0, 0.0
    other_total, other_magnitude, other_largest, square = 0.0, 0.0, 0.0, 0.0
    product = 0.0
    for i in range(start, stop):
        value, other = ay[i], yaw_rate[i]
        total += value
        magnitude += abs(value)
        largest = max(largest, abs(value))
        own += value * value
        other_total += other
        other_magnitude += abs(other)
        other_largest = max(other_largest, abs(other))
        square += other * other
        product += value * other
    mean, other_mean = total / n, other_total / n
    squares, other_squares = 0.0, 0.0
    for i in range(start, stop):
        squares += (ay[i] - mean) ** 2
        other_squares += (yaw_rate[i] - other_mean) ** 2
    out[0], out[1], out[2], out[3] = abs(mean), magnitude / n, math.sqrt(squares / n), largest
    out[4], out[5] = abs(other_mean), other_magnitude / n
    out[6], out[7] = math.sqrt(other_squares / n), other_largest
    slope = product / max(square, n * LEAST_YAW_RATE * LEAST_YAW_RATE)
    left = own - 2.0 * slope * product + slope * slope * square
    out[8], out[9], out[10] = product / n, slope, math.sqrt(max(left, 0.0) / n)


@kernel
def statistics_at(ay, yaw_rate, k, length, history, out):
    """Write the features of sample k: of its window, and of the windows before it with it."""
    for level in range(2):
        span = length if level == 0 else length * history
        # At the start of a log the window is what there is.
        _statistics(ay, yaw_rate, max(0, k + 1 - span), k + 1, out[11 * level : 11 * level + 11])


@kernel
def _statistics_run(ay, yaw_rate, first, length, history, out):
    """Fill the features of the samples from `first` on."""
    for k in range(first, ay.size):
        statistics_at(ay, yaw_rate, k, length, history, out[k - first])


@kernel
def raw_at(ay, yaw_rate, k, length, out):
    """Write the samples of the window of sample k; before the log is its first sample."""
    for j in range(length):
        i = max(0, k + 1 - length + j)
        out[j] = ay[i]
        out[length + j] = yaw_rate[i]


@kernel
def _raw_run(ay, yaw_rate, first, length, out):
    """Fill the features of the samples from `first` on with the samples of their windows."""
    for k in range(first, ay.size):
        raw_at(ay, yaw_rate, k, length, out[k - first])


@kernel
def _hold(values, last):
    """Fill missing samples in place with the last one before them; none is beyond `FAR`."""
    for k in range(values.size):
        if math.isfinite(values[k]):
            last = min(max(values[k], -FAR), FAR)
        values[k] = last


@dataclass
class Past:
    """Newest samples of a drive, as far back as the next window reaches; missing ones are filled."""

    ay: np.ndarray = field(default_factory=lambda: np.empty(0))  # [m/s^2]
    yaw_rate: np.ndarray = field(default_factory=lambda: np.empty(0))  # [rad/s]


def window_features(ay: np.ndarray, yaw_rate: np.ndarray, settings: WindowSettings) -> np.ndarray:
    """Features of the window that ends at each sample.

    Parameters
    ----------
    ay : (n,) [m/s^2]
    yaw_rate : (n,) [rad/s]
        At the working rate; a missing sample counts as the last one before it.
    settings : WindowSettings

    Returns
    -------
    (n, features) float32
        In the precision in which the trees of scikit-learn compare.
    """
    return next_windows(Past(), ay, yaw_rate, settings)


def next_windows(past: Past, ay: np.ndarray, yaw_rate: np.ndarray, settings: WindowSettings) -> np.ndarray:
    """Features of `window_features` at the next samples of a drive; `past` keeps what later ones need."""
    first = len(past.ay)
    past.ay, past.yaw_rate = _joined(past.ay, ay), _joined(past.yaw_rate, yaw_rate)
    out = np.empty((len(ay), len(settings.names)))
    if settings.features == "raw":
        _raw_run(past.ay, past.yaw_rate, first, settings.length, out)
    else:
        _statistics_run(past.ay, past.yaw_rate, first, settings.length, settings.history, out)
    keep = settings.memory - 1
    past.ay, past.yaw_rate = past.ay[-keep:], past.yaw_rate[-keep:]
    return out.astype(np.float32)


def _joined(past: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Old and new samples, the missing among the new ones filled and the absurd bounded."""
    joined = np.concatenate([past, new])
    _hold(joined[len(past) :], past[-1] if len(past) else 0.0)
    return joined

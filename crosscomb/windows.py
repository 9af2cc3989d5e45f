"""Windows of lateral acceleration and yaw rate, and what the selector sees of them.

The one place for features: training and run time call the same kernels, sample by sample, so a decision at
sample k sees samples up to k only and does not depend on how the log was cut into pieces.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from crosscomb.filters.base import hold


class WindowSettings(BaseModel):
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

    model_config = ConfigDict(frozen=True, extra="forbid")

    length: int = Field(default=10, ge=2, le=1000)
    history: int = Field(default=10, ge=1, le=100)
    hop: int = Field(default=10, ge=1, le=1000)
    features: Literal["raw", "statistics"] = "statistics"

    @property
    def names(self) -> list[str]:
        """Name of each feature with its unit, in order."""
        if self.features == "raw":
            return [
                f"{channel}[{k - self.length + 1}] [{unit}]"
                for channel, unit in (("ay", "m/s^2"), ("yaw_rate", "rad/s"))
                for k in range(self.length)
            ]
        spans = (self.length, self.length * self.history)
        per_channel = [
            f"{statistic}({channel}, {span} samples) [{unit}]"
            for span in spans
            for channel, unit in (("ay", "m/s^2"), ("yaw_rate", "rad/s"))
            for statistic in ("mean", "mean abs", "std", "min", "max")
        ]
        products = [f"mean(ay yaw_rate, {span} samples) [m rad/s^3]" for span in spans]
        return per_channel + products


@njit(cache=True)
def _statistics(values, start, stop, out):
    """Mean, mean magnitude, standard deviation, least and largest of values[start:stop]."""
    n = stop - start
    total, magnitude, least, largest = 0.0, 0.0, math.inf, -math.inf
    for i in range(start, stop):
        total += values[i]
        magnitude += abs(values[i])
        least = min(least, values[i])
        largest = max(largest, values[i])
    mean = total / n
    squares = 0.0
    for i in range(start, stop):
        squares += (values[i] - mean) ** 2
    out[0], out[1], out[2], out[3], out[4] = mean, magnitude / n, math.sqrt(squares / n), least, largest


@njit(cache=True)
def _statistics_run(ay, yaw_rate, length, history, out):
    """Fill the features of every sample, statistics of the window and of the windows before it with it."""
    for k in range(ay.size):
        for level in range(2):
            span = length if level == 0 else length * history
            # At the start of a log the window is what there is.
            start = max(0, k + 1 - span)
            _statistics(ay, start, k + 1, out[k, 10 * level : 10 * level + 5])
            _statistics(yaw_rate, start, k + 1, out[k, 10 * level + 5 : 10 * level + 10])
            product = 0.0
            for i in range(start, k + 1):
                product += ay[i] * yaw_rate[i]
            out[k, 20 + level] = product / (k + 1 - start)


@njit(cache=True)
def _raw_run(ay, yaw_rate, length, out):
    """Fill the features of every sample with the samples of its window; before the log is its first sample."""
    for k in range(ay.size):
        for j in range(length):
            i = max(0, k + 1 - length + j)
            out[k, j] = ay[i]
            out[k, length + j] = yaw_rate[i]


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
    ay, yaw_rate = hold(ay), hold(yaw_rate)
    out = np.empty((len(ay), len(settings.names)))
    if settings.features == "raw":
        _raw_run(ay, yaw_rate, settings.length, out)
    else:
        _statistics_run(ay, yaw_rate, settings.length, settings.history, out)
    return out.astype(np.float32)

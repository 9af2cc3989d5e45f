"""Training windows: features, the filter with the lowest windowed RMSE, and what a wrong choice costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crosscomb.estimate import FilterRun
from crosscomb.signals import MIN_SPEED
from crosscomb.training.metrics import countable
from crosscomb.windows import WindowSettings


@dataclass(frozen=True)
class Windows:
    """Labelled windows of one or several recordings.

    Attributes
    ----------
    features : (w, f) float32
    rmse : (w, filters) [rad]
        RMSE of each filter in each window.
    """

    features: np.ndarray
    rmse: np.ndarray

    @property
    def label(self) -> np.ndarray:
        """Filter with the lowest RMSE in each window ``(w,)`` (Atheupe 2023, eq. 33)."""
        return np.argmin(self.rmse, axis=1)

    @property
    def saved(self) -> np.ndarray:
        """Squared error that each filter saves over the worst one in each window ``(w, filters) [rad^2]``.

        Squared, as the RMSE of a recording is what is reported. The mean over all windows is one, so that the
        tree's own thresholds on weight work.
        """
        squared = self.rmse**2
        saved = squared.max(axis=1, keepdims=True) - squared
        mean = saved.mean()
        return saved / mean if mean > 0.0 else np.ones_like(saved)


def window_ends(beta_ref: np.ndarray, vx: np.ndarray, settings: WindowSettings) -> np.ndarray:
    """Last sample of each window that can be judged, ``hop`` samples apart.

    The car is fast enough in all of it, and there is truth in some of it: a reference may come more rarely
    than the signals.
    """
    if len(vx) < settings.length:
        return np.empty(0, dtype=np.int64)
    ends = np.arange(settings.length - 1, len(vx), settings.hop)
    windows = np.lib.stride_tricks.sliding_window_view
    fast = windows(vx > MIN_SPEED, settings.length).all(axis=1)
    known = windows(np.isfinite(beta_ref), settings.length).any(axis=1)
    judged = np.logical_and(fast, known)
    return ends[judged[ends - settings.length + 1]]


def label_run(run: FilterRun, settings: WindowSettings) -> Windows:
    """Cut and label the windows of one segment.

    Parameters
    ----------
    run : FilterRun
    settings : WindowSettings
    """
    signals = run.segment.signals
    beta_ref = signals.beta_ref
    ends = window_ends(beta_ref, signals.column("vx"), settings)
    squared = (run.beta - beta_ref[:, None]) ** 2
    members = ends[:, None] - np.arange(settings.length)[None, :]
    return Windows(run.features[ends], np.sqrt(np.nanmean(squared[members], axis=1)))


def concatenate(parts: list[Windows]) -> Windows:
    """Put the windows of several segments into one table."""
    return Windows(
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.rmse for part in parts]),
    )


def oracle_beta(run: FilterRun, length: int) -> np.ndarray:
    """Estimate of a selector that knows the truth: the best filter of each window ``(n,) [rad]``.

    The log is cut into windows of `length` samples side by side; the bound for what switching at the pace of
    windows can reach.
    """
    signals = run.segment.signals
    beta_ref = signals.beta_ref
    counted = countable(beta_ref, signals.column("vx"))
    squared = np.where(counted[:, None], (run.beta - beta_ref[:, None]) ** 2, 0.0)
    starts = np.arange(0, len(squared), length)
    best = np.argmin(np.add.reduceat(squared, starts, axis=0), axis=1)
    active = np.repeat(best, length)[: len(squared)]
    return run.beta[np.arange(len(squared)), active]

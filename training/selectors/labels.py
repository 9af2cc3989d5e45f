"""Training windows: features, the filter with the lowest windowed RMSE, and what a wrong choice costs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from crosscomb.selection.features import all_features
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import MIN_SPEED
from crosscomb.training.metrics import countable

TIE = np.radians(0.1)
"""Errors below this [rad] are equal: optical and two-antenna references are hardly better."""


def thinning(count: int, most: int) -> int:
    """Step with which at most `most` of `count` things are left."""
    return -(-count // most)


@dataclass(frozen=True)
class Windows:
    """Labelled windows of one or several recordings.

    Attributes
    ----------
    features : (w, f) float32
    rmse : (w, filters) [rad]
        RMSE of each filter in each window.
    everything : (w, F) float32
        All features at the end of each window (`crosscomb.selection.features`); none of them where nobody asked.
    beta : (w, filters) [rad]
        Of each filter at the end of each window.
    beta_ref : (w,) [rad]
        Truth there; NaN where there is none.
    """

    features: np.ndarray
    rmse: np.ndarray
    everything: np.ndarray
    beta: np.ndarray
    beta_ref: np.ndarray

    @property
    def label(self) -> np.ndarray:
        """Filter with the lowest RMSE in each window ``(w,)`` (Atheupe 2023, eq. 33)."""
        return np.argmin(self.rmse, axis=1)

    @property
    def plain(self) -> Windows:
        """Without all the features beside them."""
        return replace(self, everything=self.everything[:, :0])

    def regret(self, chosen: np.ndarray) -> np.ndarray:
        """RMSE of the chosen filters ``(w,) int`` less that of the best one in each window ``(w,) [rad]``."""
        return self.rmse[np.arange(len(chosen)), chosen] - self.rmse.min(axis=1)

    def where(self, inside: np.ndarray) -> Windows:
        """Keep the windows that `inside` ``(w,) bool`` says."""
        return Windows(*(getattr(self, name)[inside] for name in WINDOW_COLUMNS))

    def thinned(self, most: int) -> Windows:
        """Keep so many windows at most, evenly."""
        step = thinning(len(self.rmse), most)
        return self.where(np.arange(len(self.rmse)) % step == 0) if step > 1 else self

    @property
    def saved(self) -> np.ndarray:
        """RMSE that each filter saves over the worst one in each window ``(w, filters) [rad]``, scaled to mean one.

        The heaviest class of a leaf is then the one with the least regret. Errors below the accuracy of references
        count as that: such a tie weighs nothing.
        """
        rmse = np.maximum(self.rmse, TIE)
        saved = rmse.max(axis=1, keepdims=True) - rmse
        mean = saved.mean()
        return saved / mean if mean > 0.0 else np.ones_like(saved)


WINDOW_COLUMNS = ("features", "rmse", "everything", "beta", "beta_ref")


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


def label_run(run: Seen, settings: WindowSettings, everything: bool = False) -> Windows:
    """Cut and label the windows of one stretch.

    Parameters
    ----------
    run : Seen
    settings : WindowSettings
    everything : bool
        Also give all features at the end of each window.
    """
    beta_ref = run.beta_ref
    ends = window_ends(beta_ref, run.column("vx"), settings)
    squared = (run.beta - beta_ref[:, None]) ** 2
    members = ends[:, None] - np.arange(settings.length)[None, :]
    rmse = np.sqrt(np.nanmean(squared[members], axis=1))
    features = all_features(run)[ends] if everything else np.empty((len(ends), 0), dtype=np.float32)
    return Windows(run.windows[ends], rmse, features, run.beta[ends], beta_ref[ends])


def concatenate(parts: list[Windows]) -> Windows:
    """Put the windows of several stretches into one table."""
    return Windows(*(np.concatenate([getattr(part, name) for part in parts]) for name in WINDOW_COLUMNS))


def oracle_beta(run: Seen, length: int) -> np.ndarray:
    """Estimate of a selector that knows the truth: the best filter of each window ``(n,) [rad]``.

    The log is cut into windows of `length` samples side by side; the bound for what switching at the pace of
    windows can reach.
    """
    beta_ref = run.beta_ref
    counted = countable(beta_ref, run.column("vx"))
    squared = np.where(counted[:, None], (run.beta - beta_ref[:, None]) ** 2, 0.0)
    starts = np.arange(0, len(squared), length)
    best = np.argmin(np.add.reduceat(squared, starts, axis=0), axis=1)
    active = np.repeat(best, length)[: len(squared)]
    return run.beta[np.arange(len(squared)), active]

"""A fault and what came of it: answers to a faulty log beside those to the sound one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.run.estimate import LogEstimate
from crosscomb.signals import MIN_SPEED

FLAGS = ("degraded", "invalid", "extrapolating", "recovering", "uncertain")
"""A row is flagged where its status holds one of these words and that of the sound log does not."""

ALARMS = ("degraded", "invalid", "extrapolating")
"""Words that are false alarms in a sound log."""

WRONG = math.radians(3.0)
"""An error beyond this [rad] must not say ok."""

EXCITED_AY = 2.0
"""Lateral acceleration [m/s^2] from which on, for a second, the driving tells of faults."""


class Answers(NamedTuple):
    """Columns of an estimate that criteria look at, each ``(n,)``."""

    beta: np.ndarray  # [rad]
    beta_std: np.ndarray  # [rad]
    active: np.ndarray  # str
    status: np.ndarray  # str
    finite: np.ndarray  # bool, all that a row of the estimate file holds


def answers_of(estimate: LogEstimate) -> Answers:
    """Columns of an estimate that criteria look at."""
    numbers = np.column_stack([estimate.beta, estimate.beta_std, *estimate.filters.values()])
    finite = np.isfinite(numbers).all(axis=1)
    return Answers(estimate.beta, estimate.beta_std, estimate.active, estimate.status, finite)


def at_rows(answers: Answers, rows: np.ndarray) -> Answers:
    """Answers at some rows."""
    return Answers(*(column[rows] for column in answers))


def same(one: Answers, other: Answers) -> bool:
    """Tell whether two runs answer the same bit for bit."""
    return all(np.array_equal(mine, theirs) for mine, theirs in zip(one, other, strict=True))


@dataclass(frozen=True)
class Trial:
    """A fault and what came of it: rows from the onset on that both runs answered.

    Attributes
    ----------
    t : (n,)
        Since the onset [s].
    sound, faulty : Answers
    truth : (n,)
        Ground truth [rad], NaN where there is none.
    vx, ay : (n,)
        Of the sound log [m/s], [m/s^2].
    lasts : float
        Time from the onset to the return [s].
    dropped : int
        Rows that were not answered.
    notes : tuple of str
        What was said of the faulty log and not of the sound one.
    """

    t: np.ndarray
    sound: Answers
    faulty: Answers
    truth: np.ndarray
    vx: np.ndarray
    ay: np.ndarray
    lasts: float = math.inf
    dropped: int = 0
    notes: tuple[str, ...] = ()

    @property
    def apart(self) -> np.ndarray:
        """Distance of both answers ``(n,) [deg]``."""
        return np.degrees(np.abs(self.faulty.beta - self.sound.beta))

    @property
    def counted(self) -> np.ndarray:
        """Rows ``(n,)`` with ground truth and above `MIN_SPEED`."""
        return np.isfinite(self.truth) & (self.vx > MIN_SPEED)

    @property
    def flagged(self) -> np.ndarray:
        """Rows ``(n,)`` that hold one of `FLAGS` which the sound log's do not."""
        return self.newly(*FLAGS)

    def newly(self, *words: str, within: float = 0.0) -> np.ndarray:
        """Rows ``(n,)`` whose status holds one of the words, and not in the sound log, nor there `within` [s] of it."""
        rows = [
            holds(self.faulty.status, word) & (distances(self.t, holds(self.sound.status, word)) > within)
            for word in words
        ]
        return np.any(rows, axis=0)

    def excited_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Which rows ``(n,)`` are of excited driving, and how much of it there was up to each [s]."""
        strong = np.where(np.abs(self.ay) > EXCITED_AY, self.t, -math.inf)
        excited = self.t - np.maximum.accumulate(strong) <= 1.0
        return excited, np.cumsum(np.diff(self.t, prepend=self.t[0]) * excited)


def distances(t: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Time ``(n,) [s]`` from each row to the nearest marked one; infinite where none is."""
    before = np.maximum.accumulate(np.where(marked, t, -math.inf))
    after = np.minimum.accumulate(np.where(marked, t, math.inf)[::-1])[::-1]
    return np.minimum(t - before, after - t)


def holds(status: np.ndarray, word: str) -> np.ndarray:
    """Tell which rows ``(n,)`` of a status hold a word."""
    texts, places = np.unique(status.astype(str), return_inverse=True)
    return np.array([word in text.split("+") for text in texts], dtype=bool)[places]

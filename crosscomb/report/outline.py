"""Of a long log, what a picture of it shows: the least and the largest value of each few rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.run.estimate import LogEstimate
from crosscomb.run.handling import Handling
from crosscomb.run.motion import Motion

MOST = 12_000
"""Rows that are drawn: nine for each point across a picture."""

_SIGNALS = ("t", "vx", "ay", "yaw_rate", "beta_ref")


@dataclass
class Outline:
    """Estimates of a log on their way into a picture, piece by piece.

    Attributes
    ----------
    rows : int
        Of the whole log. Up to `MOST` all are kept, else two for each few: one with the least and one with the
        largest of each number, with the words of the first and of the last.
    """

    rows: int
    parts: list[LogEstimate] = field(default_factory=list)
    rest: LogEstimate | None = None  # rows that do not yet fill one group

    @property
    def group(self) -> int:
        """Rows that become two; 1 where all are kept."""
        return 1 if self.rows <= MOST else -(-self.rows // (MOST // 2))

    def take(self, estimate: LogEstimate) -> None:
        """Take the next rows."""
        if self.rest is not None:
            estimate = _mapped(lambda *parts: np.concatenate(parts), self.rest, estimate)
        whole = len(estimate.beta) // self.group * self.group
        self.parts.append(_mapped(lambda column: _bounds(column[:whole], self.group), estimate))
        self.rest = _mapped(lambda column: column[whole:].copy(), estimate)

    def estimate(self) -> LogEstimate:
        """What is to be drawn of the rows so far."""
        return _mapped(lambda *parts: np.concatenate(parts), *self.parts, self.rest)


def _bounds(column: np.ndarray, group: int) -> np.ndarray:
    """Least and largest number of each group, or first and last word, in turn."""
    groups = column.reshape(-1, group)
    if group == 1:
        return column.copy()
    if column.dtype.kind == "f":
        both = np.fmin.reduce(groups, axis=1), np.fmax.reduce(groups, axis=1)
    else:
        both = groups[:, 0], groups[:, -1]
    return np.stack(both, axis=1).ravel()


def _mapped(function: Callable[..., np.ndarray], *estimates: LogEstimate) -> LogEstimate:
    """An estimate of columns that are made of the columns of others."""
    first = estimates[0]

    def of(column: Callable[[LogEstimate], Any]) -> np.ndarray:
        return function(*map(column, estimates))

    signals = {name: of(lambda one, name=name: _signal(one, name)) for name in _SIGNALS}
    return LogEstimate(
        replace(first.signals, frame=pd.DataFrame(signals)),
        of(lambda one: one.beta),
        of(lambda one: one.beta_std),
        of(lambda one: one.active),
        of(lambda one: one.status),
        {name: of(lambda one, name=name: one.filters[name]) for name in first.filters},
        Motion(*(of(lambda one, name=name: getattr(one.motion, name)) for name in Motion._fields)),
        Handling(*(of(lambda one, name=name: getattr(one.handling, name)) for name in Handling._fields)),
        {name: of(lambda one, name=name: one.extras[name]) for name in first.extras},
    )


def _signal(estimate: LogEstimate, name: str) -> np.ndarray:
    return estimate.signals.beta_ref if name == "beta_ref" else estimate.signals.column(name)

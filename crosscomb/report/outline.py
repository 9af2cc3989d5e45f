"""Of a long log, what a picture of it shows: the least and the largest value of each few rows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from crosscomb.run.estimate import LogEstimate
from crosscomb.run.handling import Handling
from crosscomb.run.motion import Motion

MOST = 12_000
"""Rows that are drawn: nine for each point across a picture."""

Columns = dict[tuple[str, str], np.ndarray]


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
    parts: list[Columns] = field(default_factory=list)
    rest: Columns = field(default_factory=dict)  # rows that do not yet fill one group
    like: LogEstimate | None = None  # the newest piece

    @property
    def group(self) -> int:
        """Rows that become two; 1 where all are kept."""
        return 1 if self.rows <= MOST else -(-self.rows // (MOST // 2))

    def take(self, estimate: LogEstimate) -> None:
        """Take the next rows."""
        columns = _columns(estimate)
        if self.rest:
            columns = {key: np.concatenate([self.rest[key], column]) for key, column in columns.items()}
        whole = len(columns["", "beta"]) // self.group * self.group
        self.parts.append({key: _bounds(column[:whole], self.group) for key, column in columns.items()})
        self.rest = {key: column[whole:].copy() for key, column in columns.items()}
        self.like = estimate

    def estimate(self) -> LogEstimate:
        """What is to be drawn of the rows so far, at least one."""
        assert self.like is not None
        columns = {key: np.concatenate([part[key] for part in (*self.parts, self.rest)]) for key in self.rest}

        def told(kind: str) -> dict[str, np.ndarray]:
            return {name: column for (of, name), column in columns.items() if of == kind}

        signals = replace(self.like.signals, frame=pd.DataFrame(told("signals")))
        motion, handling, own = Motion(**told("motion")), Handling(**told("handling")), told("")
        answers = own["beta"], own["beta_std"], own["active"], own["status"]
        return LogEstimate(
            signals, *answers, told("filters"), motion, handling, told("extras"), own["reason"]
        )


def _columns(estimate: LogEstimate) -> Columns:
    """All columns of an estimate that pictures show, by where they stand in it."""
    signals = {name: estimate.signals.column(name) for name in ("t", "vx", "ay", "yaw_rate")}
    tables = {
        "": {name: getattr(estimate, name) for name in ("beta", "beta_std", "active", "status", "reason")},
        "signals": signals | {"beta_ref": estimate.signals.beta_ref},
        "filters": estimate.filters,
        "motion": estimate.motion._asdict(),
        "handling": estimate.handling._asdict(),
        "extras": estimate.extras,
    }
    return {(kind, name): column for kind, table in tables.items() for name, column in table.items()}


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

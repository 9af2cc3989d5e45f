"""Times of a log's rows: what is not later than all before it is dropped and counted, where the rest is sound."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from crosscomb.errors import UsageError

FEW_ROWS, FEW_SHARE = 20, 0.01
"""So many rows, or this share of them, may be out of time in a log that is sound otherwise."""

RESTART_FALL, RESTART_ROWS, RESTART_FALLS = 1.0, 5, 3
"""Time starts again where it falls by more than this [s] and so many rows follow in order; where it has fallen more
often than that, the rows are unordered."""


@dataclass
class Stamps:
    """The times so far, taken piece by piece; of rows with one time the first stays."""

    live: bool = False  # no row to come may be waited for: a deep fall is refused at once
    rows: int = 0
    dropped: int = 0
    newest: float = -math.inf  # of the rows that are kept [s]
    before: float = -math.inf  # of the row before, kept or not [s]
    kept: np.ndarray | None = None  # values of the newest row that is kept
    fault: str = ""  # of the first row that was dropped
    word: str = ""  # of the newest one, "time repeats" or "time goes backwards"
    falls: int = 0  # how often time went back
    fall: tuple[str, float] = ("", 0.0)  # where it last did, and how far below the newest time [s]
    in_order: int = 0  # rows in order since then

    def later(self, values: np.ndarray, place: int, source: str, rows: np.ndarray) -> np.ndarray:
        """Tell which of the next rows are later than all before them.

        Parameters
        ----------
        values : (n, columns)
            Of the rows; NaN means "no measurement".
        place : int
            Column of the time [s].
        source : str
            What messages call the log.
        rows : (n,) int
            Numbers of the rows in the file, for messages.

        Returns
        -------
        ndarray
            ``(n,) bool``.

        Raises
        ------
        UsageError
            A row has no time, time starts again, or a row of a repeated time holds what the one before lacks.
        """
        t = values[:, place]
        if not t.size:
            return np.ones(0, dtype=bool)
        if self.newest < t[0] and t[-1] < math.inf and (t.size == 1 or (t[1:] > t[:-1]).all()):
            self._take(values, float(t[-1]), t)
            return np.ones(t.size, dtype=bool)
        bad = np.flatnonzero(~np.isfinite(t))
        if bad.size:
            raise UsageError(
                f"{source}: row {rows[bad[0]]}, column t: no time there: fill it in or delete the row"
            )
        newest = np.maximum.accumulate(np.concatenate([[self.newest], t]))
        later = t > newest[:-1]
        last = np.maximum.accumulate(np.where(later, np.arange(t.size), -1))
        for row in np.flatnonzero(~later).tolist():
            kept = values[last[row]] if last[row] >= 0 else self.kept
            before = float(t[row - 1]) if row else self.before
            self._drop(
                values[row], kept, float(newest[row]) - t[row], before, t[row], source, f"row {rows[row]}"
            )
        self._take(values[: last[-1] + 1], float(newest[-1]), t)
        return later

    def _take(self, kept: np.ndarray, newest: float, t: np.ndarray) -> None:
        """Move on behind rows at times `t` [s], of which the last of the `kept` ones is the `newest` one."""
        self.rows += t.size
        self.newest, self.before = newest, float(t[-1])
        if len(kept):
            self.kept = kept[-1].copy()

    def _drop(
        self,
        values: np.ndarray,
        kept: np.ndarray | None,
        depth: float,
        before: float,
        t: float,
        source: str,
        row: str,
    ) -> None:
        """Count one row whose time `t` lies `depth` [s] below the newest one."""
        at = f"{row}, column t: {{}} ({before:.10g} then {t:.10g} s)"
        self.word = "time repeats" if depth == 0.0 else "time goes backwards"
        fault = at.format(self.word)
        if depth == 0.0 and kept is not None and _fills_others(values, kept):
            raise UsageError(
                f"{source}: {fault} and the row fills other columns: merge the rows of one time into one"
            )
        self.fault = self.fault or fault
        self.dropped += 1
        if t < before:
            self.falls, self.fall, self.in_order = self.falls + 1, (at.format("time starts again"), depth), 1
        else:
            self.in_order = self.in_order + 1 if t > before else 0
        if self.live and depth > RESTART_FALL:
            raise UsageError(f"{source}: {self.fall[0]}: reset() before a new log, or pass samples in order")
        deep = self.fall[1] > RESTART_FALL and self.falls <= RESTART_FALLS
        if deep and self.in_order >= RESTART_ROWS:
            raise UsageError(f"{source}: {self.fall[0]}: several runs in one file: split it there")

    def notes(self, source: str) -> list[str]:
        """Say how many rows were dropped.

        Raises
        ------
        UsageError
            They are not few.
        """
        if self.dropped > max(FEW_SHARE * self.rows, min(FEW_ROWS, max(1, self.rows // 4))):
            share = f"{self.dropped} of {self.rows} rows are out of time"
            raise UsageError(f"{source}: {self.fault}; {share}: sort the rows and delete repeated ones")
        return self.counted()

    def counted(self) -> list[str]:
        """Say how many rows were dropped, few or not."""
        count = "1 row" if self.dropped == 1 else f"{self.dropped} rows"
        return [f"{count} dropped, out of time (first: {self.fault})"] if self.dropped else []


def _fills_others(values: np.ndarray, kept: np.ndarray) -> bool:
    """Tell whether a row of the same time fills columns that are empty in the `kept` one, and only those."""
    there, known = np.isfinite(values), np.isfinite(kept)
    return bool(np.any(there & ~known)) and int(np.count_nonzero(there & known)) == 1  # the time itself

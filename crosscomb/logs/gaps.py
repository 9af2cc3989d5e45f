"""What a log lacks: channels with holes, stuck channels, silences, standstill, offsets, ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from crosscomb.logs.grid import MAX_AGE, MAX_GAP
from crosscomb.signals import MIN_SPEED, REFERENCES, UNITS, Signals

STUCK_TIME = 10.0
"""A channel that shows one value for longer than this [s] in a moving car is worth a look."""

STANDSTILL_OFFSETS = {"ay": 0.1, "yaw_rate": 0.005}
"""Mean values at standstill above these are reported."""


@dataclass(frozen=True)
class Finding:
    """One line on a column: an ``error`` is plainly wrong and has a mend, a ``warning`` may be harmless."""

    severity: Literal["error", "warning"]
    column: str
    message: str


@dataclass
class Held:
    """How long a channel shows one value."""

    value: float  # the newest one
    since: float  # when it came [s]
    longest: tuple[float, float, float] = (0.0, 0.0, 0.0)  # time [s], value and begin [s] of the longest rest


@dataclass
class Gaps:
    """What weakens an estimate without being wrong, gathered over a log piece by piece."""

    rows: int = 0
    t: float = -np.inf  # of the newest row [s]
    measured: dict[str, int] = field(default_factory=dict)  # values of each column
    held: dict[str, Held] = field(default_factory=dict)
    silences: tuple[int, int, float] = (0, 0, 0.0)  # long ones, short ones, the longest [s]
    fast: bool = False
    stands: bool = False  # in the newest row
    still: float = 0.0  # time at standstill [s]
    offsets: dict[str, tuple[int, float, float]] = field(default_factory=dict)  # number, mean, sum of squares

    def take(self, signals: Signals) -> None:
        """Look at the next rows."""
        speed = np.abs(_speed(signals))
        steps = np.diff(signals.t, prepend=self.t if self.rows else signals.t[0])
        for name in signals.frame.columns:
            count = int(signals.frame[name].notna().sum())
            self.measured[name] = self.measured.get(name, 0) + count
            if name != "t" and name not in REFERENCES:
                self._hold(name, signals, speed > MIN_SPEED)
        long, short, longest = self.silences
        long, short = (
            long + int(np.sum(steps > MAX_GAP)),
            short + int(np.sum((steps > MAX_AGE) & (steps <= MAX_GAP))),
        )
        self.silences = long, short, max(longest, float(steps.max()))
        self.fast = self.fast or bool(np.any(speed > MIN_SPEED))
        still = speed < 0.1
        self.still += float(steps[1:][still[:-1]].sum()) + self.stands * float(steps[0])
        for name in STANDSTILL_OFFSETS:
            self._average(name, signals.column(name)[still & np.isfinite(signals.column(name))])
        self.rows, self.t, self.stands = self.rows + len(signals), float(signals.t[-1]), bool(still[-1])

    def _hold(self, name: str, signals: Signals, moving: np.ndarray) -> None:
        """Find the longest rest of a channel in the moving car."""
        values = signals.column(name)
        known = moving & np.isfinite(values)
        if not known.any():
            return
        t, values, held = signals.t[known], values[known], self.held.get(name)
        if held is not None:
            t, values = np.append(held.since, t), np.append(held.value, values)
        starts = np.append(0, np.flatnonzero(np.diff(values) != 0.0) + 1)
        times = np.append(t[starts[1:]], t[-1]) - t[starts]
        place = int(np.argmax(times))
        longest = float(times[place]), float(values[starts[place]]), float(t[starts[place]])
        if held is not None and held.longest[0] >= longest[0]:
            longest = held.longest
        self.held[name] = Held(float(values[starts[-1]]), float(t[starts[-1]]), longest)

    def _average(self, name: str, values: np.ndarray) -> None:
        """Take values into the mean and the sum of squares about it."""
        if not values.size:
            return
        mean = float(values.mean())
        number, squares = values.size, float(((values - mean) ** 2).sum())
        if name in self.offsets:
            before, other, others = self.offsets[name]
            number, apart = before + values.size, mean - other
            squares += others + apart * apart * before * values.size / number
            mean = other + apart * values.size / number
        self.offsets[name] = number, mean, squares

    def findings(self) -> list[Finding]:
        """Warnings on the rows so far."""
        found = [*self._holes(), *self._rests(), *self._silences(), *self._standstill_offsets()]
        if not self.fast:
            found.append(("vx", f"vx never exceeds {MIN_SPEED:g} m/s: sideslip cannot be judged in this log"))
        if not any(self.measured.get(name) for name in REFERENCES):
            found.append(
                ("beta_ref", "no ground truth: the log can be estimated, but not trained on or scored")
            )
        return [Finding("warning", column, message) for column, message in found]

    def _holes(self) -> list[tuple[str, str]]:
        shares = [
            (name, count / self.rows) for name, count in self.measured.items() if name not in REFERENCES
        ]
        return [
            (name, f"{name} has a value in only {share:.0%} of the rows")
            for name, share in shares
            if share < 0.5
        ]

    def _rests(self) -> list[tuple[str, str]]:
        found = []
        for name, (time, value, since) in ((name, held.longest) for name, held in self.held.items()):
            if time > STUCK_TIME:
                where = f"for {time:.0f} s in the moving car, from t = {since:.1f} s"
                found.append((name, f"{name} rests at {value:.4g} {UNITS[name]} {where}"))
        return found

    def _silences(self) -> list[tuple[str, str]]:
        long, short, longest = self.silences
        found = []
        if long:
            text = f"{long} gaps longer than {MAX_GAP:g} s, the longest {longest:.3g} s"
            found.append(("t", f"{text}: the filters begin anew after each"))
        if short:
            found.append(("t", f"{short} steps of {MAX_AGE:g} to {MAX_GAP:g} s: nothing is measured in them"))
        return found

    def _standstill_offsets(self) -> list[tuple[str, str]]:
        if self.still < 2.0:
            return []
        found = []
        for name, (number, mean, squares) in self.offsets.items():
            if number < 20 or abs(mean) <= max(STANDSTILL_OFFSETS[name], 4.0 * np.sqrt(squares) / number):
                continue
            cause = " (or the car stood on a slope)" if name == "ay" else ""
            mend = f"write in a channel map (`channel_map`): [channels.{name}] offset = {mean:.3g}"
            found.append(
                (name, f"{name} is {mean:.3g} {UNITS[name]} at standstill{cause}: to take it off {mend}")
            )
        return found


def _speed(signals: Signals) -> np.ndarray:
    if signals.has("vx"):
        return signals.column("vx")
    return 0.25 * (
        signals.column("vfl") + signals.column("vfr") + signals.column("vrl") + signals.column("vrr")
    )

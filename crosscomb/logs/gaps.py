"""What a log lacks: channels with holes, stuck channels, silences, standstill, offsets, ground truth."""

from __future__ import annotations

from dataclasses import dataclass
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


def check_gaps(signals: Signals) -> list[Finding]:
    """Warn of what weakens an estimate without being wrong.

    Parameters
    ----------
    signals : Signals
        The log as read.

    Returns
    -------
    list of Finding
        Warnings only.
    """
    warnings = [*_holes(signals), *_stuck(signals), *_silences(signals), *_standstill_offsets(signals)]
    speed = np.abs(_speed(signals))
    if not np.any(speed > MIN_SPEED):
        warnings.append(("vx", f"vx never exceeds {MIN_SPEED:g} m/s: sideslip cannot be judged in this log"))
    if not any(signals.has(name) for name in REFERENCES):
        warnings.append(
            ("beta_ref", "no ground truth: the log can be estimated, but not trained on or scored")
        )
    return [Finding("warning", column, message) for column, message in warnings]


def _speed(signals: Signals) -> np.ndarray:
    if signals.has("vx"):
        return signals.column("vx")
    return 0.25 * (
        signals.column("vfl") + signals.column("vfr") + signals.column("vrl") + signals.column("vrr")
    )


def _holes(signals: Signals) -> list[tuple[str, str]]:
    found = []
    for name in signals.frame.columns:
        share = float(signals.frame[name].notna().mean())
        if share < 0.5 and name not in REFERENCES:
            found.append((name, f"{name} has a value in only {share:.0%} of the rows"))
    return found


def _stuck(signals: Signals) -> list[tuple[str, str]]:
    found = []
    moving = np.abs(_speed(signals)) > MIN_SPEED
    for name in signals.frame.columns.drop("t"):
        values = signals.column(name)
        known = moving & np.isfinite(values)
        if name in REFERENCES or not known.any():
            continue
        t, values = signals.t[known], values[known]
        changes = np.flatnonzero(np.diff(values) != 0.0) + 1
        edges = np.concatenate([[0], changes, [len(values) - 1]])
        longest = int(np.argmax(np.diff(t[edges])))
        held = float(t[edges[longest + 1]] - t[edges[longest]])
        if held > STUCK_TIME:
            value, since = values[edges[longest]], t[edges[longest]]
            where = f"for {held:.0f} s in the moving car, from t = {since:.1f} s"
            found.append((name, f"{name} rests at {value:.4g} {UNITS[name]} {where}"))
    return found


def _silences(signals: Signals) -> list[tuple[str, str]]:
    steps = np.diff(signals.t)
    long, short = int(np.sum(steps > MAX_GAP)), int(np.sum((steps > MAX_AGE) & (steps <= MAX_GAP)))
    found = []
    if long:
        text = f"{long} gaps longer than {MAX_GAP:g} s, the longest {steps.max():.3g} s"
        found.append(("t", f"{text}: the filters begin anew after each"))
    if short:
        found.append(("t", f"{short} steps of {MAX_AGE:g} to {MAX_GAP:g} s: nothing is measured in them"))
    return found


def _standstill_offsets(signals: Signals) -> list[tuple[str, str]]:
    still = np.abs(_speed(signals)) < 0.1
    if float(np.diff(signals.t, append=signals.t[-1])[still].sum()) < 2.0:
        return []
    found = []
    for name, most in STANDSTILL_OFFSETS.items():
        values = signals.column(name)[still & np.isfinite(signals.column(name))]
        if values.size < 20 or abs(values.mean()) <= max(most, 4.0 * values.std() / np.sqrt(values.size)):
            continue
        mean, cause = values.mean(), " (or the car stood on a slope)" if name == "ay" else ""
        mend = f"write in a channel map (`channel_map`): [channels.{name}] offset = {mean:.3g}"
        found.append(
            (name, f"{name} is {mean:.3g} {UNITS[name]} at standstill{cause}: to take it off {mend}")
        )
    return found

"""Find channels that are plainly in the wrong unit or of the wrong sign, before a filter believes them.

Pairs of channels are tied by physics: ay to vx * yaw_rate, the steering angle to wheelbase * yaw_rate / vx, vx
to the wheels. A unit error of one channel puts every tie it is part of wrong by a known factor. The smallest
set of faults that puts all ties right is reported; where two sets do, both are named. A tie is used only where
the log excites it, so a quiet log raises nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.prepare import complete
from crosscomb.resample import MAX_AGE, MAX_GAP, resample
from crosscomb.signals import GRAVITY, MIN_SPEED, UNITS, WHEEL_SPEEDS, Signals

RATE = 20.0
"""Channels are compared at this rate [Hz], after a moving average of `SMOOTHING` samples."""
SMOOTHING = 9

DEGREE = np.pi / 180.0
LIMITS = {"vx": 120.0, "wheels": 120.0, "vx_ref": 120.0, "yaw_rate": 10.0, "steer": 1.5, "steer_wheel": 35.0}
"""No car goes beyond these in SI units for more than 2 % of a log."""

MOST_FAULTS = 3


@dataclass(frozen=True)
class Finding:
    """Something wrong (``error``) or worth a look (``warning``) in one column, with its mend, in one line."""

    severity: Literal["error", "warning"]
    column: str
    message: str


@dataclass(frozen=True)
class _Tie:
    """Two sides that physics ties: ``gain`` is their ratio as found, 1 when all is right."""

    text: str
    powers: dict[str, int]  # which channels the gain is made of, and how
    gain: float
    possible: tuple[float, float]  # gains outside cannot be right
    likely: tuple[float, float]  # gains that a set of faults must bring it back to
    column: str = ""  # channel whose size says whether the log excites the tie
    size: float = np.inf
    least_size: float = 0.0


@dataclass(frozen=True)
class _Fault:
    """One way for a channel to be wrong; multiplying by ``factor`` mends it."""

    channel: str
    factor: float
    looks: str
    mend: str


def check_units(signals: Signals, vehicle: Vehicle) -> list[Finding]:
    """Check a log's units, signs and coverage against physics and its own channels.

    Parameters
    ----------
    signals : Signals
        The log as read: columns that `crosscomb.prepare.complete` derives would only confirm themselves.
    vehicle : Vehicle
        Wheelbase, track and steering ratio are used; a similar car will do.

    Returns
    -------
    list of Finding
        Errors first. An error is plainly wrong and must be mended; a warning is worth a look.
    """
    slow = _time_unit(signals)
    if slow:
        return slow
    table = _smoothed(signals, vehicle)
    ties = [*_ties(signals, table, vehicle), *_limit_ties(signals)]
    sets = _explanations(ties, _faults(signals, vehicle))
    findings = _findings(sets, ties)
    findings += _reference_unit(signals, table, {fault.channel for faults in sets for fault in faults})
    return findings + coverage(signals)


def _time_unit(signals: Signals) -> list[Finding]:
    step = float(np.median(np.diff(signals.t)))
    if step < 0.5:
        return []
    unit = "ms" if step < 1e3 else "us" if step < 1e6 else "ns"
    message = (
        f"t looks like {unit}, not s: rows are {step:g} s apart (a log that slow is of no use): "
        f'write in a channel map (--map): [channels.t] unit = "{unit}"'
    )
    return [Finding("error", "t", message)]


def _smoothed(signals: Signals, vehicle: Vehicle) -> dict[str, np.ndarray]:
    """Low-passed channels on a regular grid, and the rates of vx and vy; long gaps are not bridged."""
    names = [name for name in signals.frame.columns if name != "t"]
    parts: list[dict[str, np.ndarray]] = []
    for segment in resample(signals, RATE):
        if len(segment.signals) < 2 * SMOOTHING:
            continue
        part = {name: _moving_average(segment.signals.column(name)) for name in names}
        part["wheels"] = np.mean([part.get(wheel, np.nan) for wheel in WHEEL_SPEEDS], axis=0)
        if not signals.has("vx"):
            part["vx"] = part["wheels"] * np.ones(len(segment.signals))
        part["vx_rate"] = np.gradient(part["vx"]) * RATE
        part["vy_rate"] = np.gradient(part["vx"] * part.get("beta_ref", np.nan)) * RATE
        parts.append(part)
    return {name: np.concatenate([part[name] * np.ones_like(part["vx"]) for part in parts]) for name in parts[0]}

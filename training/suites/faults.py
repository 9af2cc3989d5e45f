"""Faults of sensors, stamps, cars and filters: what the campaign of faults puts into sound logs.

A fault of the signals is a pure function of a log and the time of its onset: rows before the onset stay as they are.
What it gives is as a logger would have written it, stamps that repeat included: it has not passed a reader's checks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY, WHEEL_SPEEDS, Signals

Change = Callable[[Signals, float], Signals]

CHANNELS = ("ax", "ay", "yaw_rate", "steer", "vx")
WHEELS = ("vfl", "vrr")
"""Wheels that faults are put on: one of each axle and side stands for its neighbours."""

BIASES = {"ax": 0.5, "ay": 0.5, "yaw_rate": math.radians(2.0), "steer": math.radians(1.0), "vx": 1.0}
"""Offsets [SI]; a slow drift reaches three times as much."""

SPIKES = {
    "ax": 100.0,
    "ay": 100.0,
    "yaw_rate": 3.0,
    "steer": 1.0,
    "vx": 50.0,
    **dict.fromkeys(WHEEL_SPEEDS, 50.0),
}
"""What a spike adds [SI]."""

ABSURD = {"ax": 1e154, "ay": 1e154, "yaw_rate": 571.9, "steer": 57.3, "vx": 655.35}
"""Values that a broken frame on a bus, or 0xFFFF with its scale, comes to [SI]."""

TEN, TEN_APART = 10, 0.2
"""Spikes in a row, and the time from one to the next [s]."""

DRIFT_TIME, DRIFT_SIZE = 20.0, 3.0
"""Time in which a slow drift reaches its size [s], and that over a bias."""

LATENCY = 0.1
"""[s]"""
NOISE = 10.0
"""Noise of a noisy second over the channel's own."""
JITTER = 0.2
"""Of the step to the neighbouring rows."""
GAP = 3.0
"""[s]"""
BANK = math.radians(5.0)
SCALE = 1.2
ROUNDING = 1e-6
"""Stamps this close are the same [s]."""


def _heavier(car: Vehicle, factor: float) -> Vehicle:
    return car.model_copy(update={"mass": factor * car.mass})


def _softer(car: Vehicle) -> Vehicle:
    stiffness = "cornering_stiffness_front", "cornering_stiffness_rear"
    return car.model_copy(update={name: 0.5 * getattr(car, name) for name in stiffness})


def _more_slippery(car: Vehicle) -> Vehicle:
    return car.model_copy(update={"friction": 0.5 * car.friction})


VEHICLE_FAULTS: dict[str, Callable[[Vehicle], Vehicle]] = {
    "mass +20 %": partial(_heavier, factor=1.2),
    "mass -20 %": partial(_heavier, factor=0.8),
    "stiffness halved": _softer,
    "friction halved": _more_slippery,
}
"""What the vehicle file says instead of the truth."""

DIVERGING: dict[str, dict[str, Any]] = {
    "kinematic_kf": {"speed": 1e3, "rolling": 1e3, "rear_slip": 10.0, "accel_bias": 1e-6},
    "dynamic_ekf": {"slip_rate": 100.0, "ay": 1e-3},
    "random_walk_pf": {"slip_rate": 30.0, "pseudo": 1e3},
}
"""Noise settings with which a filter runs away."""


def unsigned_speed(log: Signals) -> Signals:
    """The speed as a sensor without direction gives it."""
    wheels = {name: np.abs(log.column(name)) for name in WHEEL_SPEEDS if log.has(name)}
    return log.with_columns("", vx=np.abs(log.column("vx")), **wheels)


@dataclass(frozen=True)
class Fault:
    """One fault of the signals.

    Attributes
    ----------
    kind : str
        Row of the table of results.
    channel : str
        The channel it is on; ``t`` is that of the stamps, ``rows`` that of whole rows.
    change : callable
        Gives the faulty log of a sound one and the time of the onset [s].
    lasts : float
        Time from the onset to the return [s]; infinite where it is for good.
    """

    kind: str
    channel: str
    change: Change
    lasts: float


def hit(t: np.ndarray, onset: float, lasts: float) -> np.ndarray:
    """Rows ``(n,) bool`` from the onset on, until it is over [s]."""
    return (t >= onset) & (t < onset + lasts)


def put(log: Signals, onset: float, channel: str, value: float, lasts: float) -> Signals:
    """Put a constant, NaN for a dropout, in the place of a channel's values."""
    values = log.column(channel).copy()
    values[hit(log.t, onset, lasts)] = value
    return log.with_columns("", **{channel: values})


def stick(log: Signals, onset: float, channel: str, lasts: float = math.inf) -> Signals:
    """Hold a channel's last value before the onset."""
    before = log.column(channel)[log.t < onset]
    known = before[np.isfinite(before)]
    return put(log, onset, channel, float(known[-1]) if known.size else 0.0, lasts)


def spike(log: Signals, onset: float, channel: str, size: float, count: int = 1) -> Signals:
    """Add a size to single rows of a channel, `TEN_APART` from one another."""
    values = log.column(channel).copy()
    rows = np.searchsorted(log.t, onset + TEN_APART * np.arange(count))
    values[rows[rows < len(values)]] += size
    return log.with_columns("", **{channel: values})


def once(log: Signals, onset: float, channel: str, value: float) -> Signals:
    """Put a value into a single row of a channel."""
    values = log.column(channel).copy()
    values[np.searchsorted(log.t, onset)] = value
    return log.with_columns("", **{channel: values})


def shift(log: Signals, onset: float, channel: str, size: float, rise: float = 0.0) -> Signals:
    """Add an offset to a channel, at once or as a ramp over a time [s]."""
    after = log.t - onset
    share = np.minimum(after / rise, 1.0) if rise else np.ones(len(log))
    return log.with_columns("", **{channel: log.column(channel) + np.where(after >= 0.0, share * size, 0.0)})


def scale(log: Signals, onset: float, channel: str, factor: float) -> Signals:
    """Multiply a channel; -1 flips its sign."""
    factors = np.where(log.t >= onset, factor, 1.0)
    return log.with_columns("", **{channel: log.column(channel) * factors})


def delay(log: Signals, onset: float, channel: str, latency: float) -> Signals:
    """Give at each row what the channel showed a while [s] ago."""
    ago = np.maximum(np.searchsorted(log.t, log.t - latency + ROUNDING, side="right") - 1, 0)
    values = log.column(channel)
    return log.with_columns("", **{channel: np.where(log.t >= onset, values[ago], values)})


def noise_of(values: np.ndarray) -> float:
    """Standard deviation of the white noise in a channel ``(n,)``, from the median of its second differences.

    Second differences of white noise have six times its variance; slow motion leaves little in them, and single
    jumps do not move a median. Where more than half of them are zero (a coarse step) their mean size counts.
    """
    second = np.diff(values, n=2)
    second = np.abs(second[np.isfinite(second)])
    if not second.size:
        return 0.0
    return float(1.4826 * np.median(second) or second.mean()) / math.sqrt(6.0)


def roughen(log: Signals, onset: float, channel: str, factor: float, lasts: float) -> Signals:
    """Add white noise that makes the channel's own so many times larger."""
    values = log.column(channel)
    size = math.sqrt(factor**2 - 1.0) * noise_of(values)
    noise = size * np.random.default_rng(14).normal(size=len(log))
    return log.with_columns("", **{channel: values + np.where(hit(log.t, onset, lasts), noise, 0.0)})


def jitter(log: Signals, onset: float, share: float) -> Signals:
    """Move stamps by up to a share of the step to the nearer neighbour, to either side."""
    steps = np.diff(log.t)
    room = np.minimum(np.append(steps[:1], steps), np.append(steps, steps[-1:]))
    moved = log.t + share * room * np.random.default_rng(14).uniform(-1.0, 1.0, len(log))
    return log.with_columns(t=np.where(log.t >= onset, np.maximum(moved, onset), log.t))


def silence(log: Signals, onset: float, lasts: float) -> Signals:
    """Leave rows out."""
    return _keep(log, log.frame[~hit(log.t, onset, lasts)])


def restamp(log: Signals, onset: float, back: int) -> Signals:
    """Give a single row the stamp of the row before (1), or of the one before that (2): time runs backwards."""
    t = log.t.copy()
    row = int(np.searchsorted(t, onset)) + back
    t[row] = t[row - back]
    return log.with_columns(t=t)


def cut_last(log: Signals, onset: float) -> Signals:
    """Leave only the stamp of the last row, as a logger that lost its power does."""
    frame = log.frame.copy()
    frame.loc[frame.index[-1], [name for name in frame.columns if name != "t"]] = np.nan
    return _keep(log, frame)


def repeat_last(log: Signals, onset: float) -> Signals:
    """Write the last row twice."""
    return _keep(log, pd.concat([log.frame, log.frame.tail(1)]))


def tilt(log: Signals, onset: float, bank: float) -> Signals:
    """Bank the road [rad]: the accelerometer feels gravity."""
    return shift(log, onset, "ay", GRAVITY * math.sin(bank))


def _keep(log: Signals, frame: pd.DataFrame) -> Signals:
    return replace(log, frame=frame.reset_index(drop=True))


def signal_faults(log: Signals) -> list[Fault]:
    """All faults of the signals that make sense for a log.

    Parameters
    ----------
    log : Signals
        Wheel speeds have faults where it has them.
    """
    of_channels = [fault for channel in CHANNELS if log.has(channel) for fault in _of_channel(channel)]
    of_wheels = [fault for wheel in WHEELS if log.has(wheel) for fault in _missing_or_wild(wheel)]
    return [
        *of_channels,
        *of_wheels,
        Fault("jitter 20 %", "t", partial(jitter, share=JITTER), math.inf),
        Fault("gap of 3 s", "t", partial(silence, lasts=GAP), GAP),
        Fault("repeated stamp", "t", partial(restamp, back=1), 0.0),
        Fault("stamp backwards", "t", partial(restamp, back=2), 0.0),
        Fault("cut last row", "rows", cut_last, math.inf),
        Fault("repeated last row", "rows", repeat_last, math.inf),
        Fault("bank 5 deg", "ay", partial(tilt, bank=BANK), math.inf),
    ]


def _on(channel: str, kind: str, change: Callable[..., Signals], until: float, **settings: float) -> Fault:
    return Fault(kind, channel, partial(change, channel=channel, **settings), until)


def _missing_or_wild(channel: str) -> list[Fault]:
    """Faults that any measured channel may have."""
    of, size = partial(_on, channel), SPIKES[channel]
    return [
        of("dropout 0.1 s", put, 0.1, value=math.nan, lasts=0.1),
        of("dropout 2 s", put, 2.0, value=math.nan, lasts=2.0),
        of("dropout for good", put, math.inf, value=math.nan, lasts=math.inf),
        of("stuck", stick, math.inf),
        of("one spike", spike, 0.0, size=size),
        of("ten spikes", spike, TEN_APART * (TEN - 1), size=size, count=TEN),
    ]


def _of_channel(channel: str) -> list[Fault]:
    """Faults of a channel that the filters live on."""
    of, size = partial(_on, channel), BIASES[channel]
    return [
        *_missing_or_wild(channel),
        of("absurd value", once, 0.0, value=ABSURD[channel]),
        of("NaN for 1 s", put, 1.0, value=math.nan, lasts=1.0),
        of("infinity for 1 s", put, 1.0, value=math.inf, lasts=1.0),
        of("bias", shift, math.inf, size=size),
        of("slow drift", shift, math.inf, size=DRIFT_SIZE * size, rise=DRIFT_TIME),
        of("scale 1.2", scale, math.inf, factor=SCALE),
        of("100 ms late", delay, math.inf, latency=LATENCY),
        of("noise x 10", roughen, 1.0, factor=NOISE, lasts=1.0),
        of("sign flip", scale, math.inf, factor=-1.0),
    ]

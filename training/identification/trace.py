"""One log as identification needs it: a regular grid, smooth without delay, and the rows that count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.signal import butter, sosfiltfilt

from crosscomb.logs.prepare import speed_from_wheels
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import MIN_SPEED, Signals

RATE = 100.0
"""Working rate [Hz]: ten times the frequencies in which a car answers its steering."""
CUT_OFF = 4.0
"""Everything above [Hz] is taken out of all channels alike, so that they keep their phase to each other."""
LONGEST_GAP = 0.15  # [s] a longer one is not bridged
SETTLING = 0.8  # [s] of the model, after a start or a slide
NORMAL_AY = 8.0
"""Lateral acceleration [m/s^2] up to which the single track holds on a dry road; beyond, everything slides."""
MOST_AX = 3.0  # [m/s^2] under harder braking or drive the single track is wrong
STANDSTILL_SPEED = 0.15  # [m/s] some speed sensors rest above zero
ENDS = 16
"""Rows left out at the end of a stretch: more than the largest latency."""
DERIVED = 1e-3
"""steer made of steer_wheel follows it to this share of its spread."""


@dataclass(frozen=True)
class Trace:
    """A log on a regular grid. All arrays ``(n,)``, SI units, smoothed with zero phase.

    Attributes
    ----------
    name : str
    t : [s]
    vx, ax, ay, yaw_rate, steer_rear
        Speed, accelerations as felt (ax NaN where it was not measured), yaw rate, rear road-wheel angle.
    hand : [rad]
        Hand-wheel angle where `ratio_open`, else the road-wheel angle as measured.
    beta : [rad]
        Ground truth; NaN where there is none.
    ratio_open : bool
        The steering ratio may be found from this log.
    normal : bool
        Rows below the limit, in which the single track holds.
    wild : bool
        Rows with any lateral acceleration.
    """

    name: str
    t: np.ndarray
    vx: np.ndarray
    ax: np.ndarray
    ay: np.ndarray
    yaw_rate: np.ndarray
    hand: np.ndarray
    steer_rear: np.ndarray
    beta: np.ndarray
    ratio_open: bool
    normal: np.ndarray
    wild: np.ndarray


def make_trace(signals: Signals, vehicle: Vehicle, use_reference: bool = True) -> Trace | None:
    """Prepare one log; None where it holds no driving that says anything.

    Parameters
    ----------
    signals : Signals
        As measured; steer need not be completed.
    vehicle : Vehicle
        Its tracks make vx from wheel speeds where the log has no vx.
    use_reference : bool
        Keep the ground truth.
    """
    steer, ratio_open = steering(signals)
    if not signals.has("vx"):
        moving = signals.with_columns(steer=steer / vehicle.steering_ratio if ratio_open else steer)
        signals = signals.with_columns(vx=speed_from_wheels(moving, vehicle))
    tau = signals.t - signals.t[0]
    grid = np.arange(0.0, tau[-1], 1.0 / RATE)
    if len(grid) < 3.0 * RATE:
        return None
    there = np.ones(len(grid), dtype=bool)

    def channel(values: np.ndarray, needed: bool = False) -> np.ndarray:
        nonlocal there
        known = np.isfinite(values)
        if known.sum() < 2:
            if needed:
                there[:] = False
            return np.full(len(grid), np.nan)
        if needed:
            there &= near_samples(tau[known], grid)
        return low_pass(tau[known], values[known], grid)

    vx, yaw_rate = channel(signals.column("vx"), True), channel(signals.column("yaw_rate"), True)
    ay, hand = channel(signals.column("ay"), True), channel(steer, True)
    rear = np.nan_to_num(channel(signals.column("steer_rear")))
    ax = channel(signals.column("ax"))
    beta = np.full(len(grid), np.nan)
    if use_reference and signals.has_reference:
        truth = signals.beta_ref
        known = np.isfinite(truth) & (signals.column("vx") > MIN_SPEED)
        beta = np.where(near_samples(tau[known], grid), low_pass(tau[known], truth[known], grid), np.nan)
    drivable = there & (vx > MIN_SPEED + 0.5) & (np.abs(np.gradient(vx, grid)) < MOST_AX)
    if not drivable.any():
        return None
    return Trace(
        name=signals.name, t=grid, vx=vx, ax=ax, ay=ay, yaw_rate=yaw_rate, hand=hand, steer_rear=rear, beta=beta,
        ratio_open=ratio_open, normal=drivable & (np.abs(ay) < NORMAL_AY), wild=drivable,
    )  # fmt: skip


def steering(signals: Signals) -> tuple[np.ndarray, bool]:
    """Steering angle that was measured ``(n,) [rad]``, and whether it is the hand wheel's."""
    if not signals.has("steer"):
        return signals.column("steer_wheel"), True
    steer, wheel = signals.column("steer"), signals.column("steer_wheel")
    both = np.isfinite(steer) & np.isfinite(wheel)
    if both.sum() < 10 or np.std(wheel[both]) == 0.0:
        return steer, False
    slope, level = np.polyfit(wheel[both], steer[both], 1)
    left = np.std(steer[both] - slope * wheel[both] - level)
    derived = left < DERIVED * np.std(steer[both])
    return (wheel, True) if derived else (steer, False)


def near_samples(tau: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Tell for each grid time whether it lies in no gap of the samples ``(n,)``."""
    newer = np.clip(np.searchsorted(tau, grid), 1, len(tau) - 1)
    inside = (grid >= tau[0] - 1e-9) & (grid <= tau[-1] + 1e-9)
    return inside & (tau[newer] - tau[newer - 1] <= LONGEST_GAP)


def low_pass(tau: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Values at the grid times without what is above `CUT_OFF`, with zero phase.

    Parameters
    ----------
    tau, values : ndarray
        Samples ``(m,)``; gaps are bridged by straight lines.
    grid : ndarray
        ``(n,) [s]`` at `RATE`.
    """
    # The filter runs near the log's own rate: thinning first would fold vibration into the answer.
    step = min(max(float(np.median(np.diff(tau))), 0.002), 1.0 / RATE)
    fine = np.arange(min(grid[0], tau[0]), grid[-1] + step, step)
    sos = butter(2, CUT_OFF * 2.0 * step, output="sos")
    smooth = sosfiltfilt(sos, np.interp(fine, tau, values), padlen=min(int(0.5 / step), len(fine) - 2))
    return np.interp(grid, fine, smooth)


def standstill(signals: Signals, shortest: float = 1.0) -> np.ndarray:
    """Rows ``(n,)`` in which the car stands for at least `shortest` seconds, its ends left out."""
    still = np.nan_to_num(np.abs(signals.column("vx")), nan=9.9) < STANDSTILL_SPEED
    dt = float(np.median(np.diff(signals.t)))
    ends = max(int(0.3 / dt), 1)
    core = binary_erosion(still, iterations=ends)
    long = binary_erosion(core, iterations=max(int((shortest / 2.0) / dt), 1))
    return binary_dilation(long, iterations=-1, mask=core) if long.any() else np.zeros_like(still)


def settled(running: np.ndarray) -> np.ndarray:
    """Rows ``(n,)`` of the stretches in which the model has run for a while and goes on running.

    The last rows of a stretch would compare with a model that no longer runs where a channel is early.
    """
    rows = np.arange(len(running))
    last_still = np.maximum.accumulate(np.where(running, -1, rows))
    since = np.where(last_still < 0, rows, rows - last_still)
    return binary_erosion(running, iterations=ENDS) & (since > SETTLING * RATE)

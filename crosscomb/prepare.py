"""Make the columns that a log lacks from those it has, causally."""

from __future__ import annotations

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import WHEEL_SPEEDS, Signals

SPEED_SLOPE_WINDOW = 0.15
"""Length of the line fitted to vx for ax [s]: a shorter one is noisy on wheel speeds, a longer one late."""


def complete(signals: Signals, vehicle: Vehicle) -> Signals:
    """Add the columns steer, vx and ax where the log lacks them, with a note for each.

    Row i depends on rows up to i only. A column that holds any measurement is left as it is.

    Parameters
    ----------
    signals : Signals
        One log.
    vehicle : Vehicle
        Its steering ratio and tracks are used.

    Returns
    -------
    Signals
        The log with steer [rad], vx [m/s] and ax [m/s^2].
    """
    if not signals.has("steer"):
        signals = signals.with_columns(
            f"steer made from steer_wheel and the steering ratio {vehicle.steering_ratio:g}",
            steer=signals.column("steer_wheel") / vehicle.steering_ratio,
        )
    if not signals.has("vx"):
        signals = signals.with_columns(
            "vx made from the wheel speeds, yaw rate and steering angle",
            vx=speed_from_wheels(signals, vehicle),
        )
    if not signals.has("ax"):
        signals = signals.with_columns(
            f"ax is missing: the slope of vx over the last {SPEED_SLOPE_WINDOW:g} s is taken instead",
            ax=causal_slope(signals.t, signals.column("vx"), SPEED_SLOPE_WINDOW),
        )
    return signals


def speed_from_wheels(signals: Signals, vehicle: Vehicle) -> np.ndarray:
    """Longitudinal speed of the centre of gravity ``(n,) [m/s]`` as the mean of the wheels.

    Each wheel's speed is first moved to the centre line: in a left turn (ISO 8855, yaw rate > 0) the left
    wheels are the slower ones. A wheel without a measurement is left out of the mean. Di Biase 2020,
    eq. 61 to 64.
    """
    yaw_rate = signals.column("yaw_rate")
    ahead = np.cos(signals.column("steer"))
    front, rear = 0.5 * vehicle.track_front, 0.5 * vehicle.track_rear
    vfl, vfr, vrl, vrr = (signals.column(wheel) for wheel in WHEEL_SPEEDS)
    moved = np.stack(
        [
            vfl * ahead + yaw_rate * front,
            vfr * ahead - yaw_rate * front,
            vrl + yaw_rate * rear,
            vrr - yaw_rate * rear,
        ]
    )
    known = np.isfinite(moved)
    total = np.where(known, moved, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def causal_slope(t: np.ndarray, values: np.ndarray, window: float) -> np.ndarray:
    """Slope of the least-squares line through the newest samples at each row.

    The line goes through the samples of the last `window` seconds and through at least the last three, none
    of them older than five windows. It describes the middle of its samples, about half a window ago.

    Parameters
    ----------
    t : ndarray
        Increasing time ``(n,) [s]``, any spacing.
    values : ndarray
        ``(n,)``; NaN where nothing was measured.
    window : float
        [s].

    Returns
    -------
    ndarray
        ``(n,)`` [unit of values per s]; NaN where the value is missing or fewer than three samples are near.
    """
    measured = np.flatnonzero(np.isfinite(values))
    slope = np.full(values.shape, np.nan)
    tau, x = t[measured] - t[0], values[measured]
    rounding = 1e-6 * window
    first = np.searchsorted(tau, tau - window - rounding)
    first = np.minimum(first, np.arange(tau.size) - 2)
    longest = int(np.max(np.arange(tau.size) - first, initial=2)) + 1

    # Sums over sample i - back, taken relative to sample i: no digits are lost however long the log is.
    count, sum_t, sum_x, sum_tt, sum_tx = np.zeros((5, tau.size))
    for back in range(longest):
        old = np.arange(tau.size) - back
        dt = np.where(old >= 0, tau[old], -np.inf) - tau
        used = (old >= first) & (dt >= -5.0 * window - rounding)
        dt = np.where(used, dt, 0.0)
        dx = np.where(used, x[old] - x, 0.0)
        count += used
        sum_t += dt
        sum_x += dx
        sum_tt += dt * dt
        sum_tx += dt * dx
    enough = count >= 3
    spread = np.where(enough, count * sum_tt - sum_t**2, 1.0)
    slope[measured] = np.where(enough, (count * sum_tx - sum_t * sum_x) / spread, np.nan)
    return slope

"""How often the state of handling is right, on logs whose true axle slips are known."""

from __future__ import annotations

import numpy as np
import pandas as pd

from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.estimate import LogEstimate
from crosscomb.run.handling import STATES, axle_slips
from crosscomb.signals import MIN_SPEED, Signals

CLEAR = np.radians(3.0)
"""From this difference of the true slip angles on [rad] one axle clearly slips more than the other."""

EQUAL = np.radians(1.0)
"""Below this difference [rad] the car is clearly neutral; what lies between may be called either way."""


def true_slips(log: Signals, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Slip angles of the front and rear axle ``(n,) [rad]`` from the log's ground truth; NaN at low speed.

    Parameters
    ----------
    log : Signals
        With vx_ref and vy_ref, and with yaw rate and steering angle without errors.
    vehicle : Vehicle
    """
    log = complete(log, vehicle)
    vx, beta, yaw_rate = log.column("vx_ref"), log.beta_ref, log.column("yaw_rate")
    steer, steer_rear = log.column("steer"), np.nan_to_num(log.column("steer_rear"))
    slips = np.full((2, len(log)), np.nan)
    for k in np.flatnonzero((vx > MIN_SPEED) & np.isfinite(beta)):
        slips[:, k] = axle_slips(
            beta[k], vx[k], yaw_rate[k] / vx[k], steer[k], steer_rear[k],
            vehicle.cg_to_front_axle, vehicle.cg_to_rear_axle,
        )  # fmt: skip
    return slips[0], slips[1]


def true_states(log: Signals, vehicle: Vehicle) -> np.ndarray:
    """True state of each row ``(n,) str``: neutral, understeer, oversteer; empty where it is not clear."""
    front, rear = true_slips(log, vehicle)
    understeer = np.abs(front) - np.abs(rear)
    clear = [understeer > CLEAR, understeer < -CLEAR, np.abs(understeer) < EQUAL]
    return np.select(clear, ["understeer", "oversteer", "neutral"], "")


def count_states(estimate: LogEstimate, truth: np.ndarray) -> pd.DataFrame:
    """Rows by true state ``(n,) str`` and estimated one; rows that are not clear are left out."""
    clear = truth != ""
    counts = pd.crosstab(truth[clear], estimate.handling.state[clear])
    return counts.reindex(index=["neutral", "understeer", "oversteer"], columns=STATES, fill_value=0)

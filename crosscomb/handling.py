"""Does the car understeer or oversteer: slip angles of both axles, and a word that does not chatter.

The axle that slips more gives the word. That difference hardly depends on beta while both axles slip to the
same side, as an error of beta moves both: it is known better than either slip angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from crosscomb.filters.base import MAX_BETA, STEER, STEER_REAR
from crosscomb.models.single_track import slip_angles
from crosscomb.models.vehicle import Vehicle
from crosscomb.motion import Motion
from crosscomb.signals import MIN_SPEED

NEUTRAL, UNDERSTEER, OVERSTEER, SLIDE, UNKNOWN = range(5)
STATES = ("neutral", "understeer", "oversteer", "slide", "unknown")
"""Word of each state: neither axle slips much more than the other; the front; the rear; both are far beyond grip
and neither more; it cannot be told."""

ENTER = math.radians(2.0)
"""From this difference of the slip angles on [rad] the car understeers or oversteers. The shipped cars in everyday
bends (4 m/s^2) stay below 1 deg."""

LEAVE = math.radians(1.2)
"""Below this difference [rad] it no longer does."""

SLIDING = math.radians(12.0)
"""Both axles beyond this slip angle [rad]: no tyre on any road has more grip to give there."""

CONFIRM = 0.1
"""A new state must stand this long [s] before it is said."""

MOST_YAW_AGE_DOUBT = 0.1
"""With more doubt about a missing yaw rate than this [rad/s] (0.2 s) nothing is said."""


class Handling(NamedTuple):
    """Slip of the axles and what it says.

    Attributes
    ----------
    slip_front, slip_rear : (n,) [rad]
        Slip angle of each axle, positive where it pushes to the left; NaN where the state is unknown for want of
        speed or signals.
    understeer : (n,) [rad]
        Magnitude of the front slip angle less that of the rear one; at small angles the textbook's steering angle
        less wheelbase over radius. Negative: oversteer.
    state : (n,) int or str
        Place in `STATES`, or its word.
    """

    slip_front: np.ndarray
    slip_rear: np.ndarray
    understeer: np.ndarray
    state: np.ndarray


def start_handling() -> np.ndarray:
    """State, candidate, and samples that the candidate stands ``(3,)``, before the first sample of a drive."""
    return np.array([UNKNOWN, UNKNOWN, 0])


def handling_of(
    memory: np.ndarray,
    samples: np.ndarray,
    beta: np.ndarray,
    beta_std: np.ndarray,
    motion: Motion,
    valid: np.ndarray,
    vehicle: Vehicle,
    dt: float,
) -> Handling:
    """Slip angles and state at the next samples of a drive.

    Parameters
    ----------
    memory : (3,) int
        Changed in place.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    beta, beta_std : (n,) [rad]
    motion : Motion
    valid : (n,) bool
        False where the estimate is not to be used.
    vehicle : Vehicle
    dt : float [s]
    """
    out, state = np.empty((3, len(beta))), np.empty(len(beta), dtype=np.int64)
    arms = vehicle.cg_to_front_axle, vehicle.cg_to_rear_axle
    _handling_run(memory, samples, beta, beta_std, *motion, valid, *arms, round(CONFIRM / dt), out, state)
    return Handling(*out, state)


@njit(cache=True)
def axle_slips(beta, vx, curvature, steer, steer_rear, a, b):
    """Slip angles of the front and rear axle [rad]; one formula for filters and handling."""
    both = slip_angles(curvature * vx, math.tan(beta), vx, steer, steer_rear, a, b)
    return both[0], both[1]


@njit(cache=True)
def _raw_state(front, rear, margin_front, margin_rear):
    """State that slip angles speak for, with the margins beyond which one axle slips more than the other."""
    understeer = abs(front) - abs(rear)
    if understeer > margin_front:
        return UNDERSTEER
    if understeer < -margin_rear:
        return OVERSTEER
    return SLIDE if min(abs(front), abs(rear)) > SLIDING else NEUTRAL


@njit(cache=True)
def _spoken_for(now, beta, beta_std, vx, curvature, steer, steer_rear, a, b):
    """State that one sample speaks for, now being the state; unknown where one standard deviation turns it over."""
    margin_front = LEAVE if now == UNDERSTEER else ENTER
    margin_rear = LEAVE if now == OVERSTEER else ENTER
    front, rear = axle_slips(beta, vx, curvature, steer, steer_rear, a, b)
    state = _raw_state(front, rear, margin_front, margin_rear)
    for side in (-1.0, 1.0):
        other_beta = min(max(beta + side * beta_std, -MAX_BETA), MAX_BETA)
        f, r = axle_slips(other_beta, vx, curvature, steer, steer_rear, a, b)
        far = abs((abs(f) - abs(r)) - (abs(front) - abs(rear))) > ENTER
        if far and _raw_state(f, r, margin_front, margin_rear) != state:
            return front, rear, UNKNOWN
    return front, rear, state


@njit(cache=True)
def _handling_run(
    memory, samples, beta, beta_std, vx, curvature, curvature_std, valid, a, b, confirm, out, state
):
    for k in range(beta.size):
        if not vx[k] > MIN_SPEED or curvature_std[k] * vx[k] > MOST_YAW_AGE_DOUBT or not valid[k]:
            memory[0], memory[1], memory[2] = UNKNOWN, UNKNOWN, 0
            out[0, k], out[1, k], out[2, k] = math.nan, math.nan, math.nan
            state[k] = UNKNOWN
            continue
        front, rear, wanted = _spoken_for(
            memory[0],
            beta[k],
            beta_std[k],
            vx[k],
            curvature[k],
            samples[k, STEER],
            samples[k, STEER_REAR],
            a,
            b,
        )
        memory[2] = memory[2] + 1 if wanted == memory[1] else 1
        memory[1] = wanted
        if memory[2] > confirm:
            memory[0] = wanted
        out[0, k], out[1, k], out[2, k] = front, rear, abs(front) - abs(rear)
        state[k] = memory[0]

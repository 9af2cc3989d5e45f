"""Does the car understeer or oversteer: slip angles of both axles, and a word that does not chatter.

The axle that slips more towards the outside of the turn gives the word. That difference hardly depends on beta, as an
error of beta moves both slip angles alike: the word is known better than either of them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import MAX_BETA
from crosscomb.models.compiled import kernel
from crosscomb.models.single_track import slip_angles
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.motion import Motion
from crosscomb.signals import MIN_SPEED

NEUTRAL, UNDERSTEER, OVERSTEER, COUNTERSTEER, UNKNOWN = range(5)
STATES = ("neutral", "understeer", "oversteer", "countersteer", "unknown")
"""Word of each state: neither axle slips much more than the other; the front does; the rear does; the rear does and
the front wheels point out of the turn; it cannot be told."""

ENTER = math.radians(2.0)
"""From this difference of the slip angles on [rad] the car understeers or oversteers. The shipped cars in everyday
bends (4 m/s^2) stay below 1 deg."""

LEAVE = math.radians(1.2)
"""Below this difference [rad] it no longer does."""

COUNTER = math.radians(1.0)
"""Steering against the yaw rate by more than this [rad] is countersteering."""

SIDE = 1.0
"""Below this magnitude of ay [m/s^2] the side of the turn is ever less sure, and the difference counts ever less."""

CONFIRM = 0.1
"""A new state must stand this long [s] before it is said."""

MOST_YAW_AGE_DOUBT = 0.1
"""With more doubt about a missing yaw rate than this [rad/s] (0.2 s) nothing is said."""


class Handling(NamedTuple):
    """Slip of the axles and what it says.

    Attributes
    ----------
    slip_front, slip_rear : (n,) or float [rad]
        Slip angle of each axle, positive where it pushes to the left; NaN where the state is unknown for want of
        speed or signals.
    understeer : (n,) or float [rad]
        Slip angle of the front axle less that of the rear one, positive where the front slips more to the outside of
        the turn; at small angles the textbook's steering angle less wheelbase over radius. Negative: oversteer.
    state : (n,) int or str, or one of them
        Place in `STATES`, or its word.
    """

    slip_front: Any
    slip_rear: Any
    understeer: Any
    state: Any


class HandlingState(NamedTuple):
    """State of the words of one drive, changed in place by the kernel."""

    said: np.ndarray  # (3,) state, candidate, and samples that the candidate stands
    ay: np.ndarray  # (1,) last ay [m/s^2]


def start_handling() -> HandlingState:
    """Make the state before the first sample of a drive."""
    return HandlingState(np.array([UNKNOWN, UNKNOWN, 0]), np.zeros(1))


def handling_of(
    memory: HandlingState,
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
    memory : HandlingState
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
    front, rear, understeer = out
    return Handling(front, rear, understeer, state)


@kernel
def axle_slips(beta, vx, curvature, steer, steer_rear, a, b):
    """Slip angles of the front and rear axle [rad]; one formula for filters and handling."""
    both = slip_angles(curvature * vx, math.tan(beta), vx, steer, steer_rear, a, b)
    return both[0], both[1]


@kernel
def _raw_state(now, understeer, against):
    """State that one sample speaks for, `now` being the state; `against` is steering against the yaw rate [rad]."""
    if understeer > (LEAVE if now == UNDERSTEER else ENTER):
        return UNDERSTEER
    if understeer < -(LEAVE if now in (OVERSTEER, COUNTERSTEER) else ENTER):
        return COUNTERSTEER if against > COUNTER else OVERSTEER
    return NEUTRAL


@kernel
def _spoken_for(now, side, beta, beta_std, vx, curvature, steer, steer_rear, a, b):
    """Slip angles and state of one sample; the state is unknown where one standard deviation of beta turns it over."""
    against = -math.copysign(steer, steer * curvature)
    front, rear = axle_slips(beta, vx, curvature, steer, steer_rear, a, b)
    state = _raw_state(now, side * (front - rear), against)
    for sign in (-1.0, 1.0):
        other_beta = min(max(beta + sign * beta_std, -MAX_BETA), MAX_BETA)
        f, r = axle_slips(other_beta, vx, curvature, steer, steer_rear, a, b)
        far = abs((f - r) - (front - rear)) > ENTER
        if far and _raw_state(now, side * (f - r), against) != state:
            return front, rear, UNKNOWN
    return front, rear, state


@kernel
def _handling_run(
    memory, samples, beta, beta_std, vx, curvature, curvature_std, valid, a, b, confirm, out, state
):
    said = memory.said
    for k in range(beta.size):
        sample = samples[k]
        if math.isfinite(sample[at.AY]):
            memory.ay[0] = sample[at.AY]
        if not vx[k] > MIN_SPEED or curvature_std[k] * vx[k] > MOST_YAW_AGE_DOUBT or not valid[k]:
            said[0], said[1], said[2] = UNKNOWN, UNKNOWN, 0
            out[0, k], out[1, k], out[2, k] = math.nan, math.nan, math.nan
            state[k] = UNKNOWN
            continue
        side = min(max(memory.ay[0] / SIDE, -1.0), 1.0)
        front, rear, wanted = _spoken_for(
            said[0],
            side,
            beta[k],
            beta_std[k],
            vx[k],
            curvature[k],
            sample[at.STEER],
            sample[at.STEER_REAR],
            a,
            b,
        )
        said[2] = said[2] + 1 if wanted == said[1] else 1
        said[1] = wanted
        if said[2] > confirm:
            said[0] = wanted
        out[0, k], out[1, k], out[2, k] = front, rear, side * (front - rear)
        state[k] = said[0]

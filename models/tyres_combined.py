"""Magic Formula tyre under combined slip, with load sensitivity: the tyre of the simulation plant."""

from __future__ import annotations

from math import atan, sin, sqrt
from typing import NamedTuple

from numba import njit

# Load, in static loads, at which cornering stiffness peaks: Pacejka 2012, eq. 4.E25, usual values 1.5 to 3.
PEAK_STIFFNESS_LOAD = 2.2
# Longitudinal slip stiffness over cornering stiffness; passenger-car tyres have 1.2 to 2.
SLIP_STIFFNESS_RATIO = 1.4


class CombinedTyre(NamedTuple):
    """One tyre at its static load.

    Attributes
    ----------
    load : float
        Static vertical load [N].
    stiffness : float
        Cornering stiffness at the static load [N/rad].
    shape, curvature : float
        C and E of the Magic Formula (Pacejka 2012, eq. 4.49).
    load_sensitivity : float
        Share of the friction coefficient lost per static load added.
    """

    load: float
    stiffness: float
    shape: float
    curvature: float
    load_sensitivity: float


@njit(cache=True)
def combined_forces(slip_x, slip_y, load, friction, tyre):
    """Forces of a tyre at combined slip, by the similarity method (Pacejka 2012, section 4.3.1).

    The slip, normalised by friction, stiffness and load, enters one Magic Formula of unit slope and unit
    peak. The force points along the normalised slip when small and against the sliding velocity when large.

    Parameters
    ----------
    slip_x, slip_y : float
        Sliding velocity of the wheel rim over its rolling speed [-]; positive slip gives positive force.
    load : float
        Vertical load [N].
    friction : float
        Peak friction coefficient at the static load [-].
    tyre : CombinedTyre

    Returns
    -------
    tuple of float
        Longitudinal and lateral force in the wheel's axes [N].
    """
    if load <= 0.0:
        return 0.0, 0.0
    ratio = load / tyre.load
    limit = friction * max(0.5, 1.0 - tyre.load_sensitivity * (ratio - 1.0)) * load
    peak_squared = PEAK_STIFFNESS_LOAD * PEAK_STIFFNESS_LOAD
    stiffness = tyre.stiffness * ratio * (1.0 + peak_squared) / (peak_squared + ratio * ratio)
    scale = stiffness / limit
    pure = scale * scale * (slip_x * slip_x + slip_y * slip_y)
    k_x = scale * slip_x * (1.0 + (SLIP_STIFFNESS_RATIO - 1.0) / (1.0 + pure))
    k_y = scale * slip_y
    k = sqrt(k_x * k_x + k_y * k_y)
    if k < 1e-12:
        return limit * k_x, limit * k_y
    # B = 1 / C makes the initial slope one.
    b_k = k / tyre.shape
    bent = b_k - tyre.curvature * (b_k - atan(b_k))
    force = limit * sin(tyre.shape * atan(bent)) / k
    return force * k_x, force * k_y

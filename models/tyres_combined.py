"""Magic Formula tyre under combined slip, with load sensitivity: the tyre of the simulation plant.

The equations stand in docs/plant.md.
"""

from __future__ import annotations

from math import atan, sin, sqrt
from typing import NamedTuple

from crosscomb.models.compiled import inlined

SLIP_STIFFNESS_RATIO = 1.4
"""Longitudinal slip stiffness over cornering stiffness, an assumption."""

FIRM_GROUND = 0.9
"""Below this friction coefficient the surface yields too: stiffness falls with the root of friction."""


class CombinedTyre(NamedTuple):
    """One tyre at its static load.

    Attributes
    ----------
    load : float
        Static vertical load [N].
    stiffness : float
        Cornering stiffness at the static load [N/rad].
    shape, curvature : float
        C and E of the Magic Formula.
    load_sensitivity : float
        Share of the friction coefficient lost per static load added.
    peak_load : float
        Load, in static loads, at which the cornering stiffness peaks.
    """

    load: float
    stiffness: float
    shape: float
    curvature: float
    load_sensitivity: float
    peak_load: float


@inlined
def combined_forces(slip_x, slip_y, load, friction, tyre):
    """Forces of a tyre at combined slip, by similarity (docs/plant.md, section 2).

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
    peak_squared = tyre.peak_load * tyre.peak_load
    stiffness = tyre.stiffness * ratio * (1.0 + peak_squared) / (peak_squared + ratio * ratio)
    if friction < FIRM_GROUND:
        stiffness *= sqrt(friction / FIRM_GROUND)
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

"""Lateral tyre laws of one axle: force and slope over the slip angle.

The slip angle is ISO: alpha = steer - (direction of travel of the axle), so a positive slip angle gives a
positive (leftward) force.
"""

from __future__ import annotations

import math

from numba import njit

LINEAR = 0
DUGOFF = 1

TYRE_LAWS = {"linear": LINEAR, "dugoff": DUGOFF}
"""Name of a tyre law to the number that kernels know it by."""

# tan() of the slip angle is taken no further than this [rad]: a car that slides backwards has slip angles
# beyond 90 deg, where Dugoff's tangent changes its sign and the force would push the wrong way.
MAX_SLIP_ANGLE = 1.45


@njit(cache=True)
def linear_tyre(slip_angle, stiffness):
    """Linear tyre, Atheupe 2023, eq. 25.

    Parameters
    ----------
    slip_angle : float [rad]
    stiffness : float [N/rad]
        Cornering stiffness of the axle.

    Returns
    -------
    force, slope : float [N], float [N/rad]
    """
    return stiffness * slip_angle, stiffness


@njit(cache=True)
def dugoff_tyre(slip_angle, stiffness, capacity):
    """Dugoff tyre without longitudinal slip (Dugoff, Fancher and Segel 1970).

    Parameters
    ----------
    slip_angle : float [rad]
    stiffness : float [N/rad]
        Cornering stiffness of the axle.
    capacity : float [N]
        Largest lateral force the axle can give: friction times load, less what drive or brakes use.

    Returns
    -------
    force, slope : float [N], float [N/rad]
    """
    clipped = min(max(slip_angle, -MAX_SLIP_ANGLE), MAX_SLIP_ANGLE)
    tangent = math.tan(clipped)
    demand = stiffness * abs(tangent)
    slope = stiffness * (1.0 + tangent * tangent)
    if demand <= 0.5 * capacity:
        return stiffness * tangent, slope
    # f(lambda) = (2 - lambda) lambda with lambda = capacity / (2 demand)
    saturated = capacity - 0.25 * capacity * capacity / demand
    shape = 0.5 * capacity / demand
    return math.copysign(saturated, clipped), slope * shape * shape


@njit(cache=True)
def axle_tyre(law, slip_angle, stiffness, capacity):
    """Force and slope of an axle under the chosen tyre law (`TYRE_LAWS`)."""
    if law == DUGOFF:
        return dugoff_tyre(slip_angle, stiffness, capacity)
    return linear_tyre(slip_angle, stiffness)


@njit(cache=True)
def lateral_capacity(friction, load, longitudinal_force):
    """Lateral force left on the friction circle of an axle [N]; a tenth of it always remains.

    Parameters
    ----------
    friction : float
    load : float [N]
    longitudinal_force : float [N]
    """
    total = friction * load
    left = total * total - longitudinal_force * longitudinal_force
    return math.sqrt(max(left, 0.01 * total * total))

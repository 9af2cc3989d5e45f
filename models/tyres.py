"""Lateral tyre laws of one axle: force and slope over the slip angle.

The slip angle is ISO: alpha = steer - (direction of travel of the axle), so a positive slip angle gives a
positive (leftward) force.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import inlined

LINEAR = 0
DUGOFF = 1
MODIFIED_DUGOFF = 2
RATIONAL = 3

TYRE_LAWS = {
    "linear": LINEAR,
    "dugoff": DUGOFF,
    "modified_dugoff": MODIFIED_DUGOFF,
    "rational": RATIONAL,
}
"""Name of a tyre law to the number that kernels know it by."""

# tan() of the slip angle is taken no further than this [rad]: a car that slides backwards has slip angles
# beyond 90 deg, where Dugoff's tangent changes its sign and the force would push the wrong way.
MAX_SLIP_ANGLE = 1.45


@inlined
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


@inlined
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


@inlined
def dugoff_by_capacity(slip_angle, stiffness, capacity):
    """Derivative of the force of `dugoff_tyre` by the capacity; 0 in the linear part of the curve.

    Parameters
    ----------
    slip_angle, stiffness, capacity
        As in `dugoff_tyre`.
    """
    clipped = min(max(slip_angle, -MAX_SLIP_ANGLE), MAX_SLIP_ANGLE)
    demand = stiffness * abs(math.tan(clipped))
    if demand <= 0.5 * capacity:
        return 0.0
    return math.copysign(1.0 - 0.5 * capacity / demand, clipped)


GAIN_AT_REST = 1.155
GAIN_FALL = 1.6
LEAST_GAIN = 0.3
"""Correction of the modified Dugoff law: value without slip, its fall with slip, and where we stop it."""


@inlined
def modified_dugoff_tyre(slip_angle, stiffness, capacity, friction):
    """Modified Dugoff tyre: Dugoff's force times a gain that falls with slip, so the curve has a peak.

    gain = (friction - 1.6) tan|slip angle| + 1.155, after Bian, Chen, Luo and Li (SAE 2014-01-0123), the law
    behind Villano 2021. Neither text was at hand: the form and the 1.6 agree with a public implementation that
    names the former, the 1.155 (there 1.5, on another scale) was not confirmed; compare them before you build on
    them. Dugoff's stiffness is divided by 1.155, so `stiffness` stays the slope at zero slip; and the gain, a fit
    for moderate slip that would turn negative, ends at 0.3.

    Parameters
    ----------
    slip_angle : float [rad]
    stiffness : float [N/rad]
        Cornering stiffness of the axle.
    capacity : float [N]
        As in `dugoff_tyre`.
    friction : float

    Returns
    -------
    force, slope : float [N], float [N/rad]
    """
    force, slope = dugoff_tyre(slip_angle, stiffness / GAIN_AT_REST, capacity)
    clipped = min(max(slip_angle, -MAX_SLIP_ANGLE), MAX_SLIP_ANGLE)
    tangent = abs(math.tan(clipped))
    fall = min(friction - GAIN_FALL, 0.0)
    gain = GAIN_AT_REST + fall * tangent
    if gain <= LEAST_GAIN:
        return force * LEAST_GAIN, slope * LEAST_GAIN
    return force * gain, slope * gain + abs(force) * fall * (1.0 + tangent * tangent)


@inlined
def rational_tyre(slip_angle, c1, c2, friction, load_ratio):
    """Rational tyre with its derivatives by slip angle and parameters, Di Biase 2020, eq. 4.

    The slope at zero slip is c2 friction load_ratio; the peak lies at sqrt(c1 (friction + 1)) and is half
    that slope times that angle.

    Parameters
    ----------
    slip_angle : float [rad]
    c1 : float [rad^2]
    c2 : float [N/rad]
    friction : float
    load_ratio : float
        Load of the axle over its static load.

    Returns
    -------
    force, slope : float [N], float [N/rad]
    by_c1, by_c2 : float [N/rad^2], float [rad]
        Derivatives of the force by c1 and c2.
    """
    square = slip_angle * slip_angle
    width = c1 * (friction + 1.0)
    ratio = 1.0 / (square + width)
    shape = slip_angle * width * ratio
    gain = c2 * friction * load_ratio
    slope = gain * width * (width - square) * ratio * ratio
    by_c1 = gain * slip_angle * square * (friction + 1.0) * ratio * ratio
    return gain * shape, slope, by_c1, friction * load_ratio * shape


@inlined
def rational_parameters(stiffness, friction, static_load):
    """Parameters of the rational law whose slope and peak are the stiffness and friction times load.

    The law has exactly these two features free, so no fit is needed: c2 = stiffness / friction, and the peak
    stiffness sqrt(c1 (friction + 1)) / 2 = friction static_load gives c1.

    Parameters
    ----------
    stiffness : float [N/rad]
    friction : float
    static_load : float [N]

    Returns
    -------
    c1, c2 : float [rad^2], float [N/rad]
    """
    peak_angle = 2.0 * friction * static_load / stiffness
    return peak_angle * peak_angle / (friction + 1.0), stiffness / friction


@inlined
def axle_tyre(law, slip_angle, stiffness, capacity, friction=1.0):
    """Force and slope of an axle under the chosen tyre law (`TYRE_LAWS`).

    `friction` only bends the modified Dugoff law; the others take it from the capacity.
    """
    if law == DUGOFF:
        return dugoff_tyre(slip_angle, stiffness, capacity)
    if law == MODIFIED_DUGOFF:
        return modified_dugoff_tyre(slip_angle, stiffness, capacity, friction)
    if law == RATIONAL:
        # With friction and load ratio 1, "static load" is the capacity itself.
        c1, c2 = rational_parameters(stiffness, 1.0, capacity)
        force, slope, _, _ = rational_tyre(slip_angle, c1, c2, 1.0, 1.0)
        return force, slope
    return linear_tyre(slip_angle, stiffness)


@inlined
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

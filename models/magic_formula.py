"""Magic Formula tyre with macro parameters: D'Inverno 2021, eq. 7 to 10; Pieralice 2018, eq. 5, without E.

Signs are ISO: a positive slip angle gives a positive (leftward) force. The printed slip angles (D'Inverno
2021, eq. 11) have the opposite sign to the tyre law and are turned round in `crosscomb.models.planar`.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import inlined


@inlined
def magic_formula(slip, stiffness_factor, shape, peak, curvature):
    """Force of a tyre at pure slip: D sin(C atan(B s - E (B s - atan(B s)))), D'Inverno 2021, eq. 7.

    Parameters
    ----------
    slip : float
        Slip angle [rad] or slip ratio [-].
    stiffness_factor, shape, curvature : float
        B [1/rad or -], C and E; B C D is the slope at zero slip.
    peak : float [N]
        D.

    Returns
    -------
    force, slope : float [N], float [N per unit of slip]
    """
    w = stiffness_factor * slip
    bent = w - curvature * (w - math.atan(w))
    sine, cosine = sine_cosine(shape * math.atan(bent))
    bent_slope = stiffness_factor * (1.0 - curvature * w * w / (1.0 + w * w))
    return peak * sine, peak * shape * cosine * bent_slope / (1.0 + bent * bent)


@inlined
def magic_formula_bend(slip, stiffness_factor, shape, peak, curvature):
    """First and second derivative of the force of `magic_formula` by the slip.

    Parameters
    ----------
    slip, stiffness_factor, shape, peak, curvature
        As in `magic_formula`.

    Returns
    -------
    slope, bend : float [N per unit of slip], float [N per unit of slip squared]
    """
    w = stiffness_factor * slip
    square = 1.0 + w * w
    bent = w - curvature * (w - math.atan(w))
    bent_slope = stiffness_factor * (1.0 - curvature * w * w / square)
    bent_bend = -curvature * stiffness_factor * stiffness_factor * 2.0 * w / (square * square)
    width = 1.0 + bent * bent
    sine, cosine = sine_cosine(shape * math.atan(bent))
    phase_slope = bent_slope / width
    phase_bend = (bent_bend - 2.0 * bent * bent_slope * phase_slope) / width
    scale = peak * shape
    return scale * cosine * phase_slope, scale * (
        cosine * phase_bend - shape * sine * phase_slope * phase_slope
    )


@inlined
def sine_cosine(phase):
    """Sine and cosine for |phase| <= pi; one square root is cheaper than a second series."""
    sine = math.sin(phase)
    return sine, math.copysign(math.sqrt(max(1.0 - sine * sine, 0.0)), 0.5 * math.pi - abs(phase))


@inlined
def peak_friction(load, a1, a2):
    """Friction coefficient that falls with the load: mu = a1 Fz + a2, D'Inverno 2021, eq. 8.

    Parameters
    ----------
    load : float [N]
    a1 : float [1/N]
        Negative.
    a2 : float
    """
    return a1 * load + a2


@inlined
def combined_slip_weight(slip, stiffness_factor, shape, curvature):
    """Weight G of the force when the tyre also slips the other way, D'Inverno 2021, eq. 9.

    G = cos(C atan(B s - E (B s - atan(B s)))), with the slip ratio for the lateral force. With the macro
    parameters of the longitudinal force this is the friction circle: that force over its peak is the sine of
    the same phase, so G = sqrt(1 - (Fx / D)^2). Where the longitudinal force is known and the slip ratio is
    not, as in our models, `crosscomb.models.tyres.lateral_capacity` therefore takes its place.

    Parameters
    ----------
    slip : float
        Slip ratio [-] for the lateral force, slip angle [rad] for the longitudinal force.
    stiffness_factor, shape, curvature : float
        B, C and E of the weight.
    """
    w = stiffness_factor * slip
    return math.cos(shape * math.atan(w - curvature * (w - math.atan(w))))

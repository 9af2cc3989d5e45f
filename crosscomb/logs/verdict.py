"""A verdict that takes time: something speaks for it, something against it, and much speaks for neither."""

from __future__ import annotations

from crosscomb.models.compiled import inlined

LASTS = 2.0
"""However long it was spoken for, a verdict falls after this many times the time that it took."""


@inlined
def weigh(scale, against, agrees, dt, most):
    """Take the next moment and tell whether the verdict stands.

    Parameters
    ----------
    scale : (2,)
        Time for which things spoke against less that for which they agreed [s], and 1 while the verdict stands;
        changed in place.
    against, agrees : bool
        What this moment says; both may be False.
    dt, most : float [s]
        Its length, and for how long things must speak against. The verdict falls once they agreed as long.
    """
    if against:
        scale[0] = min(scale[0] + dt, LASTS * most)
    elif agrees:
        scale[0] = max(scale[0] - dt, 0.0)
    if scale[0] > most:
        scale[1] = 1.0
    elif scale[0] == 0.0:
        scale[1] = 0.0
    return scale[1] == 1.0

"""How the kernels are compiled."""

from __future__ import annotations

from numba import njit

kernel = njit(cache=True, _nrt=False)
"""For loops over a log that allocate nothing, and what they call: without numba's counting of references to arrays.

The kinematic filter's step takes a third of the time it takes with it.
"""

inlined = njit(cache=True, forceinline=True, _nrt=False)
"""For what kernels of the Kalman family call: to pass a state's arrays costs more than many of these functions do.

An EKF's step takes two thirds of the time it takes with calls; results are the same bit for bit.
"""

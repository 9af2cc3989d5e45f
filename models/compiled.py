"""How the kernels are compiled."""

from __future__ import annotations

from numba import njit

inlined = njit(cache=True, forceinline=True)
"""For what kernels of the Kalman family call: to pass a state's arrays costs more than many of these functions do.

An EKF's step takes two thirds of the time it takes with calls; results are the same bit for bit.
"""

bare = njit(cache=True, forceinline=True, _nrt=False)
"""The same for functions that take arrays element by element only, never a slice, and allocate nothing.

Without numba's counting of references to arrays: the kinematic filter's step takes a third of the time.
"""

bare_loop = njit(cache=True, _nrt=False)
"""For loops over a log whose steps are `bare`."""

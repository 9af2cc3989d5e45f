"""How the kernels are compiled."""

from __future__ import annotations

from numba import njit

inlined = njit(cache=True, forceinline=True)
"""For what kernels of the Kalman family call: to pass a state's arrays costs more than many of these functions do.

An EKF's step takes two thirds of the time it takes with calls; results are the same bit for bit.
"""

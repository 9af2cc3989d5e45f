"""How the kernels are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core.options import DefaultOptions

# Numba counts who holds an array, also in a kernel that only borrows its arrays: these atomic additions took two
# thirds of the time of an EKF. The switch has no public name; where it is gone, kernels are slower and as right.
_OPTIONS: dict[str, Any] = {"cache": True, **({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {})}

kernel = njit(**_OPTIONS)
"""For kernels that neither make arrays nor give any back: all they work on is handed to them.

What Python calls with a random generator is an `njit(cache=True)` instead: here nobody would let go of it.
"""

inlined = njit(forceinline=True, **_OPTIONS)
"""The same for what kernels of the Kalman family call: to pass a state's arrays costs more than many of these
functions do. Results are the same bit for bit.
"""

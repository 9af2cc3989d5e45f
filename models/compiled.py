"""How the kernels are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core.options import DefaultOptions

# Numba counts who holds an array, also in a kernel that only borrows its arrays: these atomic additions took two
# thirds of the time of an EKF. The switch has no public name; where it is gone, kernels are slower and as right.
# The error model of numpy does not ask before each division whether it is one by zero. Without the GIL a log is read
# and written while the filters run.
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    **({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {}),
}

kernel = njit(**_OPTIONS)
"""For kernels that neither make arrays nor give any back: all they work on is handed to them."""

allocating = njit(cache=True, nogil=True)
"""For those that make arrays, and for those that Python calls with a random generator, which must be let go of."""

inlined = njit(forceinline=True, **_OPTIONS)
"""The same for what kernels of the Kalman family call: to pass a state's arrays costs more than many of these
functions do. Results are the same bit for bit.
"""

summing = njit(forceinline=True, fastmath={"reassoc"}, **_OPTIONS)
"""The same for sums over particles: several are added at a time, in an order that the compiler chooses once."""

"""Apply the selector's decisions to the estimates: dwell, confirmation, and transitions without a bump."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field


class SwitchSettings(BaseModel):
    """How decisions become switches, in seconds so that they hold at every rate.

    Attributes
    ----------
    dwell : float
        A filter stays active at least this long [s].
    confirm : float
        A decision must stand this long before it is followed [s].
    transition : float
        Time constant with which the step between two filters fades out [s] (the paper's smooth transition).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    dwell: float = Field(default=0.2, ge=0.0, le=60.0)
    confirm: float = Field(default=0.05, ge=0.0, le=60.0)
    transition: float = Field(default=0.1, ge=0.0, le=60.0)


@njit(cache=True)
def usable(beta, beta_std, k, i):
    """Tell whether filter i has an answer at sample k."""
    return math.isfinite(beta[k, i]) and math.isfinite(beta_std[k, i])


@njit(cache=True)
def _switch_run(beta, beta_std, decision, first, dwell, confirm, decay, out_beta, out_std, active):
    """Run the switch; dwell and confirm in samples, decay per sample."""
    n, filters = beta.shape
    current, candidate = first, first
    held, standing = dwell, 0
    offset = 0.0
    for k in range(n):
        wanted = decision[k]
        standing = standing + 1 if wanted == candidate else 1
        candidate = wanted
        held += 1
        follow = held > dwell and standing >= confirm
        if not usable(beta, beta_std, k, current):
            # The decision if it can be used, else the first filter that can.
            follow = True
            for other in range(filters):
                if usable(beta, beta_std, k, wanted):
                    break
                wanted = other
        if follow and wanted != current and usable(beta, beta_std, k, wanted):
            if usable(beta, beta_std, k, current):
                offset += (beta[k, current] - beta[k, wanted]) if k > 0 else 0.0
            elif k > 0 and math.isfinite(out_beta[k - 1]):
                offset = out_beta[k - 1] - beta[k, wanted]  # the last answer stands in for the lost estimate
            current, held = wanted, 0
        offset *= decay
        out_beta[k] = beta[k, current] + offset
        # While the old estimate fades out, what parts it from the new one is doubt.
        out_std[k] = math.sqrt(beta_std[k, current] ** 2 + offset * offset)
        active[k] = current


def switch(
    beta: np.ndarray,
    beta_std: np.ndarray,
    decision: np.ndarray,
    settings: SwitchSettings,
    dt: float,
    first: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Combine the estimates of the filters into one.

    Parameters
    ----------
    beta, beta_std : (n, filters) [rad]
    decision : (n,) int
        Filter that the selector picks at each sample.
    settings : SwitchSettings
    dt : float [s]
    first : int
        Filter that is active before the first confirmed decision.

    Returns
    -------
    beta, beta_std : (n,) [rad]
    active : (n,) int
    """
    n = len(decision)
    out_beta, out_std, active = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    decay = math.exp(-dt / settings.transition) if settings.transition > 0.0 else 0.0
    _switch_run(
        np.ascontiguousarray(beta), np.ascontiguousarray(beta_std), decision.astype(np.int64), first,
        round(settings.dwell / dt), round(settings.confirm / dt), decay, out_beta, out_std, active,
    )  # fmt: skip
    return out_beta, out_std, active

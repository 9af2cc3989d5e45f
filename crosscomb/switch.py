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
def _switch_run(beta, beta_std, decision, first, dwell, confirm, decay, out_beta, out_std, active):
    """Run the switch; dwell and confirm in samples, decay per sample."""
    n = decision.size
    current, candidate = first, first
    held, standing = dwell, 0
    offset = 0.0
    for k in range(n):
        wanted = decision[k]
        standing = standing + 1 if wanted == candidate else 1
        candidate = wanted
        held += 1
        usable = math.isfinite(beta[k, current]) and math.isfinite(beta_std[k, current])
        can_leave = held > dwell and standing >= confirm
        if wanted != current and math.isfinite(beta[k, wanted]) and (can_leave or not usable):
            if k > 0 and usable:
                offset += beta[k, current] - beta[k, wanted]
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

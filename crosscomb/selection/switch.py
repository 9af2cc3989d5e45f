"""Apply the selector's decisions to the estimates: dwell, confirmation, and transitions without a bump."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pydantic import Field

from crosscomb.checked import Record
from crosscomb.filters.base import MAX_BETA
from crosscomb.models.compiled import allocating


class SwitchSettings(Record):
    """How decisions become switches, in seconds so that they hold at every rate.

    Attributes
    ----------
    dwell : float
        A filter stays active at least this long [s].
    confirm : float
        A decision must stand this long before it is followed [s].
    transition : float
        Time constant with which the step between two filters fades out [s] (the paper's smooth transition).
    slew : float
        Largest rate at which that step fades out [rad/s]: a large step must not show as a jump.
    settle : float
        A filter that was not finite, stood still or jumped is barred for this long [s].
    stale : float
        A filter whose beta has not changed at all for this long [s] stands still.
    fastest : float
        A filter whose beta changes faster than this [rad/s] has jumped: it was reset.
    """

    dwell: float = Field(default=0.2, ge=0.0, le=60.0)
    confirm: float = Field(default=0.2, ge=0.0, le=60.0)
    transition: float = Field(default=0.2, ge=0.0, le=60.0)
    slew: float = Field(default=0.4, gt=0.0)
    settle: float = Field(default=0.5, ge=0.0, le=60.0)
    stale: float = Field(default=0.5, gt=0.0, le=60.0)
    fastest: float = Field(default=15.0, gt=0.0)


class SwitchTimes(NamedTuple):
    """Settings of the switch in samples, as kernels take them."""

    dwell: int
    confirm: int
    decay: float  # share of a step that is left after one sample
    most: float  # that fades out in one sample [rad]
    settle: int
    stale: int
    jump: float  # [rad] in one sample


class SwitchState(NamedTuple):
    """A switch under way, changed in place."""

    counts: (
        np.ndarray
    )  # (5,) active filter, candidate, samples active, samples the candidate stands, samples seen
    values: np.ndarray  # (2,) step that fades out, last answer [rad]
    last: np.ndarray  # (filters,) beta of the newest sample [rad]
    before: np.ndarray  # (filters,) beta of the sample before it [rad]
    still: np.ndarray  # (filters,) samples without a change
    barred: np.ndarray  # (filters,) samples until the filter may be selected


def switch_times(settings: SwitchSettings, dt: float) -> SwitchTimes:
    """Turn the settings into samples of dt [s]."""
    return SwitchTimes(
        dwell=round(settings.dwell / dt),
        confirm=round(settings.confirm / dt),
        decay=math.exp(-dt / settings.transition) if settings.transition > 0.0 else 0.0,
        most=settings.slew * dt,
        settle=round(settings.settle / dt),
        stale=max(1, round(settings.stale / dt)),
        jump=settings.fastest * dt,
    )


def make_switch_state(n_filters: int, first: int, times: SwitchTimes) -> SwitchState:
    """Make the state before the first sample, with filter `first` active."""
    zeros = np.zeros(n_filters, dtype=np.int64)
    counts = np.array([first, first, times.dwell, 0, 0])
    return SwitchState(
        counts, np.zeros(2), np.zeros(n_filters), np.zeros(n_filters), zeros.copy(), zeros.copy()
    )


@allocating
def _watch(state, beta, beta_std, times):
    """Bar filters that are not finite, stand still while others move, or jumped."""
    moving = False
    for i in range(beta.size):
        finite = math.isfinite(beta[i]) and math.isfinite(beta_std[i])
        jumped = state.counts[4] > 0 and abs(beta[i] - state.last[i]) > times.jump
        state.still[i] = state.still[i] + 1 if beta[i] == state.last[i] and state.counts[4] > 0 else 0
        state.barred[i] = max(state.barred[i] - 1, 0)
        if not finite or jumped:
            state.barred[i] = times.settle + 1
        moving = moving or (state.still[i] == 0 and state.counts[4] > 0)
        state.before[i] = state.last[i]
        state.last[i] = beta[i] if finite else math.nan
    for i in range(beta.size):
        if moving and state.still[i] >= times.stale:
            state.barred[i] = times.settle + 1


@allocating
def switch_step(state, beta, beta_std, wanted, times):
    """Combine the estimates of one sample; give beta, its standard deviation [rad] and the active filter.

    Parameters
    ----------
    state : SwitchState
        Changed in place.
    beta, beta_std : (filters,) [rad]
    wanted : int
        Filter that the selector picks.
    times : SwitchTimes
    """
    counts, values = state.counts, state.values
    _watch(state, beta, beta_std, times)
    counts[3] = counts[3] + 1 if wanted == counts[1] else 1
    counts[1] = wanted
    counts[2] += 1
    current = counts[0]
    follow = counts[2] > times.dwell and counts[3] >= times.confirm
    lost = not (math.isfinite(beta[current]) and math.isfinite(beta_std[current]))
    if state.barred[current] > 0:
        # The decision if it can be used, else the first filter that can.
        follow = True
        for other in range(beta.size):
            if state.barred[wanted] == 0:
                break
            wanted = other
    # A lost filter gives way even to one that has not settled.
    if lost and state.barred[wanted] > 0:
        for other in range(beta.size):
            if math.isfinite(beta[other]) and math.isfinite(beta_std[other]):
                wanted = other
                break
    usable = math.isfinite(beta[wanted]) and math.isfinite(beta_std[wanted])
    if follow and wanted != current and usable and (lost or state.barred[wanted] == 0):
        if counts[4] > 0 and math.isfinite(values[1]):
            # Go on from the last answer with the steps of the new filter.
            before = state.before[wanted]
            values[0] = values[1] - (before if math.isfinite(before) else beta[wanted])
        counts[0], counts[2] = wanted, 0
        current = wanted
    faded = (1.0 - times.decay) * values[0]
    values[0] -= min(max(faded, -times.most), times.most)
    values[1] = min(max(beta[current] + values[0], -MAX_BETA), MAX_BETA)
    counts[4] += 1
    # While the old estimate fades out, what parts it from the new one is doubt.
    return values[1], math.sqrt(beta_std[current] ** 2 + values[0] * values[0]), current


@allocating
def _switch_run(state, beta, beta_std, decision, times, out_beta, out_std, active):
    for k in range(decision.size):
        out_beta[k], out_std[k], active[k] = switch_step(state, beta[k], beta_std[k], decision[k], times)


def switch(
    beta: np.ndarray,
    beta_std: np.ndarray,
    decision: np.ndarray,
    settings: SwitchSettings,
    dt: float,
    state: SwitchState,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Combine the estimates of the filters into one.

    Parameters
    ----------
    beta, beta_std : (n, filters) [rad]
    decision : (n,) int
        Filter that the selector picks at each sample.
    settings : SwitchSettings
    dt : float [s]
    state : SwitchState
        Changed in place: the next samples of the same drive go on where these end.

    Returns
    -------
    beta, beta_std : (n,) [rad]
    active : (n,) int
    """
    n = len(decision)
    out_beta, out_std, active = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    _switch_run(
        state, np.ascontiguousarray(beta), np.ascontiguousarray(beta_std), decision.astype(np.int64),
        switch_times(settings, dt), out_beta, out_std, active,
    )  # fmt: skip
    return out_beta, out_std, active

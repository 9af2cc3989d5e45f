"""Health of the filters of a run: an unhealthy one is left out, named, and begins anew where the healthy ones are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from crosscomb.run.drive import Drive, begin_anew, take_again
from crosscomb.selection.health import HEALTHY, WORDS, HealthState, next_health
from crosscomb.selection.seen import Seen

RECKONED = 2.0
"""Who has gone by dead reckoning for longer than this [s] does not know any more."""

PIECE = 4096
"""A filter that begins anew runs over so many samples at a time: it may have to begin anew once more in them."""


class Told(NamedTuple):
    """What can be believed of the filters.

    Attributes
    ----------
    seen : Seen
        Of the watched filters; what an unhealthy one says is replaced by what the healthy ones say.
    codes : (n, watched) int64
        Places in `crosscomb.selection.health.WORDS`.
    lost : (n,) bool
        None is healthy, and has not been for too long.
    """

    seen: Seen
    codes: np.ndarray
    lost: np.ndarray

    @property
    def healthy(self) -> np.ndarray | None:
        """Which filters are healthy ``(n, watched) bool``; None where all are."""
        return self.codes == HEALTHY if self.codes.any() else None


def next_told(state: HealthState, drive: Drive, seen: Seen, watched: Sequence[int]) -> Told:
    """Judge the watched filters at the next grid points of a drive.

    Parameters
    ----------
    state : HealthState
        Of the watched filters, changed in place.
    drive : Drive
        A filter in it may begin anew.
    seen : Seen
        Of all its filters; changed in place from where one begins anew.
    watched : sequence of int
    """
    told = seen.only(watched)
    told = replace(told, beta=told.beta.copy("C"), beta_std=told.beta_std.copy("C"), nis=told.nis.copy("C"))
    beta, beta_std, nis, samples, dt = told.beta, told.beta_std, told.nis, seen.inputs.samples, seen.inputs.dt
    codes, alone = np.zeros(told.beta.shape, dtype=np.int64), np.empty(len(samples))
    begin, known = 0, [len(samples)] * len(watched)
    while begin < len(samples):
        at = slice(begin, min(known))
        begin += next_health(state, samples[at], beta[at], beta_std[at], nis[at], codes[at], alone[at], dt)
        for i, which in enumerate(watched):
            if state.restart[i]:
                begin_anew(drive, which, state.answer)
                known[i] = begin
            if known[i] == begin < len(samples):
                known[i] = min(begin + PIECE, len(samples))
                at = slice(begin, known[i])
                take_again(drive, which, seen, at)
                beta[at, i], beta_std[at, i] = seen.beta[at, which], seen.beta_std[at, which]
                nis[at, i] = seen.nis[at, which]
    if codes.any():
        innovations = [
            np.where(codes[:, i, None] == HEALTHY, seen.innovations[which], np.nan)
            for i, which in enumerate(watched)
        ]
        told = replace(told, innovations=innovations)
    return Told(told, codes, alone > RECKONED)


def with_health(reasons: np.ndarray, names: Sequence[str], codes: np.ndarray) -> np.ndarray:
    """Add to the reasons ``(n,) str`` the unhealthy ones of the named filters by their codes ``(n, filters)``."""
    if not codes.any():
        return reasons
    reasons = reasons.copy()
    for row in np.flatnonzero(codes.any(axis=1)):
        told = [f"filter {name} {WORDS[code]}" for name, code in zip(names, codes[row], strict=True) if code]
        reasons[row] = "; ".join([*filter(None, [reasons[row]]), *told])
    return reasons

"""From what the filters say to one answer: selector, switch, correction and calibrated doubt.

Works in pieces of any length, one sample or a whole log, with the same result bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.selection.artefact import Artefact
from crosscomb.selection.choice import LEAD_TIME, blend
from crosscomb.selection.correction import CorrectionState, correct, lag_gain, make_correction_state
from crosscomb.selection.features import Memory, all_features, innovations_of, make_memory
from crosscomb.selection.seen import Seen
from crosscomb.selection.switch import SwitchState, make_switch_state, switch, switch_times

FARTHEST = 0.5
"""Share of the distance to the farthest filter that is a standard deviation of a corrected answer, beside what is
foretold: a network was taught on cars that are as their files say, and knows nothing of others."""


class Answer(NamedTuple):
    """What was made of the filters' estimates.

    Attributes
    ----------
    beta, beta_std : (n,) [rad]
    active : (n,) int
        Index of the active filter.
    outside : (n,) bool
        The input lies outside the training data.
    decision : (n,) int
        Index of the filter that the selector wants.
    """

    beta: np.ndarray
    beta_std: np.ndarray
    active: np.ndarray
    outside: np.ndarray
    decision: np.ndarray


@dataclass(frozen=True)
class Selection:
    """A selection under way in one drive; its arrays change from piece to piece."""

    artefact: Artefact
    switch: SwitchState
    memory: Memory
    shares: np.ndarray  # (filters,)
    leading: np.ndarray  # (2,) int, see `crosscomb.selection.choice.blend`
    correction: CorrectionState | None


def start_selection(artefact: Artefact) -> Selection:
    """Make the state before the first sample of a drive."""
    filters = len(artefact.filters)
    first = artefact.filter_names.index(artefact.fallback)
    memory = make_memory(filters, len(innovations_of(artefact.filter_names)))
    return Selection(
        artefact=artefact,
        switch=make_switch_state(filters, first, switch_times(artefact.switch, 1.0 / artefact.rate)),
        memory=memory,
        shares=np.full(filters, -1.0),
        leading=np.zeros(2, dtype=np.int64),
        correction=make_correction_state(artefact.correction) if artefact.correction else None,
    )


def select(selection: Selection, seen: Seen, healthy: np.ndarray | None = None) -> Answer:
    """Take the next samples of a drive.

    Parameters
    ----------
    selection : Selection
        Its arrays change.
    seen : Seen
        Of the artefact's filters, in its order.
    healthy : (n, filters) bool, optional
        An unhealthy filter is not selected and has no share, while there is a healthy one; without it all are.
    """
    artefact, dt, beta, beta_std = selection.artefact, seen.inputs.dt, seen.beta, seen.beta_std
    heard = beta
    if healthy is not None:
        heard = np.where(healthy | ~healthy.any(axis=1, keepdims=True), beta, np.nan)
    features = all_features(seen, selection.memory) if artefact.sees_all else seen.windows
    asked = features if artefact.tree_sees_all else seen.windows
    outside = artefact.tree.outside(asked)
    if artefact.choice is None:
        shares, decision = np.empty((0, 0)), artefact.tree.predict(asked)
    else:
        shares = artefact.choice.probabilities(features)
        decision = np.argmax(shares, axis=1)
    if artefact.choice is not None and artefact.choice.soft:
        gain = lag_gain(artefact.choice.lag, dt)
        answer, std, active = blend(
            shares, selection.shares, selection.leading, heard, beta_std, gain, round(LEAD_TIME / dt)
        )
    else:
        answer, std, active = switch(heard, beta_std, decision, artefact.switch, dt, selection.switch)
    std = artefact.trust.widen(std, beta)
    if artefact.correction is not None and selection.correction is not None:
        anchor = artefact.filter_names.index(artefact.correction.anchor)
        answer, std, weight = correct(
            artefact.correction, selection.correction, features, anchor, beta, answer, std, dt
        )
        std = np.hypot(std, FARTHEST * weight * np.abs(beta - answer[:, None]).max(axis=1))
        outside = weight < 0.5
    return Answer(answer, std, active, outside, decision)

"""From what the filters say to one answer: selector, switch, correction and calibrated doubt.

Works in pieces of any length, one sample or a whole log, with the same result bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import Artefact
from crosscomb.selection.choice import blend
from crosscomb.selection.correction import CorrectionState, correct, lag_gain, make_correction_state
from crosscomb.selection.features import Memory, all_features, innovations_of, make_memory
from crosscomb.selection.switch import SwitchState, make_switch_state, switch, switch_times


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
    vehicle: Vehicle
    switch: SwitchState
    memory: Memory
    shares: np.ndarray  # (filters,)
    correction: CorrectionState | None

    @property
    def dt(self) -> float:
        """Time from sample to sample [s]."""
        return 1.0 / self.artefact.rate


def start_selection(artefact: Artefact, vehicle: Vehicle) -> Selection:
    """Make the state before the first sample of a drive."""
    filters = len(artefact.filters)
    first = artefact.filter_names.index(artefact.fallback)
    memory = make_memory(filters, len(innovations_of(artefact.filter_names)))
    return Selection(
        artefact=artefact,
        vehicle=vehicle,
        switch=make_switch_state(filters, first, switch_times(artefact.switch, 1.0 / artefact.rate)),
        memory=memory,
        shares=np.full(filters, -1.0),
        correction=make_correction_state(artefact.correction) if artefact.correction else None,
    )


def select(
    selection: Selection,
    samples: np.ndarray,
    beta: np.ndarray,
    beta_std: np.ndarray,
    nis: np.ndarray,
    innovations: Sequence[np.ndarray],
    windows: np.ndarray,
) -> Answer:
    """Take the next samples of a drive.

    Parameters
    ----------
    selection : Selection
        Its arrays change.
    samples : (n, 17)
        As in `crosscomb.filters.base.Inputs`.
    beta, beta_std, nis : (n, filters) [rad], [rad], [-]
    innovations : sequence of (n, m)
        Of each filter.
    windows : (n, f) float32
        Features of the windows, see `crosscomb.selection.windows`.
    """
    artefact, dt = selection.artefact, selection.dt
    features = windows
    if artefact.sees_all:
        told = beta, beta_std, nis, innovations
        features = all_features(samples, *told, selection.vehicle, dt, selection.memory)
    seen = features if artefact.tree_sees_all else windows
    outside = artefact.tree.outside(seen)
    if artefact.choice is None:
        shares, decision = np.empty((0, 0)), artefact.tree.predict(seen)
    else:
        shares = artefact.choice.probabilities(features)
        decision = np.argmax(shares, axis=1)
    if artefact.choice is not None and artefact.choice.soft:
        gain = lag_gain(artefact.choice.lag, dt)
        answer, std, active = blend(shares, selection.shares, beta, beta_std, gain)
    else:
        answer, std, active = switch(beta, beta_std, decision, artefact.switch, dt, selection.switch)
    std = artefact.trust.widen(std, beta)
    if artefact.correction is not None and selection.correction is not None:
        anchor = artefact.filter_names.index(artefact.correction.anchor)
        answer, std, weight = correct(
            artefact.correction, selection.correction, features, anchor, beta, answer, std, dt
        )
        outside = weight < 0.5
    return Answer(answer, std, active, outside, decision)

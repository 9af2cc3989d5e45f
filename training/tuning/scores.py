"""How well a filter does on recordings with given settings: what tuning makes small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.base import Inputs, KernelFilter
from crosscomb.filters.catalogue import make_filter
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import FilterSettings
from crosscomb.training.metrics import rms
from crosscomb.training.recordings import Recording

ERROR, LIKELIHOOD = "error", "likelihood"
"""What is minimised: RMSE of beta, or minus the log likelihood of the measurements per sample."""

FLOOR = 0.1
"""RMSE [deg] that is added to both sides of a comparison: references are no better."""


@dataclass(frozen=True)
class TuneLog:
    """One recording as tuning runs filters over it.

    Attributes
    ----------
    name : str
    vehicle : Vehicle
    stretches : list of (Inputs, (n,) [rad], (n,) bool)
        Samples, ground truth and which samples are scored, of each segment.
    """

    name: str
    vehicle: Vehicle
    stretches: list[tuple[Inputs, np.ndarray, np.ndarray]]


def prepare(
    recordings: Sequence[Recording], rate: float, by: str = ERROR, longest: float = np.inf
) -> list[TuneLog]:
    """Bring recordings to the working rate, once for all runs.

    Parameters
    ----------
    recordings : sequence of Recording
    rate : float [Hz]
    by : str
    longest : float [s]
        Of each recording only so much is taken, from where the car first moves beside ground truth.

    Raises
    ------
    UsageError
        A recording holds nothing that can be scored.
    """
    logs = []
    for recording in recordings:
        stretches, left = [], longest
        for inputs, beta_ref, counted in recording.stretches(rate, by != LIKELIHOOD):
            if not counted.any() or left <= 0.0:
                continue
            first = int(np.argmax(counted)) if np.isfinite(longest) else 0
            taken = slice(first, first + int(min(left * rate, len(counted))))
            left -= len(counted[taken]) / rate
            stretches.append((Inputs(inputs.dt, inputs.samples[taken]), beta_ref[taken], counted[taken]))
        if not stretches:
            raise UsageError(
                f"{recording.path}: nowhere fast enough{'' if by == LIKELIHOOD else ' beside ground truth'}: "
                f"take it out of the folder"
            )
        logs.append(TuneLog(recording.name, recording.vehicle, stretches))
    return logs


def score_logs(entry: FilterSettings, logs: Sequence[TuneLog], by: str) -> np.ndarray:
    """Score of a filter on each log ``(logs,)``: RMSE [deg], or minus the log likelihood per sample."""
    scores = []
    for log in logs:
        estimator = make_filter(entry.name, log.vehicle, entry.settings)
        if by == LIKELIHOOD:
            total = -sum(estimator.log_likelihood(inputs) for inputs, _, _ in log.stretches)
            scores.append(total / sum(len(inputs.samples) for inputs, _, _ in log.stretches))
        else:
            scores.append(np.degrees(rms(_errors(estimator, log))))
    return np.array(scores)


def errors_of(entry: FilterSettings, logs: Sequence[TuneLog]) -> list[np.ndarray]:
    """Error of a filter at the scored samples of each log ``(n,) [rad]``."""
    return [_errors(make_filter(entry.name, log.vehicle, entry.settings), log) for log in logs]


def _errors(estimator: KernelFilter, log: TuneLog) -> np.ndarray:
    parts = [(estimator.run(inputs).beta - truth)[used] for inputs, truth, used in log.stretches]
    return np.concatenate(parts)


def losses(scores: np.ndarray, before: np.ndarray, by: str) -> np.ndarray:
    """Loss of each recording ``(n,)`` against its score before: 0 for no change, negative for the better.

    By error it is the log of the ratio, by likelihood the difference. Gains beyond about one count ever less, so that a
    recording that was bad before does not outvote the others; so do losses of likelihood, which has no upper end. A
    recording whose error grows counts in full: none is given up for the others.
    """
    if by == LIKELIHOOD:
        return np.arcsinh(scores - before)
    change = np.log((scores + FLOOR) / (before + FLOOR))
    return np.where(change > 0.0, change, np.arcsinh(change))

"""What a campaign of faults gives: outcomes of runs, and figures that can be added up."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from crosscomb.logs.grid import MAX_GAP
from crosscomb.signals import Signals
from crosscomb.training.metrics import countable
from crosscomb.training.suites.fault_criteria import NOT_JUDGED, PASSED
from crosscomb.training.suites.fault_trials import ALARMS, WRONG, Answers, holds
from crosscomb.training.suites.faults import CHANNELS


@dataclass(frozen=True)
class Figures:
    """Sums over rows with ground truth above walking speed, and alarms over all rows.

    Attributes
    ----------
    wrong, seconds : float
        Time with an error over 3 deg while the status is ok, and time altogether [s].
    inside, rows : int
        Rows whose truth lies within 1.96 beta_std, and all.
    alarms : int
        False ones: onsets of degraded, invalid or extrapolating where no channel of the log lacks a sample.
    length : float
        Of the log [s].
    """

    wrong: float = 0.0
    seconds: float = 0.0
    inside: int = 0
    rows: int = 0
    alarms: int = 0
    length: float = 0.0

    def __add__(self, other: Figures) -> Figures:
        mine, others = vars(self), vars(other)
        return Figures(**{name: mine[name] + others[name] for name in mine})


@dataclass(frozen=True)
class Outcome:
    """One run: why it failed, or that it passed or could not be judged, and its figures."""

    log: str
    simulated: bool
    kind: str
    channel: str
    failure: str
    figures: Figures

    @property
    def judged(self) -> bool:
        """Whether the log holds what the criterion asks about."""
        return self.failure != NOT_JUDGED

    @property
    def passed(self) -> bool:
        """Whether the criterion holds."""
        return self.failure == PASSED


@dataclass(frozen=True)
class Campaign:
    """All runs.

    Attributes
    ----------
    outcomes : list of Outcome
        With a fault.
    sound : dict of str to Figures
        Without any, by log; simulated ones first.
    simulated : list of str
        Logs of `sound` that are.
    drifts : dict of str to Figures
        Without any fault, of the folder of drifts.
    notes : list of str
    """

    outcomes: list[Outcome]
    sound: dict[str, Figures]
    simulated: list[str]
    drifts: dict[str, Figures] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


LOST_TIME = 0.15
"""An alarm within this time [s] after a lost sample is a true one."""


def lost_rows(log: Signals) -> np.ndarray:
    """Rows ``(n,) bool`` shortly after one in which a channel that the log has lacks its sample."""
    lost = np.any([~np.isfinite(log.column(name)) for name in CHANNELS if log.has(name)], axis=0)
    newest = np.maximum.accumulate(np.where(lost, log.t, -np.inf))
    return log.t - newest <= LOST_TIME


def figures_of(
    t: np.ndarray, answers: Answers, truth: np.ndarray, vx: np.ndarray, lost: np.ndarray | bool = False
) -> Figures:
    """Figures of an estimate beside the truth.

    Parameters
    ----------
    t, truth, vx : (n,) [s], [rad], [m/s]
        As the sound log has them.
    answers : Answers
    lost : (n,) bool
        See `lost_rows`.
    """
    counted = countable(truth, vx)
    steps = np.minimum(np.diff(t, append=t[-1]), MAX_GAP)
    error = np.abs(answers.beta - truth)
    wrong = counted & ~(error <= WRONG) & (answers.status == "ok")
    alarm = np.any([holds(answers.status, word) for word in ALARMS], axis=0)
    onset = np.diff(alarm.astype(int), prepend=0) > 0
    return Figures(
        float(steps[wrong].sum()),
        float(steps[counted].sum()),
        int(np.sum(error[counted] <= 1.96 * answers.beta_std[counted])),
        int(counted.sum()),
        int(np.sum(onset & ~np.asarray(lost))),
        float(steps.sum()),
    )

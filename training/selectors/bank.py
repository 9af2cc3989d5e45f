"""Run the bank of filters over many recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from crosscomb.run.drive import make_filters, run_filters
from crosscomb.selection.artefact import FilterSettings
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import WindowSettings, window_features
from crosscomb.training.metrics import countable
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.labels import Windows, concatenate, label_run, oracle_beta


@dataclass(frozen=True)
class BankRun:
    """All filters on one recording, at the working rate.

    Attributes
    ----------
    name : str
        Of the recording.
    is_simulated : bool
        See `crosscomb.training.recordings.Recording`.
    runs : list of Seen
        One per stretch of the log without a long gap.
    beta_ref : (n,) [rad]
        Ground truth over all stretches.
    counted : (n,) bool
        Samples that are scored.
    """

    name: str
    is_simulated: bool
    runs: list[Seen]
    beta_ref: np.ndarray
    counted: np.ndarray

    @classmethod
    def of(cls, name: str, is_simulated: bool, runs: list[Seen]) -> BankRun:
        """Bank run of these stretches."""
        beta_ref = np.concatenate([run.beta_ref for run in runs])
        vx = np.concatenate([run.column("vx") for run in runs])
        return cls(name, is_simulated, runs, beta_ref, countable(beta_ref, vx))

    def joined(self, part: Callable[[Seen], np.ndarray]) -> np.ndarray:
        """Join what `part` gives of each stretch over all of them."""
        return np.concatenate([part(run) for run in self.runs])

    def only(self, members: Sequence[int]) -> BankRun:
        """Keep some of the filters, in the order given."""
        return replace(self, runs=[run.only(members) for run in self.runs])

    def oracle(self, length: int) -> np.ndarray:
        """Estimate of the oracle ``(n,) [rad]``; see `crosscomb.training.selectors.labels.oracle_beta`."""
        return self.joined(lambda run: oracle_beta(run, length))

    def windows(self, settings: WindowSettings, everything: bool = False) -> Windows:
        """Labelled windows of the recording; see `crosscomb.training.selectors.labels.label_run`."""
        return concatenate([label_run(run, settings, everything) for run in self.runs])


def run_one(
    recording: Recording, filters: Sequence[FilterSettings], rate: float, window: WindowSettings
) -> BankRun:
    """Run all filters on one recording."""
    made = make_filters(filters, recording.vehicle)
    runs = run_filters(recording.signals, recording.vehicle, made, rate, window)
    return BankRun.of(recording.name, recording.is_simulated, runs)


def with_windows(bank: BankRun, settings: WindowSettings) -> BankRun:
    """The same run seen through other windows."""
    runs = []
    for run in bank.runs:
        windows = window_features(run.column("ay"), run.column("yaw_rate"), settings)
        runs.append(replace(run, windows=windows))
    return replace(bank, runs=runs)


def run_bank(
    recordings: Sequence[Recording],
    filters: Sequence[FilterSettings],
    rate: float,
    window: WindowSettings,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
) -> list[BankRun]:
    """Run all filters on all recordings, in parallel over recordings.

    Parameters
    ----------
    recordings : sequence of Recording
    filters : sequence of FilterSettings
    rate : float [Hz]
    window : WindowSettings
    jobs : int
        Processes; the result does not depend on it.
    progress : callable, optional
        Called after each recording.
    """
    tasks = [(recording, filters, rate, window) for recording in recordings]
    return in_parallel(run_one, tasks, jobs, progress)

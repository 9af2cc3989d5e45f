"""Score a selector on recordings, beside beta = 0, every single filter and the oracle."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from crosscomb.selection.answer import Answer, select, start_selection
from crosscomb.selection.artefact import Artefact
from crosscomb.training.metrics import coverage, score
from crosscomb.training.selectors.bank import BankRun
from crosscomb.training.selectors.labels import label_run, window_ends

ZERO, SWITCH, ORACLE = "zero", "switch", "oracle"
"""Names of the rows beside those of the filters."""


BANDS = (0.0, 1.0, 3.0, 6.0, 90.0)
"""Edges of the ranges of the true beta [deg]."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of a selector on a set of recordings.

    Attributes
    ----------
    table : pandas.DataFrame
        One row per recording; columns ``(estimator, "rmse" | "max")`` [deg], estimators being zero, the filters,
        switch and oracle, and ``("switch", "coverage" | "switches_per_minute" | "largest_jump")``.
    confusion : (filters, filters) int
        Windows by best filter (rows) and selected filter (columns).
    lost : float
        Regret summed over the windows [deg].
    bands : (bands, estimators + 1)
        Sums of squared errors [deg^2] per range of the true beta, and the number of samples in it.
    """

    table: pd.DataFrame
    confusion: np.ndarray
    lost: float
    bands: np.ndarray

    @property
    def regret(self) -> float:
        """Mean over windows of the RMSE of what was selected less that of the best filter [deg]."""
        return self.lost / max(int(self.confusion.sum()), 1)

    @property
    def by_band(self) -> pd.DataFrame:
        """RMSE [deg] over all samples per range of the true beta, estimators as columns."""
        names = [f"{low} to {high} deg" for low, high in itertools.pairwise(BANDS)]
        counts = np.maximum(self.bands[:, -1:], 1.0)
        return pd.DataFrame(np.sqrt(self.bands[:, :-1] / counts), index=names, columns=self.rmse.columns)

    @property
    def rmse(self) -> pd.DataFrame:
        """RMSE [deg], recordings as rows and estimators as columns."""
        return pd.DataFrame(self.table.xs("rmse", axis=1, level=1))

    @property
    def largest(self) -> pd.DataFrame:
        """Largest error [deg], recordings as rows and estimators as columns."""
        return pd.DataFrame(self.table.xs("max", axis=1, level=1))

    @property
    def overall(self) -> pd.DataFrame:
        """Mean RMSE over recordings and largest error per estimator [deg], estimators as rows."""
        return pd.DataFrame({"rmse": self.rmse.mean(), "max": self.largest.max()})

    @property
    def best_single(self) -> str:
        """Filter with the lowest mean RMSE over the recordings."""
        rmse = self.overall["rmse"].drop([ZERO, SWITCH, ORACLE])
        return str(rmse.idxmin())

    @property
    def ratio(self) -> float:
        """RMSE of the switch over that of the best single filter."""
        rmse = self.overall["rmse"]
        return float(rmse[SWITCH] / rmse[self.best_single])


def evaluate(banks: Iterable[BankRun], artefact: Artefact) -> Evaluation:
    """Score an artefact on recordings; its fitted part must not have seen them."""
    rows, classes = {}, len(artefact.filters)
    confusion, lost = np.zeros((classes, classes), dtype=np.int64), 0.0
    bands = np.zeros((len(BANDS) - 1, classes + 4))
    for bank in banks:
        answers = [select(start_selection(artefact), run) for run in bank.runs]
        estimates = estimates_of(bank, answers, artefact)
        rows[bank.name] = evaluate_one(bank, estimates, answers, artefact)
        bands += squares_by_band(bank, estimates)
        counts, regret = confusion_of(bank, answers, artefact)
        confusion, lost = confusion + counts, lost + regret
    columns = list(next(iter(rows.values())))
    values = [[row[column] for column in columns] for row in rows.values()]
    table = pd.DataFrame(values, index=list(rows), columns=pd.MultiIndex.from_tuples(columns))
    return Evaluation(table, confusion, lost, bands)


def estimates_of(bank: BankRun, answers: Sequence[Answer], artefact: Artefact) -> dict[str, np.ndarray]:
    """beta of everything that is scored ``(n,) [rad]``, by name."""
    each = bank.joined(lambda run: run.beta)
    beta = np.concatenate([answer.beta for answer in answers])
    filters = {name: each[:, i] for i, name in enumerate(artefact.filter_names)}
    return {ZERO: np.zeros_like(beta), **filters, SWITCH: beta, ORACLE: bank.oracle(artefact.window.length)}


def squares_by_band(bank: BankRun, estimates: dict[str, np.ndarray]) -> np.ndarray:
    """Sums of squared errors [deg^2] per range of the true beta; last column the number of samples."""
    truth = np.degrees(bank.beta_ref[bank.counted])
    band = np.clip(np.digitize(np.abs(truth), BANDS) - 1, 0, len(BANDS) - 2)
    squares = [(np.degrees(beta[bank.counted]) - truth) ** 2 for beta in estimates.values()]
    sums = [np.bincount(band, weights, len(BANDS) - 1) for weights in (*squares, np.ones(len(truth)))]
    return np.column_stack(sums)


def pool(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Put the evaluations of several folds together."""
    return Evaluation(
        pd.concat([one.table for one in evaluations]),
        np.sum([one.confusion for one in evaluations], axis=0),
        float(np.sum([one.lost for one in evaluations])),
        np.sum([one.bands for one in evaluations], axis=0),
    )


def filter_scores(bank: BankRun) -> list[float]:
    """RMSE and largest error [deg] of each filter on a recording, one after the other."""
    each = bank.joined(lambda run: run.beta)
    scores = [score(beta, bank.beta_ref, bank.counted) for beta in each.T]
    return [float(np.degrees(value)) for s in scores for value in (s.rmse, s.max_error)]


def scores_table(rows: Mapping[str, list[float]], filters: Sequence[str]) -> pd.DataFrame:
    """Scores of filters on recordings, in columns as `Evaluation.table`, from `filter_scores` of each."""
    columns = pd.MultiIndex.from_product([list(filters), ["rmse", "max"]])
    return pd.DataFrame(list(rows.values()), index=list(rows), columns=columns)


def evaluate_one(
    bank: BankRun, estimates: dict[str, np.ndarray], answers: Sequence[Answer], artefact: Artefact
) -> dict[tuple[str, str], float]:
    """Scores of one recording [deg], from the answers to its stretches."""
    beta = estimates[SWITCH]
    beta_std = np.concatenate([answer.beta_std for answer in answers])
    active = np.concatenate([answer.active for answer in answers])
    each = bank.joined(lambda run: run.beta)
    row = {}
    for name, estimate in estimates.items():
        result = score(estimate, bank.beta_ref, bank.counted)
        row[name, "rmse"] = float(np.degrees(result.rmse))
        row[name, "max"] = float(np.degrees(result.max_error))
    row[SWITCH, "coverage"] = coverage(beta, beta_std, bank.beta_ref, bank.counted)
    switched = np.flatnonzero(np.diff(active) != 0) + 1
    row[SWITCH, "switches_per_minute"] = len(switched) / (len(beta) / artefact.rate / 60.0)
    # The step in the output where the active filter changes, less the step the new filter takes by itself.
    own = each[switched, active[switched]] - each[switched - 1, active[switched]]
    jumps = np.abs(np.diff(beta)[switched - 1] - own)
    row[SWITCH, "largest_jump"] = float(np.degrees(jumps.max(initial=0.0)))
    return row


def confusion_of(bank: BankRun, answers: Sequence[Answer], artefact: Artefact) -> tuple[np.ndarray, float]:
    """Count windows by best filter (rows) and filter that the selector wanted (columns), and sum their regret [deg]."""
    classes = len(artefact.filters)
    counts, lost = np.zeros((classes, classes), dtype=np.int64), 0.0
    for run, answer in zip(bank.runs, answers, strict=True):
        ends = window_ends(run.beta_ref, run.column("vx"), artefact.window)
        windows, wanted = label_run(run, artefact.window), answer.decision[ends]
        np.add.at(counts, (windows.label, wanted), 1)
        lost += float(np.degrees(windows.regret(wanted)).sum())
    return counts, lost

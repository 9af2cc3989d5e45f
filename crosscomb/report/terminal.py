"""What the commands show on a terminal: tables, progress, warnings."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from crosscomb.errors import printable
from crosscomb.report.markdown import (
    SPEED_HEADER,
    WIDE,
    number,
    row_shares,
    score_rows,
    speed_rows,
    summary_rows,
)
from crosscomb.signals import UNITS, Signals

if TYPE_CHECKING:
    import pandas as pd

    from crosscomb.report.estimates import Summary
    from crosscomb.training.metrics import Score
    from crosscomb.training.selectors.compare import Comparison
    from crosscomb.training.selectors.train import Training
    from crosscomb.training.suites.benchmark import Benchmark
    from crosscomb.training.suites.speed import Speed

PIPE_WIDTH = 150
"""Columns of a table in a file or a pipe, which has no width of its own."""

# No markup: it would swallow what stands in brackets, units and file names.
console = Console(
    markup=False, highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else PIPE_WIDTH
)
errors = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)


FLAGS = {name: f"--{name}" for name in ("filters", "vehicle", "force")}
FLAGS |= {"channel_map": "--map", "tune_budget": "--tune-budget"}
"""Options of the command line by the arguments of functions, as messages of the library name them."""


def as_flags(message: str) -> str:
    """A message of the library for those who typed a command; names of files and columns stay as they are."""
    named = r"(^|give |in |or |\()`(" + "|".join(FLAGS) + r")`(?=$|[ ),:])"
    return re.sub(named, lambda match: match[1] + FLAGS[match[2]], message)


def say(text: str) -> None:
    """Print a line."""
    console.print(printable(as_flags(text), "\n"))


def warn(text: str) -> None:
    """Print a warning to the error stream."""
    errors.print(f"warning: {printable(as_flags(text))}")


@contextmanager
def progress(text: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on the error stream where that is a terminal; gives what advances it by one.

    Print nothing meanwhile: the bar would draw it to itself.
    """
    if not errors.is_terminal:
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True) as bar:
        task = bar.add_task(text, total=total)
        yield lambda: bar.advance(task)


def show(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table; the first `left` columns are words, the others numbers."""
    table = Table(title=printable(title), title_justify="left", title_style="bold")
    for i, name in enumerate(header):
        table.add_column(printable(name), justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    console.print(table)


MANY = 40
"""So many recordings are shown in a terminal at most."""


def show_scores(title: str, rmse: pd.DataFrame, largest: pd.DataFrame) -> None:
    """Print RMSE / largest error [deg], recordings as rows and estimators as columns, with a summary row.

    Of many recordings those are shown where the switch is furthest off, the worst first.
    """
    summaries = {"mean / largest": list(rmse.index)} if len(rmse) > 1 else {}
    rows = score_rows(rmse, largest, summaries)
    if len(rmse) > MANY:
        title += f", the {MANY} worst of the switch (the report has all)"
        worst = np.argsort(-rmse["switch"].to_numpy(), kind="stable")[:MANY]
        rows = [*(rows[i] for i in worst), rows[-1]]
    show(title, ["RMSE / max [deg]", *map(str, rmse.columns)], rows)


def show_training(training: Training) -> None:
    """Print the scores of a training."""
    for part, evaluation in training.evaluations.items():
        show_scores(f"{part}: {len(evaluation.table)} recordings", evaluation.rmse, evaluation.largest)
        say(f"{part}: switch / best single filter ({evaluation.best_single}) = {evaluation.ratio:.3f}\n")
    show_confusion(training.folds.confusion, training.artefact.filter_names)


def show_benchmark(result: Benchmark) -> None:
    """Print the scores of a benchmark."""
    rmse, largest = result.evaluation.rmse, result.evaluation.largest
    if len(rmse.columns) > WIDE:
        header = ["RMSE / max [deg]", *result.summaries]
        show("Accuracy", header, summary_rows(rmse, largest, result.summaries))
        return
    rows = score_rows(rmse, largest, result.summaries)
    show("Accuracy", ["RMSE / max [deg]", *map(str, rmse.columns)], rows)


def show_speeds(speeds: Sequence[Speed]) -> None:
    """Print how much faster the kernels are than their twins."""
    show(
        "Time per sample [us] and how many times as long the twin takes",
        SPEED_HEADER,
        speed_rows(speeds),
        left=2,
    )


def show_table(title: str, table: pd.DataFrame) -> None:
    """Print a table of numbers with its index."""
    rows = [[str(name), *map(number, row)] for name, row in zip(table.index, table.to_numpy(), strict=True)]
    show(title, ["", *map(str, table.columns)], rows)


def show_comparison(comparison: Comparison) -> None:
    """Print how the selectors compare."""
    rows = [
        [*index, f"{row['ratio']:.3f}", f"{row['ratio low']:.2f} to {row['ratio high']:.2f}",
         *(number(row[name]) for name in comparison.summary.columns[3:])]
        for index, row in zip(comparison.summary.index.tolist(), comparison.summary.to_dict("records"), strict=True)
    ]  # fmt: skip
    header = ["selector", "left out", "switch / best single", "95 %", *comparison.summary.columns[3:]]
    show("Selectors on recordings they were not fitted on", header, rows, left=2)
    show_table("Single estimators [deg]", comparison.references)
    show_table("RMSE by kind of driving [deg]", comparison.by_manoeuvre)
    show_table("RMSE by true beta [deg]", comparison.by_band)
    show_table("What leaks when windows are dealt out at random (default tree)", comparison.leakage)


def show_summary(summary: Summary) -> None:
    """Print what is said of estimates: notes, scores, and how the cars were handled."""
    for note in summary.notes:
        say(note)
    if summary.scores:
        show_log_scores(summary.scores)
    for name, share in summary.shares.items():
        say(f"{name}: {shares_text(share)} of the time above walking speed")


def show_log_scores(scores: dict[str, dict[str, Score]]) -> None:
    """Print RMSE / largest error [deg] of each estimator on each log."""
    estimators = list(next(iter(scores.values())))
    rows = [
        [
            log,
            *(
                f"{math.degrees(score.rmse):.2f} / {math.degrees(score.max_error):.1f}"
                for score in each.values()
            ),
        ]
        for log, each in scores.items()
    ]
    show("Error against the logs' ground truth", ["RMSE / max [deg]", *estimators], rows)


def shares_text(shares: dict[str, float]) -> str:
    """Shares in words, those that round to nothing left out."""
    texts = [f"{name} {100.0 * share:.1f} %" for name, share in shares.items() if share >= 0.0005]
    return ", ".join(texts) or "nothing known"


def show_signals(signals: Signals) -> None:
    """Print what is in a log: each channel's unit, measured share and range."""
    t = signals.t
    say(
        f"{signals.source}: {len(signals)} rows, {t[-1] - t[0]:.1f} s, median step {np.median(np.diff(t)):.4g} s"
    )
    rows = []
    for name in signals.frame.columns.drop("t"):
        values = signals.column(name)
        there = values[np.isfinite(values)]
        share = f"{100 * len(there) / len(values):.1f} %"
        low, high = (f"{there.min():.4g}", f"{there.max():.4g}") if there.size else ("", "")
        rows.append([name, UNITS[name], share, low, high])
    show("Channels", ["channel", "unit", "measured", "least", "largest"], rows, left=2)
    absent = [name for name in UNITS if name not in signals.frame]
    say(f"not in the log: {', '.join(absent)}" if absent else "every known channel is there")


def show_confusion(confusion: np.ndarray, names: Sequence[str]) -> None:
    """Print a confusion matrix with counts and row shares."""
    shares = row_shares(confusion)
    rows = [
        [names[i], *(f"{confusion[i, j]} ({100 * shares[i, j]:.0f} %)" for j in range(len(names)))]
        for i in range(len(names))
    ]
    show(
        "Confusion matrix of the folds: windows by best filter (rows) and selected filter",
        ["best", *names],
        rows,
    )

"""What the commands show on a terminal: tables, progress, warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

# Wide enough for a table in a file or a pipe, where rich cannot ask the terminal.
console = Console(highlight=False, soft_wrap=True)
errors = Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """Print a line as it is."""
    console.print(text, markup=False)


def warn(text: str) -> None:
    """Print a warning to the error stream."""
    errors.print(f"warning: {text}", markup=False)


@contextmanager
def progress(text: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on the error stream; gives what advances it by one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True) as bar:
        task = bar.add_task(text, total=total)
        yield lambda: bar.advance(task)


def show(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table; the first `left` columns are words, the others numbers."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table, markup=False)


def show_scores(title: str, rmse: pd.DataFrame, largest: pd.DataFrame, last: str = "mean") -> None:
    """Print RMSE / largest error [deg], recordings as rows and estimators as columns, with a summary row."""
    rows = [
        [str(name), *(f"{rmse.at[name, e]:.2f} / {largest.at[name, e]:.1f}" for e in rmse.columns)]
        for name in rmse.index
    ]
    if len(rows) > 1:
        mean, most = rmse.mean(), largest.max()
        rows.append([f"[b]{last}[/b]", *(f"{mean[e]:.2f} / {most[e]:.1f}" for e in rmse.columns)])
    show(title, ["RMSE / max [deg]", *map(str, rmse.columns)], rows)


def show_confusion(confusion: np.ndarray, shares: np.ndarray, names: Sequence[str]) -> None:
    """Print a confusion matrix with counts and row shares."""
    rows = [
        [names[i], *(f"{confusion[i, j]} ({100 * shares[i, j]:.0f} %)" for j in range(len(names)))]
        for i in range(len(names))
    ]
    show("Confusion matrix of the folds: windows by best filter (rows) and selected filter", ["best", *names], rows)

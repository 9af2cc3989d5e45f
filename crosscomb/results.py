"""Tables of results as Markdown, kept in named sections of one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from crosscomb.files import write_text

if TYPE_CHECKING:
    from crosscomb.training.benchmark import Benchmark

TITLE = "# Results\n\nMeasured with the commands named in each section. Nothing here is typed by hand.\n"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table whose first column is words and whose others are numbers."""
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


def score_rows(
    rmse: pd.DataFrame, largest: pd.DataFrame, summaries: Mapping[str, Sequence[str]]
) -> list[list[str]]:
    """Rows "RMSE / largest error" per recording, then the mean and the maximum over named sets of recordings.

    Parameters
    ----------
    rmse, largest : pandas.DataFrame
        Recordings as rows, estimators as columns [deg].
    summaries : dict
        Text of a summary row to the recordings it is over.
    """
    rows = [
        [str(name), *score_cells(errors, peaks)]
        for name, errors, peaks in zip(rmse.index, rmse.to_numpy(), largest.to_numpy(), strict=True)
    ]
    for text, members in summaries.items():
        chosen = rmse.index.isin(list(members))
        rows.append([text, *score_cells(rmse[chosen].mean().to_numpy(), largest[chosen].max().to_numpy())])
    return rows


def score_cells(rmse: np.ndarray, largest: np.ndarray) -> list[str]:
    """Cells "RMSE / largest error" of one row [deg]."""
    return [f"{error:.2f} / {peak:.1f}" for error, peak in zip(rmse, largest, strict=True)]


def write_section(path: Path, name: str, text: str) -> None:
    """Put a section into a Markdown file, in the place of an earlier one of that name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    section = f"{begin}\n{text.strip()}\n{end}\n"
    old = path.read_text(encoding="utf-8") if path.exists() else TITLE
    if begin in old and end in old:
        before, rest = old.split(begin, 1)
        new = before + section.rstrip("\n") + rest.split(end, 1)[1]
    else:
        new = old.rstrip("\n") + "\n\n" + section
    write_text(path, new)


HOW = {
    "real": "`crosscomb benchmark real --data <folder of the real logs> -o docs/results.md`",
    "simulated": "`crosscomb benchmark simulated -o docs/results.md`",
}


def write_benchmark(path: Path, suite: str, result: Benchmark, speeds: dict[str, float]) -> None:
    """Keep the tables of a benchmark in a Markdown file."""
    rmse, largest = result.evaluation.rmse, result.evaluation.largest
    scores = markdown_table(
        ["recording", *map(str, rmse.columns)], score_rows(rmse, largest, result.summaries)
    )
    pace = markdown_table(["filter", "us per sample"], [[name, f"{us:.2f}"] for name, us in speeds.items()])
    lines = [
        f"## All estimators on {suite} logs",
        f"Made by {HOW[suite]}.",
        "RMSE / largest error in deg over the samples above 3 m/s. `zero` is the answer beta = 0; `switch` is the "
        "artefact; `oracle` picks the best filter of every window of ten samples with the truth in hand. Summary "
        "rows: mean of the RMSE, largest error.",
        scores,
        *(f"- {note}" for note in result.notes),
        "Time per sample on the machine of the run, for the order of magnitude only:",
        pace,
    ]
    write_section(path, suite, "\n\n".join(lines))

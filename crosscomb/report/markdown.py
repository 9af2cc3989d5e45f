"""Tables of results as Markdown, kept in named sections of one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.files import read_bytes, write_text

if TYPE_CHECKING:
    from crosscomb.training.suites.benchmark import Benchmark
    from crosscomb.training.suites.papers_adaptive import PaperTable
    from crosscomb.training.suites.speed import Speed

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


def row_shares(confusion: np.ndarray) -> np.ndarray:
    """Share of each row's windows ``(filters, filters)``; a row without windows gets zeros."""
    return confusion / np.maximum(confusion.sum(axis=1, keepdims=True), 1)


WIDE = 10
"""More estimators than this stand as rows, the recordings as columns."""


def summary_rows(
    rmse: pd.DataFrame, largest: pd.DataFrame, summaries: Mapping[str, Sequence[str]]
) -> list[list[str]]:
    """Rows per estimator, the best first: mean RMSE and largest error over named sets of recordings [deg]."""
    means = {text: rmse.loc[list(members)].mean() for text, members in summaries.items()}
    peaks = {text: largest.loc[list(members)].max() for text, members in summaries.items()}
    order = next(iter(means.values())).sort_values().index
    return [
        [str(name), *(f"{means[text][name]:.2f} / {peaks[text][name]:.1f}" for text in summaries)]
        for name in order
    ]


def number(value: object) -> str:
    """Cell of a table: numbers with three digits, words as they are."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


MOST_BYTES = 1 << 26
"""So large may a Markdown file be."""


def write_section(path: Path, name: str, text: str, title: str = TITLE) -> None:
    """Put a section into a Markdown file, in the place of an earlier one of that name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    section = f"{begin}\n{text.strip()}\n{end}\n"
    try:
        old = read_bytes(path, MOST_BYTES, "Markdown file").decode("utf-8") if path.exists() else title
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is no UTF-8 text: name a Markdown file to keep the tables in") from None
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


def write_benchmark(
    path: Path, suite: str, result: Benchmark, speeds: dict[str, float], selector_file: Path | None = None
) -> None:
    """Keep the tables of a benchmark in a Markdown file.

    Another artefact than the default one, and many estimators, have a section of their own.
    """
    how = HOW[suite]
    if selector_file is not None:
        how = how.replace(" -o", f" --selector-file {selector_file.name} -o")
    many = len(result.evaluation.rmse.columns) > WIDE
    pace = markdown_table(["filter", "us per sample"], [[name, f"{us:.2f}"] for name, us in speeds.items()])
    lines = [
        f"## {'The whole catalogue' if many else 'The switch and its filters'} on {suite} logs"
        f"{f' ({selector_file.stem})' if selector_file else ''}",
        f"Made by {how.replace(' -o', ' --filters all -o') if many else how}.",
        "RMSE / largest error in deg over the samples above 3 m/s. `zero` is the answer beta = 0; `switch` is the "
        "artefact; `oracle` picks the best of the switch's filters in every window of ten samples with the truth in "
        "hand. Summaries: mean of the RMSE, largest error.",
        *(_wide_tables(result) if many else [_tall_table(result)]),
        *(f"- {note}" for note in result.notes),
        "Time per sample on the machine of the run, for the order of magnitude only:",
        pace,
    ]
    ends = ([selector_file.stem] if selector_file else []) + (["all"] if many else [])
    write_section(path, "-".join([suite, *ends]), "\n\n".join(lines))


def _tall_table(result: Benchmark) -> str:
    rmse, largest = result.evaluation.rmse, result.evaluation.largest
    return markdown_table(["recording", *map(str, rmse.columns)], score_rows(rmse, largest, result.summaries))


def _wide_tables(result: Benchmark) -> list[str]:
    rmse, largest = result.evaluation.rmse, result.evaluation.largest
    summary = summary_rows(rmse, largest, result.summaries)
    # Recordings by number: their names are too long for column heads.
    key = [f"{i}: {name}" for i, name in enumerate(rmse.index, start=1)]
    columns = {str(name): rmse[name].to_numpy() for name in rmse.columns}
    rows = [[row[0], *(f"{value:.2f}" for value in columns[row[0]])] for row in summary]
    return [
        markdown_table(["estimator", *result.summaries], summary),
        "RMSE [deg] per recording: " + "; ".join(key) + ".",
        markdown_table(["estimator", *map(str, range(1, len(rmse) + 1))], rows),
    ]


def write_papers(path: Path, tables: Mapping[str, PaperTable]) -> None:
    """Keep the rebuilt tables of the papers in a Markdown file."""
    lines = [
        "## Tables of the papers, rebuilt with our data",
        "Made by `crosscomb benchmark papers -o docs/results.md`. All logs are simulated; noise settings are the "
        "defaults, where the papers tuned theirs.",
    ]
    for name, paper in tables.items():
        table = paper.table
        rows = [[str(i), *map(number, row)] for i, row in zip(table.index, table.to_numpy(), strict=True)]
        lines += [f"### {name}", markdown_table(["", *map(str, table.columns)], rows), paper.verdict]
    write_section(path, "papers", "\n\n".join(lines))


SPEED_HEADER = (
    "estimator", "twin in", "kernel us", "twin us", "ratio", "middle half", "on compiled models", "beta apart deg",
)  # fmt: skip


def speed_rows(speeds: Sequence[Speed]) -> list[list[str]]:
    """Cells of `SPEED_HEADER` for each kernel and twin."""
    return [
        [speed.pair.name, speed.pair.made_of, f"{speed.kernel:.3g}", f"{speed.twin:,.0f}", f"{speed.ratio:,.1f}",
         f"{speed.low:,.1f} to {speed.high:,.1f}", f"{speed.compiled:,.1f}", f"{speed.apart:.0e}"]
        for speed in speeds
    ]  # fmt: skip


def write_speeds(path: Path, speeds: Sequence[Speed]) -> None:
    """Keep the table of kernels and twins in a Markdown file."""
    lines = [
        "## Kernels beside their twins on filterpy and numpy",
        "Made by `crosscomb benchmark speed -o docs/results.md` on the machine of the run: times change from machine "
        "to machine and with what else runs, ratios less so. Processor time per sample, medians of up to nine repeats "
        "in which kernel and twin run in turn; the middle half of the repeats' ratios is their scatter. A twin does "
        "the same work with filterpy's class, or in numpy, and calls the same model functions uncompiled, as its user "
        "would write them; `on compiled models` is the ratio of the twin that calls them compiled, which leaves "
        "filterpy's own cost. Particle filters draw other random numbers than their twins, hence the larger "
        "difference of beta.",
        markdown_table(SPEED_HEADER, speed_rows(speeds)),
    ]
    write_section(path, "speed", "\n\n".join(lines))

"""Before and after of a tuning: the file for the commands, tables and a picture for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crosscomb.files import versions, write_file, write_text
from crosscomb.report import terminal
from crosscomb.report.markdown import markdown_table
from crosscomb.report.pictures import COLOURS, save_figure
from crosscomb.run.tuned import Tuned, TunedNoise
from crosscomb.training.tuning.scores import ERROR
from crosscomb.training.tuning.tune import FilterTuning, Tuning

COLUMNS = ("before", "tuned on other logs", "tuned on all logs")
MOST_NAMES = 40
"""More recordings than this stand in the picture without their names."""


def to_tuned(tuning: Tuning, record: Mapping[str, Any]) -> Tuned:
    """Make the content of TUNED.json: the noise that was accepted, and the record of all of it."""
    return Tuned(
        by="error" if tuning.by == ERROR else "likelihood",
        filters=[
            TunedNoise(name=each.entry.name, noise=each.noise) for each in tuning.filters if each.accepted
        ],
        record={
            **record,
            "versions": versions(),
            "scores": {
                each.entry.name: {
                    "accepted": each.accepted,
                    "evaluations": each.evaluations,
                    "tuned_noise": each.noise,
                    "factors": {name: round(factor, 6) for name, factor in each.factors.items()},
                    **{
                        column: {name: round(float(value), 6) for name, value in table.items()}
                        for column, table in tuning_table(tuning, each).items()
                    },
                }
                for each in tuning.filters
            },
        },
    )


def tuning_table(tuning: Tuning, each: FilterTuning) -> pd.DataFrame:
    """Score of each recording before and after, recordings as rows: RMSE [deg] or minus log likelihood per sample."""
    values = np.column_stack([each.before, each.held_out, each.after])
    return pd.DataFrame(values, index=tuning.recordings, columns=list(COLUMNS))


def beside_tuned(path: Path) -> list[Path]:
    """Files that `write_tuning` writes beside a TUNED.json."""
    return [path.with_suffix(f".tuning{end}") for end in (".csv", ".md", ".png")]


def write_tuning(tuning: Tuning, path: Path) -> list[Path]:
    """Write what belongs beside a TUNED.json: the table as CSV, a Markdown page and a picture.

    Returns
    -------
    list of Path
        The files written.
    """
    table_path, page_path, picture_path = paths = beside_tuned(path)
    table = pd.concat({each.entry.name: tuning_table(tuning, each) for each in tuning.filters})
    table = table.rename_axis(["filter", "recording"])
    table.columns = ["before", "held_out", "after"]
    write_file(table_path, lambda temporary: table.to_csv(temporary, lineterminator="\n"))
    write_text(page_path, tuning_page(tuning, picture_path.name))
    save_figure(tuning_figure(tuning), picture_path)
    return paths


def measure(tuning: Tuning) -> str:
    """What the scores are."""
    return "RMSE [deg]" if tuning.by == ERROR else "minus log likelihood per sample"


def verdict(each: FilterTuning) -> str:
    """One line on a filter: whether its tuned noise is taken, and how the settings moved."""
    name, before, held_out = each.entry.name, each.before.mean(), each.held_out.mean()
    change = f"{before:.3g} to {held_out:.3g} on average on logs it was not tuned on"
    if not each.accepted:
        return f"{name}: stays as it was, tuning does not help enough on other logs ({change})"
    moved = [f"{key} x {factor:.3g}" for key, factor in each.factors.items() if factor != 1.0]
    return f"{name}: tuned, {change}; {', '.join(moved)}"


def tuning_rows(tuning: Tuning, each: FilterTuning) -> list[list[str]]:
    """Rows of a printed table: each recording, then the mean."""
    table = tuning_table(tuning, each)
    table.loc["mean"] = table.mean()
    return [
        [str(name), *(f"{value:.3f}" for value in row)]
        for name, row in zip(table.index, table.to_numpy(), strict=True)
    ]


def show_tuning(tuning: Tuning) -> None:
    """Print before and after of each filter, and the verdicts."""
    for each in tuning.filters:
        title = f"{each.entry.name}, {measure(tuning)}"
        terminal.show(title, ["recording", *COLUMNS], tuning_rows(tuning, each))
    for each in tuning.filters:
        terminal.say(verdict(each))


def tuning_page(tuning: Tuning, picture: str) -> str:
    """Markdown page on a tuning."""
    blocks = [
        "# Tuned noise",
        f"{measure(tuning)} of each recording. Judge by the middle column: its noise was tuned without the recording. "
        "The last one has seen them all.",
        f"![before and after]({picture})",
    ]
    for each in tuning.filters:
        settings = [[name, f"{factor:.4g}"] for name, factor in each.factors.items()]
        blocks += [
            f"## {each.entry.name}",
            verdict(each) + ".",
            markdown_table(["recording", *COLUMNS], tuning_rows(tuning, each)),
            markdown_table(["setting", "tuned / before"], settings),
        ]
    return "\n\n".join(blocks) + "\n"


def tuning_figure(tuning: Tuning) -> Figure:
    """Draw, for each filter, the score of each recording before and after, and how far the settings moved."""
    count = len(tuning.filters)
    height = 1.6 + 0.22 * min(len(tuning.recordings), MOST_NAMES)
    figure = Figure(figsize=(12, 0.6 + count * max(2.4, height)), layout="constrained")
    axes = figure.subplots(count, 2, squeeze=False, width_ratios=(2.2, 1))
    for (scores, factors), each in zip(axes, tuning.filters, strict=True):
        _draw_scores(scores, tuning, each)
        _draw_factors(factors, each)
    marks, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(marks, labels, loc="outside upper left", ncols=len(COLUMNS), fontsize=9, frameon=False)
    return figure


def _draw_scores(axis: Axes, tuning: Tuning, each: FilterTuning) -> None:
    rows = np.arange(len(tuning.recordings))[::-1]
    axis.hlines(rows, each.before, each.held_out, color="0.7", lw=2, zorder=1)
    axis.scatter(each.before, rows, color="0.35", marker="o", s=26, label=COLUMNS[0], zorder=2)
    axis.scatter(each.after, rows, facecolors="none", edgecolors=COLOURS[0], marker="s", s=26,
                 label=COLUMNS[2], zorder=2)  # fmt: skip
    axis.scatter(each.held_out, rows, color=COLOURS[1], marker="D", s=26, label=COLUMNS[1], zorder=3)
    if len(rows) <= MOST_NAMES:
        axis.set_yticks(rows, tuning.recordings, fontsize=8)
    else:
        axis.set_yticks([])
        axis.set_ylabel("recordings")
    axis.set_xlabel(measure(tuning))
    if tuning.by == ERROR:
        axis.set_xlim(left=0.0)
    axis.set_title(f"{each.entry.name}: {'tuned' if each.accepted else 'stays as it was'}")
    axis.grid(axis="x", alpha=0.3)


def _draw_factors(axis: Axes, each: FilterTuning) -> None:
    names, factors = list(each.factors), np.array(list(each.factors.values()))
    rows = np.arange(len(names))[::-1]
    axis.barh(rows, factors - 1.0, left=1.0, color=COLOURS[1] if each.accepted else "0.75", height=0.6)
    axis.axvline(1.0, color="0.35", lw=1.0)
    axis.set_xscale("log")
    axis.set_xlim(8e-3, 125.0)
    axis.set_yticks(rows, names, fontsize=8)
    axis.set_xlabel("tuned / before")
    axis.grid(axis="x", alpha=0.3)

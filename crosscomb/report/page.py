"""Pictures and pages that people read: estimates, confusion matrices, the report of a training."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from crosscomb.files import write_file, write_text
from crosscomb.report.tree_view import tree_figure, tree_text
from crosscomb.run.estimate import LogEstimate
from crosscomb.run.handling import STATES
from crosscomb.signals import MIN_SPEED

if TYPE_CHECKING:
    from crosscomb.training.selectors.evaluate import Evaluation
    from crosscomb.training.selectors.train import Training

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colour of each filter, told apart by colour-blind eyes (Okabe and Ito)."""


STATE_COLOURS = dict(zip(STATES, ("0.88", COLOURS[0], COLOURS[4], COLOURS[1], "white"), strict=True))
"""Colour of each state of handling."""


def estimate_figure(estimate: LogEstimate, title: str) -> Figure:
    """Draw beta with its band and the reference, the active filter, the handling, and the signals it was chosen by.

    Parameters
    ----------
    estimate : LogEstimate
    title : str
    """
    t = estimate.signals.t - estimate.signals.t[0]
    names = list(estimate.filters)
    moving = estimate.signals.column("vx") > MIN_SPEED
    figure = Figure(figsize=(12, 7.4), layout="constrained")
    main, strip, balance, inputs = figure.subplots(4, 1, sharex=True, height_ratios=(5, 0.6, 0.6, 2.2))
    beta, band = np.degrees(estimate.beta), np.degrees(1.96 * estimate.beta_std)
    for colour, name in zip(COLOURS, names, strict=False):
        main.plot(t, np.degrees(estimate.filters[name]), color=colour, lw=0.7, alpha=0.55, label=name)
    main.fill_between(t, beta - band, beta + band, color="0.75", alpha=0.6, lw=0, label="± 1.96 beta_std")
    main.plot(t, beta, color="black", lw=1.4, label="crosscomb")
    reference = np.where(moving, np.degrees(estimate.signals.beta_ref), np.nan)
    shown = [beta[moving]] if moving.any() else [beta]
    if np.isfinite(reference).any():
        main.plot(t, reference, color="#e6007e", lw=1.2, ls="--", label="reference")
        shown.append(reference[np.isfinite(reference)])
    _limits(main, np.concatenate(shown))
    main.axhline(0.0, color="0.5", lw=0.5)
    main.set_ylabel("beta [deg]")
    main.set_title(title)
    main.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    for colour, name in zip(COLOURS, names, strict=False):
        strip.fill_between(t, 0, 1, where=estimate.active == name, color=colour, lw=0, step="post")
    strip.fill_between(t, 0, 1, where=~moving, color="white", alpha=0.75, lw=0, step="post")
    for state, colour in STATE_COLOURS.items():
        here = estimate.handling.state == state
        balance.fill_between(t, 0, 1, where=here, color=colour, lw=0, step="post")
    for axis, label in ((strip, "active"), (balance, "handling")):
        axis.set_yticks([])
        axis.set_ylim(0.0, 1.0)
        axis.set_ylabel(label, rotation=0, ha="right", va="center")
    shown_states = [Patch(fc=STATE_COLOURS[state], ec="0.6", label=state) for state in STATES]
    balance.legend(handles=shown_states, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, ncols=2,
                   frameon=False, columnspacing=1.0, handlelength=1.0)  # fmt: skip
    inputs.plot(t, estimate.signals.column("ay"), color="0.25", lw=0.7, label="ay [m/s²]")
    inputs.plot(t, np.degrees(estimate.signals.column("yaw_rate")) / 10.0, color=COLOURS[4], lw=0.9,
                label="yaw rate [10 deg/s]")  # fmt: skip
    inputs.plot(t, estimate.signals.column("vx") / 10.0, color=COLOURS[5], lw=0.9, label="vx [10 m/s]")
    inputs.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    inputs.set_xlabel("t [s]")
    for axis in (main, inputs):
        axis.grid(alpha=0.3)
    return figure


def _limits(axis: Axes, values: np.ndarray) -> None:
    """Scale to what is estimated, not to a single filter that runs off."""
    low, high = float(values.min()), float(values.max())
    margin = max(1.0, 0.25 * (high - low))
    axis.set_ylim(low - margin, high + margin)


def plot_estimate(estimate: LogEstimate, path: Path, title: str) -> None:
    """Write the picture of an estimate as PNG."""
    save_figure(estimate_figure(estimate, title), path)


def extras_figure(table: pd.DataFrame, title: str) -> Figure:
    """Draw what estimators tell beside beta, each quantity over time, that of all estimators in one picture.

    Parameters
    ----------
    table : pandas.DataFrame
        As of `crosscomb.run.estimate.LogEstimate.extras_table`.
    title : str
    """
    told = [str(column).partition(" ") for column in table.columns.drop("t")]
    quantities = list(dict.fromkeys(quantity for _, _, quantity in told))
    figure = Figure(figsize=(12, 1.2 + 1.9 * len(quantities)), layout="constrained")
    axes = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for axis, quantity in zip(axes, quantities, strict=True):
        for name in (name for name, _, other in told if other == quantity):
            axis.plot(table["t"] - table["t"].iloc[0], table[f"{name} {quantity}"], lw=0.9, label=name)
        axis.set_ylabel(quantity.replace(" [", "\n["), fontsize=8)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
        axis.grid(alpha=0.3)
    axes[0].set_title(title)
    axes[-1].set_xlabel("t [s]")
    return figure


def plot_extras(table: pd.DataFrame, path: Path, title: str) -> None:
    """Write the picture of what estimators tell beside beta as PNG."""
    save_figure(extras_figure(table, title), path)


def confusion_figure(confusion: np.ndarray, names: Sequence[str]) -> Figure:
    """Draw a confusion matrix with counts and row shares.

    Parameters
    ----------
    confusion : (filters, filters) int
        Windows by best filter (rows) and selected filter (columns).
    names : sequence of str
    """
    shares = row_shares(confusion)
    figure = Figure(figsize=(6.2, 5.2), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(shares, vmin=0.0, vmax=1.0, cmap="Blues")
    for i in range(len(names)):
        for j in range(len(names)):
            axis.text(j, i, f"{confusion[i, j]}\n{100 * shares[i, j]:.0f} %", ha="center", va="center",
                      color="white" if shares[i, j] > 0.5 else "black")  # fmt: skip
    axis.set_xticks(range(len(names)), names, rotation=20, ha="right")
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel("selected")
    axis.set_ylabel("best in the window")
    axis.set_title("Windows of recordings not seen in fitting")
    figure.colorbar(image, label="share of the row")
    return figure


def row_shares(confusion: np.ndarray) -> np.ndarray:
    """Share of each row's windows ``(filters, filters)``; a row without windows gets zeros."""
    return confusion / np.maximum(confusion.sum(axis=1, keepdims=True), 1)


def confusion_table(confusion: np.ndarray, names: Sequence[str]) -> pd.DataFrame:
    """Confusion matrix as a table: one row per best filter, counts and then row shares per selected one."""
    counts = pd.DataFrame(confusion, index=list(names), columns=[f"selected_{name}" for name in names])
    shares = pd.DataFrame(
        row_shares(confusion), index=list(names), columns=[f"share_{name}" for name in names]
    )
    return pd.concat([counts, shares], axis=1).rename_axis("best")


def beside_artefact(artefact_path: Path) -> list[Path]:
    """Files that `write_training` writes beside an artefact."""
    names = (
        "report.html",
        "confusion_matrix.csv",
        "confusion_matrix.png",
        "metrics.json",
        "tree.txt",
        "tree.png",
    )
    return [artefact_path.with_name(name) for name in names]


def write_training(training: Training, artefact_path: Path, notes: Sequence[str]) -> list[Path]:
    """Write what belongs beside an artefact: report, confusion matrix, metrics and the tree to read.

    Returns
    -------
    list of Path
        The files written.
    """
    names = training.artefact.filter_names
    confusion = training.folds.confusion
    paths = beside_artefact(artefact_path)
    write_file(paths[1], lambda path: confusion_table(confusion, names).to_csv(path, lineterminator="\n"))
    save_figure(confusion_figure(confusion, names), paths[2])
    write_text(paths[3], metrics_json(training))
    write_text(paths[4], tree_text(training.artefact))
    save_figure(tree_figure(training.artefact), paths[5])
    write_text(paths[0], training_page(training, artefact_path.name, notes))
    return paths


def metrics_json(training: Training) -> str:
    """Scores of a training for programs [deg]."""
    content = {
        "selector": training.artefact.selector_name,
        "depth": training.shape.depth,
        "parts": {
            part: {
                "recordings": list(map(str, evaluation.table.index)),
                "best_single": evaluation.best_single,
                "switch_to_best_single": evaluation.ratio,
                "overall_deg": json.loads(evaluation.overall.to_json(orient="index", double_precision=6)),
                "per_recording_deg": {
                    str(name): {
                        "_".join(map(str, column)): round(float(row[column]), 6) for column in row.index
                    }
                    for name, row in evaluation.table.iterrows()
                },
                "confusion": evaluation.confusion.tolist(),
            }
            for part, evaluation in training.evaluations.items()
        },
    }
    return json.dumps(content, indent=1) + "\n"


STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1 { margin-bottom: 0 } table { border-collapse: collapse; margin: .6rem 0 1.4rem; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .7rem; border-bottom: 1px solid #ddd; text-align: right } th:first-child { text-align: left }
thead th { border-bottom: 2px solid #888; font-weight: 600; vertical-align: bottom } .best { font-weight: 700 }
p.note { color: #555 } img { max-width: 100% }
"""


def training_page(training: Training, artefact_name: str, notes: Sequence[str]) -> str:
    """One self-contained page on a training."""
    record = training.artefact.training
    blocks = [
        f"<h1>{html.escape(artefact_name)}</h1>",
        f"<p class=note>Selector {html.escape(training.artefact.selector_name)}, depth {training.shape.depth}; "
        f"{len(record['data'])} recordings, seed {record['seed']}. Every figure below is of trees that had not seen "
        f"the recording; the tree in the file was fitted on all of them afterwards.</p>",
    ]
    explained = {
        "folds": "Grouped folds inside the training part (75 %). What was chosen or calibrated was so on folds "
        "inside each of them.",
        "validation": "Validation part (15 %): judged by a tree fitted on the training part.",
        "test": "Test part (10 %): judged by the same tree.",
    }
    for part, evaluation in training.evaluations.items():
        blocks.append(f"<h2>{part.capitalize()}</h2><p class=note>{explained[part]}</p>")
        blocks.append(_overall_html(evaluation))
        blocks.append(_recordings_html(evaluation))
    image = _as_png(confusion_figure(training.folds.confusion, training.artefact.filter_names))
    blocks.append("<h2>Confusion matrix of the folds</h2>")
    blocks.append(
        f'<img alt="confusion matrix" src="data:image/png;base64,{base64.b64encode(image).decode()}">'
    )
    blocks.append("<h2>The tree</h2>")
    image = _as_png(tree_figure(training.artefact))
    blocks.append(f'<img alt="tree" src="data:image/png;base64,{base64.b64encode(image).decode()}">')
    blocks.append(f"<pre>{html.escape(tree_text(training.artefact))}</pre>")
    if notes:
        blocks.append(
            "<h2>Notes</h2><ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in notes) + "</ul>"
        )
    blocks.append("<h2>Parts</h2>")
    for part, members in record["parts"].items():
        blocks.append(f"<p><b>{part}</b>: {html.escape(', '.join(members))}</p>")
    body = "\n".join(blocks)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(artefact_name)}</title>'
        f"<style>{STYLE}</style></head><body>{body}</body></html>\n"
    )


def _overall_html(evaluation: Evaluation) -> str:
    overall = evaluation.overall
    head = "".join(f"<th>{html.escape(str(name))}</th>" for name in overall.index)
    rows = []
    for measure, text in (("rmse", "mean RMSE [deg]"), ("max", "largest error [deg]")):
        rows.append(f"<tr><th>{text}</th>{_cells(overall[measure])}</tr>")
    ratio = (
        f"<p>Switch / best single filter ({html.escape(evaluation.best_single)}): "
        f"<b>{evaluation.ratio:.3f}</b></p>"
    )
    return f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>{ratio}"


def _recordings_html(evaluation: Evaluation) -> str:
    rmse = evaluation.rmse
    head = "".join(f"<th>{html.escape(str(name))}</th>" for name in rmse.columns)
    pairs = zip(rmse.iterrows(), evaluation.largest.iterrows(), strict=True)
    rows = "".join(
        f"<tr><th>{html.escape(str(name))}</th>{_cells(row, largest)}</tr>"
        for (name, row), (_, largest) in pairs
    )
    return f"<table><thead><tr><th>RMSE / max [deg]</th>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _cells(row: pd.Series, largest: pd.Series | None = None) -> str:
    """Table cells of one row, with the largest errors where given; the best real estimate is bold."""
    best = row.drop("oracle").min()
    return "".join(
        f"<td{' class=best' if name != 'oracle' and value == best else ''}>{value:.2f}"
        f"{'' if largest is None else f' / {largest.iloc[i]:.1f}'}</td>"
        for i, (name, value) in enumerate(row.items())
    )


def _as_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture as PNG, whole or not at all."""
    content = _as_png(figure)
    write_file(path, lambda temporary: temporary.write_bytes(content))

"""The page on a training."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from crosscomb.report.pictures import as_png, confusion_figure
from crosscomb.report.tree_view import tree_figure, tree_text

if TYPE_CHECKING:
    from crosscomb.training.selectors.evaluate import Evaluation
    from crosscomb.training.selectors.train import Training

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
    image = as_png(confusion_figure(training.folds.confusion, training.artefact.filter_names))
    blocks.append("<h2>Confusion matrix of the folds</h2>")
    blocks.append(
        f'<img alt="confusion matrix" src="data:image/png;base64,{base64.b64encode(image).decode()}">'
    )
    blocks.append("<h2>The tree</h2>")
    image = as_png(tree_figure(training.artefact))
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

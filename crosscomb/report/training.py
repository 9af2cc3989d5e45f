"""What `train` writes: the artefact and, beside it, how good it is."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from crosscomb.files import run_record, write_file, write_json, write_text
from crosscomb.report.markdown import row_shares
from crosscomb.report.page import training_page
from crosscomb.report.pictures import confusion_figure, save_figure
from crosscomb.report.tree_view import tree_figure, tree_text
from crosscomb.selection.artefact import save_artefact

if TYPE_CHECKING:
    from crosscomb.training.selectors.compare import Comparison
    from crosscomb.training.selectors.train import Training


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


def training_files(artefact_path: Path) -> list[Path]:
    """All files that `write_artefact` writes."""
    return [artefact_path, _record_file(artefact_path), *beside_artefact(artefact_path)]


def _record_file(artefact_path: Path) -> Path:
    return artefact_path.with_suffix(".run.json")


def comparison_file(artefact_path: Path) -> Path:
    """Where the comparison of all selectors stands."""
    return artefact_path.with_name("comparison.json")


def write_comparison(comparison: Comparison, artefact_path: Path) -> None:
    """Write the comparison of all selectors."""
    write_text(comparison_file(artefact_path), comparison.to_json())


def write_artefact(
    training: Training,
    artefact_path: Path,
    notes: Sequence[str],
    settings: dict[str, Any],
    inputs: Sequence[Path],
) -> list[Path]:
    """Write an artefact, what belongs beside it, and the record of the run.

    Parameters
    ----------
    training : Training
    artefact_path : Path
    notes : sequence of str
        What was skipped in the data, and why.
    settings : dict
        Of the run, for its record.
    inputs : sequence of Path
        Files that it read, for its record.

    Returns
    -------
    list of Path
        The files written beside the artefact and the record.
    """
    save_artefact(training.artefact, artefact_path)
    paths = write_training(training, artefact_path, notes)
    write_json(_record_file(artefact_path), run_record("train", settings, inputs))
    return paths


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


def confusion_table(confusion: np.ndarray, names: Sequence[str]) -> pd.DataFrame:
    """Confusion matrix as a table: one row per best filter, counts and then row shares per selected one."""
    counts = pd.DataFrame(confusion, index=list(names), columns=[f"selected_{name}" for name in names])
    shares = pd.DataFrame(
        row_shares(confusion), index=list(names), columns=[f"share_{name}" for name in names]
    )
    return pd.concat([counts, shares], axis=1).rename_axis("best")

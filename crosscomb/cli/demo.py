"""The command `demo`: everything once, on a small set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for everything the demo makes.")
    ] = Path("crosscomb-demo"),
) -> None:
    """Simulate, train and estimate on a small set, in under a minute."""
    from crosscomb.cli.estimate import answer
    from crosscomb.cli.simulate import make_logs
    from crosscomb.cli.train import learn
    from crosscomb.filters.catalogue import DEFAULT_FILTERS
    from crosscomb.logs.intake import open_logs
    from crosscomb.models.vehicle import load_vehicle
    from crosscomb.report import terminal
    from crosscomb.report.estimates import Sources
    from crosscomb.training.recordings import files_of, read_recordings

    car, logs, selector = load_vehicle("generic_compact"), output / "logs", output / "selector.json"
    make_logs(car, logs, seed=1, logs=30, force=True, jobs=2, preset="quick")
    recordings, notes = read_recordings(logs)
    settings = {
        "selector": "tree", "folds": 5, "seed": 0, "rate": 100.0, "vehicle": None, "filters": list(DEFAULT_FILTERS),
        "tuned": None, "tune_budget": 0,  # noise tuned on logs this short would be no better
    }  # fmt: skip
    artefact = learn(recordings, selector, settings, 2, notes=notes, inputs=files_of(recordings)).artefact
    fresh = make_logs(car, output / "unseen", seed=2, logs=3, force=True, jobs=2, preset="quick")
    opened = open_logs(sorted(fresh), artefact.vehicle)
    answer(opened, artefact, output / "estimates", Sources(selector), plot=True)
    terminal.say(
        f"look at {output / 'estimates'} (pictures) and {output / 'report.html'} (how well it was trained)"
    )

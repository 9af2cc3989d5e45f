"""Tuned noise against default noise on the shared real logs, each tested with noise tuned on the others.

    python benchmarks/tuned_against_default.py FOLDER_OF_REAL_LOGS [--filters dynamic_ekf] [--evaluations 50]

Nothing that a recording is judged by has seen it: its noise comes from the eleven others, its car from the vehicle
file. A filter whose default noise held up better on the folds inside those eleven keeps it, as in `crosscomb tune`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import FilterSettings
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.selectors.train import RATE, default_filters
from crosscomb.training.suites.benchmark import SHARED_SET
from crosscomb.training.tuning.scores import ERROR, prepare, score_logs
from crosscomb.training.tuning.tune import tune

DIVERGED = 15.0
"""RMSE [deg] from which a filter counts as diverged: the largest sideslip angle of the set is 11 deg."""

BAR = 0.30
"""Fall of the mean RMSE that is asked for, of tuned noise and identified car together."""

Identify = Callable[[Recording], Vehicle]
"""The car to test a recording with, found without its ground truth."""


def as_in_file(recording: Recording) -> Vehicle:
    """The car of the vehicle file."""
    return recording.vehicle


def test_one(
    index: int, recordings: Sequence[Recording], entry: FilterSettings, evaluations: int, seed: int
) -> FilterSettings:
    """The filter with noise tuned on all recordings but one."""
    others = [recording for i, recording in enumerate(recordings) if i != index]
    return tune(others, [entry], RATE, ERROR, evaluations, seed=seed).filters[0].kept


def compare(
    recordings: Sequence[Recording],
    name: str,
    evaluations: int,
    seed: int = 0,
    jobs: int = 2,
    identify: Identify = as_in_file,
) -> pd.DataFrame:
    """RMSE [deg] of a filter on each recording: by default, and tuned and identified without its truth."""
    entry = default_filters(recordings[0].vehicle, [name])[0]
    cars = [replace(recording, vehicle=identify(recording)) for recording in recordings]
    work = (delayed(test_one)(i, cars, entry, evaluations, seed) for i in range(len(cars)))
    tuned = Parallel(n_jobs=jobs, max_nbytes=None)(work)
    columns = {
        "default": score_logs(entry, prepare(recordings, RATE), ERROR),
        "identified": score_logs(entry, prepare(cars, RATE), ERROR),
        "tuned": np.array([
            score_logs(kept, prepare([car], RATE), ERROR)[0] for kept, car in zip(tuned, cars, strict=True)
        ]),
    }  # fmt: skip
    table = pd.DataFrame(columns, index=[recording.name for recording in recordings])
    return table.assign(accepted=[kept != entry for kept in tuned])


def shared_recordings(folder: Path) -> list[Recording]:
    """The recordings of the shared real set."""
    found = {recording.name: recording for recording in read_recordings(folder)[0]}
    missing = [name for name in SHARED_SET if name not in found]
    if missing:
        raise SystemExit(f"{folder}: not there: {', '.join(missing)}")
    return [found[name] for name in SHARED_SET]


def main() -> None:
    """Print a table for each filter, and the mean fall of its error."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--filters", default="dynamic_ekf", help="a,b,c, or all three: " + ", ".join(list(CATALOGUE)[:3])
    )
    parser.add_argument("--evaluations", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    recordings = shared_recordings(options.folder)
    for name in options.filters.split(","):
        table = compare(recordings, name, options.evaluations, options.seed, options.jobs)
        print(f"\n{name}, RMSE [deg]\n{table.round(2).to_string()}")
        default, tuned = table["default"].mean(), table["tuned"].mean()
        worst = table["tuned"].max()
        print(
            f"mean {default:.3f} -> {tuned:.3f}: falls by {1 - tuned / default:.1%} "
            f"(asked for with identified cars: {BAR:.0%})"
        )
        print(f"largest RMSE {worst:.1f} deg: {'none diverges' if worst < DIVERGED else 'DIVERGED'}")


if __name__ == "__main__":
    main()

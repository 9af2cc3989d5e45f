"""How much windows of ay and yaw rate can tell: what boosted trees get out of them, beside one tree and the oracle.

Run with ``python benchmarks/selector_bound.py LEARN FRESH``; the folders are those of ``selector_accuracy.py``. Per
filter, boosted trees learn from the windows of LEARN how much worse than the best filter it is; on FRESH that is taken
that should lose least. They are far larger than a tree that can be read, so what they miss is not in the windows.
RMSE is over whole windows, without a switch, in the mean over recordings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from crosscomb.training.fit import SELECTORS
from crosscomb.training.fit_boosted import fit_trees
from crosscomb.training.fit_correction import recording_weights
from crosscomb.training.fit_tree import fit_tree
from crosscomb.training.labels import Windows, concatenate
from crosscomb.training.recordings import read_recordings
from crosscomb.training.train import default_filters, make_fitter


def windows_of(folder: Path, jobs: int) -> tuple[Windows, np.ndarray]:
    """Labelled windows of a folder, and the recording of each."""
    recordings = read_recordings(folder)[0]
    fitter = make_fitter(recordings, "tree", default_filters(recordings[0].vehicle), 1, jobs=jobs)
    members = range(len(recordings))
    return concatenate(fitter.windows), fitter.owner(members)


def mean_rmse(square: np.ndarray, owner: np.ndarray) -> float:
    """Mean over recordings [deg] of the root of the mean square error of windows."""
    return float(np.degrees(np.mean(np.sqrt(np.bincount(owner, square) / np.bincount(owner)))))


def main() -> None:
    """Print RMSE and its ratio to the best single filter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("learn", type=Path)
    parser.add_argument("fresh", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    learn, owner = windows_of(options.learn, options.jobs)
    fresh, fresh_owner = windows_of(options.fresh, options.jobs)
    square, every = fresh.rmse**2, np.arange(len(fresh.rmse))
    singles = [mean_rmse(square[:, i], fresh_owner) for i in range(square.shape[1])]
    best = min(singles)
    weight = recording_weights(learn.rmse[:, int(np.argmin(singles))], owner)
    excess = np.degrees(learn.rmse - learn.rmse.min(axis=1, keepdims=True)) * weight[:, None]
    foretold = [
        fit_trees(learn.features, np.minimum(lost, 30.0), 0, 150).predict(fresh.features) for lost in excess.T
    ]
    shape = SELECTORS["tree"].shapes[1]
    tree = fit_tree(learn.features, learn, True, shape, 0, weight).predict(fresh.features)
    rows = {
        "best single filter": best,
        "one tree": mean_rmse(square[every, tree], fresh_owner),
        "boosted trees": mean_rmse(square[every, np.argmin(foretold, axis=0)], fresh_owner),
        "oracle": mean_rmse(square.min(axis=1), fresh_owner),
    }
    for name, rmse in rows.items():
        print(f"{name:20} {rmse:.3f} deg, ratio {rmse / best:.3f}")


if __name__ == "__main__":
    main()

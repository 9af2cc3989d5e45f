"""How much windows of ay and yaw rate can tell: what boosted trees get out of them, beside one tree and the oracle.

Run with ``python benchmarks/selector_bound.py LEARN FRESH [REAL]``; folders and tables are those of
``selector_accuracy.py``. Per filter, boosted trees learn from windows how much worse than the best filter it is; on
windows of other recordings that filter is taken that should lose least. They are far larger than a tree that can be
read, so what they miss is not in the windows. RMSE is over whole windows, without a switch, in the mean over
recordings.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from selector_accuracy import beside_real, fitter_of, is_of_cars, read

from crosscomb.training.selectors.fit import SELECTORS, Fitter
from crosscomb.training.selectors.fit_boosted import fit_trees
from crosscomb.training.selectors.fit_correction import recording_weights
from crosscomb.training.selectors.fit_tree import fit_tree
from crosscomb.training.suites.benchmark import SHARED_SET

ROWS = ("one tree", "boosted trees", "oracle")


def squares(fitter: Fitter, learned: Sequence[int], judged: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean square error [rad^2] of recordings by filter ``(judged, filters)`` and by the rows of `ROWS`."""
    learn, owner = fitter.together(learned), fitter.owner(learned)
    windows, judged_owner = fitter.together(judged), fitter.owner(judged)
    weight = recording_weights(learn.rmse[:, fitter.safe(learned)], owner) * fitter.balance(learned)[owner]
    excess = np.degrees(learn.rmse - learn.rmse.min(axis=1, keepdims=True)) * weight[:, None]
    foretold = [
        fit_trees(learn.features, [np.minimum(lost, 30.0)], 0, 150)[0].predict(windows.features)
        for lost in excess.T
    ]
    tree = fit_tree(learn.features, learn, True, SELECTORS["tree"].shape, 0, weight)
    chosen = (tree.predict(windows.features), np.argmin(foretold, axis=0), windows.label)
    every, square = np.arange(len(windows.rmse)), windows.rmse**2
    counts = np.bincount(judged_owner)

    def mean(column: np.ndarray) -> np.ndarray:
        return np.bincount(judged_owner, column) / counts

    return (
        np.column_stack([mean(column) for column in square.T]),
        np.column_stack([mean(square[every, one]) for one in chosen]),
    )


def show(title: str, single: np.ndarray, others: np.ndarray) -> None:
    """Print mean RMSE of recordings and its ratio to the best single filter."""
    best = float(np.degrees(np.sqrt(single).mean(axis=0).min()))
    print(f"\n{title}: {len(single)} recordings\n{'best single filter':20} {best:.3f} deg")
    for name, rmse in zip(ROWS, np.degrees(np.sqrt(others).mean(axis=0)), strict=True):
        print(f"{name:20} {rmse:.3f} deg, ratio {rmse / best:.3f}")


def main() -> None:
    """Print RMSE and its ratio to the best single filter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("learn", type=Path)
    parser.add_argument("fresh", type=Path)
    parser.add_argument("real", type=Path, nargs="?")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    folders = [read(one) for one in (options.learn, options.fresh, options.real) if one is not None]
    recordings = [one for folder in folders for one in folder]
    fitter = fitter_of(recordings, "tree", options.jobs)
    starts = np.cumsum([0, *map(len, folders)]).tolist()
    learn, fresh, *rest = [list(range(begin, end)) for begin, end in pairwise(starts)]
    show("fresh simulated logs", *squares(fitter, learn, fresh))
    if not rest:
        return
    (real,) = rest
    shared = [i for i in real if recordings[i].name in SHARED_SET]
    own = [i for i in learn if is_of_cars(recordings[i])]
    show("shared real set, simulation only", *squares(fitter, own, shared))
    known = [*own[beside_real(len(own))], *real]
    parts = [squares(fitter, [i for i in known if i != place], [place]) for place in shared]
    single, others = (np.concatenate(column) for column in zip(*parts, strict=True))
    show("shared real set, leave one out", single, others)


if __name__ == "__main__":
    main()

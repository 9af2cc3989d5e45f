"""Where the time of `train` goes, by part and by selector.

    python benchmarks/profile_training.py LOGS

LOGS is a folder of logs with ground truth. Everything is done once in one process: logs read, filters run and windows
labelled, then every selector fitted on four fifths of the recordings and judged on the rest. Times are CPU seconds;
parts contain one another where they are indented.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from threadpoolctl import threadpool_limits

from crosscomb.training.folds import grouped_folds
from crosscomb.training.recordings import common_vehicle, read_recordings
from crosscomb.training.selectors import compare, fit, fit_correction, shelf, train
from crosscomb.training.selectors.train import default_filters

PARTS: dict[str, tuple[ModuleType, str]] = {
    "trees that are read": (fit, "fit_tree"),
    "trees that choose": (fit, "fit_choice"),
    "temperature of the blend": (fit, "fit_temperature"),
    "correction": (fit, "fit_correction"),
    "  networks": (fit_correction, "fit_member"),
    "  boosted trees": (fit_correction, "fit_trees"),
    "doubt of the correction": (fit, "fit_doubt"),
    "answers for the calibration": (fit, "select"),
    "quantiles of the calibration": (fit, "fit_trust"),
    "copies of windows": (fit, "concatenate"),
    "judging": (train, "evaluate"),
}


def clocked(work: Callable[..., Any], spent: Counter[str], name: str) -> Callable[..., Any]:
    """The same work, its CPU time added to what was spent."""

    @functools.wraps(work)
    def timed(*given: Any, **named: Any) -> Any:
        start = time.process_time()
        result = work(*given, **named)
        spent[name] += time.process_time() - start
        return result

    return timed


def main() -> None:
    """Print CPU seconds by part and by selector."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path)
    asked = parser.parse_args()
    spent: Counter[str] = Counter()
    recordings, _ = clocked(read_recordings, spent, "reading and checks")(asked.logs, hold=False)
    entries, rate = default_filters(recordings[0].vehicle), train.RATE
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        fill = clocked(shelf.fill_shelf, spent, "filters, features and labels")
        kept = fill(recordings, entries, rate, compare.KINDS, Path(folder))
        for name, (module, function) in PARTS.items():
            setattr(module, function, clocked(getattr(module, function), spent, name))
        learn, rest = grouped_folds(list(range(len(kept))), 5, 0)[0]
        fitters = compare.fitters_of(kept, entries, rate, common_vehicle(recordings), 0)
        for fitter in fitters:
            clocked(train.fit_and_judge, spent, f"all of {fitter.selector}")(fitter, learn, [rest])
    print(
        f"{len(recordings)} recordings, one fit on {len(learn)} of them with each of {len(fitters)} selectors"
    )
    order = ["reading and checks", "filters, features and labels", *PARTS]
    for name in [*order, *(name for name in spent if name not in order)]:
        print(f"{name:32}{spent[name]:8.1f} s")


if __name__ == "__main__":
    main()

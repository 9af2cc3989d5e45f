"""The selectors on recordings they have not seen: fresh simulated logs, and the shared real set.

Run with ``python benchmarks/selector_accuracy.py LEARN FRESH REAL [--selectors tree,hybrid] [--tables ...]``. LEARN and
FRESH hold one folder of simulated logs per car, of different seeds (CONTRIBUTING, "Training the shipped artefacts
anew"); REAL holds the real logs. Three tables per selector, each beside the single filters and the oracle:

- *simulated*: learned on all of LEARN, judged on FRESH;
- *simulation only*: learned on LEARN's logs of the cars of the shared set, judged on the shared real set;
- *leave one out*: each recording of the shared set is judged by what was learned on all other real recordings and
  some of those simulated logs, evenly.

Nothing judged is seen in any fit, and nothing is chosen by these figures.
"""

from __future__ import annotations

import argparse
import atexit
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from crosscomb.selection.answer import select, start_selection
from crosscomb.selection.artefact import Artefact
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.selectors.bank import BankRun
from crosscomb.training.selectors.compare import summary_of
from crosscomb.training.selectors.evaluate import Evaluation, evaluate, pool
from crosscomb.training.selectors.fit import Fitter
from crosscomb.training.selectors.train import default_filters, make_fitter
from crosscomb.training.suites.benchmark import SHARED_SET

CARS = ("volvo_s90", "volvo_v40", "golf_gti_2018", "ferrari_250lm")
"""Shipped vehicles of the shared real set."""

BESIDE_REAL = 100
"""At least so many simulated logs, as far as there are, beside the real ones where one of these is left out."""


def read(folder: Path) -> list[Recording]:
    """Recordings of a folder, those that cannot be used left out."""
    return read_recordings(folder)[0]


def fitter_of(recordings: Sequence[Recording], selector: str, jobs: int) -> Fitter:
    """Filters run over the recordings, windows labelled."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    entries = default_filters(recordings[0].vehicle)
    return make_fitter(recordings, selector, entries, Path(folder.name), 1, jobs=jobs)


def pace(banks: Sequence[BankRun], artefact: Artefact) -> float:
    """CPU time that features, selector and switch take per sample [us], filters left out."""
    runs = [run for bank in banks for run in bank.runs]
    select(start_selection(artefact), runs[0])
    start = time.process_time()
    for run in runs:
        select(start_selection(artefact), run)
    return 1e6 * (time.process_time() - start) / sum(len(run.beta) for run in runs)


def show(title: str, evaluation: Evaluation) -> None:
    """Print what counts of an evaluation."""
    summary, means = summary_of(evaluation, 0), evaluation.rmse.mean()
    print(f"\n{title}: {len(evaluation.table)} recordings")
    print("  mean RMSE [deg]: " + ", ".join(f"{name} {value:.3f}" for name, value in means.items()))
    print("  " + ", ".join(f"{name} {value:.3f}" for name, value in summary.items()))
    if set(evaluation.table.index) <= set(SHARED_SET):
        print(evaluation.rmse.round(2).to_string())


def simulated(selector: str, options: argparse.Namespace) -> None:
    """Learned on simulated logs, judged on others."""
    learn, fresh = read(options.learn), read(options.fresh)
    fitter = fitter_of([*learn, *fresh], selector, options.jobs)
    artefact, _ = fitter.fit(range(len(learn)))
    judged = fitter.banks[len(learn) :]
    show(f"{selector}, simulated", evaluate(judged, artefact))
    print(f"  {pace(judged, artefact):.1f} us per sample beside the filters")


def simulation_only(selector: str, options: argparse.Namespace) -> None:
    """Learned on simulated logs of their cars, judged on the shared real recordings."""
    own, shared = logs_of_cars(options.learn), shared_set(options.real)
    fitter = fitter_of([*own, *shared], selector, options.jobs)
    artefact, _ = fitter.fit(range(len(own)))
    show(f"{selector}, simulation only", evaluate(fitter.banks[len(own) :], artefact))


def left_out(selector: str, options: argparse.Namespace) -> None:
    """Each shared real recording judged by what was learned on the other real ones and some simulated logs."""
    own, real = logs_of_cars(options.learn), read(options.real)
    few = own[beside_real(len(own))]
    fitter = fitter_of([*few, *real], selector, options.jobs)

    def judge(place: int) -> Evaluation:
        artefact, _ = fitter.fit([i for i in range(len(fitter.banks)) if i != place])
        return evaluate([fitter.banks[place]], artefact)

    places = [len(few) + i for i, one in enumerate(real) if one.name in SHARED_SET]
    judged = Parallel(n_jobs=options.jobs, prefer="threads")(delayed(judge)(place) for place in places)
    show(f"{selector}, leave one out", pool(judged))


def logs_of_cars(folder: Path) -> list[Recording]:
    """Simulated logs of the cars of the shared real set."""
    return [one for one in read(folder) if is_of_cars(one)]


def is_of_cars(recording: Recording) -> bool:
    """Whether a simulated log is of a car of the shared real set."""
    return recording.path.parent.name in CARS


def beside_real(count: int) -> slice:
    """Which of so many simulated logs stand beside the real ones: some, evenly."""
    return slice(None, None, max(count // BESIDE_REAL, 1))


def shared_set(folder: Path) -> list[Recording]:
    """The shared real recordings."""
    return [one for one in read(folder) if one.name in SHARED_SET]


TABLES = {"simulated": simulated, "simulation-only": simulation_only, "leave-one-out": left_out}


def main() -> None:
    """Print the three tables of each selector."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("learn", type=Path)
    parser.add_argument("fresh", type=Path)
    parser.add_argument("real", type=Path)
    parser.add_argument("--selectors", default="tree,hybrid")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--tables", default=",".join(TABLES))
    options = parser.parse_args()
    for selector in options.selectors.split(","):
        with threadpool_limits(1):
            for table in options.tables.split(","):
                TABLES[table](selector, options)


if __name__ == "__main__":
    np.set_printoptions(precision=3)
    main()

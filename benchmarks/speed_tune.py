"""Time to tune the three main filters on ten logs of a minute, beside one plain pass of them over the logs.

    python benchmarks/speed_tune.py [--jobs 2]

The bar is 3 minutes on two cores. The seconds depend on what else runs; the number of passes hardly does.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from joblib.externals.loky import get_reusable_executor

from crosscomb.filters.catalogue import DEFAULT_FILTERS
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.train import RATE, default_filters
from crosscomb.training.simulation.presets import plan_jobs
from crosscomb.training.simulation.simulate import simulate_log
from crosscomb.training.tuning.scores import ERROR, prepare, score_logs
from crosscomb.training.tuning.tune import tune

LOGS, LENGTH, BAR = 10, 60.0, 180.0


def main() -> None:
    """Print seconds, passes and the verdict."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=2)
    jobs = parser.parse_args().jobs
    car = load_vehicle("generic_compact")
    recordings = [
        Recording(job.name, Path(job.name), car, simulate_log(
            car, job.manoeuvre, (5, job.number), surface=job.surface, duration=LENGTH, name=job.name
        ))
        for job in plan_jobs(car, LOGS)
    ]  # fmt: skip
    logs, entries = prepare(recordings, RATE, longest=LENGTH), default_filters(car, DEFAULT_FILTERS)
    for entry in entries:  # compile
        score_logs(entry, logs[:1], ERROR)
    start = time.perf_counter()
    for entry in entries:
        score_logs(entry, logs, ERROR)
    plain = time.perf_counter() - start
    before = sum(os.times()[:4])
    start = time.perf_counter()
    tuning = tune(recordings, entries, RATE, jobs=jobs, longest=LENGTH)
    seconds = time.perf_counter() - start
    get_reusable_executor().shutdown(wait=True)  # only then the system tells what the processes took
    spent = os.times()
    processor = spent.user + spent.system + spent.children_user + spent.children_system - before
    samples = sum(len(inputs.samples) for log in logs for inputs, _, _ in log.stretches)
    made = sum(each.evaluations for each in tuning.filters)
    print(f"{LOGS} logs, {samples / RATE:.0f} s in all; {jobs} processes; load {os.getloadavg()[0]:.1f}")
    print(f"one pass of {', '.join(DEFAULT_FILTERS)}: {plain:.2f} s")
    print(f"tuning them: {seconds:.1f} s, {seconds / plain:.0f} passes, {processor:.0f} s of processor time")
    print(f"{made} evaluations in the searches on all logs")
    print(f"bar {BAR:.0f} s on two cores: {'met' if seconds <= BAR else 'missed'} by the clock")
    print(f"the same work on {jobs} cores of its own: about {processor / jobs:.0f} s")


if __name__ == "__main__":
    main()

"""Time of one live sample: percentiles of a streaming step, beside the time per sample of the whole log in one piece.

    python benchmarks/speed_stream.py [--selector-file ARTEFACT.json] [--steps 6000]

All of the artefact's filters run, the particle filter with 1,000 particles, with completion, the grid, windows,
selector and switch. CPU time is that of this thread; wall time also holds what the machine did meanwhile.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.run.stream import StreamingEstimator
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.simulation.simulate import simulate_log

BAR = 1000.0
"""The 99th percentile of a step must lie below this [us]."""

PERCENTILES = (50, 90, 99, 99.9, 100)
WARM_UP = 500
"""Steps before the first counted one: they load the kernels."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--selector-file", type=Path, default=None)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--rates", type=float, nargs="*", default=[100.0, 200.0, 50.0])
    options = parser.parse_args()
    artefact, car = load_artefact(options.selector_file), load_vehicle("generic_compact")
    particles = {entry.name: entry.settings.get("particles", 1000) for entry in artefact.filters}
    table = Table(
        title=f"One sample, us; selector {artefact.selector_name}, particles {particles['random_walk_pf']}"
    )
    table.add_column("log")
    for heading in ("clock", *(f"{p} %" for p in PERCENTILES), "whole log", "median / whole", "99 % < 1 ms"):
        table.add_column(heading, justify="right")
    log = simulate_log(car, "road_limit", seed=1, duration=(options.steps + WARM_UP) / 100.0)
    for rate in options.rates:
        steps, batch = measure(log.frame.assign(t=log.t * 100.0 / rate), car, artefact)
        for clock, times in steps.items():
            figures = [f"{value:.0f}" for value in np.percentile(times, PERCENTILES)]
            verdict = "met" if np.percentile(times, 99) < BAR else "missed"
            share = f"{np.median(times) / batch:.1f}"
            table.add_row(f"{rate:g} Hz", clock, *figures, f"{batch:.1f}", share, verdict)
    Console(width=140, markup=False).print(table)


def measure(frame, car, artefact) -> tuple[dict[str, np.ndarray], float]:
    """Times of the steps by clock ``(n,) [us]``, and CPU time per sample of the log in one piece [us]."""
    live = StreamingEstimator(car, artefact)
    samples = frame.to_dict("records")
    cpu, wall = np.empty(len(samples)), np.empty(len(samples))
    for k, sample in enumerate(samples):
        begin_cpu, begin = time.thread_time_ns(), time.perf_counter_ns()
        live.step(sample)
        wall[k], cpu[k] = time.perf_counter_ns() - begin, time.thread_time_ns() - begin_cpu
    steps = {"CPU": 1e-3 * cpu[WARM_UP:], "wall": 1e-3 * wall[WARM_UP:]}
    signals = StreamingEstimator(car, artefact).take(frame).signals
    batches = []
    for _ in range(3):
        begin = time.process_time()
        estimate_log(signals, car, artefact)
        batches.append((time.process_time() - begin) / len(samples) * 1e6)
    return steps, min(batches)


if __name__ == "__main__":
    main()

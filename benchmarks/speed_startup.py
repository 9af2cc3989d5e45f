"""Start-up and memory of the commands, side by side in one run with bare Python and with its heavy imports.

    python benchmarks/speed_startup.py [--repeats 11]

Each repeat starts all programs one after the other, so that all see the same machine: only the ratios mean
anything on a machine that does other work. The log is a simulated minute at 100 Hz; the shipped artefact runs
the particle filter with 1,000 particles. A first round, not counted, fills the caches of files and kernels.
"""

# Nothing heavy is imported here: a child's peak of memory would start at that of this process.
from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

COMMAND = "import sys; sys.argv[0] = 'crosscomb'; from crosscomb.cli.main import main; main()"
WRITE_LOG = """
import sys
from crosscomb.selection.artefact import load_artefact
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.simulation.simulate import simulate_log
particles = [entry.settings.get("particles") for entry in load_artefact().filters]
assert 1000 in particles, "the bar is for 1,000 particles"
log = simulate_log(load_vehicle("generic_compact"), "road_limit", seed=1, duration=60.0)
log.frame.to_csv(sys.argv[1], index=False)
"""
BARE, HELP, IMPORTS, ESTIMATE = (
    "python -c pass",
    "crosscomb --help",
    "import numpy, pandas, numba",
    "crosscomb estimate",
)


class Run(NamedTuple):
    """One process: wall time [s] and the peak of its resident memory [MB]."""

    seconds: float
    memory: float


def run(*words: str) -> Run:
    """Run Python with these words and wait for it."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL)
    if hasattr(os, "wait4"):
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        memory = usage.ru_maxrss / (1024.0**2 if sys.platform == "darwin" else 1024.0)
    else:  # Windows tells no peak afterwards
        process.wait()
        memory = float("nan")
    seconds = time.perf_counter() - start
    if process.returncode != 0:
        raise SystemExit(f"python {' '.join(words)[:200]}: exit code {process.returncode}")
    return Run(seconds, memory)


def measure(repeats: int) -> dict[str, list[Run]]:
    """Runs of each program, in turn."""
    with tempfile.TemporaryDirectory() as name:
        log = str(Path(name) / "minute.csv")
        run("-c", WRITE_LOG, log)
        words = ("estimate", log, "--vehicle", "generic_compact", "-o", str(Path(name) / "out"))
        programs = {
            BARE: ("-c", "pass"),
            HELP: ("-c", COMMAND, "--help"),
            IMPORTS: ("-c", IMPORTS),
            ESTIMATE: ("-c", COMMAND, *words),
        }
        rounds = [{program: run(*line) for program, line in programs.items()} for _ in range(repeats + 1)]
    return {program: [each[program] for each in rounds[1:]] for program in programs}


def main() -> None:
    """Print times, ratios and memory against their bars."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=11)
    runs = measure(parser.parse_args().repeats)
    print(f"{'program':<32}{'best s':>10}{'median s':>10}{'peak MB':>10}")
    for program, each in runs.items():
        seconds = [one.seconds for one in each]
        peak = max(one.memory for one in each)
        print(f"{program:<32}{min(seconds):>10.3f}{statistics.median(seconds):>10.3f}{peak:>10.0f}")
    print(f"\n{'':<44}{'of the best':>12}{'median':>10}{'at most':>10}")
    for program, base, bar in ((HELP, BARE, 25.0), (ESTIMATE, IMPORTS, 3.0)):
        best = min(runs[program]).seconds / min(runs[base]).seconds
        ratios = [one.seconds / other.seconds for one, other in zip(runs[program], runs[base], strict=True)]
        median = statistics.median(ratios)
        verdict = "met" if median <= bar else "missed"
        print(f"{f'{program} / {base}':<44}{best:>12.2f}{median:>10.2f}{bar:>10g}  {verdict}")
    peak = max(one.memory for one in runs[ESTIMATE])
    verdict = "met" if peak < 400.0 else "missed"
    print(f"{'peak memory of crosscomb estimate [MB]':<44}{'':>12}{peak:>10.0f}{400:>10}  {verdict}")


if __name__ == "__main__":
    main()

"""Time and memory of `estimate` on short, long and wide logs, beside an old version in the same run.

    python benchmarks/speed_reading.py --old OLD_COMMAND [--new crosscomb] [--only minute hour wide]

`OLD_COMMAND` starts the command line of another commit, such as one installed into a folder of its own. The two
run one after the other, in turn, so that both see the same machine: only the ratios mean anything on a machine that
does other work. The logs are simulated and put together end to end: a minute (median of several), an hour at 100 Hz
without and with a picture, and a wide one of 500 MB, most of whose columns nobody maps; at last the growth of the new
version over 1, 10 and 100 minutes. `--filters kinematic_kf,dynamic_ekf` leaves out the particle filter, which is most
of the time; `--only wider` is a log of 2 GB, which the old version need not read.
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
from typing import NamedTuple

WRITE_LOGS = """
import sys
import numpy as np
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.simulation.simulate import simulate_log
car, folder = load_vehicle("generic_compact"), sys.argv[1]
parts = [simulate_log(car, "road_limit", seed=seed, duration=60.0).frame[:6000] for seed in range(1, 6)]
def text(minute):
    frame = parts[minute % len(parts)].assign(t=np.round(np.arange(6000) / 100.0 + 60.0 * minute, 6))
    return frame.to_csv(index=False, header=False)
for name, minutes in (("minute", 1), ("ten", 10), ("hour", 60), ("hundred", 100)):
    if name in sys.argv[2:]:
        with open(f"{folder}/{name}.csv", "w", newline="") as file:
            file.write(",".join(parts[0].columns) + "\\n")
            file.writelines(text(minute) for minute in range(minutes))
for name, rows in (("wide", 3_670_000), ("wider", 14_680_000)):
    if name in sys.argv[2:]:
        needed = ["vx", "ax", "ay", "yaw_rate", "steer"]
        tail = [",".join(map(str, row)) for row in np.round(np.random.default_rng(1).normal(size=(500, 18)), 2)]
        with open(f"{folder}/{name}.csv", "w", newline="") as file:
            file.write(",".join(["t", *needed, *(f"other_{i}" for i in range(18))]) + "\\n")
            bodies = [part[needed].round(4).to_csv(index=False, header=False).splitlines() for part in parts]
            for first in range(0, rows, 6000):
                body = bodies[first // 6000 % len(bodies)][: rows - first]
                lines = (f"{(first + i) / 100:.2f},{cells},{tail[i % 500]}\\n" for i, cells in enumerate(body))
                file.writelines(lines)
"""
BARS = {
    "minute": (0.75, None),
    "hour": (0.25, 300.0),
    "hour, picture": (0.25, 300.0),
    "wide": (0.25, 500.0),
    "wider": (None, 600.0),
}
"""At most so much of the old time, and so much memory [MB]."""


class Run(NamedTuple):
    """One process: wall and CPU time [s] and the peak of its resident memory [MB]."""

    seconds: float
    cpu: float
    memory: float


def run(*words: str) -> Run:
    """Run a program and wait for it."""
    start = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(words)[:200]}: exit code {process.returncode}")
    memory = usage.ru_maxrss / (1024.0**2 if sys.platform == "darwin" else 1024.0)
    return Run(seconds, usage.ru_utime + usage.ru_stime, memory)


def median(runs: list[Run]) -> Run:
    """Medians of the times, the largest memory."""
    times = (statistics.median(each) for each in list(zip(*runs, strict=True))[:2])
    return Run(*times, max(each.memory for each in runs))


HEADER = f"{'work':<16}{'s':>8}{'at most':>9}{'MB':>6}{'at most':>9}{'old s':>9}{'old MB':>8}{'ratio':>8}{'of CPU':>8}"


def line_of(work: str, new: Run, old: Run | None = None) -> str:
    """A line of the table: times of both and their ratio."""
    times, memory = BARS[work]
    line = f"{work:<16}{new.seconds:>8.2f}{times or '':>9}{new.memory:>6.0f}{memory or '':>9}"
    if old is None:
        return line
    return f"{line}{old.seconds:>9.2f}{old.memory:>8.0f}{new.seconds / old.seconds:>8.2f}{new.cpu / old.cpu:>8.2f}"


def main() -> None:
    """Print times, ratios and memory against their bars."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--old", help="command of the old version; without it only the new one runs")
    parser.add_argument("--new", default="crosscomb")
    parser.add_argument("--filters", help="estimators to run instead of the artefact's")
    parser.add_argument("--repeats", type=int, default=7, help="of the minute")
    parser.add_argument("--only", nargs="*", default=["minute", "hour", "wide", "growth"])
    asked = parser.parse_args()
    logs = {"growth": ["minute", "ten", "hundred"]}
    needed = [log for name in asked.only for log in logs.get(name, [name])]
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "-c", WRITE_LOGS, folder, *needed)
        chosen = ["--filters", asked.filters] if asked.filters else []

        def estimate(command: str, log: str, *words: str) -> Run:
            line = [
                command,
                "estimate",
                f"{folder}/{log}.csv",
                "--vehicle",
                "generic_compact",
                *chosen,
                *words,
            ]
            return run(*line, "-o", f"{folder}/out")

        commands = [asked.new, *([asked.old] if asked.old else [])]
        works = {
            "minute": ["minute"],
            "hour": ["hour", "hour, picture"],
            "wide": ["wide"],
            "wider": ["wider"],
        }
        print(HEADER)
        for work in (work for name in asked.only for work in works.get(name, [])):
            log, words = work.partition(",")[0], ["--plot"] if "picture" in work else []
            repeats = asked.repeats if work == "minute" else 1
            if work == "minute":  # fills the caches of files and kernels
                [estimate(command, log) for command in commands]
            turns = [[estimate(command, log, *words) for command in commands] for _ in range(repeats)]
            print(line_of(work, *(median(list(runs)) for runs in zip(*turns, strict=True))), flush=True)
        if "growth" in asked.only:
            print(f"\n{'minutes':<10}{'s':>8}{'CPU s':>8}{'MB':>6}")
            for minutes, log in ((1, "minute"), (10, "ten"), (100, "hundred")):
                each = estimate(asked.new, log)
                print(f"{minutes:<10}{each.seconds:>8.2f}{each.cpu:>8.2f}{each.memory:>6.0f}")


if __name__ == "__main__":
    main()

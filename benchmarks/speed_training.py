"""Time of `train` beside an old version in the same run, and the error of what both train on fresh logs.

    python benchmarks/speed_training.py --old OLD_COMMAND [--new crosscomb] [--only hybrid all growth] [--jobs 2]

`OLD_COMMAND` starts the command line of another commit, such as one installed into a folder of its own. Both train on
the same simulated logs (200 for the hybrid, 100 for all selectors), one after the other; both hybrids then estimate
100 logs of another seed, each by its own version. The old version takes long: it is stopped after `--patience` times
the new one's time, which is then what the ratio is known to be below; without `--old` only the new one runs.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from crosscomb.training.metrics import countable, rms

BARS = {"hybrid": 1.0 / 8.0, "all": 1.0 / 10.0}
"""At most so much of the old time."""

LOGS = {"hybrid": 200, "all": 100}


class Run(NamedTuple):
    """A command and the processes it started: wall time [s], largest memory of all together [MB], whether it ended."""

    seconds: float
    memory: float
    ended: bool


def run(*words: object, patience: float | None = None) -> Run:
    """Run a command for `patience` seconds at most."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [str(word) for word in words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    most = 0.0
    while process.poll() is None:
        if patience is not None and time.perf_counter() - start > patience:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return Run(time.perf_counter() - start, most, False)
        most = max(most, memory_of(process.pid))
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.5)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, words))[:200]}: exit code {process.returncode}")
    return Run(time.perf_counter() - start, most, True)


def memory_of(session: int) -> float:
    """Memory of all processes of a session [MB], without the files that they map; 0 where the system does not tell."""
    total = 0
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):
            if int((place / "stat").read_text().rpartition(")")[2].split()[3]) == session:
                told = (place / "smaps_rollup").read_text()
                total += int(told.partition("Pss_Anon:")[2].split()[0])
    return total / 1024.0


def error_of(command: str, artefact: Path, fresh: Path, folder: Path) -> float:
    """Mean RMSE [deg] of an artefact over logs, estimated by the command that trained it."""
    logs = sorted(fresh.glob("*.csv.gz"))
    run(
        command,
        "estimate",
        *logs,
        "--vehicle",
        fresh / "vehicle.toml",
        "--selector-file",
        artefact,
        "-o",
        folder,
    )
    each = []
    for log in logs:
        beta = pd.read_csv(folder / f"{log.name.removesuffix('.csv.gz')}.estimate.csv")["beta"]
        truth = pd.read_csv(log)[["beta_ref", "vx"]]
        counted = countable(truth["beta_ref"].to_numpy(), truth["vx"].to_numpy())
        each.append(np.degrees(rms((beta - truth["beta_ref"]).to_numpy()[counted])))
    return float(np.mean(each))


def main() -> None:
    """Print times and ratios against their bars."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--old", help="command of the old version")
    parser.add_argument("--new", default="crosscomb")
    parser.add_argument("--only", nargs="*", default=["hybrid", "all", "growth"])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--patience", type=float, default=12.0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def simulate(logs: int, seed: int) -> Path:
            made = folder / f"logs{logs}_{seed}"
            if not made.exists():
                run(asked.new, "simulate", made, "--logs", logs, "--seed", seed, "--jobs", asked.jobs)
            return made

        def train(command: str, logs: Path, selector: str, out: str, patience: float | None = None) -> Run:
            where = folder / out / "selector.json"
            return run(
                command,
                "train",
                logs,
                "-o",
                where,
                "--selector",
                selector,
                "--jobs",
                asked.jobs,
                patience=patience,
            )

        for work in (work for work in asked.only if work in BARS):
            logs = simulate(LOGS[work], 11)
            new = train(asked.new, logs, work, f"new_{work}")
            line = f"{work}, {LOGS[work]} logs: new {new.seconds:.0f} s, {new.memory:.0f} MB"
            if asked.old:
                old = train(asked.old, logs, work, f"old_{work}", asked.patience * new.seconds)
                below = "" if old.ended else "below "
                line += f", old {'' if old.ended else 'over '}{old.seconds:.0f} s, "
                line += f"ratio {below}{new.seconds / old.seconds:.3f} (at most {BARS[work]:.3f})"
            print(line, flush=True)
            if work == "hybrid":
                fresh = simulate(100, 77)
                for command, out in ((asked.new, "new_hybrid"), (asked.old, "old_hybrid")):
                    artefact = folder / out / "selector.json"
                    if command and artefact.exists():
                        error = error_of(command, artefact, fresh, folder / f"{out}_estimates")
                        print(f"  {out}: {error:.4f} deg on fresh logs", flush=True)
        if "growth" in asked.only:
            for count in (10, 100, 400):
                grown = train(asked.new, simulate(count, 11), "hybrid", f"growth_{count}")
                print(f"hybrid, {count} logs: {grown.seconds:.0f} s, {grown.memory:.0f} MB", flush=True)


if __name__ == "__main__":
    main()

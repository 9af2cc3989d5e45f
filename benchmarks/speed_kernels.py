"""Kernels of kinematic_kf and dynamic_ekf beside the same equations in hand-written C (`kernels.c`).

    python benchmarks/speed_kernels.py [--rounds 60] [--compiler cc]

C is compiled with -O3 -march=native. Both run on the same samples in turn in one process, and their answers are
compared first. The ratio is the median over the rounds of kernel over C, both timed next to each other by CPU time;
the bar is 1.3.
"""

from __future__ import annotations

import argparse
import ctypes
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from crosscomb.filters.base import KernelFilter
from crosscomb.filters.catalogue import make_filter
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.suites.speed import slalom

BAR = 1.3
AGREES = 1e-9
DT = 0.01
KERNELS = {"kinematic_kf": "kinematic", "dynamic_ekf": "dynamic"}


def compiled(compiler: str, folder: str) -> ctypes.CDLL:
    """Compile `kernels.c` and load it."""
    library = Path(folder) / "kernels.so"
    source = Path(__file__).with_name("kernels.c")
    flags = ["-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


def samples_with_gaps() -> np.ndarray:
    """A slalom with a stop, missing measurements and a held steering angle."""
    samples = slalom(load_vehicle("golf_gti_2018"), 6000).samples
    samples[500:560, 1] = samples[520:600, 2] = samples[540:640, 3] = np.nan
    samples[1000:1050, 8] = samples[1020:1080, 9] = 1.0
    samples[2000:2100, 0], samples[2100:2150, 0] = 0.5, 3.5
    return np.ascontiguousarray(samples)


def in_c(
    function: ctypes._CFuncPtr, estimator: KernelFilter, samples: np.ndarray
) -> Callable[[], np.ndarray]:
    """Make a call of the C function that answers as the estimator's kernel does."""
    car = (ctypes.c_double * 8)(*estimator.car[:8])
    noise = (ctypes.c_double * len(estimator.noise))(*estimator.noise)
    out = np.empty((len(samples), 5))
    to, given = out.ctypes.data_as(ctypes.c_void_p), samples.ctypes.data_as(ctypes.c_void_p)
    count, dt = ctypes.c_long(len(samples)), ctypes.c_double(DT)

    def call() -> np.ndarray:
        function(given, count, car, noise, dt, to)
        return out

    return call


def in_kernel(estimator: KernelFilter, samples: np.ndarray) -> Callable[[], np.ndarray]:
    """Make a call of the estimator's kernel on a fresh state."""
    out = np.full((len(samples), 5), np.nan)

    def call() -> np.ndarray:
        estimator.run_kernel(estimator.make_state(), samples, estimator.car, estimator.noise, DT, out)
        return out

    return call


def seconds(call: Callable[[], np.ndarray]) -> float:
    """CPU time of one call [s]."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def main() -> None:
    """Print both times and their ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--compiler", default="cc")
    asked = parser.parse_args()
    if shutil.which(asked.compiler) is None:
        sys.exit(f"no C compiler {asked.compiler}: install one, or name yours with --compiler")
    samples, vehicle = samples_with_gaps(), load_vehicle("golf_gti_2018")
    table = Table(title=f"Kernels beside C, {len(samples):,} samples, {asked.rounds} rounds")
    for heading in ("kernel", "us per sample", "C", "ratio", "middle half", "apart", f"bar {BAR}"):
        table.add_column(heading, justify="left" if heading == "kernel" else "right")
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(asked.compiler, folder)
        for name, function in KERNELS.items():
            estimator = make_filter(name, vehicle)
            ours, theirs = in_kernel(estimator, samples), in_c(library[function], estimator, samples)
            answers = ours(), theirs()
            apart = float(np.nanmax(np.abs(answers[0] - answers[1])))
            same = apart < AGREES and np.array_equal(*(np.isnan(answer) for answer in answers))
            if not same:
                sys.exit(f"{name}: kernel and C differ by {apart:.1e}: one of them is wrong")
            times = np.array([(seconds(ours), seconds(theirs)) for _ in range(asked.rounds)])
            low, ratio, high = np.quantile(times[:, 0] / times[:, 1], [0.25, 0.5, 0.75])
            kernel, c = np.median(times, axis=0) / len(samples) * 1e6
            met = "met" if ratio <= BAR else ""
            spread = f"{low:.2f} to {high:.2f}"
            table.add_row(name, f"{kernel:.3f}", f"{c:.3f}", f"{ratio:.2f}", spread, f"{apart:.0e}", met)
    Console().print(table)


if __name__ == "__main__":
    main()

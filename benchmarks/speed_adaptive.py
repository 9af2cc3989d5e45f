"""Speed of the adaptive and random-walk filters against filterpy's ExtendedKalmanFilter, side by side in one run.

    python benchmarks/speed_adaptive.py [--repeats 7] [--steps 600]

Kernel and twin take turns on the same samples, so only the ratios mean anything on a machine that does other work.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table
from speed_filters import KERNEL_STEPS, Pair, measure, slalom

from crosscomb.filters.base import Estimate
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.reference_adaptive import (
    reference_dual_ekf,
    reference_friction_adaptive_ekf,
    reference_tyre_ekf,
)
from crosscomb.filters.reference_random_walk import (
    reference_double_track_random_walk_ekf,
    reference_random_walk_ekf,
)
from crosscomb.models.vehicle import load_vehicle

BAR = 200.0

TWINS: dict[str, Callable[..., Estimate]] = {
    "lint_ekf": reference_tyre_ekf,
    "ratt_ekf": reference_tyre_ekf,
    "ratte_ekf": reference_tyre_ekf,
    "dual_ekf": reference_dual_ekf,
    "friction_adaptive_ekf": reference_friction_adaptive_ekf,
    "random_walk_ekf": reference_random_walk_ekf,
    "double_track_random_walk_ekf": reference_double_track_random_walk_ekf,
}


def make_pairs(steps: int) -> list[Pair]:
    """Each filter of the catalogue with its twin."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = slalom(vehicle, steps), slalom(vehicle, steps * KERNEL_STEPS)
    pairs = []
    for name, twin in TWINS.items():
        estimator = make_filter(name, vehicle)
        pairs.append(
            Pair(
                name,
                "filterpy",
                lambda estimator=estimator: estimator.run(long),
                lambda estimator=estimator, twin=twin: twin(estimator, short),
                len(long.samples),
                len(short.samples),
                BAR,
            )
        )
    return pairs


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=600, help="samples for the slow side of each pair")
    options = parser.parse_args()
    pairs = make_pairs(options.steps)
    times = measure(pairs, options.repeats)
    table = Table(title=f"Time per sample on one core, best of {options.repeats}")
    for heading in ("filter", "rival", "kernel us", "rival us", "ratio", "median ratio", "bar", ""):
        table.add_column(heading, justify="left" if heading in ("filter", "rival", "") else "right")
    best, median = times.min(axis=0), np.median(times[:, :, 1] / times[:, :, 0], axis=0)
    for pair, (kernel, rival), middle in zip(pairs, best, median, strict=True):
        ratio = rival / kernel
        table.add_row(
            pair.name, pair.rival, f"{kernel:.3f}", f"{rival:.1f}", f"{ratio:.1f}", f"{middle:.1f}",
            f"{pair.bar:g}", "met" if ratio >= pair.bar else "missed",
        )  # fmt: skip
    Console().print(table)


if __name__ == "__main__":
    main()

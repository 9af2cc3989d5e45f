"""Speed of the aided kinematic and dynamic filters against filterpy, side by side in one run.

    python benchmarks/speed_aided.py [--repeats 7] [--steps 600]

Kernel and twin take turns on the same samples, so only the ratios mean anything on a machine that does other
work. GNSS fixes come at 5 Hz.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table
from speed_filters import KERNEL_STEPS, Pair, measure, slalom

from crosscomb.filters.base import GNSS_COURSE, GNSS_SPEED, HEADING, VX, YAW_RATE, Estimate, Inputs
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.reference_aided import (
    reference_gnss_dynamic_observer,
    reference_gnss_kinematic_kf,
    reference_zero_yaw_kf,
)
from crosscomb.models.vehicle import Vehicle, load_vehicle

BAR = 200.0

TWINS: dict[str, Callable[..., Estimate]] = {
    "kinematic_kf_zero_yaw": reference_zero_yaw_kf,
    "gnss_kinematic_kf": reference_gnss_kinematic_kf,
    "gnss_dynamic_observer": reference_gnss_dynamic_observer,
}


def slalom_with_fixes(vehicle: Vehicle, steps: int) -> Inputs:
    """The slalom of `speed_filters`, with a fix of a car that goes where it points at every 20th sample."""
    inputs = slalom(vehicle, steps)
    samples = inputs.samples
    heading = inputs.dt * np.cumsum(samples[:, YAW_RATE])
    samples[:, [GNSS_SPEED, GNSS_COURSE, HEADING]] = np.nan
    samples[::20, GNSS_SPEED] = samples[::20, VX]
    samples[::20, GNSS_COURSE] = samples[::20, HEADING] = np.arctan2(np.sin(heading), np.cos(heading))[::20]
    return inputs


def make_pairs(steps: int) -> list[Pair]:
    """Each filter with its twin."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = slalom_with_fixes(vehicle, steps), slalom_with_fixes(vehicle, steps * KERNEL_STEPS)
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

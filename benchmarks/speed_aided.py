"""Speed of the aided kinematic and dynamic filters against filterpy, side by side in one run.

    python benchmarks/speed_aided.py [--repeats 7] [--steps 600]

What the twins are and what is measured: `speed_filters`. GNSS fixes come at 5 Hz.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from speed_filters import KERNEL_STEPS, print_pairs, slalom, twin_pair

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.twins.aided import (
    twin_gnss_dynamic_observer,
    twin_gnss_kinematic_kf,
    twin_zero_yaw_kf,
)
from crosscomb.models.vehicle import Vehicle, load_vehicle

BAR = 200.0

TWINS: dict[str, Callable[..., Estimate]] = {
    "kinematic_kf_zero_yaw": twin_zero_yaw_kf,
    "gnss_kinematic_kf": twin_gnss_kinematic_kf,
    "gnss_dynamic_observer": twin_gnss_dynamic_observer,
}


def slalom_with_fixes(vehicle: Vehicle, steps: int) -> Inputs:
    """The slalom of `speed_filters`, with a fix of a car that goes where it points at every 20th sample."""
    inputs = slalom(vehicle, steps)
    samples = inputs.samples
    heading = inputs.dt * np.cumsum(samples[:, at.YAW_RATE])
    samples[:, [at.GNSS_SPEED, at.GNSS_COURSE, at.HEADING]] = np.nan
    samples[::20, at.GNSS_SPEED] = samples[::20, at.VX]
    samples[::20, at.GNSS_COURSE] = samples[::20, at.HEADING] = np.arctan2(np.sin(heading), np.cos(heading))[
        ::20
    ]
    return inputs


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=600, help="samples for the slow side of each pair")
    options = parser.parse_args()
    vehicle = load_vehicle("golf_gti_2018")
    short, long = (
        slalom_with_fixes(vehicle, options.steps),
        slalom_with_fixes(vehicle, options.steps * KERNEL_STEPS),
    )
    pairs = [
        twin_pair(name, make_filter(name, vehicle), twin, short, long, BAR) for name, twin in TWINS.items()
    ]
    print_pairs(pairs, options.repeats)


if __name__ == "__main__":
    main()

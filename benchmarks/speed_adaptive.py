"""Speed of the adaptive and random-walk filters against filterpy's ExtendedKalmanFilter, side by side in one run.

    python benchmarks/speed_adaptive.py [--repeats 7] [--steps 600]

What the twins are and what is measured: `speed_filters`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from speed_filters import KERNEL_STEPS, print_pairs, slalom, twin_pair

from crosscomb.filters.base import Estimate
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.twins.adaptive import (
    twin_dual_ekf,
    twin_friction_adaptive_ekf,
    twin_tyre_ekf,
)
from crosscomb.filters.twins.random_walk import (
    twin_double_track_random_walk_ekf,
    twin_random_walk_ekf,
)
from crosscomb.models.vehicle import load_vehicle

BAR = 200.0

TWINS: dict[str, Callable[..., Estimate]] = {
    "lint_ekf": twin_tyre_ekf,
    "ratt_ekf": twin_tyre_ekf,
    "ratte_ekf": twin_tyre_ekf,
    "dual_ekf": twin_dual_ekf,
    "friction_adaptive_ekf": twin_friction_adaptive_ekf,
    "random_walk_ekf": twin_random_walk_ekf,
    "double_track_random_walk_ekf": twin_double_track_random_walk_ekf,
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=600, help="samples for the slow side of each pair")
    options = parser.parse_args()
    vehicle = load_vehicle("golf_gti_2018")
    short, long = slalom(vehicle, options.steps), slalom(vehicle, options.steps * KERNEL_STEPS)
    pairs = [
        twin_pair(name, make_filter(name, vehicle), twin, short, long, BAR) for name, twin in TWINS.items()
    ]
    print_pairs(pairs, options.repeats)


if __name__ == "__main__":
    main()

"""Speed of the filters on the planar model against their twins, side by side in one run.

    python benchmarks/speed_planar.py [--repeats 7] [--steps 300]

The twins are filterpy's ExtendedKalmanFilter, UnscentedKalmanFilter and CubatureKalmanFilter; the iterated and the
second-order filter, which filterpy does not have, are textbook numpy. What they call and what is measured:
`speed_filters`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from speed_filters import KERNEL_STEPS, Pair, print_pairs, slalom, twin_pair

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.catalogue import make_filter
from crosscomb.filters.twins.planar import (
    twin_cubature_kf,
    twin_first_order_ekf,
    twin_iterated_ekf,
    twin_receding_horizon,
    twin_second_order_ekf,
    twin_ukf,
)
from crosscomb.models.vehicle import Vehicle, load_vehicle

EKF_BAR, UKF_BAR = 200.0, 100.0

TWINS: dict[str, Callable[..., Estimate]] = {
    "first_order_ekf": twin_first_order_ekf,
    "double_track_ekf": twin_first_order_ekf,
    "iterated_ekf": twin_iterated_ekf,
    "second_order_ekf": twin_second_order_ekf,
    "simple_ukf": twin_ukf,
    "general_ukf": twin_ukf,
    "simplex_ukf": twin_ukf,
    "spherical_ukf": twin_ukf,
    "sqrt_cubature_kf": twin_cubature_kf,
    "cubature_receding_horizon_kf": twin_receding_horizon,
}


def wheeled_slalom(vehicle: Vehicle, steps: int) -> Inputs:
    """The slalom of `speed_filters` with wheel speeds, so that all five measurements are there."""
    inputs = slalom(vehicle, steps)
    inputs.samples[:, at.VFL :] = np.nan
    inputs.samples[:, at.VFL] = inputs.samples[:, at.VFR] = inputs.samples[:, at.VX]
    return inputs


def make_pairs(steps: int) -> list[Pair]:
    """The comparisons."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = wheeled_slalom(vehicle, steps), wheeled_slalom(vehicle, steps * KERNEL_STEPS)
    # A horizon is many steps: fewer samples will do, and the same ones for both, as the first fill the horizon.
    few = Inputs(short.dt, short.samples[:60])
    pairs = []
    for name, twin in TWINS.items():
        ours, theirs = (few, few) if name == "cubature_receding_horizon_kf" else (long, short)
        rival = "numpy" if twin in (twin_iterated_ekf, twin_second_order_ekf) else "filterpy"
        bar = EKF_BAR if name.endswith("ekf") else UKF_BAR
        pairs.append(twin_pair(name, make_filter(name, vehicle), twin, theirs, ours, bar, rival))
    return pairs


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300, help="samples for the slow side of each pair")
    options = parser.parse_args()
    print_pairs(make_pairs(options.steps), options.repeats)


if __name__ == "__main__":
    main()

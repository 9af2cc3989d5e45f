"""Speed of the filters on the planar model against their plain twins, side by side in one run.

    python benchmarks/speed_planar.py [--repeats 7] [--steps 300] [--compiled-models]

The twins are filterpy's ExtendedKalmanFilter, UnscentedKalmanFilter and CubatureKalmanFilter; the iterated
and the second-order filter, which filterpy does not have, are textbook numpy. Their models are our
functions in plain Python, as one writes them for filterpy; with --compiled-models the twins get our
compiled ones. Only the ratios mean anything.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table
from speed_filters import KERNEL_STEPS, Pair, measure, slalom

from crosscomb.filters.base import VFL, VFR, VX, Estimate, Inputs
from crosscomb.filters.cubature import CubatureRecedingHorizonKF, SqrtCubatureKF
from crosscomb.filters.planar import PlanarFilter
from crosscomb.filters.planar_ekf import DoubleTrackEKF, FirstOrderEKF, IteratedEKF
from crosscomb.filters.reference_planar import (
    reference_cubature_kf,
    reference_first_order_ekf,
    reference_iterated_ekf,
    reference_receding_horizon,
    reference_second_order_ekf,
    reference_ukf,
)
from crosscomb.filters.second_order_ekf import SecondOrderEKF
from crosscomb.filters.sigma_point import GeneralUKF, SimpleUKF, SimplexUKF, SphericalUKF
from crosscomb.models.vehicle import Vehicle, load_vehicle

EKF_BAR, UKF_BAR = 200.0, 100.0


def wheeled_slalom(vehicle: Vehicle, steps: int) -> Inputs:
    """The slalom of `speed_filters` with wheel speeds, so that all five measurements are there."""
    inputs = slalom(vehicle, steps)
    inputs.samples[:, VFL:] = np.nan
    inputs.samples[:, VFL] = inputs.samples[:, VFR] = inputs.samples[:, VX]
    return inputs


def make_pairs(steps: int, plain: bool) -> list[Pair]:
    """The comparisons."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = wheeled_slalom(vehicle, steps), wheeled_slalom(vehicle, steps * KERNEL_STEPS)
    # A horizon is many steps: fewer samples will do, and the same ones for both, as the first fill the horizon.
    few = Inputs(short.dt, short.samples[:60])

    def pair(
        name: str, estimator: PlanarFilter, twin: Callable[..., Estimate], rival: str, bar: float
    ) -> Pair:
        is_long = isinstance(estimator, CubatureRecedingHorizonKF)
        ours, theirs = (few, few) if is_long else (long, short)
        return Pair(
            name, rival, lambda: estimator.run(ours), lambda: twin(estimator, theirs, plain),
            len(ours.samples), len(theirs.samples), bar,
        )  # fmt: skip

    ekfs = {
        "first-order EKF": (FirstOrderEKF(vehicle), reference_first_order_ekf, "filterpy"),
        "the same, double track": (DoubleTrackEKF(vehicle), reference_first_order_ekf, "filterpy"),
        "iterated EKF": (IteratedEKF(vehicle), reference_iterated_ekf, "numpy"),
        "second-order EKF": (SecondOrderEKF(vehicle), reference_second_order_ekf, "numpy"),
    }
    receding = CubatureRecedingHorizonKF(vehicle)
    ukfs = {
        "simple UKF": (SimpleUKF(vehicle), reference_ukf, "filterpy"),
        "general UKF": (GeneralUKF(vehicle), reference_ukf, "filterpy"),
        "simplex UKF": (SimplexUKF(vehicle), reference_ukf, "filterpy"),
        "spherical UKF": (SphericalUKF(vehicle), reference_ukf, "filterpy"),
        "square-root cubature KF": (SqrtCubatureKF(vehicle), reference_cubature_kf, "filterpy"),
        "the same, receding horizon": (receding, reference_receding_horizon, "filterpy"),
    }
    return [
        pair(name, *row, bar)
        for rows, bar in ((ekfs, EKF_BAR), (ukfs, UKF_BAR))
        for name, row in rows.items()
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300, help="samples for the slow side of each pair")
    parser.add_argument("--compiled-models", action="store_true", help="twins call our compiled models")
    options = parser.parse_args()
    pairs = make_pairs(options.steps, not options.compiled_models)
    times = measure(pairs, options.repeats)

    table = Table(title=f"Time per sample on one core, best of {options.repeats}")
    for heading in ("filter", "rival", "kernel us", "rival us", "ratio", "median ratio", "bar", ""):
        table.add_column(heading, justify="left" if heading in ("filter", "rival", "") else "right")
    best, median = times.min(axis=0), np.median(times[:, :, 1] / times[:, :, 0], axis=0)
    for i, pair in enumerate(pairs):
        kernel, rival = best[i]
        table.add_row(
            pair.name, pair.rival, f"{kernel:.2f}", f"{rival:.0f}", f"{rival / kernel:.0f}",
            f"{median[i]:.0f}", f"{pair.bar:g}", "met" if rival / kernel >= pair.bar else "missed",
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()

"""Speed of the filters on the planar model against their plain twins, side by side in one run.

    python benchmarks/speed_planar.py [--repeats 7] [--steps 400]

The twins are filterpy's ExtendedKalmanFilter, UnscentedKalmanFilter and CubatureKalmanFilter; the iterated and the
second-order filter, which filterpy does not have, are textbook numpy. They call the compiled model functions, which
flatters the twins: in plain Python these alone would take longer than all of filterpy. Only the ratios mean anything.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table
from speed_filters import Pair, measure, slalom

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

KERNEL_STEPS = 20
"""The kernels run this many times the samples of their rivals, or their time could not be measured."""

EKF_BAR, UKF_BAR = 200.0, 100.0


def wheeled_slalom(vehicle: Vehicle, steps: int) -> Inputs:
    """The slalom of `speed_filters` with wheel speeds, so that all five measurements are there."""
    inputs = slalom(vehicle, steps)
    inputs.samples[:, VFL:] = np.nan
    inputs.samples[:, VFL] = inputs.samples[:, VFR] = inputs.samples[:, VX]
    return inputs


def make_pairs(steps: int) -> list[Pair]:
    """The comparisons."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = wheeled_slalom(vehicle, steps), wheeled_slalom(vehicle, steps * KERNEL_STEPS)

    def pair(name: str, estimator: PlanarFilter, twin: Callable[..., Estimate], rival: str, bar: float) -> Pair:
        # A horizon is many steps; fewer samples will do.
        part = 20 if isinstance(estimator, CubatureRecedingHorizonKF) else 1
        few, many = (Inputs(i.dt, i.samples[: len(i.samples) // part]) for i in (short, long))
        return Pair(
            name, rival, lambda: estimator.run(many), lambda: twin(estimator, few),
            len(many.samples), len(few.samples), bar,
        )  # fmt: skip

    return [
        pair("first-order EKF", FirstOrderEKF(vehicle), reference_first_order_ekf, "filterpy", EKF_BAR),
        pair("the same, double track", DoubleTrackEKF(vehicle), reference_first_order_ekf, "filterpy", EKF_BAR),
        pair("iterated EKF", IteratedEKF(vehicle), reference_iterated_ekf, "numpy", EKF_BAR),
        pair("second-order EKF", SecondOrderEKF(vehicle), reference_second_order_ekf, "numpy", EKF_BAR),
        pair("simple UKF", SimpleUKF(vehicle), reference_ukf, "filterpy", UKF_BAR),
        pair("general UKF", GeneralUKF(vehicle), reference_ukf, "filterpy", UKF_BAR),
        pair("simplex UKF", SimplexUKF(vehicle), reference_ukf, "filterpy", UKF_BAR),
        pair("spherical UKF", SphericalUKF(vehicle), reference_ukf, "filterpy", UKF_BAR),
        pair("square-root cubature KF", SqrtCubatureKF(vehicle), reference_cubature_kf, "filterpy", UKF_BAR),
        pair(
            "the same, receding horizon", CubatureRecedingHorizonKF(vehicle), reference_receding_horizon,
            "filterpy", UKF_BAR,
        ),
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=400, help="samples for the slow side of each pair")
    options = parser.parse_args()
    pairs = make_pairs(options.steps)
    times = measure(pairs, options.repeats)

    table = Table(title=f"Time per sample on one core, best of {options.repeats}")
    for heading in ("filter", "rival", "kernel us", "rival us", "ratio", "median ratio", "bar", ""):
        table.add_column(heading, justify="left" if heading in ("filter", "rival", "") else "right")
    best, median = times.min(axis=0), np.median(times[:, :, 1] / times[:, :, 0], axis=0)
    for i, pair in enumerate(pairs):
        kernel, rival = best[i]
        table.add_row(
            pair.name, pair.rival, f"{kernel:.2f}", f"{rival:.0f}", f"{rival / kernel:.0f}", f"{median[i]:.0f}",
            f"{pair.bar:g}", "met" if rival / kernel >= pair.bar else "missed",
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()

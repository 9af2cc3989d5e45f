"""The estimators that tests ask: all of the catalogue, with settings that make another one of it, by room."""

import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from crosscomb.filters.algebra.resampling import RESAMPLING
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.models.vehicle import Vehicle, load_vehicle
from drives import GOLF
from estimator_checks import CHECKS

CAR = load_vehicle("generic_compact")
FEW = {
    "dynamic_pf": {"particles": 200},
    "kinematic_pf": {"particles": 200},
    "adaptive_pf": {"effective": 100, "least_particles": 100, "most_particles": 800},
}
"""Particle filters run with fewer particles here: it is their conduct that is tested."""

SCHEMES = tuple(RESAMPLING)
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "dynamic_ekf": ({"tyre": "linear"},),
    "dynamic_pf": ({"tyre": "linear"}, {"particles": 1}),
    "kinematic_pf": tuple({"particles": 50, "resampling": scheme} for scheme in SCHEMES),
    "random_walk_pf": (
        *({"resampling": scheme} for scheme in SCHEMES),
        *({"particles": 200, "resampling": scheme} for scheme in SCHEMES),
        {"particles": 1, "forces": "solved"},
    ),
    "random_walk_ekf": ({"slip_from": "geometric"}, {"slip_from": "free"}),
    "double_track_random_walk_ekf": (
        {"measured": "u_r", "yaw_moment": "zero", "slip_from": "free"},
        {"slip_from": "geometric", "yaw_moment": "zero"},
    ),
    "second_order_ekf": ({"track": "double"},),
    "simple_ukf": ({"track": "double"},),
    "general_ukf": ({"alpha": 0.9, "kappa": 0.5},),
}
"""Settings, beside the defaults, with which an estimator is another one."""

KNOWN = {
    ("random_walk_ekf free", "a_missing_channel_is_survived"): "nothing holds a free beta: beta_std grows",
    ("dual_ekf", "a_wild_sample_is_survived"): "beta_std is not finite after an ay of 1e6 m/s^2",
}
"""Checks that an estimator is known to fail."""

CASES = {name: (name, {}) for name in CATALOGUE} | {
    f"{name} {' '.join(map(str, settings.values()))}": (name, settings)
    for name, variants in VARIANTS.items()
    for settings in variants
}


def quick(name: str, car: Vehicle = CAR, settings: dict[str, Any] | None = None) -> KernelFilter:
    """Make an estimator that does not hold up the tests."""
    return make_filter(name, car, FEW.get(name, {}) | (settings or {}))


SHORT = ("cubature_receding_horizon_kf", "cubature_hybrid_kf")
"""Filters that take 0.3 s anew at each sample: all checks are done at 0.05 s, those of steps at both."""


def contract(room: str) -> Iterator[Any]:
    """Every check of every case in a room of `crosscomb.filters`, with what is known not to hold."""
    for case, (name, settings) in CASES.items():
        if re.split("[.:]", CATALOGUE[name].place)[0] != room:
            continue
        short = {"horizon": 0.05} if name in SHORT else {}
        make = partial(quick, name, GOLF, short | settings)
        for check in CHECKS:
            known = KNOWN.get((case, check.__name__))
            marks = [pytest.mark.xfail(reason=known, strict=True)] if known else []
            yield pytest.param(make, check, id=f"{case}-{check.__name__}", marks=marks)

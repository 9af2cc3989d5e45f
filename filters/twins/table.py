"""Which twin belongs to which estimator: what the tests hold kernels against, and `crosscomb benchmark speed` times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from crosscomb.filters.base import Estimate, Inputs
from crosscomb.filters.twins import adaptive, aided, basic, particles, planar, random_walk

Twin = Callable[[Any, Inputs], Estimate]
"""Takes the estimator and its inputs, and gives what the estimator's own `run` does."""

FILTERPY: dict[str, Twin] = {
    "kinematic_kf": basic.twin_kinematic_kf,
    "dynamic_ekf": basic.twin_dynamic_ekf,
    "random_walk_pf": particles.twin_random_walk_pf,
    "lint_ekf": adaptive.twin_tyre_ekf,
    "ratt_ekf": adaptive.twin_tyre_ekf,
    "ratte_ekf": adaptive.twin_tyre_ekf,
    "dual_ekf": adaptive.twin_dual_ekf,
    "friction_adaptive_ekf": adaptive.twin_friction_adaptive_ekf,
    "random_walk_ekf": random_walk.twin_random_walk_ekf,
    "double_track_random_walk_ekf": random_walk.twin_double_track_random_walk_ekf,
    "first_order_ekf": planar.twin_first_order_ekf,
    "double_track_ekf": planar.twin_first_order_ekf,
    "simple_ukf": planar.twin_ukf,
    "general_ukf": planar.twin_ukf,
    "simplex_ukf": planar.twin_ukf,
    "spherical_ukf": planar.twin_ukf,
    "sqrt_cubature_kf": planar.twin_cubature_kf,
    "cubature_receding_horizon_kf": planar.twin_receding_horizon,
    "kinematic_kf_zero_yaw": aided.twin_zero_yaw_kf,
    "gnss_kinematic_kf": aided.twin_gnss_kinematic_kf,
    "gnss_dynamic_observer": aided.twin_gnss_dynamic_observer,
}
"""Estimators whose prediction, update or resampling filterpy has."""

NUMPY: dict[str, Twin] = {
    "iterated_ekf": planar.twin_iterated_ekf,
    "second_order_ekf": planar.twin_second_order_ekf,
    "random_walk_pf": particles.numpy_random_walk_pf,
}
"""Twins without filterpy: it has no such filter, or numpy does it faster."""

TWINS: dict[str, Twin] = {**NUMPY, **FILTERPY}
"""The twin of each estimator that has one; filterpy's where there are two."""

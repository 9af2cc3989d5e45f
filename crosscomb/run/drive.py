"""Filters and windows over one drive: a stretch of a log without a long gap.

Works in pieces of any length, one grid point or a whole stretch, with the same result bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.base import HELD, Estimate, Inputs, KernelFilter, Started, next_inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import Artefact, FilterSettings
from crosscomb.selection.windows import Past, WindowSettings, next_windows
from crosscomb.signals import COLUMN

_AY, _YAW_RATE = COLUMN["ay"], COLUMN["yaw_rate"]


@dataclass(frozen=True)
class Drive:
    """A drive under way; its arrays change from piece to piece."""

    vehicle: Vehicle
    filters: Sequence[KernelFilter]
    started: Sequence[Started]
    dt: float  # [s]
    window: WindowSettings
    held: np.ndarray
    past: Past


class Seen(NamedTuple):
    """What filters and windows make of some grid points.

    Attributes
    ----------
    inputs : Inputs
    beta, beta_std, nis : (n, filters) [rad], [rad], [-]
    innovations : list of (n, m)
        Of each filter, see `KernelFilter.innovations`.
    features : (n, f) float32
        Of the window that ends at each point.
    """

    inputs: Inputs
    beta: np.ndarray
    beta_std: np.ndarray
    nis: np.ndarray
    innovations: list[np.ndarray]
    features: np.ndarray


def start_drive(
    vehicle: Vehicle, filters: Sequence[KernelFilter], rate: float, window: WindowSettings
) -> Drive:
    """Make the state before the first grid point.

    Parameters
    ----------
    vehicle : Vehicle
    filters : sequence of KernelFilter
    rate : float [Hz]
    window : WindowSettings
    """
    dt = 1.0 / rate
    started = [estimator.start(dt) for estimator in filters]
    return Drive(vehicle, filters, started, dt, window, np.zeros(len(HELD)), Past())


def next_seen(drive: Drive, points: np.ndarray) -> Seen:
    """Take the next grid points of a drive ``(n, columns)``, completed and as of `Signals.rows`."""
    inputs = next_inputs(drive.held, points, drive.vehicle, drive.dt)
    estimates = [
        estimator.advance(started, inputs.samples)
        for estimator, started in zip(drive.filters, drive.started, strict=True)
    ]
    return Seen(
        inputs,
        np.column_stack([estimate.beta for estimate in estimates]),
        np.column_stack([estimate.beta_std for estimate in estimates]),
        np.column_stack([estimate.nis for estimate in estimates]),
        [
            _innovations(estimator, estimate)
            for estimator, estimate in zip(drive.filters, estimates, strict=True)
        ],
        next_windows(drive.past, points[:, _AY], points[:, _YAW_RATE], drive.window),
    )


def _innovations(estimator: KernelFilter, estimate: Estimate) -> np.ndarray:
    told = [estimate.extra[name] for name in estimator.innovations()]
    return np.array(told).T if told else np.empty((len(estimate.beta), 0))


def make_filters(entries: Sequence[FilterSettings], vehicle: Vehicle) -> list[KernelFilter]:
    """Make filters for a vehicle."""
    return [make_filter(entry.name, vehicle, entry.settings) for entry in entries]


def require_known(names: Sequence[str]) -> None:
    """Refuse names of filters that are not in the catalogue, or stand twice.

    Raises
    ------
    UsageError
    """
    for name in names:
        if name not in CATALOGUE:
            raise UsageError(f"--filters {name}: not in the catalogue: `crosscomb filters` lists it")
        if list(names).count(name) > 1:
            raise UsageError(f"--filters {name}: named twice: name it once")


def name_filters(names: Sequence[str], artefact: Artefact) -> list[FilterSettings]:
    """Settings of the named filters: the artefact's own where it has them, else the defaults.

    Raises
    ------
    UsageError
        A name is not in the catalogue, or stands twice.
    """
    require_known(names)
    known = {entry.name: entry for entry in artefact.filters}
    return [known.get(name, FilterSettings(name=name)) for name in names]

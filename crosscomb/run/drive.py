"""Filters and windows over one drive: a stretch of a log without a long gap.

Works in pieces of any length, one grid point or a whole stretch, with the same result bit for bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import HELD, Estimate, KernelFilter, Started, next_inputs
from crosscomb.filters.catalogue import make_filter, require_listed
from crosscomb.logs.grid import to_grid
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import Artefact, FilterSettings
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import Past, WindowSettings, next_windows
from crosscomb.signals import COLUMN, MIN_SPEED, Signals

_AY, _YAW_RATE = COLUMN["ay"], COLUMN["yaw_rate"]

LONG = 1000
"""From so many samples on filters run in threads."""


@dataclass(frozen=True)
class Drive:
    """A drive under way; its arrays change from piece to piece."""

    vehicle: Vehicle
    filters: Sequence[KernelFilter]
    started: list[Started]
    dt: float  # [s]
    window: WindowSettings
    extras: bool  # keep all that the filters tell beside beta
    held: np.ndarray
    past: Past
    handed: (
        np.ndarray
    )  # (filters,) beta from which a filter begins anew at its next sample [rad]; NaN where none does


def start_drive(
    vehicle: Vehicle,
    filters: Sequence[KernelFilter],
    rate: float,
    window: WindowSettings,
    extras: bool = False,
) -> Drive:
    """Make the state before the first grid point.

    Parameters
    ----------
    vehicle : Vehicle
    filters : sequence of KernelFilter
    rate : float [Hz]
    window : WindowSettings
    extras : bool
        Keep all that the filters tell beside beta.
    """
    dt = 1.0 / rate
    started = [estimator.start(dt) for estimator in filters]
    handed = np.full(len(filters), np.nan)
    return Drive(vehicle, filters, started, dt, window, extras, np.zeros(len(HELD)), Past(), handed)


def next_seen(drive: Drive, points: np.ndarray) -> Seen:
    """Take the next grid points of a drive ``(n, columns)``, completed and as of `Signals.rows`."""
    inputs = next_inputs(drive.held, points, drive.vehicle, drive.dt)
    running = [
        begin(len(points), estimator.advance, drive.started[i], _handed_over(drive, i, inputs.samples))
        for i, estimator in enumerate(drive.filters)
    ]
    windows = next_windows(drive.past, points[:, _AY], points[:, _YAW_RATE], drive.window)
    estimates = [wait() for wait in running]
    both = list(zip(drive.filters, estimates, strict=True))
    return Seen(
        vehicle=drive.vehicle,
        points=points,
        inputs=inputs,
        beta=np.column_stack([estimate.beta for estimate in estimates]),
        beta_std=np.column_stack([estimate.beta_std for estimate in estimates]),
        nis=np.column_stack([estimate.nis for estimate in estimates]),
        innovations=[_told(estimate, estimator.innovations()) for estimator, estimate in both],
        extras=[_told(estimate, estimator.extras) for estimator, estimate in both] if drive.extras else [],
        windows=windows,
    )


def begin_anew(drive: Drive, which: int, beta: float) -> None:
    """Let a filter begin anew at its next sample, from a beta [rad]."""
    drive.started[which] = drive.filters[which].start(drive.dt)
    drive.handed[which] = beta


def _handed_over(drive: Drive, which: int, samples: np.ndarray) -> np.ndarray:
    """Samples ``(n, 17)`` as a filter takes them that may begin anew.

    Filters start from the beta of a car that rolls without tyre slip. Steered by beta in front and in the rear a car
    rolls in the direction of beta.
    """
    beta, drive.handed[which] = drive.handed[which], np.nan
    if not (np.isfinite(beta) and samples[0, at.VX] > MIN_SPEED):
        return samples
    samples = samples.copy()
    samples[0, [at.STEER, at.STEER_REAR]] = beta
    return samples


def take_again(drive: Drive, which: int, seen: Seen, rows: slice) -> None:
    """Write anew what a filter says in some rows, where it has begun anew in between."""
    estimator = drive.filters[which]
    estimate = estimator.advance(drive.started[which], _handed_over(drive, which, seen.inputs.samples[rows]))
    seen.beta[rows, which], seen.beta_std[rows, which] = estimate.beta, estimate.beta_std
    seen.nis[rows, which] = estimate.nis
    seen.innovations[which][rows] = _told(estimate, estimator.innovations())
    if seen.extras:
        seen.extras[which][rows] = _told(estimate, estimator.extras)


def begin(samples: int, work: Callable[..., Any], *given: Any) -> Callable[[], Any]:
    """Begin a filter's work, in a thread where it is worth one, and give what waits for its result."""
    if samples < LONG:
        result = work(*given)
        return lambda: result
    return _threads().submit(work, *given).result


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count())


def _told(estimate: Estimate, names: Sequence[str]) -> np.ndarray:
    told = [estimate.extra[name] for name in names]
    return np.array(told).T if told else np.empty((len(estimate.beta), 0))


def run_filters(
    signals: Signals, vehicle: Vehicle, filters: Sequence[KernelFilter], rate: float, window: WindowSettings
) -> list[Seen]:
    """Run filters over a log and cut its windows: where training starts. Run time goes the same way, with a switch.

    Parameters
    ----------
    signals : Signals
        Completed by `crosscomb.logs.prepare.complete`.
    vehicle, filters, rate, window
        As in `start_drive`.

    Returns
    -------
    list of Seen
        One per stretch of the log without a long gap.
    """
    return [
        next_seen(start_drive(vehicle, filters, rate, window), segment.signals.rows())
        for segment in to_grid(signals, rate)
    ]


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
        require_listed(f"`filters` {name}", name)
        if list(names).count(name) > 1:
            raise UsageError(f"`filters` {name}: named twice: name it once")


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

"""One log end to end: filters in parallel, selector, switch, and the answer at each row of the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.files import refuse_overwriting, write_text
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.logs.grid import MAX_GAP
from crosscomb.logs.plausibility import check_units
from crosscomb.logs.prepare import complete
from crosscomb.logs.read import log_name, read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.answers import Plan, Stream, advance, make_plan
from crosscomb.run.handling import STATES, Handling
from crosscomb.run.motion import Motion, PointVelocity, velocity_at
from crosscomb.run.status import TEXTS
from crosscomb.run.tuned import Tuned
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import MIN_SPEED, REFERENCES, Signals

OUTPUTS = (
    ".estimate.csv",
    ".estimate.png",
    ".point.csv",
    ".handling.csv",
    ".extras.csv",
    ".extras.png",
    ".run.json",
)
"""Endings of what is written for a log."""

GENERIC = "generic_compact"
"""Shipped vehicle that stands in for an unknown car."""


@dataclass(frozen=True)
class LogEstimate:
    """Answer at each row of a log.

    Attributes
    ----------
    signals : Signals
        The log, completed.
    beta, beta_std : (n,) [rad]
    active : (n,) str
        Name of the filter that is active.
    status : (n,) str
        ``ok``, or words joined by ``+``.
    filters : dict of str to (n,) [rad]
        beta of each filter.
    motion : Motion
        Speed and curvature, from which `at` makes the velocity of any point of the car.
    handling : Handling
        Slip angles of both axles and whether the car understeers or oversteers.
    extras : dict of str to (n,)
        What the filters tell beside beta, by ``<filter> <quantity> [unit]``; empty where nobody asked.
    """

    signals: Signals
    beta: np.ndarray
    beta_std: np.ndarray
    active: np.ndarray
    status: np.ndarray
    filters: dict[str, np.ndarray]
    motion: Motion
    handling: Handling
    extras: dict[str, np.ndarray]

    def table(self) -> pd.DataFrame:
        """Columns of the estimate file: t, beta, beta_std, active, status and beta of each filter."""
        columns = {"t": self.signals.t, "beta": self.beta, "beta_std": self.beta_std}
        filters = {f"beta_{name}": beta for name, beta in self.filters.items()}
        return pd.DataFrame({**columns, "active": self.active, "status": self.status, **filters})

    def at(self, x: float, y: float = 0.0) -> PointVelocity:
        """Velocity of the point x [m] ahead and y [m] to the left of the centre of gravity, at each row."""
        return velocity_at(self.beta, self.beta_std, self.motion, x, y)

    def point_table(self, x: float, y: float = 0.0) -> pd.DataFrame:
        """Columns of the file of a point: t, vx, vy, beta and beta_std."""
        return pd.DataFrame({"t": self.signals.t, **self.at(x, y)._asdict()})

    def handling_table(self) -> pd.DataFrame:
        """Columns of the handling file: t, slip_front, slip_rear, understeer and state."""
        return pd.DataFrame({"t": self.signals.t, **self.handling._asdict()})

    def extras_table(self) -> pd.DataFrame:
        """Columns of the file of what the filters tell beside beta: t and each of `extras`."""
        return pd.DataFrame({"t": self.signals.t, **self.extras})

    def handling_shares(self) -> dict[str, float]:
        """Share of the time above `MIN_SPEED` in each state of handling; all 0 where the car never was that fast."""
        steps = np.minimum(np.diff(self.signals.t, append=self.signals.t[-1]), MAX_GAP)
        steps[self.motion.vx <= MIN_SPEED] = 0.0
        total = max(float(steps.sum()), 1e-9)
        return {state: float(steps[self.handling.state == state].sum()) / total for state in STATES}


def estimate_log(
    signals: Signals,
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
    extras: bool = False,
) -> LogEstimate:
    """Estimate the sideslip angle at each row of a log.

    A row holds the newest estimate at or before its time; none is made from later samples.

    Parameters
    ----------
    signals : Signals
        As read from a file.
    vehicle : Vehicle
    artefact : Artefact
    filters : sequence of str, optional
        Estimators to run instead of the artefact's. With all of the artefact's among them its switch works as ever,
        and the others stand beside it; else the first named one is the answer, and nothing is switched.
    tuned : Tuned, optional
        Noise that takes the place of the filters' own.
    extras : bool
        Also give what the estimators tell beside beta: innovations, forces, yaw moment, friction in use, tyre
        parameters, shares.

    Raises
    ------
    UsageError
        Extras are wanted, and none of the estimators tells more than beta.
    """
    signals = complete(signals, vehicle)
    plan = make_plan(vehicle, artefact, filters, tuned, extras)
    if not plan.switched:
        needed = ", ".join(artefact.filter_names)
        note = f"{plan.names[0]} is the answer: the selector needs all of {needed}"
        signals = replace(signals, notes=(*signals.notes, note))
    return to_estimate(plan, signals, advance(Stream(plan), signals.rows()))


def to_estimate(plan: Plan, signals: Signals, answers: np.ndarray) -> LogEstimate:
    """Put names to the answers at the rows of a completed log."""
    told = {name: answers[name].T.copy() for name in plan.record.names or ()}
    slips = told["slip_front"], told["slip_rear"], told["understeer"]
    return LogEstimate(
        signals,
        told["beta"],
        told["beta_std"],
        np.array(plan.names)[told["active"]],
        TEXTS[told["status"]],
        dict(zip(plan.names, told["filters"], strict=True)),
        Motion(*(told[name] for name in Motion._fields)),
        Handling(*slips, np.array(STATES, dtype=object)[told["state"]]),
        dict(zip(plan.extras, told["extras"], strict=True)),
    )


@dataclass(frozen=True)
class OpenedLog:
    """A log that was read and found fit to be estimated.

    Attributes
    ----------
    path : Path
    signals : Signals
        As read.
    vehicle : Vehicle
    origin : str
        Where the vehicle came from.
    warnings : tuple of str
    """

    path: Path
    signals: Signals
    vehicle: Vehicle
    origin: str
    warnings: tuple[str, ...]


def open_logs(
    paths: Sequence[Path],
    artefact: Artefact,
    vehicle: str | Path | None = None,
    channel_map: ChannelMap | None = None,
    output: Path | None = None,
    progress: Callable[[], None] | None = None,
) -> list[OpenedLog]:
    """Read and check logs, all of them before anything is written.

    Parameters
    ----------
    paths : sequence of Path
    artefact : Artefact
    vehicle : str or Path, optional
        Vehicle file for all of them; else see `choose_vehicle`.
    channel_map : ChannelMap, optional
    output : Path, optional
        Folder the estimates will go to: none of them may overwrite an input.
    progress : callable, optional
        Called for each log that is read.

    Raises
    ------
    UsageError
        A log is broken or plainly in wrong units, two have one name, or an output would overwrite an input.
    """
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder: name the logs in it")
        name = log_name(path)
        if name in by_name:
            raise UsageError(f"{path}: has the same name as {by_name[name]}: estimate them in two calls")
        by_name[name] = path
    if output is not None:
        refuse_overwriting(paths, (output / f"{name}{end}" for name in by_name for end in OUTPUTS))
    opened = []
    for path in paths:
        opened.append(_open_log(path, artefact, vehicle, channel_map))
        if progress is not None:
            progress()
    return opened


def _open_log(
    path: Path, artefact: Artefact, vehicle: str | Path | None, channel_map: ChannelMap | None
) -> OpenedLog:
    signals = read_log(path, channel_map)
    car, origin, warning = choose_vehicle(path, vehicle, artefact)
    if warning:  # the generic car stands in
        require_road_wheel_angle(signals)
    warnings = [*([warning] if warning else []), *require_plausible(signals, car)]
    return OpenedLog(path, signals, car, origin, tuple(warnings))


def choose_vehicle(log: Path, given: str | Path | None, artefact: Artefact) -> tuple[Vehicle, str, str]:
    """Find the vehicle of a log: given, beside the log, in the artefact, or the generic car.

    Returns
    -------
    vehicle : Vehicle
    origin : str
        Where it came from, for the record.
    warning : str
        What the user must know about it; empty when all is well.
    """
    if given is not None:
        return load_vehicle(given), str(given), ""
    beside = log.parent / "vehicle.toml"
    if beside.exists():
        return load_vehicle(beside), str(beside), ""
    if artefact.vehicle is not None:
        return artefact.vehicle, "artefact", ""
    warning = (
        f"{log}: no vehicle file: the generic compact car is taken, its beta can be far off: "
        f"give --vehicle, or write vehicle.toml beside the log with `crosscomb vehicle`"
    )
    return load_vehicle(GENERIC), GENERIC, warning


def require_road_wheel_angle(signals: Signals) -> None:
    """Refuse a log that has only the hand-wheel angle when the car, and so its steering ratio, is unknown.

    Raises
    ------
    UsageError
    """
    if not signals.has("steer"):
        raise UsageError(
            f"{signals.source}: column steer is missing and steer_wheel needs the car's steering ratio: "
            f"give --vehicle, or map steer with scale = 1 / ratio (--map)"
        )


def require_plausible(signals: Signals, vehicle: Vehicle) -> list[str]:
    """Refuse a log whose units or signs are plainly wrong; give the warnings about what merely looks odd.

    Raises
    ------
    UsageError
    """
    findings = check_units(signals, vehicle)
    for finding in findings:
        if finding.severity == "error":
            raise UsageError(f"{signals.source}: column {finding.column}: {finding.message}")
    return [
        f"{signals.source}: column {finding.column}: {finding.message}"
        for finding in findings
        if finding.column not in REFERENCES
    ]


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table of an estimate, whole or not at all; its numbers come back exactly, NaN as an empty cell."""
    # By hand in half the time that pandas takes: no cell holds anything that must be quoted.
    names = [str(name) for name in table.columns]
    columns = [map(_cell if table[name].dtype == float else str, table[name].tolist()) for name in names]
    rows = map(",".join, zip(*columns, strict=True))
    write_text(path, "\n".join([",".join(names), *rows]) + "\n")


def _cell(value: float) -> str:
    return repr(value) if value == value else ""


def write_estimate(estimate: LogEstimate, path: Path) -> None:
    """Write the estimate file."""
    write_table(estimate.table(), path)

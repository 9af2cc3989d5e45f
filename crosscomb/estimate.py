"""One log end to end: filters in parallel, selector, switch, and the answer at each row of the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd

from crosscomb.answer import Answer, select, start_selection
from crosscomb.artefact import Artefact, FilterSettings
from crosscomb.channel_map import ChannelMap
from crosscomb.errors import UsageError
from crosscomb.features import all_features, make_memory
from crosscomb.files import refuse_overwriting, write_text
from crosscomb.filters.base import Inputs, KernelFilter, make_inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.logs import log_name, read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.plausibility import check_units
from crosscomb.prepare import complete
from crosscomb.resample import Segment, resample, rows_to_grid
from crosscomb.signals import MIN_SPEED, REFERENCES, Signals
from crosscomb.tuned import Tuned, with_tuned
from crosscomb.windows import WindowSettings, window_features

STALE = 1.0
"""Without speed, steering, or both yaw rate and ay for this long [s] the estimate is invalid."""

REVERSE_SPEED = -0.3
"""Below this vx [m/s] the car reverses; speed sensors at rest read a little on either side of 0."""

OUTPUTS = (".estimate.csv", ".estimate.png", ".traces.png", ".run.json")
"""Endings of what is written for a log."""

GENERIC = "generic_compact"
"""Shipped vehicle that stands in for an unknown car."""

NEEDED = ("vx", "ax", "ay", "yaw_rate", "steer")
"""Channels that every sample should have; one missing makes the status degraded."""


@dataclass(frozen=True)
class FilterRun:
    """What the filters made of one segment, at the working rate.

    Attributes
    ----------
    segment : Segment
    beta, beta_std, nis : (n, filters) [rad], [rad], [-]
    features : (n, f) float32
        Of the window that ends at each sample.
    inputs : Inputs
        What the filters saw.
    vehicle : Vehicle
    extras : tuple of dict
        Further answers ``(n,)`` of each filter, by name and unit.
    """

    segment: Segment
    beta: np.ndarray
    beta_std: np.ndarray
    nis: np.ndarray
    features: np.ndarray
    inputs: Inputs
    vehicle: Vehicle
    extras: tuple[dict[str, np.ndarray], ...]

    def answer(self, artefact: Artefact) -> Answer:
        """Let the artefact's selector make one answer of its filters."""
        selection = start_selection(artefact, self.vehicle)
        return select(selection, self.inputs.samples, self.beta, self.beta_std, self.nis, self.features)

    def all_features(self) -> np.ndarray:
        """All features of every sample ``(n, f) float32``, see `crosscomb.features`."""
        memory = make_memory(self.beta.shape[1])
        return all_features(
            self.inputs.samples, self.beta, self.beta_std, self.nis, self.vehicle, self.inputs.dt, memory
        )

    def only(self, members: Sequence[int]) -> FilterRun:
        """Keep some of the filters, in the order given."""
        chosen = list(members)
        return replace(
            self,
            beta=self.beta[:, chosen],
            beta_std=self.beta_std[:, chosen],
            nis=self.nis[:, chosen],
            extras=tuple(self.extras[i] for i in chosen),
        )


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
    extras : dict of str to dict
        Of each filter that has any, further answers ``(n,)`` such as adapted tyre parameters, by name and unit.
    """

    signals: Signals
    beta: np.ndarray
    beta_std: np.ndarray
    active: np.ndarray
    status: np.ndarray
    filters: dict[str, np.ndarray]
    extras: dict[str, dict[str, np.ndarray]]

    def table(self) -> pd.DataFrame:
        """Columns of the estimate file: t, beta, beta_std, active, status and beta of each filter."""
        columns = {"t": self.signals.t, "beta": self.beta, "beta_std": self.beta_std}
        filters = {f"beta_{name}": beta for name, beta in self.filters.items()}
        return pd.DataFrame({**columns, "active": self.active, "status": self.status, **filters})


def run_filters(
    signals: Signals, vehicle: Vehicle, filters: Sequence[KernelFilter], rate: float, window: WindowSettings
) -> list[FilterRun]:
    """Run filters over a log and cut its windows; training and run time both start here.

    Parameters
    ----------
    signals : Signals
        Completed by `crosscomb.prepare.complete`.
    vehicle : Vehicle
    filters : sequence of KernelFilter
    rate : float [Hz]
    window : WindowSettings
    """
    runs = []
    for segment in resample(signals, rate):
        inputs = make_inputs(segment.signals, vehicle, 1.0 / rate)
        estimates = [estimator.run(inputs) for estimator in filters]
        runs.append(
            FilterRun(
                segment=segment,
                beta=np.column_stack([estimate.beta for estimate in estimates]),
                beta_std=np.column_stack([estimate.beta_std for estimate in estimates]),
                nis=np.column_stack([estimate.nis for estimate in estimates]),
                features=window_features(
                    segment.signals.column("ay"), segment.signals.column("yaw_rate"), window
                ),
                inputs=inputs,
                vehicle=vehicle,
                extras=tuple(estimate.extra for estimate in estimates),
            )
        )
    return runs


def make_filters(entries: Sequence[FilterSettings], vehicle: Vehicle) -> list[KernelFilter]:
    """Make filters for a vehicle."""
    return [make_filter(entry.name, vehicle, entry.settings) for entry in entries]


def name_filters(names: Sequence[str], artefact: Artefact) -> list[FilterSettings]:
    """Settings of the named filters: the artefact's own where it has them, else the defaults.

    Raises
    ------
    UsageError
        A name is not in the catalogue, or stands twice.
    """
    known = {entry.name: entry for entry in artefact.filters}
    for name in names:
        if name not in CATALOGUE:
            raise UsageError(f"--filters {name}: not in the catalogue: `crosscomb filters` lists it")
        if names.count(name) > 1:
            raise UsageError(f"--filters {name}: named twice: name it once")
    return [known.get(name, FilterSettings(name=name)) for name in names]


def estimate_log(
    signals: Signals,
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
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
    """
    signals = complete(signals, vehicle)
    names = list(filters or artefact.filter_names)
    made = make_filters(with_tuned(name_filters(names, artefact), tuned), vehicle)
    switched = all(name in names for name in artefact.filter_names)
    members = [names.index(name) for name in (artefact.filter_names if switched else names[:1])]
    if not switched:
        signals = replace(signals, notes=(*signals.notes, f"{names[0]} is the answer: the selector needs all of "
                                          f"{', '.join(artefact.filter_names)}"))  # fmt: skip
    runs = run_filters(signals, vehicle, made, artefact.rate, artefact.window)
    parts, further = [], []
    for run in runs:
        if switched:
            answer = run.only(members).answer(artefact)
        else:
            nothing = np.zeros(len(run.beta), dtype=np.int64)
            answer = Answer(run.beta[:, 0], run.beta_std[:, 0], nothing, nothing > 0, nothing)
        active = np.array(members)[answer.active]
        status = _status(run.segment.signals, answer.outside, artefact.rate)
        rows = signals.t[run.segment.start_row : run.segment.stop_row]
        at = rows_to_grid(rows, run.segment, artefact.rate)
        parts.append(
            (answer.beta[at], answer.beta_std[at], np.array(names)[active[at]], status[at], run.beta[at])
        )
        further.append([{key: values[at] for key, values in extra.items()} for extra in run.extras])
    beta, beta_std, active, status, each = (np.concatenate(column) for column in zip(*parts, strict=True))
    betas = {name: each[:, i] for i, name in enumerate(names)}
    extras = {
        name: {key: np.concatenate([part[key] for part in own]) for key in own[0]}
        for name, own in zip(names, zip(*further, strict=True), strict=True)
        if own[0]
    }
    return LogEstimate(signals, beta, beta_std, active, status, betas, extras)


def _status(signals: Signals, outside: np.ndarray, rate: float) -> np.ndarray:
    """Words that say how far to trust each sample, joined by ``+``."""
    vx = signals.column("vx")
    missing = {name: ~np.isfinite(signals.column(name)) for name in NEEDED}
    lost = (
        (_age(missing["vx"], rate) > STALE)
        | (_age(missing["steer"], rate) > STALE)
        | (_age(missing["yaw_rate"] & missing["ay"], rate) > STALE)
    )
    known_speed = pd.Series(vx).ffill().fillna(0.0).to_numpy()
    words = {
        "low_speed": (known_speed <= MIN_SPEED) & (known_speed >= REVERSE_SPEED),
        "degraded": reduce(np.logical_or, missing.values()),
        "extrapolating": outside & (known_speed > MIN_SPEED),
        "invalid": lost,
        "reverse": known_speed < REVERSE_SPEED,
    }
    return join_words(words)


def join_words(words: Mapping[str, np.ndarray]) -> np.ndarray:
    """Join the words that hold ``(n,) bool`` at each sample by ``+``; ``ok`` where none does."""
    code = np.zeros(len(next(iter(words.values()))), dtype=np.int64)
    for bit, holds in enumerate(words.values()):
        code |= holds.astype(np.int64) << bit
    texts = [
        "+".join(word for bit, word in enumerate(words) if value >> bit & 1) or "ok"
        for value in range(1 << len(words))
    ]
    return np.array(texts, dtype=object)[code]


def _age(missing: np.ndarray, rate: float) -> np.ndarray:
    """Time since the last sample that was there ``(n,) [s]``, infinite before the first."""
    index = np.arange(len(missing))
    last = np.maximum.accumulate(np.where(missing, -1, index))
    return np.where(last < 0, np.inf, (index - last) / rate)


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


def write_estimate(estimate: LogEstimate, path: Path) -> None:
    """Write the estimate file, whole or not at all; its numbers come back exactly."""
    table = estimate.table()
    # By hand in half the time that pandas takes: no cell holds anything that must be quoted.
    names = [str(name) for name in table.columns]
    columns = [map(repr if table[name].dtype == float else str, table[name].tolist()) for name in names]
    rows = map(",".join, zip(*columns, strict=True))
    write_text(path, "\n".join([",".join(names), *rows]) + "\n")

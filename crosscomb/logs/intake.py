"""Logs on their way in: read, each with its vehicle, and found fit to be estimated before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscomb.errors import UsageError
from crosscomb.logs.ahead import ahead
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.logs.formats.table import log_name
from crosscomb.logs.gaps import Finding
from crosscomb.logs.plausibility import Look
from crosscomb.logs.read import LogFile, open_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import REFERENCES, Signals

GENERIC = "generic_compact"
"""Shipped vehicle that stands in for an unknown car."""


MOST_KEPT = 6_000_000
"""Numbers of logs that are kept until they are estimated (48 MB: an hour at 100 Hz); what is more is read twice."""


@dataclass(frozen=True)
class OpenedLog:
    """A log that was read and found fit to be estimated.

    Attributes
    ----------
    path : Path
    file : LogFile
    rows : int
    vehicle : Vehicle
    origin : str
        Where the vehicle came from.
    warnings : tuple of str
    kept : list of Signals, optional
        All of the log, where it is not too long to be kept until it is estimated.
    """

    path: Path
    file: LogFile
    rows: int
    vehicle: Vehicle
    origin: str
    warnings: tuple[str, ...]
    kept: list[Signals] | None

    def chunks(self) -> Iterable[Signals]:
        """The log as read, piece by piece; a long one is read anew."""
        return self.file.chunks() if self.kept is None else self.kept


def open_logs(
    paths: Sequence[Path],
    trained: Vehicle | None = None,
    vehicle: str | Path | None = None,
    channel_map: ChannelMap | None = None,
    progress: Callable[[], None] | None = None,
) -> list[OpenedLog]:
    """Read and check logs, all of them.

    Parameters
    ----------
    paths : sequence of Path
    trained : Vehicle, optional
        Vehicle of the artefact, see `choose_vehicle`.
    vehicle : str or Path, optional
        Vehicle file for all of them.
    channel_map : ChannelMap, optional
    progress : callable, optional
        Called for each log that is read.

    Raises
    ------
    UsageError
        A log is broken or plainly in wrong units, or two have one name.
    """
    opened: list[OpenedLog] = []
    for path in log_names(paths).values():
        room = MOST_KEPT - sum(part.frame.size for log in opened for part in log.kept or ())
        opened.append(_open_log(path, trained, vehicle, channel_map, room))
        if progress is not None:
            progress()
    return opened


def log_names(paths: Sequence[Path]) -> dict[str, Path]:
    """Logs by the names that their estimates will have.

    Raises
    ------
    UsageError
        Two have one name, or one is a folder.
    """
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder: name the logs in it")
        name = log_name(path)
        if name in by_name:
            raise UsageError(f"{path}: has the same name as {by_name[name]}: estimate them in two calls")
        by_name[name] = path
    return by_name


def _open_log(
    path: Path,
    trained: Vehicle | None,
    vehicle: str | Path | None,
    channel_map: ChannelMap | None,
    room: int,
) -> OpenedLog:
    file, look = open_log(path, channel_map), Look()
    kept: list[Signals] | None = []
    for chunk in ahead(file.chunks()):
        look.take(chunk)
        room -= chunk.frame.size
        kept = [*kept, chunk] if kept is not None and room >= 0 else None
    car, origin, warning = choose_vehicle(path, vehicle, trained)
    if warning:  # the generic car stands in
        require_road_wheel_angle(str(path), look.has("steer"))
    found = require_plausible(str(path), look.findings(car))
    warnings = (*([warning] if warning else []), *found)
    return OpenedLog(path, file, look.gaps.rows, car, origin, warnings, kept)


def choose_vehicle(
    log: Path, given: str | Path | None = None, trained: Vehicle | None = None
) -> tuple[Vehicle, str, str]:
    """Find the vehicle of a log: given, beside the log, that of the artefact, or the generic car.

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
    if trained is not None:
        return trained, "artefact", ""
    warning = (
        f"{log}: no vehicle file: the generic compact car is taken, its beta can be far off: "
        f"give `vehicle`, or write vehicle.toml beside the log with `crosscomb vehicle`"
    )
    return load_vehicle(GENERIC), GENERIC, warning


def require_road_wheel_angle(source: str, has_steer: bool) -> None:
    """Refuse a log that has only the hand-wheel angle when the car, and so its steering ratio, is unknown.

    Raises
    ------
    UsageError
    """
    if not has_steer:
        raise UsageError(
            f"{source}: column steer is missing and steer_wheel needs the car's steering ratio: "
            f"give `vehicle`, or map steer with scale = 1 / ratio (`channel_map`)"
        )


def require_plausible(source: str, findings: list[Finding]) -> list[str]:
    """Refuse a log whose units or signs are plainly wrong; give the warnings about what merely looks odd.

    Parameters
    ----------
    source : str
        What messages call the log.
    findings : list of Finding
        As of `crosscomb.logs.plausibility.check_units`.

    Raises
    ------
    UsageError
    """
    for finding in findings:
        if finding.severity == "error":
            raise UsageError(f"{source}: column {finding.column}: {finding.message}")
    return [
        f"{source}: column {finding.column}: {finding.message}"
        for finding in findings
        if finding.column not in REFERENCES
    ]

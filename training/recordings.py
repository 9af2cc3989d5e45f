"""A data folder as recordings: logs with ground truth, each with its vehicle."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.base import Inputs, make_inputs
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.logs.formats.table import ending, endings, log_name
from crosscomb.logs.grid import to_grid
from crosscomb.logs.intake import require_plausible
from crosscomb.logs.plausibility import check_units
from crosscomb.logs.prepare import complete
from crosscomb.logs.read import open_log, read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import Signals
from crosscomb.training.metrics import countable
from crosscomb.training.parallel import in_parallel

LEAST_RECORDINGS = 7
"""Fewer cannot be split 75/15/10 and still leave five folds."""


@dataclass(frozen=True)
class Recording:
    """One log with its vehicle; with ground truth unless asked for otherwise.

    Attributes
    ----------
    name : str
        Log name, after its sub-folder where there are several.
    path : Path
    vehicle : Vehicle
    held : Signals, optional
        Completed; where left out the log is read anew each time somebody asks, with the `channel_map`.
    channel_map : ChannelMap, optional
    """

    name: str
    path: Path
    vehicle: Vehicle
    held: Signals | None = None
    channel_map: ChannelMap | None = None

    @property
    def signals(self) -> Signals:
        """The log, completed."""
        if self.held is not None:
            return self.held
        return complete(read_log(self.path, self.channel_map), self.vehicle)

    @property
    def is_simulated(self) -> bool:
        """Whether it comes from `crosscomb simulate`, whose data card then lies beside it."""
        return self.path.with_name(CARD).is_file()

    def stretches(
        self, rate: float, with_truth: bool = True
    ) -> Iterator[tuple[Inputs, np.ndarray, np.ndarray]]:
        """Samples as filters take them, the true beta ``(n,) [rad]`` and which of them count ``(n,) bool``.

        Parameters
        ----------
        rate : float
            Working rate [Hz].
        with_truth : bool
            Only samples with ground truth count.
        """
        for segment in to_grid(self.signals, rate):
            beta_ref, vx = segment.signals.beta_ref, segment.signals.column("vx")
            counted = countable(beta_ref if with_truth else np.zeros_like(vx), vx)
            yield make_inputs(segment.signals, self.vehicle, 1.0 / rate), beta_ref, counted


CARD = "dataset.json"
"""Data card of a folder of simulated logs."""

OUR_TABLES = (
    ".estimate.csv",
    ".point.csv",
    ".handling.csv",
    ".extras.csv",
    ".tuning.csv",
    "confusion_matrix.csv",
)
"""Endings of what crosscomb itself writes: no logs."""


def find_logs(folder: Path) -> list[Path]:
    """Logs in a folder, in order of their names; hidden files and crosscomb's own tables are none."""
    return sorted(
        path
        for path in folder.iterdir()
        if ending(path)
        and not path.name.startswith(".")
        and not path.name.endswith(OUR_TABLES)
        and path.is_file()
    )


def find_places(folder: Path) -> list[tuple[Path, list[Path]]]:
    """Folders that hold logs, with their logs: a data folder and its sub-folders.

    Raises
    ------
    UsageError
        The folder is missing or holds no log.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such data folder: check the name")
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    found = [(place, logs) for place in places if (logs := find_logs(place))]
    if not found:
        raise UsageError(f"{folder}: holds no log ({endings()}): name the folder with the logs")
    return found


def read_recordings(
    folder: Path,
    vehicle: str | Path | None = None,
    channel_map: ChannelMap | None = None,
    progress: Callable[[], None] | None = None,
    unscored: bool = False,
    jobs: int = 1,
    hold: bool = True,
) -> tuple[list[Recording], list[str]]:
    """Read all recordings of a data folder and of its sub-folders, one per vehicle.

    Parameters
    ----------
    folder : Path
        Logs directly in it, or sub-folders each with logs and a ``vehicle.toml``.
    vehicle : str or Path, optional
        Vehicle file, or name of a shipped one, that holds for all logs.
    channel_map : ChannelMap, optional
    progress : callable, optional
        Called for each log that is read.
    unscored : bool
        Keep logs without ground truth too.
    jobs : int
        Processes.
    hold : bool
        Hold the logs in memory; else each is read anew when it is needed.

    Returns
    -------
    recordings : list of Recording
    notes : list of str
        What was skipped and why.

    Raises
    ------
    UsageError
        The folder is missing or holds no log, or a log or vehicle file is broken: it is named, nothing is run.
    """
    notes: list[str] = []
    tasks = []
    for place, logs in find_places(folder):
        beside = place / "vehicle.toml"
        if not vehicle and not beside.exists():
            if place == folder:
                raise UsageError(f"{folder}: no vehicle.toml beside the logs: write it, or give `vehicle`")
            notes.append(f"{place.name}: skipped, it has no vehicle.toml (one given for all logs would do)")
            continue
        car = load_vehicle(vehicle or beside)
        prefix = "" if place == folder else f"{place.name}/"
        tasks += [(path, prefix, car, channel_map, unscored, hold) for path in logs]
    read = in_parallel(_read_one, tasks, jobs, progress)
    for result, _ in read:
        if isinstance(result, UsageError):
            raise result
    recordings = [result for result, _ in read if isinstance(result, Recording)]
    notes += [note for _, some in read for note in some]
    if not recordings and notes:
        raise UsageError(
            f"{folder}: holds nothing to use: {'; '.join(notes[:3])}{'; ...' if notes[3:] else ''}"
        )
    _require_unique([recording.name for recording in recordings], folder)
    return recordings, notes


def _read_one(
    path: Path, prefix: str, car: Vehicle, channel_map: ChannelMap | None, unscored: bool, hold: bool
) -> tuple[Recording | UsageError | None, list[str]]:
    """One log as a recording, or what is wrong with it, or None where it is skipped; and notes."""
    name = f"{prefix}{path.name}"
    try:
        if open_log(path, channel_map).is_foreign:
            return None, [f"{name}: skipped, it has none of ay, yaw_rate, steer and steer_wheel"]
        signals = read_log(path, channel_map)
        require_plausible(signals.source, check_units(signals, car))
        notes = [f"{name}: {note}" for note in signals.notes if "dropped" in note]
        signals = complete(signals, car)
    except (
        UsageError
    ) as error:  # handed over, so that the first log in order is named and not the first one done
        return error, []
    if not unscored and not signals.has_reference:
        return None, [*notes, f"{name}: skipped, it has no ground truth above walking speed"]
    return Recording(prefix + log_name(path), path, car, signals if hold else None, channel_map), notes


def files_of(recordings: Sequence[Recording], vehicle: str | Path | None = None) -> list[Path]:
    """Files that recordings were read from: vehicle files beside the logs, unless one was given, then the logs."""
    cars = [] if vehicle else sorted({recording.path.with_name("vehicle.toml") for recording in recordings})
    return [*cars, *(recording.path for recording in recordings)]


def require_enough(recordings: list[Recording], folder: Path) -> None:
    """Refuse a data set that is too small to be split.

    Raises
    ------
    UsageError
    """
    if len(recordings) < LEAST_RECORDINGS:
        raise UsageError(
            f"{folder}: {len(recordings)} recordings with ground truth, training needs at least "
            f"{LEAST_RECORDINGS}: add logs, or simulate some with `crosscomb simulate`"
        )


def common_vehicle(recordings: list[Recording]) -> Vehicle | None:
    """The vehicle of all recordings, None where there are several."""
    first = recordings[0].vehicle
    return first if all(recording.vehicle == first for recording in recordings) else None


def _require_unique(names: list[str], folder: Path) -> None:
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{folder}: two logs are called {name}: rename one")

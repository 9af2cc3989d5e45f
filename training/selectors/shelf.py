"""What a training looks at again and again, in files: its memory does not grow with the recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.base import Inputs
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import FilterSettings
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import WindowSettings
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.bank import BankRun, run_one, with_windows
from crosscomb.training.selectors.evaluate import filter_scores
from crosscomb.training.selectors.labels import WINDOW_COLUMNS, Windows

Thing = TypeVar("Thing")


class Stored(NamedTuple):
    """A file of arrays: the type and shape of each."""

    path: Path
    arrays: list[tuple[str, tuple[int, ...]]]


@dataclass(frozen=True)
class Kept:
    """One recording on the shelf.

    Attributes
    ----------
    name : str
    is_simulated : bool
        See `crosscomb.training.recordings.Recording`.
    vehicle : Vehicle
    dt : float [s]
    window : WindowSettings
        Of the first kind of windows.
    rmse : list of (w, filters) [rad]
        Of its windows, for each kind of them.
    scores : list of float [deg]
        RMSE and largest error of each filter that ran, also of those that are not kept.
    runs : Stored
        What the filters said.
    windows : list of Stored
        Its windows, for each kind of them.
    """

    name: str
    is_simulated: bool
    vehicle: Vehicle
    dt: float
    window: WindowSettings
    rmse: list[np.ndarray]
    scores: list[float]
    runs: Stored
    windows: list[Stored]


@dataclass(frozen=True)
class Shelf(Sequence[Thing], Generic[Thing]):
    """A sequence whose members are read each time somebody asks for one."""

    kept: Sequence[Kept]
    read: Callable[[Kept], Thing]

    def __len__(self) -> int:
        return len(self.kept)

    def __getitem__(self, place):  # type: ignore[no-untyped-def]
        if isinstance(place, slice):
            return [self.read(one) for one in self.kept[place]]
        return self.read(self.kept[place])


def fill_shelf(
    recordings: Sequence[Recording],
    filters: Sequence[FilterSettings],
    rate: float,
    kinds: Sequence[tuple[WindowSettings, bool]],
    folder: Path,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    beside: Sequence[FilterSettings] = (),
) -> list[Kept]:
    """Run filters on recordings, label their windows, and put both into a folder.

    Parameters
    ----------
    recordings : sequence of Recording
    filters : sequence of FilterSettings
    rate : float [Hz]
    kinds : sequence of (WindowSettings, bool)
        Kinds of windows, and whether all features stand beside them.
    folder : Path
    jobs : int
        Processes; the result does not depend on it.
    progress : callable, optional
        Called after each recording.
    beside : sequence of FilterSettings
        Filters that are only scored.
    """
    tasks = [
        (recording, filters, beside, rate, kinds, folder / str(i)) for i, recording in enumerate(recordings)
    ]
    return in_parallel(_keep, tasks, jobs, progress)


def banks_of(kept: Sequence[Kept], settings: WindowSettings) -> Shelf[BankRun]:
    """Bank runs of recordings on the shelf, seen through these windows."""
    return Shelf(kept, partial(_read_bank, settings=settings))


def windows_of(kept: Sequence[Kept], kind: int) -> Shelf[Windows]:
    """Windows of recordings on the shelf, of the kind at this place among those that it was filled with."""
    return Shelf(kept, partial(_read_windows, kind=kind))


def _keep(
    recording: Recording,
    filters: Sequence[FilterSettings],
    beside: Sequence[FilterSettings],
    rate: float,
    kinds: Sequence[tuple[WindowSettings, bool]],
    place: Path,
) -> Kept:
    every = run_one(recording, [*filters, *beside], rate, kinds[0][0])
    bank = every.only(range(len(filters)))
    rmse, files = [], []
    for kind, (settings, everything) in enumerate(kinds):
        seen = with_windows(bank, settings) if kind else bank
        windows = seen.windows(settings, everything)
        rmse.append(windows.rmse)
        columns = [getattr(windows, name) for name in WINDOW_COLUMNS]
        files.append(_write(place.with_name(f"{place.name}.windows{kind}"), columns))
    runs = _write(
        place.with_name(f"{place.name}.runs"), [array for run in bank.runs for array in _arrays_of(run)]
    )
    car, scores = recording.vehicle, filter_scores(every)
    return Kept(bank.name, bank.is_simulated, car, 1.0 / rate, kinds[0][0], rmse, scores, runs, files)


def _arrays_of(run: Seen) -> list[np.ndarray]:
    return [run.points, run.inputs.samples, run.windows, run.beta, run.beta_std, run.nis, *run.innovations]


def _read_bank(kept: Kept, settings: WindowSettings) -> BankRun:
    arrays, runs = iter(_read(kept.runs)), []
    for points in arrays:
        samples, windows, beta, beta_std, nis = (next(arrays) for _ in range(5))
        innovations = [next(arrays) for _ in range(beta.shape[1])]
        inputs = Inputs(kept.dt, samples)
        runs.append(Seen(kept.vehicle, points, inputs, beta, beta_std, nis, innovations, [], windows))
    bank = BankRun.of(kept.name, kept.is_simulated, runs)
    return bank if settings == kept.window else with_windows(bank, settings)


def _read_windows(kept: Kept, kind: int) -> Windows:
    return Windows(*_read(kept.windows[kind]))


_ALIGNED = 8


def _write(path: Path, arrays: Sequence[np.ndarray]) -> Stored:
    """Write arrays one behind the other."""
    try:
        with path.open("wb") as out:
            for array in arrays:
                out.write(array.tobytes() + bytes(-array.nbytes % _ALIGNED))
    except OSError as error:
        raise UsageError(
            f"{path.parent}: {error.strerror}: a training keeps about 3 MB a log there: set TMPDIR to a larger folder"
        ) from None
    return Stored(path, [(array.dtype.str, array.shape) for array in arrays])


def _read(stored: Stored) -> list[np.ndarray]:
    """Map a file of arrays: what nobody looks at is never read.

    Mapped to be written to, though nothing is: kernels would be compiled anew for read-only arrays.
    """
    empty = stored.path.stat().st_size == 0
    whole = np.empty(0, np.uint8) if empty else np.memmap(stored.path, np.uint8, "c").view(np.ndarray)
    arrays, start = [], 0
    for kind, shape in stored.arrays:
        size = np.dtype(kind).itemsize * math.prod(shape)
        arrays.append(whole[start : start + size].view(kind).reshape(shape))
        start += size + -size % _ALIGNED
    return arrays

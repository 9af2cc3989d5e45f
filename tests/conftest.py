"""Fixtures shared by all tests."""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pytest

from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import Signals
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.simulation.presets import plan_jobs
from crosscomb.training.simulation.simulate import simulate_log

PROJECT = Path(__file__).resolve().parents[1]
LOGS = 10


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real logs; tests that need it skip, and say so, where it is not there."""
    folder = Path(os.environ.get("CROSSCOMB_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real logs not found at {folder}: set CROSSCOMB_DATA")
    return folder


@pytest.fixture(scope="session")
def car() -> Vehicle:
    """The car of the simulated logs."""
    return load_vehicle("generic_compact")


@pytest.fixture(scope="session")
def simulated(car: Vehicle) -> list[Signals]:
    """A few short logs of every kind of driving, at 100 Hz and with ground truth."""
    return [
        simulate_log(car, job.manoeuvre, (5, job.number), surface=job.surface, duration=15.0, name=job.name)
        for job in plan_jobs(car, LOGS)
    ]


@pytest.fixture(scope="session")
def write_vehicle() -> Callable[[Path, Vehicle], Path]:
    """Write the vehicle file of a car into a folder."""

    def write(folder: Path, car: Vehicle) -> Path:
        keys = car.model_dump(exclude={"tyre", "plant"})
        path = folder / "vehicle.toml"
        lines = [f"{key} = {json.dumps(value)}\n" for key, value in keys.items()]
        path.write_text("".join(lines), encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="session")
def write_log() -> Callable[[pd.DataFrame, Path], Path]:
    """Write a table as a log."""

    def write(frame: pd.DataFrame, path: Path) -> Path:
        frame.to_csv(path, index=False)
        return path

    return write


@pytest.fixture(scope="session")
def data_set(
    simulated: list[Signals],
    car: Vehicle,
    write_log: Callable[[pd.DataFrame, Path], Path],
    write_vehicle: Callable[[Path, Vehicle], Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """The simulated logs in a folder with their vehicle file; to be read only."""
    folder = tmp_path_factory.mktemp("data_set")
    for log in simulated:
        write_log(log.frame, folder / f"{log.name}.csv")
    write_vehicle(folder, car)
    return folder


@pytest.fixture(scope="session")
def recordings(data_set: Path) -> list[Recording]:
    """The simulated logs as training takes them."""
    found, notes = read_recordings(data_set)
    assert (len(found), notes) == (LOGS, [])
    return found


@dataclass(frozen=True)
class Ran:
    """What a command left behind."""

    code: int
    out: str
    err: str


@pytest.fixture
def crosscomb(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run a command line in this process; what it does not turn into an exit code fails the test."""
    from crosscomb.cli.main import main

    def run(*words: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["crosscomb", *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        assert isinstance(stop.value.code, int)
        return Ran(stop.value.code, out, err)

    return run

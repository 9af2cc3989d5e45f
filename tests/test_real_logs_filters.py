"""The three filters on real logs: an answer at every sample, and none that runs away."""

from pathlib import Path

import numpy as np
import pytest

from crosscomb.filters.catalogue import DEFAULT_FILTERS, make_filter
from crosscomb.logs.prepare import complete
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.drive import run_filters
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import MIN_SPEED


def runs_of(path: Path) -> list[Seen]:
    """The default filters over one recording, with the vehicle file beside it."""
    beside = path.parent / "vehicle.toml"
    vehicle = load_vehicle(beside if beside.exists() else "generic_compact")
    filters = [make_filter(name, vehicle) for name in DEFAULT_FILTERS]
    return run_filters(complete(read_log(path), vehicle), vehicle, filters, 100.0, WindowSettings())


@pytest.fixture(scope="module")
def runs(data_dir: Path) -> dict[str, list[Seen]]:
    logs = sorted(path for path in data_dir.glob("*/*") if path.name.endswith((".csv", ".csv.gz")))
    assert len(logs) > 20
    return {f"{path.parent.name}/{path.name}": runs_of(path) for path in logs}


def test_every_sample_has_an_answer(runs: dict[str, list[Seen]]) -> None:
    for name, parts in runs.items():
        for part in parts:
            assert np.isfinite(part.beta).all(), name
            assert np.isfinite(part.beta_std).all(), name
            assert np.degrees(np.abs(part.beta)).max() < 80.0, name
            assert part.beta_std.min() > 0.0, name
            assert np.degrees(part.beta_std).max() < 90.0, name


def test_no_filter_runs_away(runs: dict[str, list[Seen]], data_dir: Path) -> None:
    scored = 0
    for name, parts in runs.items():
        beta = np.concatenate([part.beta for part in parts])
        truth = np.concatenate([part.beta_ref for part in parts])
        vx = np.concatenate([part.column("vx") for part in parts])
        counted = np.isfinite(truth) & (vx > MIN_SPEED)
        if not counted.any():
            continue
        scored += 1
        error = np.degrees(beta - truth[:, None])[counted]
        rmse = dict(zip(DEFAULT_FILTERS, np.sqrt(np.mean(error**2, axis=0)), strict=True))
        zero = np.degrees(np.sqrt(np.mean(truth[counted] ** 2)))
        assert max(rmse.values()) < zero + 3.0, (name, zero, rmse)
        if (data_dir / name).with_name("vehicle.toml").exists():
            assert min(rmse.values()) < zero, (name, zero, rmse)
    assert scored > 15

"""The example estimator of CONTRIBUTING.md works as it stands there."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from crosscomb.filters import catalogue
from crosscomb.filters.base import make_inputs
from crosscomb.logs.grid import to_grid
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.simulation.simulate import simulate_log
from drives import GOLF
from estimator_checks import CHECKS

TEXT = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)


@pytest.fixture
def example(tmp_path, monkeypatch):
    """Make the module of the example, and put its line into the catalogue."""
    file = tmp_path / "steady_state.py"
    file.write_text(BLOCKS[0], encoding="utf-8")
    spec = importlib.util.spec_from_file_location("crosscomb.filters.single_track.steady_state", file)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "crosscomb.filters.single_track.steady_state", module)
    spec.loader.exec_module(module)
    line = BLOCKS[1].strip().rstrip(",")
    entry = eval("{" + line + "}", {"Entry": catalogue.Entry})
    for name, value in entry.items():
        monkeypatch.setitem(catalogue.CATALOGUE, name, value)
    return next(iter(entry))


def test_example_is_short_and_estimates_steady_cornering(example):
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 40
    car = load_vehicle("generic_compact")
    log = simulate_log(car, "circle", seed=3, duration=20.0, spread=False, faults=False)
    segment = to_grid(complete(log, car), 100.0)[0].signals
    estimator = catalogue.make_filter(example, car)
    inputs = make_inputs(segment, car, 0.01)
    estimate = estimator.run(inputs)
    late = segment.t > 15.0
    assert np.degrees(np.abs(segment.beta_ref[late])).mean() > 0.5
    assert np.degrees(np.sqrt(np.mean((estimate.beta - segment.beta_ref)[late] ** 2))) < 0.5


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_example_does_what_every_estimator_must(example, check):
    check(lambda: catalogue.make_filter(example, GOLF))


def test_example_is_taken_by_name_in_an_estimate(example):
    car = load_vehicle("generic_compact")
    log = simulate_log(car, "slalom", seed=3, duration=10.0)
    result = estimate_log(log, car, load_artefact(), [example])
    assert list(result.filters) == [example]
    np.testing.assert_array_equal(result.beta, result.filters[example])

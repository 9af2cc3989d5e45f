"""The speed suite: every twin is timed and agrees with its kernel. How fast anything is, is no matter of tests."""

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.filters.base import Inputs
from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.filters.twins.table import FILTERPY, NUMPY, TWINS
from crosscomb.models import single_track
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.suites import speed
from crosscomb.training.suites.speed import Run, measure, pairs_of, plain_models, plan, slalom


@pytest.fixture
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "STEPS", 60)
    monkeypatch.setattr(speed, "LEAST_STEPS", 4)
    monkeypatch.setattr(speed, "RUN_TIME", 1e-6)
    monkeypatch.setattr(speed, "PAIR_TIME", 0.0)
    monkeypatch.setattr(speed, "PAPER_PARTICLES", (200, 1100))


def test_every_estimator_with_a_twin_is_timed_against_each_of_its_twins() -> None:
    assert set(TWINS) == set(FILTERPY) | set(NUMPY) <= set(CATALOGUE)
    timed = {(pair.name.partition(" ")[0], pair.made_of) for pair in pairs_of()}
    for made_of, twins in (("filterpy", FILTERPY), ("numpy", NUMPY)):
        assert {(name, made_of) for name in twins} <= timed
    assert len(pairs_of()) == len(FILTERPY) + len(NUMPY) + 2, "and one filter with many particles"


@pytest.mark.usefixtures("few_samples")
@pytest.mark.parametrize("name", TWINS)
def test_kernel_and_twin_answer_alike_and_have_a_ratio(name: str) -> None:
    inputs = slalom(load_vehicle(speed.CAR), speed.STEPS)
    for pair in pairs_of([name]):
        found = measure(pair, inputs)
        assert 0.0 < found.low <= found.ratio <= found.high
        assert found.compiled > 0.0
        assert found.kernel > 0.0
        assert found.twin > 0.0
        expected = pair.twin(pair.estimator, inputs)
        apart = np.degrees(np.abs(pair.estimator.run(inputs).beta - expected.beta).max())
        assert apart < (3.0 if name == "random_walk_pf" else 1e-6)
        assert np.ptp(expected.beta) > np.radians(0.01), "a filter that stays where it is proves nothing"


def test_the_command_prints_its_table_and_keeps_it(crosscomb, few_samples, tmp_path) -> None:
    results = tmp_path / "results.md"
    results.write_text("# Mine\n", encoding="utf-8")
    words = ("benchmark", "speed", "--filters", "kinematic_kf,random_walk_pf", "-o", results)
    for _ in range(2):  # the second run replaces the section of the first
        ran = crosscomb(*words)
        assert (ran.code, ran.err) == (0, "")
    text = results.read_text(encoding="utf-8")
    assert text.startswith("# Mine\n")
    assert text.count("| kinematic_kf | filterpy |") == 1
    assert text.count("| random_walk_pf (1,100 particles, forces drawn) | numpy |") == 1
    for word in ("kinematic_kf", "random_walk_pf", "filterpy", "numpy", "ratio", "middle half"):
        assert word in ran.out


def test_an_estimator_without_a_twin_is_refused(crosscomb) -> None:
    with pytest.raises(UsageError, match="luenberger: has no twin"):
        pairs_of(["luenberger"])
    ran = crosscomb("benchmark", "speed", "--filters", "luenberger")
    assert ran.code == 2
    assert "kinematic_kf" in ran.err


def test_models_are_plain_inside_only() -> None:
    compiled = single_track.body_rates
    with plain_models():
        assert single_track.body_rates is compiled.py_func
    assert single_track.body_rates is compiled


def test_a_run_takes_as_many_samples_and_calls_as_fill_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(speed, "CLOCK", lambda: now[0])
    inputs = Inputs(0.01, np.zeros((1000, 1)))

    def takes(us: float) -> Run:
        def function(given: Inputs) -> None:
            now[0] += 1e-6 * us * len(given.samples)

        return plan(function, inputs)  # type: ignore[arg-type]

    assert (len(takes(1.0).inputs.samples), takes(1.0).calls) == (1000, round(1e6 * speed.RUN_TIME / 1000))
    assert (len(takes(100.0).inputs.samples), takes(100.0).calls) == (round(1e4 * speed.RUN_TIME), 1)
    assert (len(takes(1e5).inputs.samples), takes(1e5).calls) == (speed.LEAST_STEPS, 1)
    assert takes(100.0).time() == pytest.approx(100.0)

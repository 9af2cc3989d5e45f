"""Identification: what it finds on logs whose truth is known, and what it leaves alone."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import Signals, make_signals
from crosscomb.training.identification.files import fitted_map
from crosscomb.training.identification.identify import Identification, identify
from crosscomb.training.identification.sensors import still_biases
from crosscomb.training.identification.trace import make_trace, steering
from crosscomb.training.recordings import Recording
from crosscomb.training.simulation.simulate import simulate_log

REFERENCE = ["beta_ref", "vx_ref", "vy_ref"]


def benchmark() -> ModuleType:
    """The benchmark script that simulates cars with known faults."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "identify_simulated.py"
    spec = importlib.util.spec_from_file_location("identify_simulated", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by name.
    import sys

    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


CASES = benchmark()


@pytest.fixture(scope="module", params=[False, True], ids=["without truth", "with truth"])
def solved(request: pytest.FixtureRequest) -> tuple[object, Identification]:
    case = CASES.make_case(2, reference=request.param)
    return case, identify(case.logs, case.given)


def test_excited_logs_give_the_car_and_its_sensors(solved: tuple) -> None:
    case, result = solved
    for name, bar in CASES.BARS.items():
        finding, true = result.judgements[name], case.truth[name]
        error = finding.after / true - 1.0 if name in CASES.RELATIVE else finding.after - true
        assert finding.taken, name
        assert abs(error) < bar, f"{name}: {error:.4f}"
    assert result.judgements["position"].after == pytest.approx(case.truth["position"], abs=0.1)


def test_intervals_hold_the_truth(solved: tuple) -> None:
    case, result = solved
    missed = [
        name
        for name, true in case.truth.items()
        if not result.judgements[name].low <= true <= result.judgements[name].high
    ]
    assert len(missed) <= 1, missed


def test_the_map_takes_the_errors_out_of_the_logs(solved: tuple, tmp_path: Path) -> None:
    case, result = solved
    fitted = fitted_map(result)
    assert fitted.channels["yaw_rate"].offset == pytest.approx(case.truth["yaw_bias"], abs=0.001)
    assert fitted.channels["steer"].scale * result.vehicle.steering_ratio == pytest.approx(1.0)
    lateness = fitted.channels["ay"].delay - fitted.channels["yaw_rate"].delay
    assert lateness == pytest.approx(case.truth["ay_delay"] - case.truth["yaw_delay"], abs=0.01)
    assert fitted.accelerometer is not None
    assert fitted.accelerometer.position[0] == pytest.approx(case.truth["position"], abs=0.1)


def test_straight_driving_leaves_the_car_as_it_was() -> None:
    car = load_vehicle("generic_compact")
    log = simulate_log(car, "straight", 3, 0.9, 30.0, spread=False)
    given = car.model_copy(update={"cornering_stiffness_front": 100e3, "steering_ratio": 18.0})
    result = identify([replace(log, frame=log.frame.drop(columns=REFERENCE))], given)
    for name in (
        "steering_ratio",
        "cornering_stiffness_front",
        "cornering_stiffness_rear",
        "yaw_inertia",
        "friction",
    ):
        assert not result.judgements[name].taken, name
        assert "left as it was" in result.judgements[name].word
    assert result.vehicle == given


def test_standstill_of_one_log_serves_the_others() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    rng = np.random.default_rng(1)

    def log(name: str, speed: float, bias: float) -> Signals:
        columns = {
            "t": t, "vx": np.full(len(t), speed), "steer": 0.0 * t,
            "ax": 0.1 + rng.normal(0.0, 0.03, len(t)), "ay": -0.07 + rng.normal(0.0, 0.03, len(t)),
            "yaw_rate": bias + rng.normal(0.0, 0.001, len(t)),
        }  # fmt: skip
        import pandas as pd

        return make_signals(pd.DataFrame(columns), name)

    parked, driven = still_biases([log("parked", 0.0, -0.0017), log("driven", 20.0, 0.0)])
    assert parked["yaw_rate"][0] == pytest.approx(-0.0017, abs=2e-4)
    assert driven["yaw_rate"][0] == parked["yaw_rate"][0]
    assert driven["yaw_rate"][1] > parked["yaw_rate"][1]
    assert parked["ay"][0] == pytest.approx(-0.07, abs=0.01)


def test_a_derived_road_wheel_angle_is_known_from_a_measured_one() -> None:
    log = simulate_log(load_vehicle("generic_compact"), "slalom", 1, 0.9, 10.0)
    angle, from_wheel = steering(log)
    assert from_wheel
    assert np.array_equal(angle, log.column("steer_wheel"), equal_nan=True)
    play = 0.002 * np.sin(log.t)
    measured = log.with_columns(steer=log.column("steer") + play)
    assert not steering(measured)[1]


def test_nothing_driven_is_an_error_of_use() -> None:
    log = simulate_log(load_vehicle("generic_compact"), "slalom", 1, 0.9, 10.0)
    parked = log.with_columns(vx=np.zeros(len(log)))
    assert make_trace(parked, load_vehicle("generic_compact")) is None
    with pytest.raises(UsageError, match="record a longer drive"):
        identify([parked], load_vehicle("generic_compact"))


def recordings(folder: Path, car: str) -> list[Recording]:
    from crosscomb.logs.read import read_log

    vehicle = load_vehicle(car)
    return [Recording(path.name, path, vehicle, read_log(path)) for path in sorted(folder.glob("*.csv"))]


def test_real_volvo_has_its_documented_ratio_and_latency(data_dir: Path) -> None:
    logs = [one.signals for one in recordings(data_dir / "kth_volvo_s90", "volvo_s90")]
    given = load_vehicle("volvo_s90").model_copy(update={"steering_ratio": 25.0})
    result = identify(logs, given)
    assert result.judgements["steering_ratio"].after == pytest.approx(15.6, abs=0.6)
    assert result.kinematics is not None
    assert result.kinematics.yaw_delay[0] == pytest.approx(0.040, abs=0.015)
    assert result.judgements["ay_bias"].after == pytest.approx(0.14, abs=0.05)


@pytest.mark.parametrize("use_reference", [True, False])
def test_real_audi_has_its_accelerometer_at_the_rear_axle(data_dir: Path, use_reference: bool) -> None:
    logs = [one.signals for one in recordings(data_dir / "stanford_audi_tts_2011", "audi_tts")]
    finding = identify(logs, load_vehicle("audi_tts"), use_reference).judgements["position"]
    assert finding.taken
    assert finding.after == pytest.approx(-1.42, abs=0.1)

"""Plain unit and sign errors are found and named with their mend; good logs, quiet or sliding, raise none."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.logs.channel_map import load_map
from crosscomb.logs.gaps import Finding
from crosscomb.logs.plausibility import check_units
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import GRAVITY, WHEEL_SPEEDS, Signals
from crosscomb.training.simulation.simulate import simulate_log

DEGREES = 180.0 / np.pi


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("generic_compact")


@pytest.fixture(scope="module")
def drive(vehicle: Vehicle) -> Signals:
    """Half a minute of varied driving: a steady-state single-track car with noise on every sensor."""
    rng = np.random.default_rng(11)
    t = np.arange(3000) / 100.0
    vx = 14.0 + 5.0 * np.sin(0.4 * t)
    steer = 0.05 * np.sin(1.1 * t) + 0.04 * np.sin(0.37 * t + 1.0)
    yaw_rate = vx * steer / (vehicle.wheelbase + 0.006 * vx**2)
    beta = vehicle.cg_to_rear_axle * yaw_rate / vx - 0.004 * vx * yaw_rate
    vy = vx * np.tan(beta)
    half = 0.5 * vehicle.track_rear * yaw_rate
    columns = {
        "vx": vx + rng.normal(0.0, 0.03, 3000),
        "ax": np.gradient(vx, t) + rng.normal(0.0, 0.2, 3000),
        "ay": vx * yaw_rate + np.gradient(vy, t) + rng.normal(0.1, 0.3, 3000),
        "yaw_rate": yaw_rate + rng.normal(0.0, 0.003, 3000),
        "steer": steer,
        "steer_wheel": steer * vehicle.steering_ratio,
        **{wheel: vx + (half if wheel.endswith("r") else -half) for wheel in WHEEL_SPEEDS},
        "beta_ref": beta,
        "vx_ref": vx,
        "vy_ref": vy,
    }
    return Signals("drive", pd.DataFrame({"t": t, **columns}))


def scaled(factor: float, *columns: str) -> Callable[[Signals], Signals]:
    return lambda log: replace(
        log, frame=log.frame.assign(**{c: log.frame[c] * factor for c in columns if c in log.frame})
    )


def without(*columns: str) -> Callable[[Signals], Signals]:
    return lambda log: replace(log, frame=log.frame.drop(columns=list(columns)))


def errors(log: Signals, vehicle: Vehicle) -> list[Finding]:
    return [finding for finding in check_units(log, vehicle) if finding.severity == "error"]


FAULTS: dict[str, tuple[Callable[[Signals], Signals], dict[str, str]]] = {
    "steer in deg": (scaled(DEGREES, "steer"), {"steer": 'unit = "deg"'}),
    "steer_wheel in deg": (scaled(DEGREES, "steer_wheel"), {"steer_wheel": 'unit = "deg"'}),
    "yaw_rate in deg/s": (scaled(DEGREES, "yaw_rate"), {"yaw_rate": 'unit = "deg/s"'}),
    "beta_ref in deg": (scaled(DEGREES, "beta_ref"), {"beta_ref": 'unit = "deg"'}),
    "every angle in deg": (
        scaled(DEGREES, "steer", "steer_wheel", "yaw_rate", "beta_ref"),
        dict.fromkeys(("steer", "steer_wheel", "yaw_rate", "beta_ref"), "deg"),
    ),
    "hand wheel as steer": (scaled(14.0, "steer"), {"steer": '[channels.steer_wheel] column = "steer"'}),
    "vx in km/h": (scaled(3.6, "vx"), {"vx": 'unit = "km/h"'}),
    "vx_ref in km/h": (scaled(3.6, "vx_ref"), {"vx_ref": 'unit = "km/h"'}),
    "wheels in km/h": (scaled(3.6, *WHEEL_SPEEDS), {"vfl": 'unit = "km/h"'}),
    "every speed in km/h": (
        scaled(3.6, "vx", "vx_ref", "vy_ref", *WHEEL_SPEEDS),
        dict.fromkeys(("vx", "vx_ref", "vfl"), 'unit = "km/h"'),
    ),
    "ay in g": (scaled(1.0 / GRAVITY, "ay"), {"ay": 'unit = "g"'}),
    "ax and ay in g": (scaled(1.0 / GRAVITY, "ax", "ay"), {"ax": 'unit = "g"', "ay": 'unit = "g"'}),
    "yaw_rate reversed": (scaled(-1.0, "yaw_rate"), {"yaw_rate": "sign = -1"}),
    "ay reversed": (scaled(-1.0, "ay"), {"ay": "sign = -1"}),
    "ax reversed": (scaled(-1.0, "ax"), {"ax": "sign = -1"}),
    "steer and steer_wheel reversed, no wheels": (
        lambda log: without(*WHEEL_SPEEDS, "steer")(scaled(-1.0, "steer_wheel")(log)),
        {"steer_wheel": "sign = -1"},
    ),
    "t in ms": (scaled(1000.0, "t"), {"t": 'unit = "ms"'}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_with_its_mend_and_nothing_else_is(
    drive: Signals, vehicle: Vehicle, fault: str
) -> None:
    spoil, expected = FAULTS[fault]
    found = errors(spoil(drive), vehicle)
    assert {finding.column for finding in found} == set(expected)
    for finding in found:
        assert expected[finding.column] in finding.message
        assert "\n" not in finding.message


@pytest.mark.parametrize("channel", ["vx", "ax", "ay", "yaw_rate", "steer", "steer_wheel"])
@pytest.mark.parametrize("value", [1e30, 1e300])
def test_a_channel_that_is_absurd_throughout_is_an_error(
    drive: Signals, vehicle: Vehicle, channel: str, value: float
) -> None:
    found = errors(replace(drive, frame=drive.frame.assign(**{channel: value})), vehicle)
    assert channel in {finding.column for finding in found}


def test_good_drive_raises_nothing_with_any_car_like_it(drive: Signals, vehicle: Vehicle) -> None:
    for car in (vehicle, load_vehicle("volvo_s90"), load_vehicle("ferrari_250lm")):
        assert check_units(drive, car) == []


def test_two_channels_between_which_the_log_cannot_decide_are_both_named(
    drive: Signals, vehicle: Vehicle
) -> None:
    # Without wheels, a reversed ay and yaw_rate together look like a reversed steering angle.
    log = without(*WHEEL_SPEEDS, "steer_wheel", "beta_ref", "vx_ref", "vy_ref")(drive)
    both = scaled(-1.0, "ay")(log)
    (finding,) = errors(both, vehicle)
    assert "[channels.ay] sign = -1" in finding.message
    noisy_steer = log.column("steer") + np.random.default_rng(1).normal(0.0, 0.05, len(log)).cumsum() * 0.01
    both = replace(both, frame=both.frame.assign(steer=noisy_steer))
    found = errors(both, vehicle)
    assert len(found) <= 1
    if found:
        assert "ay" in found[0].message


def test_mend_can_be_pasted_into_a_map_and_then_nothing_is_wrong(
    drive: Signals, vehicle: Vehicle, tmp_path: Path
) -> None:
    spoilt = scaled(-1.0, "ay")(scaled(3.6, "vx")(scaled(DEGREES, "yaw_rate")(drive)))
    spoilt.frame.to_csv(tmp_path / "log.csv", index=False)
    lines: dict[str, list[str]] = {}
    for finding in errors(read_log(tmp_path / "log.csv"), vehicle):
        table, setting = finding.message.split("(`channel_map`): ")[1].split("] ")
        lines.setdefault(table + "]", []).append(setting)
    text = "\n".join("\n".join([table, *settings]) for table, settings in lines.items())
    (tmp_path / "map.toml").write_text(text)
    assert len(lines) == 3
    assert errors(read_log(tmp_path / "log.csv", load_map(tmp_path / "map.toml")), vehicle) == []


def test_standstill_quiet_and_counter_steered_driving_raise_no_error(
    drive: Signals, vehicle: Vehicle
) -> None:
    rng = np.random.default_rng(8)
    frame, n = drive.frame, len(drive)
    quiet = frame.assign(
        **{
            name: rng.normal(0.0, size, n)
            for name, size in (("steer", 0.001), ("yaw_rate", 0.002), ("ay", 0.3))
        }
    )
    still = frame.assign(
        **dict.fromkeys(("vx", *WHEEL_SPEEDS), 0.0), ay=rng.normal(0.4, 0.5, n), yaw_rate=0.001
    )
    # A drift: the front wheels point along the path of the front axle, against the turn.
    yaw_rate = 0.5 * np.sin(0.5 * drive.t)
    beta = -0.6 * np.sin(0.5 * drive.t - 0.5)
    drift = frame.assign(
        yaw_rate=yaw_rate,
        beta_ref=beta,
        steer=beta + vehicle.cg_to_front_axle * yaw_rate / frame["vx"] + 0.1 * np.sin(1.7 * drive.t),
        ay=frame["vx"] * yaw_rate + np.gradient(frame["vx_ref"] * np.tan(beta), drive.t),
    ).drop(columns=["vy_ref", "steer_wheel", *WHEEL_SPEEDS])
    for table in (quiet, still, drift):
        assert errors(replace(drive, frame=table), vehicle) == []


def warned(log: Signals, vehicle: Vehicle) -> str:
    return "; ".join(
        finding.message for finding in check_units(log, vehicle) if finding.severity == "warning"
    )


def test_weak_logs_are_warned_of(drive: Signals, vehicle: Vehicle) -> None:
    frame = drive.frame
    thinned = frame["ax"].where(np.arange(len(drive)) % 3 == 0)
    offset = frame.assign(
        **{name: np.where(drive.t < 5.0, 0.0, frame[name]) for name in ("vx", *WHEEL_SPEEDS)}
    )
    offset["ay"] = np.where(drive.t < 5.0, 0.31, frame["ay"])
    cases = {
        "only 33% of the rows": frame.assign(ax=thinned),
        "rests at 0.2 rad": frame.assign(steer_wheel=np.where(drive.t > 15.0, 0.2, frame["steer_wheel"])),
        "1 gaps longer than 1 s": frame[(drive.t < 10.0) | (drive.t > 13.0)].reset_index(drop=True),
        "no ground truth": frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]),
        "never exceeds 3 m/s": frame.assign(**{name: 0.1 * frame[name] for name in ("vx", *WHEEL_SPEEDS)}),
        "[channels.ay] offset = 0.31": offset,
    }
    for words, table in cases.items():
        assert words in warned(replace(drive, frame=table), vehicle)


def test_truth_of_the_wrong_sign_is_warned_of(drive: Signals, vehicle: Vehicle) -> None:
    yaw_rate = 6.0 * np.tan(drive.column("steer")) / vehicle.wheelbase
    beta = np.arctan(vehicle.cg_to_rear_axle * yaw_rate / 6.0)
    slow = Signals(
        "slow",
        pd.DataFrame(
            {
                **{"t": drive.t, "vx": 6.0, "ay": 6.0 * yaw_rate, "yaw_rate": yaw_rate},
                **{"steer": drive.column("steer"), "beta_ref": beta},
            }
        ),
    )
    assert "beta_ref" not in warned(slow, vehicle)
    assert "beta_ref looks reversed" in warned(scaled(-1.0, "beta_ref")(slow), vehicle)


@pytest.fixture(scope="module")
def real_logs(data_dir: Path) -> list[tuple[Signals, Vehicle]]:
    logs = []
    for path in sorted(data_dir.glob("*/*.csv*")):
        car = path.parent / "vehicle.toml"
        logs.append((read_log(path), load_vehicle(car if car.exists() else "generic_compact")))
    return logs


def test_real_logs_and_their_first_seconds_raise_no_error(real_logs: list, vehicle: Vehicle) -> None:
    for log, car in real_logs:
        first = replace(log, frame=log.frame[log.t < log.t[0] + 10.0])
        for part, used in ((log, car), (log, vehicle), (first, car)):
            assert errors(part, used) == [], log.source


@pytest.mark.parametrize(
    "fault", ["steer in deg", "yaw_rate in deg/s", "vx in km/h", "beta_ref in deg", "ay in g", "ay reversed"]
)
def test_faults_are_found_in_every_real_drive(real_logs: list, fault: str) -> None:
    spoil, expected = FAULTS[fault]
    (column,) = expected
    tried = 0
    for log, car in real_logs:
        if "standstill" not in log.source and log.has(column):
            tried += 1
            found = errors(spoil(log), car)
            assert any(f"[channels.{column}]" in finding.message for finding in found), log.source
    assert tried > 15


def test_reversing_is_no_fault_of_the_reference() -> None:
    """Going backwards beta_ref jumps between 180 and -180 deg."""
    car = load_vehicle("generic_compact")
    for seed in range(3):
        log = simulate_log(car, "reversing", seed, surface="split", duration=40.0)
        assert not [finding for finding in check_units(log, car) if finding.severity == "error"]


def test_a_road_that_gives_more_than_the_vehicle_files_friction_is_warned_of(
    drive: Signals, vehicle: Vehicle
) -> None:
    """The bound of Atheupe 2023, eq. 30, holds for what the road gives, not for ay on a bank or a spin's yaw."""
    reach = float(np.quantile(np.abs(drive.column("ay")), 0.99))
    slippery = vehicle.model_copy(update={"friction": 0.7 * reach / GRAVITY})
    findings = check_units(drive, slippery)
    assert [(finding.severity, finding.column) for finding in findings] == [("warning", "ay")]
    assert "friction" in findings[0].message
    named = float(findings[0].message.split("friction = ")[1].split()[0])
    assert named == pytest.approx(reach / GRAVITY, rel=0.1)
    banked = replace(drive, frame=drive.frame.assign(ay=drive.column("ay") + 0.5 * GRAVITY))
    spinning = replace(drive, frame=drive.frame.assign(yaw_rate=2.0 * drive.column("yaw_rate")))
    for log in (banked, spinning):
        assert not [finding for finding in check_units(log, vehicle) if "friction" in finding.message]

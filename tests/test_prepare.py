"""Columns made from others: right for a rigid body, causal, noted, and only where the log lacks them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.logs.prepare import Line, complete, next_slopes, speed_from_wheels
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import WHEEL_SPEEDS, Signals


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("generic_compact")


def make_log(n: int = 400, **columns: np.ndarray) -> Signals:
    t = np.arange(n) / 100.0
    return Signals("log", pd.DataFrame({"t": t, "ay": np.zeros(n), "yaw_rate": np.zeros(n), **columns}))


def rolling_wheels(
    vx: np.ndarray, vy: np.ndarray, yaw_rate: np.ndarray, steer: np.ndarray, car: Vehicle
) -> dict:
    """Speeds of wheels that roll without spin on a planar rigid body (y left, yaw to the left)."""
    speeds = {}
    for name, x, track, angle in (
        ("f", car.cg_to_front_axle, car.track_front, steer),
        ("r", -car.cg_to_rear_axle, car.track_rear, 0.0 * steer),
    ):
        for side, y in (("l", 0.5 * track), ("r", -0.5 * track)):
            along = vx - yaw_rate * y
            across = vy + yaw_rate * x
            speeds[f"v{name}{side}"] = along * np.cos(angle) + across * np.sin(angle)
    return speeds


def test_speed_from_wheels_is_that_of_the_centre_of_gravity_in_a_turn(vehicle: Vehicle) -> None:
    t = np.arange(400) / 100.0
    yaw_rate, vx = 0.4 * np.sin(t), 12.0 + t
    steer = vehicle.wheelbase * yaw_rate / vx
    vy = vehicle.cg_to_rear_axle * yaw_rate
    wheels = rolling_wheels(vx, vy, yaw_rate, steer, vehicle)
    assert np.max(wheels["vrr"] - wheels["vrl"]) > 0.3  # the left wheels are slower in a left turn
    log = make_log(yaw_rate=yaw_rate, steer=steer, **wheels)
    np.testing.assert_allclose(complete(log, vehicle).column("vx"), vx, rtol=2e-3)
    one_lost = replace(log, frame=log.frame.assign(vfr=np.nan))
    np.testing.assert_allclose(speed_from_wheels(one_lost, vehicle), vx, rtol=4e-3)
    none = replace(log, frame=log.frame.assign(**dict.fromkeys(WHEEL_SPEEDS, np.nan)))
    assert np.all(np.isnan(speed_from_wheels(none, vehicle)))


def test_only_what_is_missing_is_made_and_each_is_noted(vehicle: Vehicle) -> None:
    full = make_log(
        steer=np.full(400, 0.1), vx=np.full(400, 9.0), ax=np.zeros(400), steer_wheel=np.full(400, 9.0)
    )
    assert complete(full, vehicle) == full
    lacking = make_log(
        steer=np.full(400, np.nan),
        steer_wheel=np.full(400, 0.5),
        **dict.fromkeys(WHEEL_SPEEDS, np.full(400, 8.0)),
    )
    log = complete(lacking, vehicle)
    np.testing.assert_allclose(log.column("steer"), 0.5 / vehicle.steering_ratio)
    np.testing.assert_allclose(log.column("ax")[2:], 0.0, atol=1e-12)
    assert [note.split()[0] for note in log.notes] == ["steer", "vx", "ax"]


def late(vehicle: Vehicle) -> Signals:
    """A log in which steer, vx and ax have their first samples only at 1, 2 and 3 s."""
    t = np.arange(400) / 100.0
    late = make_log(
        steer=np.where(t < 1.0, np.nan, 0.3),
        steer_wheel=np.full(400, 0.5),
        vx=np.where(t < 2.0, np.nan, 7.6 + 0.7 * t),
        ax=np.where(t < 3.0, np.nan, 0.7),
        **dict.fromkeys(WHEEL_SPEEDS, 8.0 + t),
    )
    lost = late.frame["t"].between(3.5, 3.6)
    late.frame.loc[lost, ["steer", "vx", "ax"]] = np.nan
    return late


def test_a_column_is_made_until_its_first_sample_comes(vehicle: Vehicle) -> None:
    log = complete(late(vehicle), vehicle)
    t, steer, vx, ax = log.t, log.column("steer"), log.column("vx"), log.column("ax")
    np.testing.assert_allclose(steer[t < 1.0], 0.5 / vehicle.steering_ratio)
    np.testing.assert_allclose(vx[t < 1.0], 8.0 + t[t < 1.0], atol=0.05)
    np.testing.assert_allclose(ax[(t > 0.5) & (t < 1.0)], 1.0, atol=0.05)
    assert set(steer[(t >= 1.0) & (t < 3.5)]) == {0.3}
    given = (t >= 2.0) & (t < 3.5)
    np.testing.assert_array_equal(vx[given], (7.6 + 0.7 * t)[given])
    assert set(ax[(t >= 3.0) & (t < 3.5)]) == {0.7}
    lost = (t >= 3.5) & (t <= 3.6)
    assert np.isnan([steer[lost], vx[lost], ax[lost]]).all()
    for note, start in zip(log.notes, ("1", "2", "3"), strict=True):
        assert note.endswith(f"until its first sample at t = {start} s")


@pytest.mark.parametrize("stop", [5, 100, 101, 250, 301, 355])
def test_what_is_made_does_not_depend_on_later_rows(vehicle: Vehicle, stop: int) -> None:
    log = late(vehicle)
    cut = complete(replace(log, frame=log.frame.iloc[:stop]), vehicle)
    pd.testing.assert_frame_equal(cut.frame, complete(log, vehicle).frame.iloc[:stop], check_exact=True)


def test_completing_twice_changes_nothing_more(vehicle: Vehicle) -> None:
    once = complete(late(vehicle), vehicle)
    twice = complete(once, vehicle)
    pd.testing.assert_frame_equal(twice.frame, once.frame, check_exact=True)
    assert twice.notes == once.notes


def test_slope_is_exact_on_a_line_at_any_spacing_and_far_from_zero_time() -> None:
    rng = np.random.default_rng(2)
    t = 5e5 + np.cumsum(rng.uniform(0.001, 0.02, 500))
    values = 3.0 - 2.5 * (t - t[0])
    values[rng.random(500) < 0.2] = np.nan
    slope = next_slopes(Line(t[0]), t, values, 0.05)
    known = np.isfinite(slope)
    assert np.array_equal(known, np.isfinite(values) & (np.cumsum(np.isfinite(values)) >= 3))
    np.testing.assert_allclose(slope[known], -2.5, rtol=1e-6)


def test_slope_does_not_reach_across_a_gap_and_is_causal() -> None:
    t = np.concatenate([np.arange(50), np.arange(50) + 1000.0]) / 100.0
    values = np.random.default_rng(4).normal(size=100)
    slope = next_slopes(Line(t[0]), t, values, 0.05)
    assert np.all(np.isnan(slope[[0, 1, 50, 51]]))
    assert np.isfinite(slope[2:50]).all()
    for row in (10, 49, 60):
        changed = values.copy()
        changed[row + 1 :] = 1e6
        assert np.array_equal(
            next_slopes(Line(t[0]), t, changed, 0.05)[: row + 1], slope[: row + 1], equal_nan=True
        )


def test_slow_log_still_gets_a_slope() -> None:
    t = np.arange(30) / 20.0
    np.testing.assert_allclose(next_slopes(Line(t[0]), t, 2.0 * t, 0.05)[2:], 2.0)


def test_measured_acceleration_is_like_the_slope_of_the_speed(data_dir: Path) -> None:
    log = read_log(data_dir / "stanford_gti_2021" / "oval_controller.csv")
    car = load_vehicle(data_dir / "stanford_gti_2021" / "vehicle.toml")
    made = complete(replace(log, frame=log.frame.drop(columns=["ax", "vx"])), car)
    known = np.isfinite(made.column("ax")) & (log.column("vx") > 3.0)
    assert np.corrcoef(made.column("ax")[known], log.column("ax")[known])[0, 1] > 0.95
    assert np.std((made.column("vx") - log.column("vx_ref"))[known]) < 0.15

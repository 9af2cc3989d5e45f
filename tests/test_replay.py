"""Replaying a log gives the motion it was made of, and real cars better than a linear model does."""

import numpy as np
import pandas as pd
import pytest

from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import make_signals
from crosscomb.training.simulation.simulate import simulate_log
from replay import replay_linear, replay_plant


def rmse(error: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.nanmean(error**2))))


def test_plant_replays_a_log_of_its_own():
    car = load_vehicle("generic_compact")
    log = simulate_log(car, "step_steer", 1, friction=0.9, spread=False, faults=False, duration=15.0)
    yaw_rate, beta = replay_plant(log, car)
    settled = log.t > 1.0
    assert rmse(beta[settled]) > 0.3
    assert rmse((beta - log.beta_ref)[settled]) < 0.05
    assert rmse((yaw_rate - log.column("yaw_rate"))[settled]) < 0.2


def test_both_models_agree_in_gentle_driving_and_differ_at_the_limit():
    car = load_vehicle("generic_compact")
    far = []
    for friction in (0.95, 0.3):
        log = simulate_log(car, "step_steer", 2, friction=0.9, spread=False, faults=False, duration=12.0)
        log = log.with_columns(steer=log.column("steer") * (0.2 if friction > 0.5 else 1.0))
        slippery = car.model_copy(update={"friction": friction})
        far.append(rmse(replay_plant(log, slippery)[0] - replay_linear(log, car)[0]))
    assert far[0] < 0.5
    assert far[1] > 4.0 * far[0]


def test_gap_and_missing_values_leave_the_result_finite():
    car = load_vehicle("generic_compact")
    frame = simulate_log(car, "slalom", 1, duration=10.0, faults=False).frame.copy()
    frame.loc[300:310, "steer"] = np.nan
    log = make_signals(frame.drop(index=range(500, 700)), "gap")
    for run in (replay_plant, replay_linear):
        yaw_rate, beta = run(log, car)
        assert len(beta) == len(log)
        assert np.all(np.isfinite(yaw_rate))
        assert np.all(np.isfinite(beta))


@pytest.mark.parametrize(
    ("name", "vehicle", "friction"),
    [
        ("kth_volvo_s90/stepsteer_left_100kph.csv", "volvo_s90", 1.36),
        ("kth_volvo_v40/sine_with_dwell_80kph.csv", "volvo_v40", 1.06),
        ("revs_ferrari_250lm/targa66_20140222_01_part1.csv.gz", "ferrari_250lm", 1.22),
    ],
)
def test_plant_is_nearer_to_a_real_car_than_a_linear_model(data_dir, name, vehicle, friction):
    log = make_signals(pd.read_csv(data_dir / name).iloc[:15_000], name)
    car = load_vehicle(vehicle).model_copy(update={"friction": friction})
    rows = (log.column("vx_ref") > 3.0) & (log.t > 1.0)
    truths = (log.column("yaw_rate")[rows], log.beta_ref[rows])
    plant, linear = (
        [rmse(got[rows] - truth) for got, truth in zip(run(log, car), truths, strict=True)]
        for run in (replay_plant, replay_linear)
    )
    assert plant[0] < linear[0]
    assert plant[1] < linear[1]

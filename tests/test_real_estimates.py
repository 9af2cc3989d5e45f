"""Every real recording through the command that users call."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.logs.formats.table import log_name
from crosscomb.logs.read import read_log
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.recordings import find_logs

CARS = [
    "kth_volvo_s90",
    "kth_volvo_v40",
    "liu_course",
    "revs_ferrari_250lm",
    "stanford_audi_tts_2011",
    "stanford_gti_2018",
    "stanford_gti_2019",
    "stanford_gti_2021",
    "stanford_gti_limits",
]
UNKNOWN_CAR = "uahl_revsted"


def check_estimate(log: Path, output: Path) -> pd.DataFrame:
    """Read an estimate and check what holds for every one."""
    names = load_artefact().filter_names
    table = pd.read_csv(output / f"{log_name(log)}.estimate.csv")
    assert list(table) == ["t", "beta", "beta_std", "active", "status", *(f"beta_{name}" for name in names)]
    signals = read_log(log)
    np.testing.assert_array_equal(table["t"], signals.t)
    numbers = table.drop(columns=["active", "status"]).to_numpy(dtype=float)
    assert np.isfinite(numbers).all()
    assert (table["beta_std"] > 0.0).all()
    assert table["active"].isin(names).all()
    low_speed = table["status"].str.contains("low_speed")
    vx = signals.column("vx")
    assert (low_speed[(vx > 3.5)].mean() if (vx > 3.5).any() else 0.0) < 0.02
    return table


def test_no_folder_of_real_logs_is_forgotten(data_dir):
    assert sorted(path.name for path in data_dir.iterdir() if path.is_dir()) == sorted([*CARS, UNKNOWN_CAR])


@pytest.mark.parametrize("car", CARS)
def test_every_row_of_every_recording_gets_a_finite_answer(crosscomb, data_dir, tmp_path, car):
    logs = find_logs(data_dir / car)
    ran = crosscomb("estimate", *logs, "-o", tmp_path)
    assert ran.code == 0, ran.err
    assert logs
    for log in logs:
        table = check_estimate(log, tmp_path)
        # No filter diverges: beyond 30 deg of sideslip none of these cars ever was.
        moving = ~table["status"].str.contains("low_speed|reverse|invalid")
        assert table.loc[moving].filter(like="beta_k").abs().max(axis=None) < np.pi or not moving.any()
        assert not moving.any() or table.loc[moving, "beta"].abs().max() < np.radians(30.0)
        truth = read_log(log).has_reference
        assert truth == any(line.startswith(f"│ {log_name(log)} ") for line in ran.out.splitlines())


def test_a_car_without_steering_ratio_is_refused_clearly(crosscomb, data_dir, tmp_path):
    (log,) = find_logs(data_dir / UNKNOWN_CAR)
    ran = crosscomb("estimate", log, "-o", tmp_path / "out")
    assert ran.code == 2
    assert ran.err.count("\n") == 1
    for word in (str(log), "steer_wheel", "steering ratio", "--vehicle", "--map"):
        assert word in ran.err
    assert not (tmp_path / "out").exists()


def test_the_same_log_is_estimated_once_its_ratio_is_mapped(crosscomb, data_dir, tmp_path):
    """The data card: wheelbase times steering ratio is 34.6 m, so about 14 for a generic compact."""
    (log,) = find_logs(data_dir / UNKNOWN_CAR)
    (tmp_path / "map.toml").write_text('[channels.steer]\ncolumn = "steer_wheel"\nscale = 0.0714\n')
    ran = crosscomb("estimate", log, "--map", tmp_path / "map.toml", "-o", tmp_path / "out")
    assert ran.code == 0
    assert "generic compact car" in ran.err
    check_estimate(log, tmp_path / "out")


def test_what_the_switch_selects_is_of_use_on_real_logs(crosscomb, data_dir, tmp_path):
    """A hard turn at 100 km/h with 10 deg of sideslip: the answer beats beta = 0 by far."""
    log = data_dir / "kth_volvo_s90" / "stepsteer_left_100kph.csv"
    assert crosscomb("estimate", log, "-o", tmp_path).code == 0
    table, signals = check_estimate(log, tmp_path), read_log(log)
    counted = np.isfinite(signals.beta_ref) & (signals.column("vx") > 3.0)
    error = (table["beta"] - signals.beta_ref)[counted]
    assert np.sqrt(np.mean(error**2)) < 0.8 * np.sqrt(np.mean(signals.beta_ref[counted] ** 2))

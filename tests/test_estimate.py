"""One log end to end: an answer in every row, in the agreed columns, made of the past only."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.errors import UsageError
from crosscomb.files import write_file
from crosscomb.filters import columns as at
from crosscomb.logs.intake import choose_vehicle, open_logs
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.report.estimates import writing_table
from crosscomb.run.estimate import LogEstimate, estimate_log
from crosscomb.run.status import DEGRADED, INVALID, LOW_SPEED, TEXTS, WORDS, start_ages, status_codes
from crosscomb.selection.artefact import Artefact, load_artefact, save_artefact
from crosscomb.signals import Signals, make_signals
from crosscomb.training.simulation.simulate import simulate_log


@pytest.fixture(scope="module")
def artefact() -> Artefact:
    """What users have: the shipped one."""
    return load_artefact()


@pytest.fixture(scope="module")
def log(car: Vehicle) -> Signals:
    """Twelve seconds of stops and starts, at 100 Hz."""
    return simulate_log(car, "stop_and_go", 3, duration=12.0)


@pytest.fixture(scope="module")
def lively(car: Vehicle, artefact: Artefact) -> Signals:
    """Ten seconds of bends and slides in which the active filter changes, without standstill or lost samples."""
    for seed in range(30):
        log = simulate_log(car, "road_slide", seed, surface="wet", duration=10.0)
        slid = np.degrees(np.abs(log.beta_ref)).max()
        whole = bool(log.frame.notna().all(axis=None)) and log.column("vx").min() > 5.0
        if whole and 8.0 < slid < 30.0 and len(set(estimate_log(log, car, artefact).active)) > 1:
            return log
    raise AssertionError("no such log among the simulated ones")


def at_rate(log: Signals, rate: float, start: float = 0.0) -> Signals:
    """The log as another logger would have sampled it."""
    t = np.arange(log.t[0], log.t[-1], 1.0 / rate)
    frame = pd.DataFrame({name: np.interp(t, log.t, log.column(name)) for name in log.frame})
    return make_signals(frame.assign(t=t + start), log.name)


def irregular(log: Signals, seed: int = 0) -> Signals:
    """The log with a third of its rows lost and with wandering time stamps."""
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(len(log), 2 * len(log) // 3, replace=False))
    frame = log.frame.iloc[kept].reset_index(drop=True)
    return make_signals(frame.assign(t=frame["t"] + rng.uniform(0.0, 0.004, len(frame))), log.name)


def words_of(estimate: LogEstimate) -> list[set[str]]:
    return [set(text.split("+")) for text in estimate.status]


def assert_whole(estimate: LogEstimate, log: Signals, artefact: Artefact) -> None:
    """What holds for the answer to any log."""
    table = estimate.table()
    beta_columns = [f"beta_{name}" for name in artefact.filter_names]
    assert list(table) == ["t", "beta", "beta_std", "active", "status", *beta_columns]
    np.testing.assert_array_equal(table["t"], log.t)
    numbers = table[["t", "beta", "beta_std", *beta_columns]].to_numpy()
    assert np.isfinite(numbers).all()
    assert (table["beta_std"] > 0.0).all()
    assert (table[["beta", *beta_columns]].abs() < np.pi).all(axis=None)
    assert set(table["active"]) <= set(artefact.filter_names)
    for text in set(table["status"]):
        known = [word for word in WORDS if word in text.split("+")]
        assert text == ("+".join(known) or "ok")


def test_columns_and_rows_are_as_agreed(log, car, artefact):
    assert_whole(estimate_log(log, car, artefact), log, artefact)
    assert artefact.filter_names == ["kinematic_kf", "dynamic_ekf", "random_walk_pf"]


def test_beta_is_near_the_truth_and_in_radians(lively, car, artefact):
    estimate = estimate_log(lively, car, artefact)
    moving = lively.column("vx") > 3.0
    error = (estimate.beta - lively.beta_ref)[moving]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(lively.beta_ref[moving] ** 2))


def test_beta_is_that_of_the_active_filter_once_a_switch_is_over(lively, car, artefact):
    estimate = estimate_log(lively, car, artefact)
    names = list(estimate.filters)
    index = np.array([names.index(name) for name in estimate.active])
    assert len(set(index)) > 1
    chosen = np.column_stack(list(estimate.filters.values()))[np.arange(len(index)), index]
    changes = np.flatnonzero(np.diff(index)) + 1
    since = (
        np.arange(len(index))
        - np.concatenate([[0], changes])[np.searchsorted(changes, np.arange(len(index)), "right")]
    )
    settled = since > 12 * artefact.switch.transition * artefact.rate
    assert settled.sum() > 100
    np.testing.assert_allclose(estimate.beta[settled], chosen[settled], atol=1e-4)


@pytest.mark.parametrize(
    "channels",
    [
        ["ax"],
        ["ay"],
        ["yaw_rate"],
        ["steer"],
        ["vx"],
        ["ay", "yaw_rate"],
        ["vx", "ax", "ay", "yaw_rate", "steer"],
    ],
    ids="+".join,
)
@pytest.mark.parametrize("rows", [slice(0, 300), slice(400, 800), slice(900, None), slice(100, 1100, 3)])
def test_beta_is_finite_through_gaps(lively, car, artefact, channels, rows):
    frame = lively.frame.copy()
    frame.loc[frame.index[rows], channels] = np.nan
    log = make_signals(frame, "gaps")
    estimate = estimate_log(log, car, artefact)
    assert_whole(estimate, log, artefact)
    assert np.abs(estimate.beta).max() < np.radians(85.0)


@pytest.mark.parametrize(
    "change",
    [
        {"vx": 0.0, "ax": 0.0, "ay": 0.0, "yaw_rate": 0.0, "steer": 0.0},
        {"vx": -4.0, "yaw_rate": -0.2},
        {"vx": 1.0},
        {"vx": 2.999},
        {"vx": 3.001},
        {"yaw_rate": 3.0},
        {"ay": -30.0, "yaw_rate": 2.0},
        {"steer": 1.4},
        {"vx": 90.0},
        {"ax": -40.0},
    ],
    ids=str,
)
def test_beta_is_finite_at_standstill_in_reverse_and_in_nonsense(lively, car, artefact, change):
    frame = lively.frame.copy()
    for name, value in change.items():
        frame.loc[300:700, name] = value
    log = make_signals(frame, "odd")
    assert_whole(estimate_log(log, car, artefact), log, artefact)


@pytest.mark.parametrize("length", [2, 3, 9, 10, 11])
def test_the_shortest_logs_are_estimated(lively, car, artefact, length):
    log = make_signals(lively.frame.iloc[:length], "short")
    assert_whole(estimate_log(log, car, artefact), log, artefact)


def resampled(log: Signals) -> dict[str, Signals]:
    return {
        "50 Hz": at_rate(log, 50.0),
        "100 Hz": log,
        "200 Hz": at_rate(log, 200.0),
        "250 Hz": at_rate(log, 250.0),
        "irregular": irregular(log),
        "unix time": at_rate(log, 100.0, start=1.7e9),
        "no ax": replace(log, frame=log.frame.drop(columns="ax")),
        "wheels only": replace(log, frame=log.frame.drop(columns=["vx", "ax"])),
    }


def futures(log: Signals, cut: int) -> dict[str, pd.DataFrame]:
    """Logs that are the same up to row `cut` and other after it."""
    later = np.arange(len(log)) > cut
    channels = log.frame.columns.drop("t")
    noisy, lost = log.frame.copy(), log.frame.copy()
    noisy.loc[later, channels] += np.random.default_rng(0).normal(0.0, 1.0, (later.sum(), len(channels)))
    lost.loc[later, channels] = np.nan
    return {
        "cut": log.frame[~later],
        "noisy": noisy,
        "lost": lost,
        "shifted": log.frame.assign(t=log.t + 0.0037 * later),
        "gap": log.frame.assign(t=log.t + 50.0 * later),
    }


@pytest.mark.parametrize(
    "kind", ["50 Hz", "100 Hz", "200 Hz", "250 Hz", "irregular", "unix time", "no ax", "wheels only"]
)
def test_later_rows_change_no_earlier_answer(lively, car, artefact, kind):
    """Bit for bit, whether later rows are other, missing, shifted in time or cut off."""
    log = resampled(lively)[kind]
    whole = estimate_log(log, car, artefact)
    assert_whole(whole, log, artefact)
    before = whole.table()
    for cut in (1, 17, len(log) // 2, len(log) // 2 + 1):
        for name, frame in futures(log, cut).items():
            after = estimate_log(make_signals(frame, "log"), car, artefact).table()
            pd.testing.assert_frame_equal(
                before.iloc[: cut + 1], after.iloc[: cut + 1], check_exact=True, obj=f"{name} after row {cut}"
            )


def test_a_row_holds_the_newest_estimate_and_none_from_later_samples(lively, car, artefact):
    estimate = estimate_log(at_rate(lively, 200.0), car, artefact)
    np.testing.assert_array_equal(estimate.beta[1::2], estimate.beta[0:-1:2][: len(estimate.beta[1::2])])
    assert (np.diff(estimate.beta[::2]) != 0.0).mean() > 0.9


@pytest.mark.parametrize("kind", ["50 Hz", "200 Hz", "250 Hz", "irregular", "unix time"])
def test_other_loggers_give_much_the_same_answer(lively, car, artefact, kind):
    estimate = estimate_log(lively, car, artefact)
    other = estimate_log(resampled(lively)[kind], car, artefact)
    t = other.signals.t - other.signals.t[0]
    for name in ("kinematic_kf", "dynamic_ekf"):
        difference = other.filters[name] - np.interp(t, lively.t, estimate.filters[name])
        assert np.sqrt(np.mean(difference**2)) < np.radians(1.0)


def test_unix_time_changes_nothing(lively, car, artefact):
    one = estimate_log(lively, car, artefact)
    other = estimate_log(
        make_signals(lively.frame.assign(t=lively.t + 1_700_000_000.0), "unix"), car, artefact
    )
    np.testing.assert_array_equal(one.beta, other.beta)
    np.testing.assert_array_equal(one.status, other.status)


def test_truth_is_not_looked_at(lively, car, artefact):
    without = lively.frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"])
    empty = lively.frame.assign(beta_ref=np.nan, vx_ref=np.nan, vy_ref=np.nan)
    expected = estimate_log(lively, car, artefact).table()
    for frame in (without, empty):
        log = make_signals(frame, "blind")
        assert not log.has_reference
        pd.testing.assert_frame_equal(estimate_log(log, car, artefact).table(), expected, check_exact=True)


def test_after_a_long_gap_everything_begins_anew(lively, car, artefact):
    late = lively.t >= 5.0
    log = make_signals(lively.frame.assign(t=lively.t + 7.0 * late), "gap")
    estimate = estimate_log(log, car, artefact)
    assert_whole(estimate, log, artefact)
    second = estimate_log(make_signals(lively.frame[late].reset_index(drop=True), "second"), car, artefact)
    np.testing.assert_array_equal(estimate.beta[late], second.beta)
    first = estimate_log(make_signals(lively.frame[~late], "first"), car, artefact)
    np.testing.assert_array_equal(estimate.beta[~late], first.beta)


def test_a_short_gap_is_bridged_and_said(lively, car, artefact):
    kept = (lively.t < 5.0) | (lively.t >= 5.8)
    log = make_signals(lively.frame[kept].reset_index(drop=True), "gap")
    estimate = estimate_log(log, car, artefact)
    assert_whole(estimate, log, artefact)
    after = int(np.argmax(log.t >= 5.8))
    # Without measurements the filters' own doubt grows; the switch's own may fall as a transition fades.
    before = estimate_log(make_signals(lively.frame, "whole"), car, artefact)
    whole = int(np.argmax(lively.t >= 5.8))
    assert estimate.beta_std[after] > before.beta_std[whole]


def test_status_says_low_speed_and_reverse(log, car, artefact):
    frame = log.frame.copy()
    braking = np.maximum(frame["vx"][999] - 0.09 * np.arange(1, len(frame) - 999), -2.0)
    frame.loc[1000:, "vx"] = braking  # 9 m/s^2
    estimate = estimate_log(make_signals(frame, "log"), car, artefact)
    vx, words = frame["vx"].to_numpy(), words_of(estimate)
    assert ((vx > 3.0).sum(), (np.abs(vx) < 0.3).sum()) > (100, 100)
    for k in range(len(vx)):
        assert ("low_speed" in words[k]) == (-0.3 <= vx[k] <= 3.0)
        assert ("reverse" in words[k]) == (vx[k] < -0.3)


@pytest.mark.parametrize("channel", ["vx", "ax", "ay", "yaw_rate", "steer"])
def test_status_says_degraded_while_a_channel_is_missing(lively, car, artefact, channel):
    frame = lively.frame.copy()
    frame.loc[400:600, channel] = np.nan
    words = words_of(estimate_log(make_signals(frame, "log"), car, artefact))
    assert all("degraded" in words[k] for k in range(415, 601))
    assert not any("degraded" in words[k] for k in [*range(400), *range(602, len(words))])


@pytest.mark.parametrize("channels", [["vx"], ["steer"], ["ay", "yaw_rate"]], ids="+".join)
def test_status_says_invalid_a_second_after_a_channel_was_lost(lively, car, artefact, channels):
    frame = lively.frame.copy()
    frame.loc[300:700, channels] = np.nan
    words = words_of(estimate_log(make_signals(frame, "log"), car, artefact))
    assert all("invalid" in words[k] for k in range(415, 701))
    assert not any("invalid" in words[k] for k in [*range(395), *range(702, len(words))])


@pytest.mark.parametrize("channel", ["ax", "ay", "yaw_rate"])
def test_status_is_not_invalid_while_the_rest_serves(lively, car, artefact, channel):
    frame = lively.frame.copy()
    frame.loc[300:, channel] = np.nan
    assert not any(
        "invalid" in words for words in words_of(estimate_log(make_signals(frame, "log"), car, artefact))
    )


def shaken(log: Signals) -> Signals:
    """The log with an ay that rises to 60 m/s^2 from row 400 to 500 and stays there."""
    frame = log.frame.copy()
    frame.loc[400:500, "ay"] = np.linspace(frame["ay"][400], 60.0, 101)
    frame.loc[500:, "ay"] = 60.0 + frame["ay"][500:]
    return make_signals(frame, "log")


def test_status_says_extrapolating_outside_the_training(lively, car, artefact):
    words = words_of(estimate_log(shaken(lively), car, artefact))
    assert all("extrapolating" in words[k] for k in range(530, 600))
    assert not any("extrapolating" in words[k] for k in range(400))


def test_a_single_sample_outside_the_training_is_not_said():
    samples = np.zeros((100, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 20.0
    outside = np.zeros(100, dtype=bool)
    outside[[10, 40, 41, 80]] = True
    no, doubt = np.zeros(100, dtype=bool), np.full(100, 0.01)
    codes = status_codes(start_ages(), samples, outside, no, 0.0 * doubt, doubt, 0.01)
    assert set(TEXTS[codes]) == {"ok"}


def test_doubt_about_its_bound_does_not_flicker():
    samples, no = np.zeros((400, at.SAMPLE_WIDTH)), np.zeros(400, dtype=bool)
    samples[:, at.VX] = 20.0
    beta_std = np.radians(np.where(np.arange(400) % 8 < 5, 1.51, 1.49))
    beta_std[:100] = beta_std[300:] = np.radians(1.0)
    beta_std[50] = np.radians(1.6)
    said = TEXTS[status_codes(start_ages(), samples, no, no, 0.0 * beta_std, beta_std, 0.01)] == "uncertain"
    assert np.count_nonzero(np.diff(said)) == 2
    assert 100 < np.flatnonzero(said)[0] < 160
    beta_std[50] = np.radians(2.0)  # large doubt is said at once
    assert (
        TEXTS[status_codes(start_ages(), samples, no, no, 0.0 * beta_std, beta_std, 0.01)][50] == "uncertain"
    )


@pytest.mark.parametrize(
    ("vx", "word"),
    [
        (-0.31, "reverse"),
        (-0.3, "low_speed"),
        (-0.05, "low_speed"),  # a speed sensor at rest
        (0.0, "low_speed"),
        (3.0, "low_speed"),
        (3.01, "extrapolating"),
    ],
)
def test_outside_the_training_the_speed_gives_the_word(vx, word):
    """Up to walking speed the estimate does not come from what was trained, so nothing is extrapolated."""
    assert outside_in_a_turn(vx, 1.0) == word


def outside_in_a_turn(vx: float, yaw_rate: float, ay: float = 0.0) -> str:
    """What is said after 0.6 s outside the training data."""
    samples = np.zeros((60, at.SAMPLE_WIDTH))
    samples[:, [at.VX, at.YAW_RATE, at.AY]] = vx, yaw_rate, ay
    outside, no, doubt = np.full(60, True), np.full(60, False), np.full(60, 0.001)
    return str(TEXTS[status_codes(start_ages(), samples, outside, no, 0.0 * doubt, doubt, 0.01)][-1])


def test_a_spin_is_invalid_until_the_car_is_caught():
    """At 20 m/s with 0.5 rad/s of yaw rate and without ay beta falls by 29 deg/s: 40 deg are 0.3 s ahead at 31."""
    degrees = np.array([-29.0, -32.0, -60.0, -25.0, -21.0, -19.0, -25.0])
    samples = np.zeros((7, at.SAMPLE_WIDTH))
    samples[:, [at.VX, at.YAW_RATE]] = 20.0, 0.5
    no, doubt = np.full(7, False), np.full(7, 0.001)
    codes = status_codes(start_ages(), samples, no, no, np.radians(degrees), doubt, 0.01)
    assert TEXTS[codes].tolist() == ["ok", *["invalid"] * 4, "ok", "ok"]


def test_straight_ahead_nothing_is_extrapolated():
    assert outside_in_a_turn(70.0, 0.01) == "ok"
    assert outside_in_a_turn(70.0, 0.05) == "extrapolating"
    assert outside_in_a_turn(70.0, 0.0, 20.0) == "extrapolating"
    assert outside_in_a_turn(70.0, np.nan) == "degraded+extrapolating"


def test_ax_made_from_the_speed_is_not_missed_in_the_first_samples(lively, car, artefact):
    frame = lively.frame.drop(columns="ax")
    first = words_of(estimate_log(make_signals(frame, "log"), car, artefact))[:5]
    assert not any("degraded" in words for words in first)


def test_extrapolating_is_said_once_the_correction_lost_half_its_weight(lively, car):
    hybrid = load_artefact("hybrid")
    assert hybrid.correction is not None
    words = words_of(estimate_log(shaken(lively), car, hybrid))
    said = next(k for k in range(400, len(words)) if "extrapolating" in words[k])
    assert 430 < said < 600


def test_words_are_joined_in_one_order():
    codes = [LOW_SPEED | DEGRADED, INVALID | DEGRADED, 0]
    assert TEXTS[codes].tolist() == ["low_speed+degraded", "degraded+invalid", "ok"]


def test_made_columns_are_said(lively, car, artefact):
    bare = lively.frame.drop(columns=["steer", "vx", "ax"])
    log = make_signals(bare, "bare")
    estimate = estimate_log(log, car, artefact)
    assert_whole(estimate, log, artefact)
    notes = " ".join(estimate.signals.notes)
    for word in ("steer made from steer_wheel", "vx made from the wheel speeds", "ax is missing"):
        assert word in notes


def test_a_filter_file_row_is_written_exactly(lively, car, artefact, tmp_path):
    estimate = estimate_log(lively, car, artefact)
    with writing_table(tmp_path / "x.estimate.csv") as write:
        write(estimate.table())
    numbers = [name for name in estimate.table() if name not in ("active", "status")]
    back = pd.read_csv(tmp_path / "x.estimate.csv", converters=dict.fromkeys(numbers, float))
    pd.testing.assert_frame_equal(back, estimate.table(), check_dtype=False, check_exact=True)
    assert b"\r" not in (tmp_path / "x.estimate.csv").read_bytes()


# Which vehicle


def test_the_given_vehicle_wins_then_the_one_beside_then_the_artefact(car, artefact, write_vehicle, tmp_path):
    log = tmp_path / "log.csv"
    given, beside, trained = (
        car.model_copy(update={"name": name}) for name in ("given", "beside", "trained")
    )
    (tmp_path / "other").mkdir()
    given_file = write_vehicle(tmp_path / "other", given)

    assert choose_vehicle(log, None, trained) == (trained, "artefact", "")
    generic, _, warning = choose_vehicle(log, None, artefact.vehicle)
    assert generic == load_vehicle("generic_compact")
    assert str(log) in warning
    assert "`vehicle`" in warning
    beside_file = write_vehicle(tmp_path, beside)
    assert choose_vehicle(log, None, trained)[0].name == "beside"
    assert choose_vehicle(log, None, artefact.vehicle)[1:] == (str(beside_file), "")
    assert choose_vehicle(log, given_file, trained)[0].name == "given"
    assert choose_vehicle(log, "volvo_s90", trained)[0] == load_vehicle("volvo_s90")


def test_hand_wheel_only_needs_a_known_car(lively, car, artefact, write_log, write_vehicle, tmp_path):
    path = write_log(lively.frame.drop(columns="steer"), tmp_path / "log.csv")
    with pytest.raises(UsageError) as caught:
        open_logs([path], artefact.vehicle)
    for word in (str(path), "steer_wheel", "`vehicle`"):
        assert word in str(caught.value)
    assert open_logs([path], artefact.vehicle, "generic_compact")[0].vehicle.name == car.name
    write_vehicle(tmp_path, car)
    assert open_logs([path], artefact.vehicle)[0].warnings == ()


def test_the_vehicle_changes_the_answer(lively, car, artefact):
    heavy = car.model_copy(update={"cornering_stiffness_rear": 0.6 * car.cornering_stiffness_rear})
    one, other = (estimate_log(lively, vehicle, artefact) for vehicle in (car, heavy))
    assert np.abs(one.filters["dynamic_ekf"] - other.filters["dynamic_ekf"]).max() > np.radians(0.2)


# Inputs and outputs


def test_two_logs_of_one_name_are_refused(lively, artefact, write_log, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_log(lively.frame, tmp_path / folder / "log.csv")
    other = write_log(lively.frame, tmp_path / "a" / "log.csv.gz")
    for second in (tmp_path / "b" / "log.csv", other):
        with pytest.raises(UsageError, match="same name") as caught:
            open_logs([tmp_path / "a" / "log.csv", second], artefact.vehicle)
        assert str(second) in str(caught.value)


def test_an_input_is_never_overwritten(crosscomb, lively, car, write_log, write_vehicle, tmp_path):
    write_vehicle(tmp_path, car)
    (tmp_path / "x").mkdir()
    first = write_log(lively.frame, tmp_path / "log.csv")
    second = write_log(lively.frame, tmp_path / "log.estimate.csv")
    before = second.read_bytes()
    ran = crosscomb("estimate", first, second, "-o", tmp_path / "x" / "..")
    assert ran.code == 2
    assert ran.err.count("\n") == 1
    assert str(second) in ran.err
    assert second.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "log.csv",
        "log.estimate.csv",
        "vehicle.toml",
        "x",
    ]


def test_earlier_outputs_are_replaced(crosscomb, lively, car, write_log, write_vehicle, tmp_path):
    write_vehicle(tmp_path, car)
    log = write_log(lively.frame, tmp_path / "log.csv")
    out = tmp_path / "out"
    assert crosscomb("estimate", log, "-o", out).code == 0
    first = (out / "log.estimate.csv").read_bytes()
    write_log(lively.frame.iloc[:200], log)
    assert crosscomb("estimate", log, "-o", out).code == 0
    second = (out / "log.estimate.csv").read_bytes()
    assert second == b"".join(first.splitlines(keepends=True)[:201])
    assert sorted(path.name for path in out.iterdir()) == ["log.estimate.csv", "log.run.json"]


def test_a_broken_log_among_good_ones_leaves_no_output(
    crosscomb, lively, car, write_log, write_vehicle, tmp_path
):
    write_vehicle(tmp_path, car)
    good = write_log(lively.frame, tmp_path / "good.csv")
    bad = write_log(lively.frame.iloc[:1], tmp_path / "bad.csv")
    ran = crosscomb("estimate", good, bad, "-o", tmp_path / "out")
    assert ran.code == 2
    assert str(bad) in ran.err
    assert not (tmp_path / "out").exists()


def test_the_trained_car_stands_in_for_a_missing_file(crosscomb, lively, car, artefact, write_log, tmp_path):
    log = write_log(lively.frame, tmp_path / "log.csv")
    save_artefact(artefact.model_copy(update={"vehicle": car}), tmp_path / "mine.json")
    ran = crosscomb("estimate", log, "--selector-file", tmp_path / "mine.json", "-o", tmp_path / "out")
    assert (ran.code, ran.err) == (0, "")
    ran = crosscomb("estimate", log, "-o", tmp_path / "out")
    assert ran.code == 0
    assert ran.err.startswith("warning: ")
    assert "generic" in ran.err


def failing_writer(path: Path) -> None:
    path.write_text("half")
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("earlier", [None, b"whole"])
def test_a_failed_write_leaves_what_was_there(earlier, tmp_path):
    target = tmp_path / "new" / "x.estimate.csv" if earlier is None else tmp_path / "x.estimate.csv"
    if earlier is not None:
        target.write_bytes(earlier)
    with pytest.raises(UsageError, match="No space left"):
        write_file(target, failing_writer)
    assert [path.name for path in target.parent.iterdir()] == ([] if earlier is None else [target.name])
    assert earlier is None or target.read_bytes() == earlier


def test_any_other_failure_leaves_nothing_either(tmp_path):
    def interrupted(path: Path) -> None:
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "x.csv", interrupted)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL on Windows")
def test_a_killed_run_leaves_no_half_file(tmp_path):
    code = (
        "import os, signal, sys, pathlib\n"
        "from crosscomb.files import write_file\n"
        "def write(path):\n"
        "    path.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_file(pathlib.Path(sys.argv[1]), write)\n"
    )
    target = tmp_path / "x.estimate.csv"
    target.write_text("whole")
    done = subprocess.run([sys.executable, "-c", code, str(target)], timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert target.read_text() == "whole"


def test_a_place_that_cannot_be_written_is_an_error_of_use(
    crosscomb, lively, car, write_log, write_vehicle, tmp_path
):
    write_vehicle(tmp_path, car)
    log = write_log(lively.frame, tmp_path / "log.csv")
    (tmp_path / "taken").write_text("a file, not a folder")
    ran = crosscomb("estimate", log, "-o", tmp_path / "taken")
    assert ran.code == 2
    assert ran.err.count("\n") == 1
    assert "taken" in ran.err

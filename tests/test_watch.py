"""What no sensor can have said is no measurement: bad samples and channels of otherwise sound drives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscomb.filters import columns as at
from crosscomb.filters.catalogue import DEFAULT_FILTERS
from crosscomb.logs.prepare import complete
from crosscomb.logs.watch import CHANNELS, count_faults, in_words, reasons, start_watch, watch_rows
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.doubt import OUTAGE, next_doubt, start_doubt
from crosscomb.run.estimate import estimate_log
from crosscomb.run.status import UNCERTAIN_STD
from crosscomb.selection.artefact import load_artefact
from crosscomb.signals import COLUMN, Signals, make_signals
from crosscomb.training.simulation.simulate import simulate_log
from crosscomb.training.suites.faults import unsigned_speed

CAR = load_vehicle("generic_compact")
SPIKES = {"vx": 50.0, "ax": 100.0, "ay": 100.0, "yaw_rate": 3.0, "steer": 1.0}
ONSET = 1500


@pytest.fixture(scope="module")
def drive() -> Signals:
    """Thirty seconds of a country road, without lost samples."""
    log = simulate_log(CAR, "country_road", 5, duration=30.0)
    frame = log.frame.drop(columns=["steer_wheel"])
    return make_signals(frame.interpolate(limit_direction="both"), "drive")


def watched(log: Signals, car: Vehicle = CAR) -> tuple[np.ndarray, np.ndarray]:
    """Rows after the watch, and the words of each."""
    rows = log.rows()
    return rows, reasons(watch_rows(start_watch(), rows, car))


def changed(log: Signals, channel: str, values: np.ndarray) -> Signals:
    frame = log.frame.copy()
    frame.loc[ONSET : ONSET + len(values) - 1, channel] = values
    return Signals(log.name, frame)


def test_a_sound_drive_is_left_as_it_is(drive: Signals) -> None:
    rows, words = watched(drive)
    assert set(words) == {""}
    np.testing.assert_array_equal(rows, drive.rows())


@pytest.mark.parametrize("channel", SPIKES)
def test_a_spike_is_one_missing_sample(drive: Signals, channel: str) -> None:
    here = drive.frame[channel].to_numpy()[ONSET] + SPIKES[channel]
    rows, words = watched(changed(drive, channel, np.array([here])))
    assert words[ONSET].startswith(channel)
    assert np.isnan(rows[ONSET, COLUMN[channel]])
    assert set(np.delete(words, ONSET)) == {""}


@pytest.mark.parametrize(
    ("channel", "value"), [("yaw_rate", 571.9), ("vx", 655.35), ("ax", 1e154), ("ay", -1e300)]
)
def test_an_impossible_value_is_out_of_range(drive: Signals, channel: str, value: float) -> None:
    _, words = watched(changed(drive, channel, np.array([value])))
    assert words[ONSET] == f"{channel} out of range"


@pytest.mark.parametrize("channel", ["ax", "ay", "yaw_rate", "steer", "vx"])
def test_a_stuck_channel_is_found_until_it_moves_again(drive: Signals, channel: str) -> None:
    here = drive.frame[channel].to_numpy()[ONSET]
    rows, words = watched(changed(drive, channel, np.full(600, here)))
    stuck = np.array([f"{channel} stuck" in word for word in words])
    assert 20 < int(np.argmax(stuck)) - ONSET < 250
    assert np.isnan(rows[stuck, COLUMN[channel]]).all() == (channel != "steer")
    assert not stuck[ONSET + 700 :].any()


@pytest.mark.parametrize("channel", ["ay", "yaw_rate", "steer"])
def test_a_reversed_channel_is_found_while_the_car_turns(drive: Signals, channel: str) -> None:
    tail = drive.frame[channel].to_numpy()[ONSET:]
    rows, words = watched(changed(drive, channel, -tail))
    found = np.array([f"{channel} reversed" in word for word in words])
    turning = np.abs(drive.column("ay")) > 2.0
    assert found.any()
    first = int(np.argmax(found))
    assert np.sum(turning[ONSET:first]) < 200
    assert np.isnan(rows[found, COLUMN[channel]]).all() == (channel != "steer")
    others = [name for name in ("ay", "yaw_rate", "steer") if name != channel]
    assert not any(f"{name} reversed" in word for name in others for word in words)


def test_an_ax_of_the_wrong_sign_is_found_and_stays_found(drive: Signals) -> None:
    rows, words = watched(changed(drive, "ax", -drive.frame["ax"].to_numpy()[ONSET:]))
    found = np.array([word == "ax reversed" for word in words])
    assert 20 < int(np.argmax(found)) - ONSET < 300
    assert found[int(np.argmax(found)) :].mean() > 0.98
    assert np.isnan(rows[found, COLUMN["ax"]]).all()


def test_an_offset_of_ax_is_no_wrong_sign(drive: Signals) -> None:
    for offset in (-0.5, 0.5):  # a road of five in a hundred
        ax = drive.frame["ax"].to_numpy()[ONSET:] + offset
        _, words = watched(changed(drive, "ax", ax))
        assert set(words) == {""}


def test_a_speed_that_changes_its_sign_is_mended(drive: Signals) -> None:
    rows, words = watched(changed(drive, "vx", -drive.frame["vx"].to_numpy()[ONSET:]))
    assert set(words[:ONSET]) == {""}
    assert set(words[ONSET:]) == {"vx reversed"}
    np.testing.assert_array_equal(rows, drive.rows())


@pytest.mark.parametrize("seed", range(3))
def test_a_car_that_reverses_with_an_unsigned_speed_is_found(seed: int) -> None:
    log = simulate_log(CAR, "reversing", seed, duration=32.0)
    estimate = estimate_log(unsigned_speed(log), CAR, load_artefact())
    vx = log.column("vx")
    forward = np.maximum.accumulate(np.where(vx > -0.5, log.t, log.t[0]))
    reverse = np.array(["reverse" in text for text in estimate.status])
    assert np.sum(log.t - forward > 2.0) > 100
    assert reverse[log.t - forward > 2.0].mean() > 0.95
    assert not reverse[vx > 0.5].any()
    late = reverse & (log.t - forward > 2.0)
    assert set(estimate.reason[late]) == {"vx reversed"}
    signed = estimate_log(log, CAR, load_artefact())
    assert not any("reversed" in word for word in signed.reason)


@pytest.mark.parametrize("manoeuvre", ["stop_and_go", "road_slide", "u_turn", "handbrake_turn"])
@pytest.mark.parametrize("seed", range(2))
def test_no_car_that_goes_forwards_is_said_to_reverse(manoeuvre: str, seed: int) -> None:
    log = complete(simulate_log(CAR, manoeuvre, seed, surface="wet", duration=20.0), CAR)
    _, words = watched(unsigned_speed(log))
    assert not any("vx reversed" in word for word in words)


def test_a_noise_free_cruise_is_not_stuck() -> None:
    t = np.arange(3000) / 100.0
    vx = np.minimum(2.0 * t, 20.0)
    frame = {
        "t": t,
        "vx": vx,
        "ax": np.where(t < 10.0, 2.0, 0.0),
        "ay": 0.0 * t,
        "yaw_rate": 0.0 * t,
        "steer": 0.0 * t,
    }
    import pandas as pd

    _, words = watched(make_signals(pd.DataFrame(frame), "cruise"))
    assert set(words) == {""}


def test_faults_are_counted_and_told(drive: Signals) -> None:
    here = drive.frame["ay"].to_numpy()[ONSET] + 100.0
    log = complete(changed(drive, "ay", np.array([here])), CAR)
    assert log.notes == ("samples taken as missing: ay out of range 1",) or log.notes == (
        "samples taken as missing: ay spike 1",
    )
    assert count_faults(np.zeros(5, dtype=np.int64)) == {}
    words = in_words({"ay spike": 2, "vx reversed": 3, "steer stuck": 4, "vx stuck": 5})
    assert words == (
        "samples taken as missing: ay spike 2, vx stuck 5; samples whose sign was mended: vx reversed 3; "
        "samples that look bad: steer stuck 4"
    )


@settings(deadline=None)
@given(
    cuts=st.lists(st.integers(1, 2999), max_size=6),
    channel=st.sampled_from(CHANNELS[:5]),
    seed=st.integers(0, 99),
)
def test_pieces_of_any_length_are_watched_alike(drive, cuts: list[int], channel: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = drive.rows()
    rows = rng.choice(len(whole), 40)
    whole[rows, COLUMN[channel]] = rng.choice([np.nan, 1e3, -50.0, 0.0], 40)
    pieces = np.split(whole.copy(), sorted({cut for cut in cuts if cut < len(whole)}))
    watch = start_watch()
    codes = np.concatenate([watch_rows(watch, piece, CAR) for piece in pieces])
    np.testing.assert_array_equal(watch_rows(start_watch(), whole, CAR), codes)
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


ABSURD = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(deadline=None, max_examples=40)
@given(
    values=st.lists(ABSURD, min_size=1, max_size=12),
    channel=st.sampled_from(CHANNELS),
    start=st.integers(500, 900),
)
def test_finite_out_whatever_comes_in(drive, values: list[float], channel: str, start: int) -> None:
    frame = drive.frame.iloc[:1200].copy()
    frame.loc[start : start + len(values) - 1, channel] = values
    estimate = estimate_log(
        make_signals(frame.reset_index(drop=True), "absurd"), CAR, load_artefact(), list(DEFAULT_FILTERS)
    )
    assert np.isfinite(estimate.beta).all()
    assert np.isfinite(estimate.beta_std).all()
    for beta in estimate.filters.values():
        assert np.isfinite(beta).all()
    before = slice(0, start)
    sound = estimate_log(
        make_signals(drive.frame.iloc[:1200], "sound"), CAR, load_artefact(), list(DEFAULT_FILTERS)
    )
    np.testing.assert_array_equal(estimate.beta[before], sound.beta[before])


def samples(n: int, missing: slice) -> np.ndarray:
    """A car at 20 m/s whose yaw rate is missing for a while."""
    made = np.zeros((n, at.SAMPLE_WIDTH))
    made[:, at.VX] = 20.0
    made[missing, at.YAW_RATE] = np.nan
    return made


def test_doubt_grows_in_an_outage_and_fades_after_it() -> None:
    beta_std = np.full(1000, 0.01)
    recovering = next_doubt(start_doubt(), samples(1000, slice(200, 400)), np.zeros(1000), beta_std, 0.01)
    assert (beta_std[:200] == 0.01).all()
    assert np.all(np.diff(beta_std[200:400]) > 0.0)
    assert np.all(np.diff(beta_std[400:700]) < 0.0)
    assert not recovering[:400].any()
    assert recovering[400]
    last = int(np.flatnonzero(recovering)[-1])
    assert beta_std[last + 1] <= 0.011 + 1e-9


def test_a_short_hole_needs_no_recovery() -> None:
    hole = slice(200, 200 + round(0.5 * OUTAGE / 0.01))
    recovering = next_doubt(start_doubt(), samples(600, hole), np.zeros(600), np.full(600, 0.01), 0.01)
    assert recovering.sum() < 60


def test_uncertain_is_said_where_the_error_may_be_large() -> None:
    drive = simulate_log(CAR, "road_slide", 3, surface="wet", duration=10.0)
    estimate = estimate_log(drive, CAR, load_artefact())
    uncertain = np.array(["uncertain" in text for text in estimate.status])
    fast = drive.column("vx") > 3.0
    doubtful = fast & (estimate.beta_std > UNCERTAIN_STD)
    assert doubtful.any()
    assert uncertain[fast & (estimate.beta_std > 1.25 * UNCERTAIN_STD)].all()
    assert (uncertain != doubtful).mean() < 0.1  # said, and taken back, a little later


def test_what_contradicts_itself_is_doubted() -> None:
    """A yaw rate that is 2 deg/s off from some moment on, in a car that goes straight: about 4 deg in two seconds."""
    made, beta_std = samples(3000, slice(0, 0)), np.full(3000, 0.001)
    made[1500:, at.YAW_RATE] = np.radians(2.0)
    next_doubt(start_doubt(), made, np.zeros(3000), beta_std, 0.01)
    assert beta_std[1499] == pytest.approx(0.001)
    assert np.degrees(beta_std[1900]) > 1.2
    assert np.degrees(beta_std[2999]) < np.degrees(beta_std[1900])  # what lasts is usual


def test_a_missing_ax_is_doubted_within_bounds() -> None:
    """One filter of several cannot do without: the others can."""
    lacking = samples(3000, slice(0, 0))
    lacking[200:2200, at.AX] = np.nan
    beta_std = np.full(3000, 0.01)
    recovering = next_doubt(start_doubt(), lacking, np.zeros(3000), beta_std, 0.01)
    assert (np.diff(beta_std[200:300]) > 0.0).all()
    assert 0.015 < beta_std[2199] < 0.02
    assert recovering[2205]
    assert not recovering[-1]
    assert beta_std[-1] < 0.0101

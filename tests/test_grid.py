"""Resampling is causal, invents nothing across gaps, and leaves a log at the working rate alone."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscomb.logs.grid import JITTER, MAX_AGE, MAX_GAP, to_grid
from crosscomb.logs.read import read_log
from crosscomb.signals import Signals


def make_log(t: np.ndarray, **columns: np.ndarray) -> Signals:
    return Signals("log", pd.DataFrame({"t": t, **columns}, dtype=np.float64))


def random_log(seed: int, n: int = 120) -> Signals:
    """Irregular time with bursts, silences and long gaps, and channels with holes."""
    rng = np.random.default_rng(seed)
    steps = rng.choice(
        [0.0005, 0.004, 0.01, 0.013, 0.05, 0.3, 1.7], n, p=[0.1, 0.3, 0.3, 0.15, 0.1, 0.03, 0.02]
    )
    t = rng.choice([0.0, -3.0, 1.7e9]) + np.cumsum(steps)
    ay, vx, beta = rng.normal(size=(3, n))
    ay[rng.random(n) < 0.3] = np.nan
    vx[np.arange(n) % 3 > 0] = np.nan
    return make_log(t, ay=ay, vx=vx, beta_ref=beta)


@pytest.mark.parametrize("start", [0.0, 12.34, 1_700_000_000.0])
def test_log_at_the_working_rate_passes_bit_for_bit(start: float) -> None:
    t = start + np.arange(1000) / 100.0
    ay = np.random.default_rng(0).normal(size=1000)
    ay[::7] = np.nan
    log = make_log(t, ay=ay, beta_ref=ay[::-1])
    (segment,) = to_grid(log, 100.0)
    assert len(segment.signals) == 1000
    pd.testing.assert_frame_equal(
        segment.signals.frame.drop(columns="t"), log.frame.drop(columns="t"), check_exact=True
    )
    np.testing.assert_allclose(segment.signals.t, t, rtol=0.0, atol=np.spacing(start + 10.0))
    assert np.array_equal(segment.newest, np.arange(1000))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), cut=st.integers(0, 118), rate=st.sampled_from([20.0, 50.0, 100.0, 333.0]))
def test_later_rows_never_change_earlier_grid_points(seed: int, cut: int, rate: float) -> None:
    log = random_log(seed)
    rng = np.random.default_rng(seed + 1)
    changed = log.frame.copy()
    later = np.arange(len(log)) > cut
    for column in ("ay", "vx", "beta_ref"):
        changed.loc[later, column] = rng.choice([np.nan, 7.0, -1e6], later.sum())
    changed = changed[~later | (rng.random(len(log)) < 0.7)]  # rows vanish, too: other gaps, other segments
    before = grid(log, rate)
    after = grid(Signals("log", changed.reset_index(drop=True)), rate)
    known = before["t"] <= log.t[cut]
    assert known.any()
    pd.testing.assert_frame_equal(before[known], after[: known.sum()], check_exact=True)


def grid(log: Signals, rate: float) -> pd.DataFrame:
    return pd.concat([segment.signals.frame for segment in to_grid(log, rate)], ignore_index=True)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), rate=st.sampled_from([20.0, 100.0, 1000.0]))
def test_every_grid_value_comes_from_fresh_samples_of_its_own_segment(seed: int, rate: float) -> None:
    log = random_log(seed)
    stop = 0
    for segment in to_grid(log, rate):
        assert segment.start_row == stop
        stop = segment.stop_row
        rows = slice(segment.start_row, segment.stop_row)
        t, ay = log.t[rows], log.column("ay")[rows]
        assert np.all(np.diff(t) <= MAX_GAP)
        for time, value in zip(segment.signals.t, segment.signals.column("ay"), strict=True):
            if np.isfinite(value):
                near = (t <= time + JITTER / rate) & (t >= time - max(MAX_AGE, 1.0 / rate) - 1e-6)
                assert np.nanmin(ay[near]) - 1e-12 <= value <= np.nanmax(ay[near]) + 1e-12
        newest = segment.newest
        assert np.all(segment.signals.t[newest] <= t + JITTER / rate)
        following = newest + 1 < len(segment.signals)
        assert np.all(segment.signals.t[(newest + 1)[following]] > t[following] - JITTER / rate)
    assert stop == len(log)


def test_faster_log_is_averaged_over_the_step_but_its_truth_is_not() -> None:
    t = np.arange(0, 41) / 1000.0
    (segment,) = to_grid(make_log(t, ay=t, beta_ref=t), 100.0)
    assert segment.signals.t.tolist() == [0.0, 0.01, 0.02, 0.03, 0.04]
    np.testing.assert_allclose(segment.signals.column("ay")[1:], [0.0055, 0.0155, 0.0255, 0.0355])
    assert segment.signals.column("beta_ref").tolist() == [0.0, 0.01, 0.02, 0.03, 0.04]


def test_slower_log_is_held_until_its_next_row_but_its_truth_is_not() -> None:
    log = make_log(
        np.array([0.0, 0.02, 0.04]), ay=np.array([1.0, 2.0, 3.0]), beta_ref=np.array([4.0, 5.0, 6.0])
    )
    (segment,) = to_grid(log, 100.0)
    assert segment.signals.column("ay").tolist() == [1.0, 1.0, 2.0, 2.0, 3.0]
    np.testing.assert_array_equal(segment.signals.column("beta_ref"), [4.0, np.nan, 5.0, np.nan, 6.0])


def test_silence_is_bridged_for_a_moment_only() -> None:
    (segment,) = to_grid(make_log(np.array([0.0, 0.01, 0.5]), ay=np.array([1.0, 2.0, 3.0])), 100.0)
    ay = segment.signals.column("ay")
    assert np.all(ay[1:12] == 2.0)  # until it is MAX_AGE old
    assert np.all(np.isnan(ay[12:50]))
    assert ay[50] == 3.0


def test_slow_channel_among_fast_ones_is_held_until_it_is_due_and_a_hole_is_not_filled() -> None:
    t = np.arange(12) / 100.0
    slow = np.array([1.0, np.nan, 2.0, np.nan, 3.0, np.nan, np.nan, np.nan, np.nan, 4.0, 5.0, np.nan])
    (segment,) = to_grid(make_log(t, vx=slow), 100.0)
    nan = np.nan
    expected = [1.0, nan, 2.0, 2.0, 3.0, 3.0, nan, nan, nan, 4.0, 5.0, nan]
    np.testing.assert_array_equal(segment.signals.column("vx"), expected)


def test_long_gap_starts_a_new_segment() -> None:
    t = np.array([0.0, 0.01, 0.02, 1.5, 1.51, 9.0])
    segments = to_grid(make_log(t, ay=np.arange(6.0)), 100.0)
    assert [(segment.start_row, segment.stop_row) for segment in segments] == [(0, 3), (3, 5), (5, 6)]
    assert [segment.signals.t[0] for segment in segments] == [0.0, 1.5, 9.0]
    assert [len(segment.signals) for segment in segments] == [3, 2, 1]


def test_rows_between_grid_points_belong_to_the_older_one() -> None:
    t = np.array([0.0, 0.004, 0.011, 0.0199999, 0.02, 0.025])
    (segment,) = to_grid(make_log(t, ay=t), 100.0)
    assert segment.newest.tolist() == [0, 0, 1, 1, 2, 2]


def test_real_logs_at_their_own_rate_are_unchanged(data_dir: Path) -> None:
    for name, rate in (("kth_volvo_s90/slalom_30kph", 100.0), ("stanford_gti_2019/low_speed", 200.0)):
        log = read_log(data_dir / f"{name}.csv")
        (segment,) = to_grid(log, rate)
        pd.testing.assert_frame_equal(segment.signals.frame, log.frame, check_exact=True)


def test_a_grid_point_is_closed_by_the_first_row_that_reaches_it() -> None:
    """Two rows a nanosecond apart, both on the grid point within rounding: the later one changes nothing."""
    t = np.array([0.0, 0.01 - 1e-9, 0.01 + 1e-9, 0.02])
    log = make_log(t, ay=np.array([0.0, 1.0, 3.0, 5.0]))
    (segment,) = to_grid(log, 100.0)
    assert segment.newest.tolist() == [0, 1, 1, 2]
    assert segment.signals.column("ay").tolist() == [0.0, 1.0, 4.0]


@pytest.mark.parametrize("rate", [50.0, 100.0, 150.0, 200.0, 250.0])
def test_jitter_of_stamps_changes_no_grid_value(rate: float) -> None:
    """Rows at a multiple of half the working rate, whose stamps miss their time by a fifth of a step."""
    rng, n = np.random.default_rng(1), 1000
    t = np.arange(n) / rate
    ay = rng.normal(size=n)
    jittered = t + np.where(np.arange(n) > 200, rng.uniform(-0.2, 0.2, n), 0.0) / rate
    (even,), (uneven,) = to_grid(make_log(t, ay=ay), 100.0), to_grid(make_log(jittered, ay=ay), 100.0)
    common = min(len(even.signals), len(uneven.signals))
    np.testing.assert_array_equal(even.signals.column("ay")[:common], uneven.signals.column("ay")[:common])

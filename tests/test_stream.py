"""Live estimates are those of the whole log, bit for bit, however the rows come in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscomb.errors import UsageError
from crosscomb.logs.intake import choose_vehicle
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.estimate import LogEstimate, estimate_log
from crosscomb.run.stream import StreamEstimate, StreamingEstimator
from crosscomb.selection.artefact import Artefact, load_artefact
from crosscomb.signals import UNITS, Signals, make_signals
from crosscomb.training.simulation.simulate import simulate_log

CAR = load_vehicle("generic_compact")


@pytest.fixture(scope="module")
def artefact() -> Artefact:
    return load_artefact()


@pytest.fixture(scope="module")
def log() -> Signals:
    """Six seconds of bends and slides."""
    return simulate_log(CAR, "road_slide", 3, surface="wet", duration=6.0)


def in_chunks(live: StreamingEstimator, log: Signals, lengths: list[int]) -> list[LogEstimate]:
    """The log in chunks of these lengths over and over."""
    parts, begin, turn = [], 0, 0
    while begin < len(log):
        end = begin + lengths[turn % len(lengths)]
        parts.append(live.take(log.frame.iloc[begin:end]))
        begin, turn = end, turn + 1
    return parts


def everything(estimate: LogEstimate) -> pd.DataFrame:
    """All that an estimate says of its rows."""
    point, handling = estimate.point_table(1.3, -0.4), estimate.handling_table()
    made = estimate.signals.frame[["steer", "vx", "ax"]]
    return pd.concat([estimate.table(), point.add_prefix("point_"), handling, made], axis=1)


def of_samples(answers: list[StreamEstimate]) -> pd.DataFrame:
    """The same as `everything`, from answers to single samples, without the completed signals."""
    rows = []
    for one in answers:
        betas = {f"beta_{name}": beta for name, beta in one.filters.items()}
        point = {f"point_{name}": value for name, value in one.at(1.3, -0.4)._asdict().items()}
        rows.append(
            {
                "t": one.t, "beta": one.beta, "beta_std": one.beta_std, "active": one.active, "status": one.status,
                **betas, "point_t": one.t, **point, "t ": one.t, **one.handling._asdict(),
            }
        )  # fmt: skip
    return pd.DataFrame(rows).rename(columns={"t ": "t"})


def assert_same(one: pd.DataFrame, other: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(one, other, check_exact=True, check_dtype=False)


def step_through(live: StreamingEstimator, log: Signals) -> list[StreamEstimate]:
    return [live.step(sample) for sample in log.frame.to_dict("records")]


def broken_log(log: Signals, seed: int) -> Signals:
    """The log as a bad logger would have it: irregular, with gaps, holes, late columns, standstill and reverse."""
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(len(log), 3 * len(log) // 4, replace=False))
    frame = log.frame.iloc[kept].reset_index(drop=True)
    n = len(frame)
    steps = np.diff(frame["t"], prepend=frame["t"][0] - 0.01) * rng.choice([0.2, 1.0, 1.0, 1.0, 7.0], n)
    steps += rng.choice([0.0, 0.4, 1.3, 30.0], n, p=[0.985, 0.009, 0.004, 0.002])
    frame["t"] = rng.choice([0.0, -2.5, 1.7e9]) + np.cumsum(steps)
    for name in frame.columns.drop("t"):
        frame.loc[rng.random(n) < rng.choice([0.0, 0.05, 0.5]), name] = np.nan
        if rng.random() < 0.3:
            begin = int(rng.integers(n))
            frame.loc[begin : begin + int(rng.integers(200)), name] = np.nan
        if rng.random() < 0.25:
            frame.loc[: int(rng.integers(n - 5)), name] = np.nan  # it starts late
    slow = slice(*sorted(rng.integers(n, size=2)))
    frame.loc[slow, "vx"] *= rng.choice([0.0, -0.2, 0.1, 1.0])
    frame.loc[:1, ["ay", "yaw_rate", "steer_wheel", "vfl", "vfr", "vrl", "vrr"]] = 0.1
    dropped = [name for name in ("ax", "vx", "steer", "steer_rear") if name in frame and rng.random() < 0.3]
    return make_signals(frame.drop(columns=dropped), "broken")


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), lengths=st.lists(st.integers(1, 400), min_size=1, max_size=5))
def test_any_log_in_any_chunks_gives_what_the_whole_log_gives(artefact, log, seed, lengths):
    rough = broken_log(log, seed)
    whole = everything(estimate_log(rough, CAR, artefact))
    parts = in_chunks(StreamingEstimator(CAR, artefact), rough, lengths)
    assert_same(pd.concat([everything(part) for part in parts], ignore_index=True), whole)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_any_log_sample_by_sample_gives_what_the_whole_log_gives(artefact, log, seed):
    rough = broken_log(log, seed)
    whole = everything(estimate_log(rough, CAR, artefact)).drop(columns=["steer", "vx", "ax"])
    assert_same(of_samples(step_through(StreamingEstimator(CAR, artefact), rough)), whole)


@pytest.mark.parametrize("seed", range(6))
def test_cut_off_anywhere_the_answers_are_the_same(artefact, log, seed):
    """The whole way is causal: the log up to a row gives what the whole log gives up to there."""
    rough = broken_log(log, seed)
    whole = everything(estimate_log(rough, CAR, artefact))
    for stop in (7, len(rough) // 3, len(rough) - 3):
        cut = replace(rough, frame=rough.frame.iloc[:stop])
        assert_same(everything(estimate_log(cut, CAR, artefact)), whole.iloc[:stop])


@pytest.mark.parametrize(
    "name",
    [
        "kth_volvo_v40/sine_with_dwell_80kph.csv",
        "kth_volvo_s90/slalom_30kph.csv",
        "liu_course/double_lane_change_49kph.csv",
        "stanford_gti_limits/wet_1.csv",
        "stanford_audi_tts_2011/run_a_part1.csv",
        "uahl_revsted/obd_sample.csv",
    ],
)
def test_real_logs_live(artefact, data_dir: Path, name):
    path = data_dir / name
    log = read_log(path)
    log = replace(log, frame=log.frame.iloc[:1000])
    car, _, _ = choose_vehicle(path, None, artefact.vehicle)
    whole = estimate_log(log, car, artefact)
    live = StreamingEstimator(car, artefact)
    assert_same(of_samples(step_through(live, log)), everything(whole).drop(columns=["steer", "vx", "ax"]))
    live.reset()
    parts = in_chunks(live, log, [1, 100, 17, 731])
    assert_same(pd.concat([part.table() for part in parts], ignore_index=True), whole.table())


def test_samples_and_chunks_may_alternate(artefact, log):
    whole = estimate_log(log, CAR, artefact)
    live = StreamingEstimator(CAR, artefact)
    live.take(log.frame.iloc[:500])
    answers = [live.step(log.frame.iloc[k]) for k in range(500, 520)]
    assert [one.beta for one in answers] == whole.beta[500:520].tolist()
    assert live.take(replace(log, frame=log.frame.iloc[520:])).beta.tolist() == whole.beta[520:].tolist()


def test_other_filters_run_live_too(artefact, log):
    names = ["imm", "dynamic_ekf", "kinematic_kf", "random_walk_pf", "network_feedback"]
    for filters in (names, names[:1]):
        whole = estimate_log(log, CAR, artefact, filters)
        parts = in_chunks(StreamingEstimator(CAR, artefact, filters), log, [1, 7, 350])
        assert_same(pd.concat([part.table() for part in parts], ignore_index=True), whole.table())


def test_a_correction_live_sees_what_it_sees_in_the_whole_log_whoever_runs_beside_its_filters(log):
    hybrid = load_artefact("hybrid")
    alone = estimate_log(log, CAR, hybrid)
    names = ["luenberger", "random_walk_pf", "lint_ekf", "dynamic_ekf", "kinematic_kf"]
    for filters in (None, names):
        parts = in_chunks(StreamingEstimator(CAR, hybrid, filters), log, [1, 7, 350])
        np.testing.assert_array_equal(np.concatenate([part.beta for part in parts]), alone.beta)
        np.testing.assert_array_equal(np.concatenate([part.beta_std for part in parts]), alone.beta_std)


def test_after_a_reset_nothing_is_remembered(artefact, log):
    live = StreamingEstimator(CAR, artefact)
    first = live.take(log)
    live.reset()
    pd.testing.assert_frame_equal(live.take(log).table(), first.table(), check_exact=True)


def test_what_a_sample_leaves_out_is_no_measurement(artefact):
    live = StreamingEstimator(CAR, artefact)
    full = {"vx": 20.0, "ax": 0.0, "ay": 1.0, "yaw_rate": 0.05, "steer": 0.01}
    assert live.step({"t": 0.0, **full}).status == "ok"
    for t, lost in ((0.01, {}), (0.02, {"ay": None}), (0.03, {"ay": np.nan}), (0.04, {"ay": np.inf})):
        kept = {name: value for name, value in full.items() if name != "ay"}
        assert live.step({"t": t, **kept, **lost}).status == "degraded"
    assert live.step({"t": 0.05, **full}).status == "ok"


def test_vy_and_beta_agree(artefact, log):
    live = StreamingEstimator(CAR, artefact)
    for one in step_through(live, replace(log, frame=log.frame.iloc[:300])):
        assert one.vy == pytest.approx(one.motion.vx * np.tan(one.beta))
        assert one.at(0.0).vy == one.vy


@pytest.mark.parametrize(
    ("sample", "words"),
    [
        ({"t": 1.0, "speed": 3.0}, ("column speed", "unknown", "vx")),
        ({"vx": 3.0}, ("column t", "no time")),
        ({"t": None, "vx": 3.0}, ("column t", "no time")),
        ({"t": np.inf}, ("column t", "no time")),
        ({"t": -1.5}, ("column t", "starts again", "0 then -1.5 s", "reset()")),
        ({"t": 0.0, "steer_rear": 0.1}, ("column t", "repeats", "merge")),
        ({"t": 1.0, "vx": "fast"}, ("column vx", "'fast'", "m/s")),
        ([1.0, 2.0], ("list", "dict")),
    ],
    ids=str,
)
def test_wrong_samples_are_refused_in_one_line_and_change_nothing(artefact, log, sample, words):
    live, other = StreamingEstimator(CAR, artefact), StreamingEstimator(CAR, artefact)
    first, second = log.frame.iloc[0], log.frame.iloc[1]
    live.step(first)
    other.step(first)
    with pytest.raises(UsageError) as error:
        live.step(sample)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)
    assert live.step(second) == other.step(second)


def out_of_time(log: Signals, seed: int) -> pd.DataFrame:
    """The rows with a few more that repeat a stamp or go back by up to half a second, with other values."""
    rng = np.random.default_rng(seed)
    places = np.sort(rng.choice(np.arange(60, len(log)), 4, replace=False))
    late = log.frame.iloc[places].assign(t=log.t[places] - rng.choice([0.0, 0.01, 0.5], 4), ay=99.0)
    return pd.concat([log.frame, late.set_axis(places + 0.5)]).sort_index().reset_index(drop=True)


@pytest.mark.parametrize("seed", range(4))
def test_samples_out_of_time_are_dropped_as_rows_of_a_log_are(artefact, log, seed):
    rows = out_of_time(log, seed)
    signals = make_signals(rows, "late")
    whole = estimate_log(signals, CAR, artefact)
    assert len(whole.beta) == len(log)
    live = StreamingEstimator(CAR, artefact)
    answers = step_through(live, replace(log, frame=rows))
    late = [k for k, one in enumerate(answers) if one.reason.startswith("time")]
    assert len(late) == 4
    for k in late:
        assert answers[k].reason == (
            "time repeats" if rows["t"][k] == rows["t"][k - 1] else "time goes backwards"
        )
        assert answers[k]._replace(reason="") == answers[k - 1]._replace(reason="")
    kept = [one for k, one in enumerate(answers) if k not in late]
    assert_same(of_samples(kept), everything(whole).drop(columns=["steer", "vx", "ax"]))
    live.reset()
    parts = in_chunks(live, replace(log, frame=rows), [1, 7, 350])
    assert_same(pd.concat([everything(part) for part in parts], ignore_index=True), everything(whole))
    notes = [note for part in parts for note in part.signals.notes if "out of time" in note]
    assert sum(int(note.split()[0]) for note in notes) == 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda frame: frame.rename(columns={"vx": "velocity"}), ("column velocity", "unknown")),
        (lambda frame: frame.assign(t=-200.0 * frame["t"]), ("column t", "starts again", "reset()")),
        (lambda frame: frame.drop(columns="t"), ("column t", "no time")),
        (lambda frame: frame.iloc[:0], ("no rows",)),
        (lambda frame: frame.assign(vx="fast"), ("no number", "fast")),
    ],
)
def test_wrong_chunks_are_refused(artefact, log, change, words):
    with pytest.raises(UsageError) as error:
        StreamingEstimator(CAR, artefact).take(change(log.frame.iloc[:10]))
    for word in words:
        assert word in str(error.value)


def test_every_known_column_may_come(artefact):
    live = StreamingEstimator(CAR, artefact)
    answer = live.step(dict.fromkeys(UNITS, 0.5))
    assert np.isfinite(answer.beta)


def test_the_vehicle_counts(artefact, log):
    heavy: Vehicle = load_vehicle("truck_heavy")
    one, other = (StreamingEstimator(car, artefact).take(log) for car in (CAR, heavy))
    assert (one.beta != other.beta).mean() > 0.9

"""Rows out of time: few are dropped and counted, a log that is unordered or starts again is refused."""

from pathlib import Path

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.logs import content
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.logs.read import open_log, read_log
from crosscomb.training.recordings import read_recordings

HEADER = "t,vx,ay,yaw_rate,steer\n"
ROWS = 400


def table(times: np.ndarray) -> str:
    """Rows that say in vx where they stood before anything went wrong."""
    rows = (f"{t:.6g},{10 + i / 8},{-0.125 * (10 + i / 8):.6g},-0.125,0.02\n" for i, t in enumerate(times))
    return HEADER + "".join(rows)


TIMES = np.arange(ROWS) / 100


def with_time(row: int, t: float) -> np.ndarray:
    """Times with another one in a row; rows as in the file."""
    times = TIMES.copy()
    times[row - 2] = t
    return times


@pytest.fixture(params=(211, 20_011), autouse=True)
def small_pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "PIECE", request.param)


def write(folder: Path, text: str) -> Path:
    path = folder / "drive.csv"
    path.write_text(text)
    return path


FEW = {
    "one repeated": (
        with_time(42, 0.39),
        [42],
        "1 row dropped, out of time (first: row 42, column t: time repeats",
    ),
    "one back": (
        with_time(42, 0.3),
        [42],
        "1 row dropped, out of time (first: row 42, column t: time goes back",
    ),
    "two changed places": (np.r_[TIMES[:50], TIMES[51], TIMES[50], TIMES[52:]], [53], "1 row dropped"),
    "the last repeated": (np.r_[TIMES, TIMES[-1]], [ROWS + 2], "1 row dropped"),
    "one far back": (with_time(300, -5.0), [300], "1 row dropped"),
    "a clock set back by 100 ms": (np.r_[TIMES[:200], TIMES[190:]], range(202, 212), "10 rows dropped"),
    "some of each": (
        np.r_[TIMES[:100], TIMES[99], TIMES[99], TIMES[100:200], TIMES[150], TIMES[200:]],
        [102, 103, 204],
        "3 rows dropped, out of time (first: row 102, column t: time repeats (0.99 then 0.99 s))",
    ),
}


@pytest.mark.parametrize("fault", FEW)
def test_few_rows_out_of_time_are_dropped_and_counted(tmp_path: Path, fault: str) -> None:
    times, dropped, note = FEW[fault]
    signals = read_log(write(tmp_path, table(times)))
    kept = np.setdiff1d(np.arange(len(times)), np.array(dropped) - 2)
    assert np.all(np.diff(signals.t) > 0.0)
    np.testing.assert_array_equal(signals.column("vx"), 10 + kept / 8)  # of repeated rows the first stays
    assert len(signals.notes) == 1
    assert signals.notes[0].startswith(note)


MANY = {
    "backwards": (TIMES[::-1], "row 3, column t: time goes backwards .*; 399 of 400 .*: sort the rows"),
    "half of them repeated": (TIMES.round(1), r"row 3, column t: time repeats \(0 then 0 s\); 359 of 400"),
    "shuffled": (np.random.default_rng(3).permutation(TIMES), "out of time: sort the rows"),
    "started again": (np.r_[TIMES, TIMES], f"row {ROWS + 2}, column t: time starts again .*: split it there"),
    "started again at the end": (np.r_[TIMES, TIMES[:9]], f"row {ROWS + 2}, column t: time starts again"),
    "a frozen clock": (np.minimum(TIMES, 2.0), "row 203, column t: time repeats"),
    "no time": (with_time(42, np.nan), "row 42, column t: no time there"),
}


@pytest.mark.parametrize("fault", MANY)
def test_a_log_without_order_is_refused(tmp_path: Path, fault: str) -> None:
    times, words = MANY[fault]
    with pytest.raises(UsageError, match=words) as refusal:
        read_log(write(tmp_path, table(times)))
    assert "\n" not in str(refusal.value)


def test_jitter_within_order_is_no_fault(tmp_path: Path) -> None:
    times = TIMES + np.random.default_rng(0).uniform(0.0, 0.009, ROWS)
    assert read_log(write(tmp_path, table(times))).notes == ()


def test_rows_of_one_time_that_fill_different_columns_are_not_dropped(tmp_path: Path) -> None:
    lines = [f"{i / 50},{10 + i / 8},,,\n{i / 50},,0.5,-0.125,0.02\n" for i in range(60)]
    with pytest.raises(UsageError, match=r"row 3, column t: time repeats .* merge the rows"):
        read_log(write(tmp_path, HEADER + "".join(lines)))


@pytest.mark.parametrize("separator", [",", ";", " "])
@pytest.mark.parametrize("left", [3, 14])
def test_a_last_row_that_was_cut_is_dropped_and_said(tmp_path: Path, separator: str, left: int) -> None:
    text = table(TIMES).replace(",", separator)
    whole = read_log(write(tmp_path, text)).frame
    start = text.rstrip("\n").rindex("\n") + 1
    signals = read_log(write(tmp_path, text[: start + left]))
    assert signals.frame.equals(whole[:-1])
    assert signals.notes[0].startswith(f"row {ROWS + 1}, the last one, dropped: it was cut off (")


def test_only_a_last_row_without_a_line_end_counts_as_cut(tmp_path: Path) -> None:
    text = table(TIMES)
    assert read_log(write(tmp_path, text[:-1])).notes == ()
    start = text.rstrip("\n").rindex("\n") + 1
    with pytest.raises(UsageError, match=f"row {ROWS + 1} has 2 fields"):
        read_log(write(tmp_path, text[: start + 8] + "\n"))
    with pytest.raises(UsageError, match="one data row"):
        read_log(write(tmp_path, HEADER + "0,1,0,0,0\n0.01,1"))


def test_notes_are_the_same_when_a_log_is_read_again(tmp_path: Path) -> None:
    log = open_log(write(tmp_path, table(with_time(42, 0.39))[:-6]))
    for _ in range(2):
        frames = [chunk.frame for chunk in log.chunks()]
        assert sum(map(len, frames)) == ROWS - 2
        assert [note.split(" dropped")[0] for note in log.notes] == ["row 401, the last one,", "1 row"]


def test_a_channel_map_sees_only_rows_in_time(tmp_path: Path) -> None:
    signs = ChannelMap.model_validate(
        {"channels": {"steer": {"delay": 0.02}}, "accelerometer": {"position": [1, 0]}}
    )
    sound = read_log(write(tmp_path, table(TIMES)), signs)
    lines = table(TIMES).splitlines(keepends=True)
    repeated = read_log(write(tmp_path, "".join([*lines[:51], lines[50], *lines[51:]])), signs)
    assert repeated.frame.equals(sound.frame)
    assert repeated.notes[1:] == sound.notes


def test_training_says_what_was_dropped_and_skips_a_foreign_table(tmp_path: Path, car, write_vehicle) -> None:
    write_vehicle(tmp_path, car)
    (tmp_path / "laps.csv").write_text("lap,seconds\n1,91.2\n2,90.7\n")
    with pytest.raises(UsageError, match=r"holds nothing to use: laps.csv: skipped, it has none of ay"):
        read_recordings(tmp_path)
    text = table(with_time(42, 0.39)).splitlines()
    write(tmp_path, "\n".join([text[0] + ",beta_ref", *(line + ",0" for line in text[1:])]) + "\n")
    recordings, notes = read_recordings(tmp_path)
    assert [recording.name for recording in recordings] == ["drive"]
    assert [note.split(":")[0] for note in notes] == ["drive.csv", "laps.csv"]

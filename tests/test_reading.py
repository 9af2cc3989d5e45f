"""Long logs: read, checked, estimated and written piece by piece, with the same answers and the same messages."""

import gzip
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscomb.errors import UsageError
from crosscomb.logs import content, plausibility
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.logs.formats import csv
from crosscomb.logs.intake import open_logs
from crosscomb.logs.plausibility import Look, Thinned
from crosscomb.logs.read import open_log, read_log
from crosscomb.report import outline
from crosscomb.report.estimates import writing_table
from crosscomb.report.outline import Outline
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import load_artefact
from crosscomb.signals import Signals

PIECES = (211, 20_011)
ROWS = 400
HEADER = "t,vx,ay,yaw_rate,steer\n"


def rows(count: int, first: int = 0) -> str:
    return "".join(
        f"{i / 100},{10 + i % 9 / 8},{i % 7 * 0.1:.1f},-0.125,0.02\n" for i in range(first, first + count)
    )


def write(folder: Path, text: str | bytes, name: str = "drive.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.fixture(params=PIECES)
def small_pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(content, "PIECE", request.param)
    return request.param


LAYOUTS = {
    "plain": HEADER + rows(ROWS),
    "windows line ends": (HEADER + rows(ROWS)).replace("\n", "\r\n"),
    "old mac line ends": (HEADER + rows(ROWS)).replace("\n", "\r"),
    "byte order mark": b"\xef\xbb\xbf" + (HEADER + rows(ROWS)).encode(),
    "comments and blank lines": "# logger\n\n"
    + HEADER
    + rows(99)
    + '\n  \n# 19" wheels\n'
    + rows(ROWS - 99, 99),
    "quotes": (HEADER + rows(ROWS)).replace("-0.125", '"-0.125"'),
    "a line break in quotes": (HEADER + rows(ROWS))
    .replace("steer", 'steer,"of\nnobody"')
    .replace("0.02\n", '0.02,"\n"\n'),
    "decimal commas": (HEADER + rows(ROWS)).replace(",", ";").replace(".", ","),
    "no line end at the end": (HEADER + rows(ROWS)).removesuffix("\n"),
    "packed": gzip.compress((HEADER + rows(ROWS)).encode()),
    "packed in two": gzip.compress((HEADER + rows(99)).encode())
    + gzip.compress(rows(ROWS - 99, 99).encode()),
}


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "a line break in quotes"])
def test_any_layout_in_pieces_of_any_length_reads_the_same(
    tmp_path: Path, small_pieces: int, layout: str
) -> None:
    name = "drive.csv.gz" if "packed" in layout else "drive.csv"
    log = open_log(write(tmp_path, LAYOUTS[layout], name))
    chunks = list(log.chunks())
    assert small_pieces > 20_000 or len(chunks) > 1 or "mac" in layout
    t = np.concatenate([chunk.t for chunk in chunks])
    assert np.array_equal(t, np.arange(ROWS) / 100)
    monkey = read_log(log.path)
    expected = pd.read_csv(write(tmp_path, LAYOUTS["plain"], "plain.csv"))
    pd.testing.assert_frame_equal(monkey.frame, expected, check_exact=True)
    again = [chunk.frame for chunk in log.chunks()]
    pd.testing.assert_frame_equal(pd.concat(again, ignore_index=True), expected, check_exact=True)


LATE = {
    "text": (rows(ROWS).replace("3.5,", "3.5,x", 1), "row 352, column vx"),
    "units": (
        rows(ROWS).replace("3.5,", "3.5,m/s", 1),
        "correct the cell, or empty it if nothing was measured$",
    ),
    "long row": (rows(ROWS).replace("3.5,", "3.5,1,", 1), "row 352 has 6 fields"),
    "short row": (rows(ROWS).replace("3.5,", "", 1), "row 352 has 4 fields"),
    "after blank rows": ("\n" * 50 + rows(ROWS).replace("3.5,", "3.5,x", 1), "row 402, column vx"),
    "binary": (rows(ROWS) + "\0", "is a binary file"),
}


@pytest.mark.parametrize("fault", LATE)
def test_a_fault_in_a_late_piece_is_named_with_its_row(tmp_path: Path, small_pieces: int, fault: str) -> None:
    text, words = LATE[fault]
    with pytest.raises(UsageError, match=words):
        read_log(write(tmp_path, HEADER + text))


def test_channels_that_have_no_value_are_known_only_at_the_end(tmp_path: Path, small_pieces: int) -> None:
    late = rows(ROWS).replace("-0.125", "", ROWS - 1)
    assert np.isfinite(read_log(write(tmp_path, HEADER + late)).column("yaw_rate")).sum() == 1
    with pytest.raises(UsageError, match="column yaw_rate has no value in any row"):
        read_log(write(tmp_path, HEADER + rows(ROWS).replace("-0.125", "")))


def test_infinite_values_are_counted_over_all_pieces(tmp_path: Path, small_pieces: int) -> None:
    text = rows(ROWS).replace("-0.125", "inf", 3)
    text = text[::-1].replace("-0.125"[::-1], "fni", 2)[::-1]
    assert read_log(write(tmp_path, HEADER + text)).notes == ("5 infinite values taken as missing",)


def test_a_channel_map_in_pieces_gives_the_same_bits(
    tmp_path: Path, simulated: list[Signals], monkeypatch
) -> None:
    channels = {
        "t": {"unit": "ms", "column": "time"}, "ay": {"delay": 0.08}, "vx": {"unit": "km/h", "delay": 0.21},
        "yaw_rate": {"delay": 0.013, "offset": 0.001},
    }  # fmt: skip
    reader = {"time_from_zero": True}
    signs = ChannelMap.model_validate(
        {"channels": channels, "reader": reader, "accelerometer": {"position": [0.4, -0.2]}}
    )
    frame = simulated[0].frame.rename(columns={"t": "time"})
    time = 1e3 * frame["time"].to_numpy() + 1e12
    time[700:] += 300.0  # a silence
    path = write(tmp_path, frame.assign(time=time).to_csv(index=False))
    whole = read_log(path, signs)
    for piece in PIECES:
        monkeypatch.setattr(content, "PIECE", piece)
        cut = read_log(path, signs)
        pd.testing.assert_frame_equal(cut.frame, whole.frame, check_exact=True)
        assert cut.notes == whole.notes
    assert len(whole.notes) == 2


def test_estimates_in_pieces_are_the_same_bytes(
    crosscomb, simulated: list[Signals], tmp_path: Path, monkeypatch
) -> None:
    frame = simulated[1].frame.drop(columns="ax")
    frame.loc[:450, "vx"] = np.nan  # made from the wheels, until it comes
    frame.loc[900:, "t"] += 2.0  # a gap
    path = write(tmp_path, frame.to_csv(index=False), "a.csv")
    said = []
    for piece in (1 << 22, 20_011, 4_001):
        monkeypatch.setattr(content, "PIECE", piece)
        words = ("--vehicle", "generic_compact", "--handling", "--point", "1,0.2", "--extras", "--plot")
        ran = crosscomb("estimate", path, *words, "-o", tmp_path / str(piece))
        assert ran.code == 0
        said.append((ran.out.replace(str(tmp_path / str(piece)), ""), ran.err))
    assert said[0] == said[1] == said[2]
    names = {file.name for file in (tmp_path / "4001").iterdir()}
    assert {"a.estimate.csv", "a.point.csv", "a.handling.csv", "a.extras.csv", "a.estimate.png"} <= names
    for name in names:
        first = (tmp_path / str(1 << 22) / name).read_bytes()
        assert (tmp_path / "20011" / name).read_bytes() == (tmp_path / "4001" / name).read_bytes() == first


def test_checks_say_the_same_however_a_log_is_cut(simulated: list[Signals], car) -> None:
    for log in simulated[:5]:
        frame = log.frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"])
        frame.loc[frame["t"] > 2.0, "steer_wheel"] = 0.5
        frame.loc[frame["t"] > 4.0, "t"] += 1.5
        frame.loc[400:, "vrl"] = np.nan
        looks = []
        for size in (len(frame), 311):
            look = Look()
            for first in range(0, len(frame), size):
                look.take(Signals("log", frame[first : first + size].reset_index(drop=True)))
            looks.append([finding for finding in look.findings(car) if "is {" not in finding.message])
        assert [finding.message for finding in looks[0]] == [finding.message for finding in looks[1]]
        assert any("rests at" in finding.message for finding in looks[0])


def test_wrong_units_are_found_in_a_log_of_many_pieces(
    simulated: list[Signals], tmp_path: Path, small_pieces: int
) -> None:
    frame = simulated[0].frame
    path = write(tmp_path, frame.assign(yaw_rate=np.degrees(frame["yaw_rate"])).to_csv(index=False))
    if small_pieces < 20_000:  # too short to be smoothed: the limits still tell
        return
    with pytest.raises(UsageError, match="yaw_rate looks like deg/s"):
        open_logs([path], vehicle="generic_compact")


@pytest.mark.parametrize("sizes", [[1] * 40, [7, 0, 13, 20], [40]])
def test_thinning_keeps_evenly_spread_rows(sizes: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plausibility, "MOST", 16)
    thinned, ends = Thinned(), np.cumsum([0, *sizes])
    for start, stop in pairwise(ends.tolist()):
        thinned.take(np.arange(start, stop))
    assert thinned.rows().tolist() == list(range(0, 40, 4))


# Caps


def test_text_that_unpacks_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "LEAST_SUSPECT", 1 << 20)
    monkeypatch.setattr(csv, "MOST_BLANK", 1 << 40)
    path = write(tmp_path, gzip.compress(HEADER.encode() + b"\n" * (8 << 20)), "bomb.csv.gz")
    with pytest.raises(UsageError, match=r"bomb\.csv\.gz: unpacks to more than 400 times its size"):
        read_log(path)


def test_a_log_of_empty_rows_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_pieces: int
) -> None:
    monkeypatch.setattr(csv, "MOST_BLANK", 5_000)
    with pytest.raises(UsageError, match=r"empty rows|are empty than are not"):
        read_log(write(tmp_path, HEADER + rows(9) + "\n" * 40_000))
    assert len(read_log(write(tmp_path, HEADER + "\n\n".join(rows(ROWS).splitlines())))) == ROWS


def test_too_many_columns_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv, "MOST_COLUMNS", 4)
    with pytest.raises(UsageError, match="row 1 has 5 columns, more than 4: export fewer"):
        read_log(write(tmp_path, HEADER + rows(9)))


def test_too_long_fields_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv, "MOST_FIELD", 100)
    with pytest.raises(UsageError, match="row 3, field 2 has 104 characters, more than 100"):
        read_log(write(tmp_path, HEADER + rows(9).replace("0.01,", "0.01," + "1" * 98)))
    with pytest.raises(UsageError, match="row 1, field 2 has 102 characters"):
        read_log(write(tmp_path, HEADER.replace("vx", "vx" * 51) + rows(9)))
    wide = HEADER.replace("\n", "".join(f",other {i}" for i in range(99)) + "\n")
    assert len(read_log(write(tmp_path, wide + rows(9).replace("\n", ",1" * 99 + "\n")))) == 9


def test_a_line_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_pieces: int
) -> None:
    monkeypatch.setattr(csv, "MOST_LINE", 50_000)
    with pytest.raises(UsageError, match="row 11 has more than 50000 characters"):
        read_log(write(tmp_path, HEADER + rows(9) + "1" * 100_000))


def test_unmapped_columns_and_length_cost_no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "PIECE", 1 << 16)
    peaks = []
    for count in (2_000, 40_000):
        text = HEADER.replace("\n", ",note\n") + rows(count).replace("\n", ",nobody maps this\n")
        path = write(tmp_path, gzip.compress(text.encode(), 1), f"{count}.csv.gz")
        tracemalloc.start()
        assert sum(len(chunk) for chunk in open_log(path).chunks()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


# What is written


@given(st.lists(st.floats(), min_size=1, max_size=8), st.integers(min_value=-330, max_value=300))
def test_cells_come_back_exactly(tmp_path_factory, values: list[float], exponent: int) -> None:
    values = [*values, *(value * 10.0**exponent for value in (1.2345678901234567, -7.5e-5, 1.0))]
    path = tmp_path_factory.mktemp("cells") / "x.csv"
    with writing_table(path) as put:
        put(pd.DataFrame({"a": values, "word": "ok", "b": values[::-1], "c": 0.0}))
    lines = path.read_text().splitlines()
    assert lines[0] == "a,word,b,c"
    for line, a, b in zip(lines[1:], values, values[::-1], strict=True):
        left, word, right, zero = line.split(",")
        assert (word, zero) == ("ok", "0.0")
        for cell, value in ((left, a), (right, b)):
            assert (cell == "") if value != value else repr(float(cell)) == repr(value)


def test_the_picture_of_a_long_log_keeps_its_extremes(
    simulated, car, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outline, "MOST", 200)
    estimate = estimate_log(simulated[0], car, load_artefact())
    drawn = Outline(len(estimate.beta))
    drawn.take(estimate)
    short = drawn.estimate()
    assert 150 < len(short.beta) < 230
    assert (short.beta.min(), short.beta.max()) == (estimate.beta.min(), estimate.beta.max())
    assert short.signals.t[0] == estimate.signals.t[0]
    assert short.signals.t[-1] == estimate.signals.t[-1]
    assert set(short.active) <= set(estimate.active)

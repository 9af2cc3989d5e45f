"""Reading logs: what loggers write is read as it is, what is broken is named with its row and its mend."""

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.errors import UsageError
from crosscomb.logs.formats.table import FORMATS, Format, log_name
from crosscomb.logs.read import read_log
from crosscomb.training.recordings import find_logs

HEADER = "t,vx,ay,yaw_rate,steer\n"
GOOD = HEADER + "".join(f"{i / 100},{10 + i / 8},{i * 0.1:.1f},-0.125,0.02\n" for i in range(20))


def write(folder: Path, text: str | bytes, name: str = "drive.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_numbers_are_read_exactly(tmp_path: Path) -> None:
    numbers = np.random.default_rng(1).normal(size=(50, 4)) * 10.0 ** np.arange(-6, 6, 3)
    t = np.arange(50) / 3.0
    rows = "".join(
        ",".join(map(repr, [float(a), *map(float, row)])) + "\n" for a, row in zip(t, numbers, strict=True)
    )
    log = read_log(write(tmp_path, HEADER + rows))
    assert np.array_equal(log.frame.to_numpy(), np.column_stack([t, numbers]))


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(GOOD.replace("\n", "\r\n"), id="windows line ends"),
        pytest.param(GOOD.replace("\n", "\r"), id="old mac line ends"),
        pytest.param(b"\xef\xbb\xbf" + GOOD.encode(), id="byte order mark"),
        pytest.param(GOOD.replace(",", " , "), id="spaces around names and numbers"),
        pytest.param(GOOD + "\n\n  \n\t\n", id="blank lines at the end"),
        pytest.param(GOOD.replace("0.05,", "\n0.05,"), id="blank line within"),
        pytest.param(GOOD.removesuffix("\n"), id="no line end at the end"),
        pytest.param(GOOD.replace(",", ";"), id="semicolons"),
        pytest.param(GOOD.replace(",", ";").replace(".", ","), id="semicolons and decimal commas"),
        pytest.param(GOOD.replace(",", "\t"), id="tabs"),
        pytest.param(GOOD.replace(",", "  "), id="blanks"),
        pytest.param("# logger 3\n#\n" + GOOD, id="comments on top"),
        pytest.param(GOOD.replace("\n", ",\n"), id="separator at the end of each line"),
        pytest.param(GOOD.replace("vx", '"vx"').replace("-0.125", '"-0.125"'), id="quotes"),
        pytest.param(
            GOOD.replace("vx", "vx [m/s]").replace("yaw_rate", "yaw_rate (rad/s)"), id="SI units in names"
        ),
        pytest.param(
            GOOD.replace("steer", "steer,Öl °C").replace("0.02\n", "0.02,warm\n").encode("latin-1"),
            id="unknown column of text in another encoding",
        ),
    ],
)
def test_layouts_of_loggers_read_the_same(tmp_path: Path, text: str | bytes) -> None:
    expected = read_log(write(tmp_path, GOOD, "plain.csv"))
    pd.testing.assert_frame_equal(read_log(write(tmp_path, text)).frame, expected.frame, check_exact=True)


def test_gzip_reads_as_the_text_in_it(tmp_path: Path) -> None:
    log = read_log(write(tmp_path, gzip.compress(GOOD.encode()), "drive.csv.gz"))
    assert log.name == "drive"
    assert len(log) == 20


@pytest.mark.parametrize("word", ["", "NaN", "nan", "NAN", "n/a", "NULL", "-", "--", " ", "-nan", "#N/A"])
def test_empty_cells_and_words_for_nothing_are_no_measurement(tmp_path: Path, word: str) -> None:
    log = read_log(write(tmp_path, GOOD.replace("0.5,-0.125", f"{word},-0.125")))
    assert np.flatnonzero(np.isnan(log.column("ay"))).tolist() == [5]


def test_infinite_values_become_no_measurement_and_are_noted(tmp_path: Path) -> None:
    log = read_log(write(tmp_path, GOOD.replace("0.5,-0.125", "inf,-0.125")))
    assert np.isnan(log.column("ay")[5])
    assert "1 infinite" in log.notes[0]


BAD: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "empty": ("", ("empty",)),
    "only blank lines": ("\n  \n", ("empty",)),
    "header only": (HEADER, ("no data rows", "at least two")),
    "header without line end": (HEADER.strip(), ("no data rows",)),
    "one row": (HEADER + "0,1,2,3,4\n", ("one data row",)),
    "no header": (GOOD.removeprefix(HEADER), ("row 1", "column names", "header")),
    "binary": (bytes(range(256)), ("binary", "CSV")),
    "NUL bytes": (GOOD.encode() + b"\0\0", ("binary",)),
    "UTF-16": (GOOD.encode("utf-16"), ("UTF-16", "UTF-8")),
    "missing column": (
        GOOD.replace("yaw_rate", "gyro"),
        ("yaw_rate [rad/s] is missing", "gyro", "channel_map"),
    ),
    "missing speed": (GOOD.replace("vx", "v"), ("vx [m/s] is missing", "vfl", "channel_map")),
    "missing steering": (GOOD.replace("steer", "wheel"), ("steer [rad] is missing", "steer_wheel")),
    "column twice": (GOOD.replace("yaw_rate", "ay"), ("row 1", "column ay", "twice")),
    "text": (GOOD.replace("0.5,-0.125", "oops,-0.125"), ("row 7", "column ay", "'oops'")),
    "text after a blank line": (
        GOOD.replace("0.02,", "\n0.02,").replace("0.5,-", "x,-"),
        ("row 8", "ay", "'x'"),
    ),
    "letter in a number": (GOOD.replace("0.05,10.625", "0.05,1O.625"), ("row 7", "column vx", "'1O.625'")),
    "truth values": (GOOD.replace("-0.125", "True"), ("row 2", "column yaw_rate", "'True'")),
    "row of units": (
        GOOD.replace("steer\n", "steer\ns,m/s,g,rad/s,deg\n"),
        ("row 2", "'s'", "first_data_row = 3"),
    ),
    "decimal comma in a cell": (
        GOOD.replace(",", ";").replace("0.05;10.625", "0.05;10,625"),
        ("row 7", "column vx", 'decimal = ","'),
    ),
    "decimal commas between commas": (GOOD.replace(".", ","), ("row 2", "10 fields", "semicolon")),
    "long row": (GOOD.replace("0.05,", "0.05,3,"), ("row 7", "6 fields", "5")),
    "short row": (GOOD.replace("0.05,", ""), ("row 7", "4 fields", "5")),
    "foreign unit in a name": (
        GOOD.replace("vx", "vx [km/h]"),
        ("'vx [km/h]'", '[channels.vx] column = "vx [km/h]"', 'unit = "km/h"'),
    ),
    "unknown unit in a name": (GOOD.replace("ay", "ay (furlong)"), ("'ay (furlong)'", "m/s^2, g")),
    "no time": (GOOD.replace("0.05,", ","), ("row 7", "column t", "no time")),
    "empty channel": (GOOD.replace("-0.125", ""), ("column yaw_rate", "no value in any row")),
    "empty speed": (HEADER + "0,,1,1,1\n1,,1,1,1\n", ("column vx", "no value in any row")),
    "empty steering": (HEADER + "0,1,1,1,\n1,1,1,1,\n", ("column steer", "no value in any row")),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_logs_are_refused_in_one_line_with_their_place(tmp_path: Path, kind: str) -> None:
    text, words = BAD[kind]
    path = write(tmp_path, text)
    with pytest.raises(UsageError) as error:
        read_log(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.csv").mkdir()
    whole = gzip.compress(GOOD.encode() * 50)
    cases = {
        "nothing.csv": "no such file",
        "folder.csv": "is a folder",
        write(tmp_path, b"no gzip", "a.csv.gz").name: "damaged or not gzip",
        write(tmp_path, whole[: len(whole) // 2], "b.csv.gz").name: "damaged or not gzip",
        write(tmp_path, GOOD, "drive.txt").name: "not a .csv",
    }
    for name, words in cases.items():
        with pytest.raises(UsageError, match=words):
            read_log(tmp_path / name)


def test_damaged_text_is_read_or_refused_but_never_crashes(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(150):
        damaged = bytearray(GOOD.encode())
        for place in rng.integers(0, len(damaged), rng.integers(1, 4)):
            damaged[place] = rng.choice(list(b'\n,;."x- \t\xff9'))
        try:
            log = read_log(write(tmp_path, bytes(damaged)))
            assert np.all(np.diff(log.t) > 0.0)
        except UsageError:
            refused += 1
    assert 0 < refused < 150


@pytest.mark.parametrize(
    ("path", "name"),
    [("a/run 1.csv", "run 1"), ("run.csv.gz", "run"), ("RUN.CSV", "RUN"), ("run.v2.csv", "run.v2")],
)
def test_name_is_the_file_name_without_its_endings(path: str, name: str) -> None:
    assert log_name(path) == name


def test_real_logs_hold_every_number_of_their_files(data_dir: Path) -> None:
    paths = sorted(data_dir.glob("*/*.csv*"))
    assert paths
    for path in paths:
        log = read_log(path)
        raw = pd.read_csv(path, dtype=str, nrows=300)
        for column in log.frame:
            expected = np.array(
                [float(text) if isinstance(text, str) else np.nan for text in raw[column][:300]]
            )
            assert np.array_equal(log.column(str(column))[:300], expected, equal_nan=True)


def test_content_counts_where_the_name_lies(tmp_path: Path) -> None:
    good = read_log(write(tmp_path, GOOD))
    for name, data in (("packed.csv", gzip.compress(GOOD.encode())), ("plain.csv.gz", GOOD)):
        log = read_log(write(tmp_path, data, name))
        pd.testing.assert_frame_equal(log.frame, good.frame, check_exact=True)
        assert "not what its name says" in log.notes[-1]
    assert not good.notes
    with pytest.raises(UsageError, match=r"column ay.*its name says: it is gzip, a binary file"):
        read_log(write(tmp_path, gzip.compress(b"t,vx\n1,2\n"), "short.csv"))


TOY = """
import numpy as np
import pandas as pd
from crosscomb.logs.formats.table import Columns

def recognises(data):
    return data.startswith(b"TOY\\0")

def open_log(content, source, reader):
    names, *rows = (line.split("|") for line in content.whole()[4:].decode().splitlines())
    table = np.array(rows, dtype=float)
    index = pd.RangeIndex(2, 2 + len(table), name="row")
    return Columns(
        names, "row 1", lambda wanted: [pd.DataFrame({name: table[:, at] for name, at in wanted.items()}, index)]
    )
"""


def test_a_new_format_is_one_file_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, TOY, "toy_format.py")
    monkeypatch.syspath_prepend(tmp_path)
    csv = [entry for entry in FORMATS if entry.name == "CSV"]
    monkeypatch.setattr("crosscomb.logs.formats.table.FORMATS", csv)
    toy = ("TOY\0" + GOOD.replace(",", "|")).encode()
    folder = tmp_path / "logs"
    folder.mkdir()
    logs = [write(folder, toy, "a.toy"), write(folder, toy, "b.csv"), write(folder, GOOD, "c.csv")]
    logs += [write(folder, GOOD, "d.toy")]
    assert find_logs(folder) == logs[1:3]
    with pytest.raises(UsageError, match=r"a\.toy: not a \.csv or \.csv\.gz file"):
        read_log(logs[0])
    with pytest.raises(UsageError, match=r"b\.csv: is a binary file"):
        read_log(logs[1])

    toy_line = Format("toy", (".toy",), "toy_format")
    monkeypatch.setattr("crosscomb.logs.formats.table.FORMATS", [*csv, toy_line])

    assert find_logs(folder) == logs
    read = [read_log(path) for path in logs]
    assert [log.name for log in read] == ["a", "b", "c", "d"]
    for log in read:
        pd.testing.assert_frame_equal(log.frame, read[2].frame, check_exact=True)
    assert [len(log.notes) for log in read] == [0, 1, 0, 1]
    assert "it is toy" in read[1].notes[0]
    with pytest.raises(UsageError, match=r"not a \.csv, \.csv\.gz or \.toy file"):
        log_name("e.mat")

"""Hostile files: one line, exit code 2, and no name that steers the terminal."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from crosscomb.checked import LARGEST
from crosscomb.errors import UsageError, printable, shown
from crosscomb.logs.channel_map import load_map
from crosscomb.models.vehicle import Vehicle, load_vehicle, vehicle_text
from crosscomb.run.tuned import load_tuned
from crosscomb.selection.artefact import load_artefact

DEEP = 100_000
HUGE = "9" * 4000

MAPS = {
    "nested": "a = " + "[" * DEEP,
    "nested tables": "a = " + "{b = " * DEEP,
    "a key of many parts": "a." * DEEP + "b = 1",
    "a huge whole number": f"[reader]\nheader_row = {HUGE}9",
    "a hexadecimal one": f"[reader]\nheader_row = 1\nfirst_data_row = 0x-{HUGE}",
    "a huge factor": f"[channels.ay]\nscale = {HUGE}",
    "infinity": "[channels.ay]\nscale = inf",
    "NaN": "[channels.ay]\noffset = nan",
    "a truth value as a number": "[channels.ay]\nscale = true",
    "a truth value as a sign": "[channels.ay]\nsign = true",
    "a text as a number": '[channels.ay]\nscale = "2"',
    "a text in a list": '[accelerometer]\nposition = ["1", 0]',
    "a long text": f'[channels.ay]\nscale = "{"x" * DEEP}"',
    "a long key": f"{'x' * DEEP} = 1",
    "a separator that ends lines": '[reader]\nseparator = "\\n"',
    "large": "#" * 300_000,
    "no UTF-8": b"\xff\xfe[\x00",
    "zeros": b"\0" * 100,
}


def one_line(run: Callable[[], object], *words: str) -> None:
    with pytest.raises(UsageError) as refusal:
        run()
    text = str(refusal.value)
    assert len(text) < 1000
    assert all(word in text for word in words), text


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("kind", MAPS)
def test_a_hostile_channel_map_is_refused(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / "map.toml", MAPS[kind])
    one_line(lambda: load_map(path), str(path))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mass", "true"),
        ("mass", '"1500"'),
        ("mass", "1e308"),
        ("mass", HUGE),
        ("name", "1"),
        ("mass", "-nan"),
    ],
)
def test_a_hostile_vehicle_file_is_refused(tmp_path: Path, car: Vehicle, key: str, value: str) -> None:
    lines = vehicle_text(car).splitlines()
    text = "\n".join(f"{key} = {value}" if line.startswith(f"{key} = ") else line for line in lines)
    one_line(lambda: load_vehicle(write(tmp_path / "car.toml", text)), key)


def test_whole_numbers_serve_as_numbers(tmp_path: Path, car: Vehicle) -> None:
    text = vehicle_text(car).replace("mass = 1450.0", "mass = 1450")
    assert "mass = 1450\n" in text
    assert load_vehicle(write(tmp_path / "car.toml", text)) == car


@pytest.fixture(scope="module")
def hybrid() -> dict[str, Any]:
    """The shipped artefact of all kinds of tables, with one network of each kind."""
    content = load_artefact("hybrid").model_dump(mode="json")
    for part in ("network", "doubt"):
        content["correction"][part]["members"] = content["correction"][part]["members"][:1]
        content["correction"][part]["trees"] = None
    content["training"] = {}
    content["correction"]["network"]["trees"] = {
        "baseline": [1e37], "roots": [0], "feature": [0, -1, -1], "threshold": [0.0, 0.0, 0.0],
        "left": [1, -1, -1], "right": [2, -1, -1], "value": [0.0, 1.0, -1.0],
    }  # fmt: skip
    return content


NETWORK = ("correction", "network")
VALUES: dict[str, tuple[tuple[str | int, ...], Any, str]] = {
    "a weight of 1e308": ((*NETWORK, "members", 0, "first", 0, 0), 1e308, "first"),
    "a weight beyond single precision": ((*NETWORK, "members", 0, "output_bias"), 3.5e38, "output_bias"),
    "weights that overflow together": ((*NETWORK, "members", 0, "second", 0, 0), 1e38, "overflow"),
    "a unit that overflows": ((*NETWORK, "unit"), 1e308, "overflow"),
    "a scale that divides by zero": ((*NETWORK, "scale", 0), 1e-300, "scale"),
    "a scale that is zero turned over": ((*NETWORK, "scale", 0), 3.3e38, "scale"),
    "trees that overflow": ((*NETWORK, "trees", "value", 1), 3.4e38, "add up"),
    "trees that overflow in their unit": (("correction", "network", "unit"), 3.4e38, "overflow"),
    "a threshold beyond single precision": (("tree", "threshold", 0), -1e39, "threshold"),
    "a range beyond it": (("correction", "highest", 0), 1e308, "highest"),
    "a huge feature of a leaf": ((*NETWORK, "trees", "feature", 1), 10**30, "feature"),
    "a root that is none": ((*NETWORK, "trees", "roots", 0), -1, ""),
    "a truth value": (("rate",), True, "rate"),
    "a number in a text": (("rate",), "100", "rate"),
    "a huge setting": (("filters", 0, "settings", "noise"), {"yaw_rate": 10**400}, ""),
    "a nested setting": (("filters", 0, "settings", "noise"), {"yaw_rate": [[[[[[[[[[]]]]]]]]]]}, ""),
    "NaN": (("trust", "scale"), float("nan"), "scale"),
    "infinity": (("switch", "slew"), float("inf"), "slew"),
}


@pytest.mark.parametrize("kind", VALUES)
def test_a_hostile_artefact_is_refused(tmp_path: Path, hybrid: dict[str, Any], kind: str) -> None:
    keys, value, word = VALUES[kind]
    content = json.loads(json.dumps(hybrid))
    path = write(tmp_path / "a.json", json.dumps(content))
    assert load_artefact(path).correction is not None
    part = content
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    write(path, json.dumps(content))
    one_line(lambda: load_artefact(path), str(path), word)


@pytest.mark.parametrize(
    "text",
    [
        "[" * DEEP,
        '{"a":' * DEEP,
        f'{{"schema_version": {HUGE}99999999}}',
        f'{{"schema_version": "{HUGE}"}}',
        "[]",
        "1",
    ],
)
@pytest.mark.parametrize("load", [load_artefact, lambda path: load_tuned(path, ["dynamic_ekf"])])
def test_text_that_is_no_artefact_is_refused(
    tmp_path: Path, load: Callable[[Path], object], text: str
) -> None:
    path = write(tmp_path / "a.json", text)
    one_line(lambda: load(path), str(path))


def test_a_hostile_tuned_file_is_refused(tmp_path: Path) -> None:
    content = {
        "schema_version": 1,
        "by": "error",
        "filters": [{"name": "dynamic_ekf", "noise": {"yaw_rate": 1e39}}],
    }
    path = write(tmp_path / "tuned.json", json.dumps(content))
    one_line(lambda: load_tuned(path, ["dynamic_ekf"]), str(path), "yaw_rate")


def test_learned_numbers_end_where_single_precision_does() -> None:
    import numpy as np

    assert float(np.finfo(np.float32).max) == LARGEST


COMMANDS: list[tuple[str, list[str]]] = [
    (".toml", ["estimate", "LOG", "--vehicle", "FILE"]),
    (".toml", ["estimate", "LOG", "--map", "FILE"]),
    (".json", ["estimate", "LOG", "--selector-file", "FILE"]),
    (".json", ["estimate", "LOG", "--tuned", "FILE"]),
    (".csv", ["estimate", "FILE"]),
    (".csv", ["check", "FILE"]),
]


@pytest.fixture
def refuse(crosscomb, data_set: Path, tmp_path: Path) -> Callable[..., str]:
    """Give a file to a command and get its one line."""
    log = next(data_set.glob("*.csv"))

    def run(command: list[str], file: Path) -> str:
        ran = crosscomb(
            *(str(log) if word == "LOG" else str(file) if word == "FILE" else word for word in command)
        )
        assert (ran.code, ran.out) == (2, "")
        assert ran.err.startswith("error: ")
        assert ran.err.count("\n") == 1
        assert ran.err[:-1].isprintable()
        return ran.err

    return run


@pytest.mark.skipif(os.name != "posix", reason="needs devices and pipes")
@pytest.mark.parametrize(("end", "command"), COMMANDS)
def test_devices_pipes_and_loops_are_refused(tmp_path: Path, refuse, end: str, command: list[str]) -> None:
    zero, pipe, loop, bad = (tmp_path / f"{name}{end}" for name in ("zero", "pipe", "loop", "n\x1b[2Jo"))
    zero.symlink_to("/dev/zero")
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for path in (zero, pipe):
        assert "is a device or a pipe" in refuse(command, path)
    assert "cannot be read" in refuse(command, loop)
    assert "n\\x1b[2Jo" in refuse(command, bad)
    assert refuse(command, tmp_path / ("x" * 5000 + end))
    assert "\\udcff" in refuse(command, Path(os.fsdecode(os.fsencode(tmp_path) + b"/n\xffo" + end.encode())))


LOGS = {
    "a name with an escape": b"t,vx,a\x1b]0;owned\x07y,yaw_rate,steer\n0,1,1,1,1\n",
    "a cell with an escape": "t,vx,ay,yaw_rate,steer\n0,1,\u202e1,1,1\n".encode(),
    "a name that is no UTF-8": b"t,vx,a\xffy,yaw_rate,steer\n0,1,1,1,1\n",
    "a huge number": f"t,vx,ay,yaw_rate,steer\n{HUGE},1,1,1,1\n{HUGE}0,1,1,1,1\n".encode(),
    "infinite times": b"t,vx,ay,yaw_rate,steer\ninf,1,1,1,1\n1,1,1,1,1\n",
    "a long line": b"t," + b"x" * 20_000_000,
    "a long cell": b"t,vx,ay,yaw_rate,steer\n0,1,1,1," + b"1" * 20_000,
}


@pytest.mark.parametrize("kind", LOGS)
def test_a_hostile_log_is_refused(tmp_path: Path, refuse, kind: str) -> None:
    path = write(tmp_path / "log.csv", LOGS[kind])
    for command in (["check", "FILE"], ["estimate", "FILE"]):
        assert str(path) in refuse(command, path)


@pytest.mark.skipif(os.name != "posix", reason="file names are bytes only there")
def test_names_do_not_steer_the_terminal(crosscomb, data_set: Path, tmp_path: Path, car: Vehicle) -> None:
    name = os.fsdecode(b"a\x1b[31m\xff\xe2\x80\xaeb")
    log = tmp_path / f"{name}.csv"
    log.write_bytes(next(data_set.glob("*.csv")).read_bytes())
    evil = car.model_copy(update={"name": "car\x1b[2J"})
    (tmp_path / "vehicle.toml").write_text(vehicle_text(evil))
    words = ["--handling", "--plot"]
    for command in (["check", log], ["estimate", log, *words, "-o", tmp_path / f"out{name}"]):
        ran = crosscomb(*command)
        assert (ran.code, ran.err) == (0, "")
        assert ran.out.replace("\n", "").isprintable()
        assert "\\x1b[" in ran.out
    assert len(list((tmp_path / f"out{name}").iterdir())) == 4


def test_what_messages_show_is_short_and_printable() -> None:
    assert printable("plain ü ☺") == "plain ü ☺"
    assert printable("a\x1b[0m\u202e\udcff\n", "\n") == "a\\x1b[0m\\u202e\\udcff\n"
    assert shown(1 << 40_000) == "a huge number"
    nested: list[Any] = []
    for _ in range(DEEP):
        nested = [nested]
    assert len(shown(nested)) < 100


def test_a_file_for_tables_that_is_no_text_stays_as_it_is(tmp_path: Path) -> None:
    from crosscomb.report.markdown import write_section

    path = write(tmp_path / "notes.md", b"\xff\xfe")
    one_line(lambda: write_section(path, "speed", "text"), "no UTF-8 text")
    assert path.read_bytes() == b"\xff\xfe"


@pytest.mark.parametrize("text", ["[]", '{"logs": 1}', '{"logs": [1]}', "[" * DEEP, "\0", '{"logs": [{}]}'])
def test_a_card_that_is_not_ours_says_nothing(tmp_path: Path, car: Vehicle, text: str) -> None:
    from crosscomb.signals import Signals
    from crosscomb.training.recordings import CARD, Recording
    from crosscomb.training.selectors.compare import driving_of

    write(tmp_path / CARD, text)
    recording = Recording("a", tmp_path / "a.csv", car, Signals("a", None))  # type: ignore[arg-type]
    assert driving_of(recording) == ("", "")

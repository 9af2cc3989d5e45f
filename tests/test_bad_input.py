"""Bad input: exit code 2, one line that names the place and the mend, and no output file."""

import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.selection.artefact import load_artefact
from crosscomb.signals import Signals
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.bank import run_bank
from crosscomb.training.selectors.fit import SELECTORS
from crosscomb.training.selectors.train import default_filters


@dataclass
class Place:
    """A folder with a good log, its vehicle file and a good artefact, to be spoilt."""

    folder: Path
    log: Path
    vehicle: Path
    artefact: Path
    frame: pd.DataFrame

    def write(self, frame: pd.DataFrame) -> None:
        frame.to_csv(self.log, index=False)

    def cell(self, row: int, column: str, text: str) -> None:
        """Put a text into a cell; rows as in the file, the header is row 1."""
        lines = self.log.read_text().splitlines()
        cells = lines[row - 1].split(",")
        cells[list(self.frame).index(column)] = text
        lines[row - 1] = ",".join(cells)
        self.log.write_text("\n".join(lines) + "\n")

    def change(self, *keys: str | int, value: object) -> None:
        """Change a value of the artefact."""
        content = json.loads(self.artefact.read_text())
        part = content
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = value
        self.artefact.write_text(json.dumps(content))


@pytest.fixture(scope="module")
def good(simulated: list[Signals]) -> pd.DataFrame:
    """A lively log that ties its channels together."""
    return simulated[0].frame


@pytest.fixture
def place(good: pd.DataFrame, car, write_log, write_vehicle, tmp_path: Path) -> Place:
    folder = tmp_path / "in"
    folder.mkdir()
    artefact = folder / "mine.json"
    artefact.write_text(json.dumps(load_artefact().model_dump(mode="json")))
    log = write_log(good, folder / "log.csv")
    return Place(folder, log, write_vehicle(folder, car), artefact, good)


def refused(ran, output: Path, *words: str) -> None:
    assert ran.code == 2
    assert ran.err.startswith("error: ")
    assert ran.err.count("\n") == 1
    assert "Traceback" not in ran.err
    assert ran.out == ""
    for word in words:
        assert word in ran.err
    assert not output.exists()


def columns(place: Place, **new: object) -> None:
    place.write(place.frame.assign(**new))


def nth(place: Place, row: int, column: str, value: float) -> None:
    frame = place.frame.copy()
    frame.loc[row - 2, column] = value
    place.write(frame)


LOGS: dict[str, tuple[Callable[[Place], object], list[str]]] = {
    "missing file": (lambda p: p.log.unlink(), ["log.csv", "no such file"]),
    "empty file": (lambda p: p.log.write_bytes(b""), ["log.csv", "empty"]),
    "blank lines only": (lambda p: p.log.write_bytes(b"\n \n\n"), ["log.csv", "empty"]),
    "header only": (lambda p: p.write(p.frame[:0]), ["log.csv", "no data rows"]),
    "one row": (lambda p: p.write(p.frame[:1]), ["log.csv", "one data row", "longer log"]),
    "binary": (lambda p: p.log.write_bytes(bytes(range(256)) * 9), ["log.csv", "binary", "CSV"]),
    "packed but called .csv": (lambda p: p.log.write_bytes(gzip.compress(b"t,vx\n")), ["log.csv", "binary"]),
    "missing column ay": (lambda p: p.write(p.frame.drop(columns="ay")), ["column ay", "missing", "--map"]),
    "missing column t": (lambda p: p.write(p.frame.drop(columns="t")), ["column t", "missing"]),
    "missing column yaw_rate": (lambda p: p.write(p.frame.drop(columns="yaw_rate")), ["column yaw_rate"]),
    "missing steering": (
        lambda p: p.write(p.frame.drop(columns=["steer", "steer_wheel"])),
        ["column steer", "steer_wheel"],
    ),
    "missing speed": (lambda p: p.write(p.frame.drop(columns=["vx", "vrl"])), ["column vx", "wheel speeds"]),
    "a column twice": (
        lambda p: p.log.write_text(p.log.read_text().replace("t,vx,ax,", "t,vx,vx,", 1)),
        ["column vx", "twice", "rename or delete"],
    ),
    "no header": (lambda p: p.frame.to_csv(p.log, index=False, header=False), ["row 1", "header"]),
    "text in a number column": (lambda p: p.cell(17, "ay", "fast"), ["row 17", "column ay", "'fast'"]),
    "text in the last row": (lambda p: p.cell(1501, "steer", "#REF!"), ["row 1501", "column steer"]),
    "time backwards": (
        lambda p: columns(p, t=p.frame["t"].to_numpy()[::-1]),
        ["row 3", "column t", "backwards", "sort"],
    ),
    "time repeated": (
        lambda p: columns(p, t=p.frame["t"].round(1)),
        ["row 3", "column t", "repeats"],
    ),
    "no time in a row": (lambda p: p.cell(40, "t", ""), ["row 40", "column t"]),
    "time in milliseconds": (lambda p: columns(p, t=1e3 * p.frame["t"]), ["column t", "ms"]),
    "a field too many": (lambda p: p.cell(12, "ay", "1,5"), ["row 12", "fields"]),
    "all-NaN ay": (lambda p: columns(p, ay=np.nan), ["column ay", "no value"]),
    "all-NaN yaw_rate": (lambda p: columns(p, yaw_rate=np.nan), ["column yaw_rate", "no value"]),
    "all-NaN steering": (
        lambda p: columns(p, steer=np.nan, steer_wheel=np.nan),
        ["column steer", "no value"],
    ),
    "all-NaN speed": (lambda p: columns(p, vx=np.nan, vfl=np.nan), ["column vx", "no value"]),
    "steer in degrees": (
        lambda p: columns(p, steer=np.degrees(p.frame["steer"])),
        ["column steer", "deg", '[channels.steer] unit = "deg"'],
    ),
    "yaw rate in degrees": (
        lambda p: columns(p, yaw_rate=np.degrees(p.frame["yaw_rate"])),
        ["column yaw_rate", "deg/s", '[channels.yaw_rate] unit = "deg/s"'],
    ),
    "vx in km/h": (
        lambda p: columns(p, vx=3.6 * p.frame["vx"]),
        ["column vx", "km/h", '[channels.vx] unit = "km/h"'],
    ),
    "wheel speeds in km/h": (
        lambda p: columns(p, **{w: 3.6 * p.frame[w] for w in ("vfl", "vfr", "vrl", "vrr")}),
        ["column vfl", "km/h", "[channels.vfl]"],
    ),
    "vx in km/h without wheels": (
        lambda p: p.write(
            p.frame.assign(vx=3.6 * p.frame["vx"], vx_ref=np.nan).drop(columns=["vfl", "vfr", "vrl", "vrr"])
        ),
        ["column vx", "km/h"],
    ),
    "ay in g": (lambda p: columns(p, ay=p.frame["ay"] / 9.81), ["column ay", '[channels.ay] unit = "g"']),
}

VEHICLES: dict[str, tuple[Callable[[str], str], list[str]]] = {
    "unknown key": (lambda text: text + "colour = 1\n", ["unknown key colour"]),
    "misspelt key": (lambda text: text.replace("friction", "frction"), ["unknown key frction"]),
    "negative mass": (lambda text: text.replace("mass = 1450.0", "mass = -1450.0"), ["mass", "-1450"]),
    "mass in tonnes": (lambda text: text.replace("mass = 1450.0", "mass = 1.45"), ["mass", "1.45"]),
    "mass missing": (lambda text: text.replace("mass = 1450.0\n", ""), ["key mass is missing"]),
    "text for a number": (lambda text: text.replace("mass = 1450.0", 'mass = "heavy"'), ["mass", "heavy"]),
    "NaN": (lambda text: text.replace("mass = 1450.0", "mass = nan"), ["mass"]),
    "no TOML": (lambda text: text + "mass 1450\n", ["no valid TOML"]),
    "empty": (lambda text: "", ["key name is missing"]),
}

ARTEFACTS: dict[str, tuple[Callable[[Place], object], list[str]]] = {
    "missing": (lambda p: p.artefact.unlink(), ["no such artefact", "crosscomb train"]),
    "no JSON": (lambda p: p.artefact.write_text("tree"), ["line 1", "no valid JSON"]),
    "binary": (lambda p: p.artefact.write_bytes(b"\x80\x81"), ["cannot be read"]),
    "older schema": (lambda p: p.change("schema_version", value=0), ["schema version 0", "train"]),
    "newer schema": (lambda p: p.change("schema_version", value=99), ["schema version 99"]),
    "unknown key": (lambda p: p.change("colour", value=1), ["unknown key colour"]),
    "child out of range": (lambda p: p.change("tree", "left", 0, value=10**6), ["node 0", "child"]),
    "cycle": (lambda p: p.change("tree", "right", 0, value=0), ["node 0", "child"]),
    "feature out of range": (lambda p: p.change("tree", "feature", 0, value=-1), ["node 0", "feature"]),
    "uneven arrays": (lambda p: p.change("tree", "threshold", value=[1.0]), ["differ in length"]),
    "unknown filter": (lambda p: p.change("filters", 1, "name", value="magic"), ["magic", "catalogue"]),
    "unknown filter setting": (
        lambda p: p.change("filters", 1, "settings", "mu", value=1.0),
        ["dynamic_ekf", "mu"],
    ),
    "window too long": (lambda p: p.change("window", "length", value=10**9), ["window.length"]),
}


@pytest.mark.parametrize("fault", LOGS)
def test_a_bad_log_is_refused(crosscomb, place, tmp_path, fault):
    spoil, words = LOGS[fault]
    spoil(place)
    ran = crosscomb("estimate", place.log, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", str(place.log), *words)


def test_the_log_was_good_before(crosscomb, place, tmp_path):
    ran = crosscomb("estimate", place.log, "--selector-file", place.artefact, "-o", tmp_path / "out")
    assert (ran.code, ran.err) == (0, "")


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("channel", ["vx", "ay", "yaw_rate", "steer"])
def test_one_absurd_value_is_no_reason_to_refuse_and_none_to_warn(crosscomb, place, tmp_path, channel):
    nth(place, 300, channel, 1e300)
    for ran in (crosscomb("check", place.log), crosscomb("estimate", place.log, "-o", tmp_path / "out")):
        assert (ran.code, ran.err) == (0, "")


@pytest.mark.parametrize("fault", VEHICLES)
def test_a_bad_vehicle_file_is_refused(crosscomb, place, tmp_path, fault):
    spoil, words = VEHICLES[fault]
    text = place.vehicle.read_text()
    place.vehicle.write_text(spoil(text))
    assert place.vehicle.read_text() != text
    ran = crosscomb("estimate", place.log, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", str(place.vehicle), *words)
    ran = crosscomb("simulate", tmp_path / "out", "--vehicle", place.vehicle, "--logs", 1)
    refused(ran, tmp_path / "out", str(place.vehicle), *words)


def test_a_vehicle_that_is_not_there_is_refused(crosscomb, place, tmp_path):
    for name in (tmp_path / "none.toml", "volvo_s09"):
        ran = crosscomb("estimate", place.log, "--vehicle", name, "-o", tmp_path / "out")
        refused(ran, tmp_path / "out", str(name), "no such vehicle file")


@pytest.mark.parametrize("fault", ARTEFACTS)
def test_a_bad_artefact_is_refused(crosscomb, place, tmp_path, fault):
    spoil, words = ARTEFACTS[fault]
    spoil(place)
    ran = crosscomb("estimate", place.log, "--selector-file", place.artefact, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", str(place.artefact), *words)
    ran = crosscomb("benchmark", "simulated", "--selector-file", place.artefact, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", str(place.artefact), *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[channels.vx]\nunit = "parsec/h"\n', ["channels.vx", "parsec/h", "km/h"]),
        ("[channels.vxx]\nsign = -1\n", ["vxx", "vx"]),
        ("[channels.ay]\nsing = -1\n", ["unknown key", "sing"]),
        ('[channels.ay]\ncolumn = "acc"\n', ["'acc'", "missing"]),
        ("channels\n", ["no valid TOML"]),
    ],
)
def test_a_bad_channel_map_is_refused(crosscomb, place, tmp_path, text, words):
    (tmp_path / "map.toml").write_text(text)
    ran = crosscomb("estimate", place.log, "--map", tmp_path / "map.toml", "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", *words)
    ran = crosscomb("estimate", place.log, "--map", tmp_path / "no.toml", "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", "no.toml", "no such channel map")


def test_other_kinds_of_file_are_refused(crosscomb, place, tmp_path):
    for name in ("log.mat", "log.csv.zip", "log"):
        (tmp_path / name).write_bytes(place.log.read_bytes())
        refused(crosscomb("estimate", tmp_path / name, "-o", tmp_path / "out"), tmp_path / "out", name, "CSV")
    refused(
        crosscomb("estimate", place.folder, "-o", tmp_path / "out"),
        tmp_path / "out",
        str(place.folder),
        "folder",
    )
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(place.log.read_bytes())[:-100])
    refused(
        crosscomb("estimate", tmp_path / "cut.csv.gz", "-o", tmp_path / "out"),
        tmp_path / "out",
        "cut.csv.gz",
        "damaged",
    )


def test_a_column_with_a_line_break_in_its_name_is_still_one_line(crosscomb, place, tmp_path):
    text = place.log.read_text()
    place.log.write_text(text.replace("ay,", '"a\ny",', 1))
    ran = crosscomb("estimate", place.log, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", str(place.log))


# Training


def copies(place: Place, count: int) -> None:
    for number in range(1, count):
        place.frame.to_csv(place.folder / f"log{number}.csv", index=False)


def train(crosscomb, place: Place, tmp_path: Path, *words: object):
    return crosscomb("train", place.folder, "-o", tmp_path / "out" / "a.json", "--jobs", 1, *words)


@pytest.mark.parametrize("fault", ["time repeated", "text in a number column", "steer in degrees", "binary"])
def test_training_names_the_one_broken_log_and_computes_nothing(
    crosscomb, place, tmp_path, monkeypatch, fault
):
    copies(place, 7)

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("nothing may be computed")

    monkeypatch.setattr("crosscomb.training.selectors.train.fill_shelf", forbidden)
    LOGS[fault][0](place)
    refused(train(crosscomb, place, tmp_path), tmp_path / "out", str(place.log), *LOGS[fault][1])


def test_training_needs_seven_recordings(crosscomb, place, tmp_path):
    copies(place, 6)
    ran = train(crosscomb, place, tmp_path)
    refused(ran, tmp_path / "out", str(place.folder), "6 recordings", "at least 7", "simulate")


def test_training_needs_two_classes(crosscomb, recordings: list[Recording], data_set, tmp_path):
    banks = run_bank(recordings, default_filters(recordings[0].vehicle), 100.0, SELECTORS["tree"].window)
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "vehicle.toml").write_bytes((data_set / "vehicle.toml").read_bytes())
    for recording, bank in zip(recordings[:7], banks[:7], strict=True):
        frame = recording.signals.frame.drop(columns=["vx_ref", "vy_ref"])
        frame = frame.assign(beta_ref=bank.joined(lambda run: run.beta)[:, 1])
        frame.to_csv(folder / f"{recording.name}.csv", index=False)
    ran = crosscomb("train", folder, "-o", tmp_path / "out" / "a.json", "--jobs", 1, "--tune-budget", 0)
    refused(ran, tmp_path / "out", str(folder), "dynamic_ekf is best in every window", "add recordings")


def test_training_refuses_what_it_does_not_know(crosscomb, place, tmp_path):
    copies(place, 7)
    ran = train(crosscomb, place, tmp_path, "--selector", "forest")
    refused(ran, tmp_path / "out", "forest", "tree", "paper")
    ran = crosscomb("train", place.folder, "-o", tmp_path / "out" / "a.pkl")
    refused(ran, tmp_path / "out", "a.pkl", ".json")
    ran = crosscomb("train", tmp_path / "none", "-o", tmp_path / "out" / "a.json")
    refused(ran, tmp_path / "out", str(tmp_path / "none"), "no such")
    place.vehicle.unlink()
    refused(
        train(crosscomb, place, tmp_path), tmp_path / "out", str(place.folder), "vehicle.toml", "--vehicle"
    )


def test_benchmark_refuses_what_it_does_not_know(crosscomb, place, tmp_path):
    out = tmp_path / "out"
    refused(crosscomb("benchmark", "imaginary", "-o", out), out, "imaginary", "real", "simulated")
    refused(crosscomb("benchmark", "real", "-o", out), out, "--data")
    refused(crosscomb("benchmark", "real", "--data", tmp_path / "none", "-o", out), out, "none", "no such")
    columns(place, beta_ref=np.nan, vx_ref=np.nan, vy_ref=np.nan)
    refused(
        crosscomb("benchmark", "real", "--data", place.folder, "-o", out),
        out,
        str(place.folder),
        "ground truth",
    )


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [("--mass", -1500, "mass"), ("--wheelbase", 2600, "wheelbase"), ("--front-share", 60, "front")],
)
def test_vehicle_refuses_impossible_basics(crosscomb, tmp_path, option, value, word):
    basics = {"--mass": 1500, "--wheelbase": 2.6, "--front-share": 0.6} | {option: value}
    words = [part for pair in basics.items() for part in pair]
    ran = crosscomb("vehicle", "Car", *words, "-o", tmp_path / "out")
    refused(ran, tmp_path / "out", word)

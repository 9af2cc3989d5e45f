"""Fuzzing of everything that reads: logs, channel maps, vehicle, tuned and artefact files, and signals themselves.

    python benchmarks/fuzz.py --inputs 100000                 # hypothesis, every night
    python benchmarks/fuzz.py --engine atheris --only log     # guided by coverage, where atheris is installed

Each input is refused in one line or gives finite answers. Prints how many inputs ran, how many of them were accepted,
and every traceback, with the first input that gave it; the exit code is 1 where there is one. tests/test_fuzz.py runs
a few of the same inputs.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import ChannelMap, apply_map, load_map
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import Vehicle, load_vehicle, vehicle_text
from crosscomb.run.estimate import LogEstimate, estimate_log
from crosscomb.run.tuned import load_tuned
from crosscomb.selection.artefact import Artefact, load_artefact
from crosscomb.signals import UNITS, Signals

FOLDER = Path(tempfile.mkdtemp(prefix="fuzz-"))

HUGE = ("9" * 400, "1e308", "-1e308", "1e400", "0x" + "f" * 300, "9" * 5000)
WORDS = (
    *(
        "nan",
        "inf",
        "-inf",
        "NaN",
        "Infinity",
        "",
        "-",
        "true",
        "null",
        "1,5",
        "1.2.3",
        "1e",
        "--",
        "\x1b[2J",
        '"',
    ),
    *("\ud7ff", "'", "# no", "\u202e", "0", "-0", "1_000", "+1", " 1 ", "1e-320", "a" * 300),
)
NUMBERS = st.one_of(
    st.floats(-100.0, 100.0), st.floats(allow_nan=True, allow_infinity=True), st.integers(-(10**6), 10**6)
)


def encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def changed(text: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    """A text as bytes, now and then with some of them replaced by others."""

    def change(drawn: tuple[str, list[tuple[int, int, bytes]]]) -> bytes:
        data = encoded(drawn[0])
        for place, length, new in drawn[1]:
            at = place % (len(data) + 1)
            data = data[:at] + new + data[at + length :]
        return data

    new = st.one_of(
        st.binary(max_size=8), st.sampled_from([*WORDS, "[", "]", "{", "}", ",", "\n", "="]).map(encoded)
    )
    edits = st.lists(st.tuples(st.integers(0, 10**5), st.integers(0, 9), new), max_size=3)
    return st.tuples(text, st.integers(0, 3).flatmap(lambda n: st.just([]) if n else edits)).map(change)


@st.composite
def logs(draw: st.DrawFn) -> str:
    """Text of a log: mostly sound columns and numbers, with odd ones among them."""
    separator, end = draw(st.sampled_from([",", ";", "\t", " "])), draw(st.sampled_from(["\n", "\r\n", "\r"]))
    known = draw(st.lists(st.sampled_from(list(UNITS)), max_size=4))
    odd = draw(st.lists(st.one_of(st.sampled_from(WORDS), st.text(max_size=8)), max_size=2))
    names = ["t", "vx", "ay", "yaw_rate", "steer", *known, *odd]
    if draw(st.integers(0, 3)):
        names = list(dict.fromkeys(names))
    if draw(st.booleans()):
        names = draw(st.permutations(names))
    step = draw(st.sampled_from([0.01] * 8 + [0.1, 0.0, -0.01, 1e-9, 1e6]))
    rows = []
    for row in range(draw(st.integers(0, 12))):
        cells = [f"{row * step:.6g}" if name == "t" else f"{row % 7 / 8}" for name in names]
        rows.append(cells)
    cell = st.one_of(NUMBERS.map(repr), st.sampled_from(WORDS + HUGE))
    for _ in range(draw(st.sampled_from([0, 0, 1, 1, 2, 4])) if rows else 0):
        draw(st.sampled_from(rows))[draw(st.integers(0, len(names) - 1))] = draw(cell)
    if rows and draw(st.booleans()):
        rows.append(list(draw(st.sampled_from(rows))))
    if rows and draw(st.integers(0, 5)) == 0:
        del draw(st.sampled_from(rows))[-1]
    return end.join(separator.join(cells) for cells in [names, *rows]) + draw(
        st.sampled_from([end, "", end * 3])
    )


def toml_value(value: Any) -> str:
    """A value as TOML writes it; what it has no word for becomes text."""
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return json.dumps(value) if isinstance(value, bool | int | float) else json.dumps(str(value))


VALUES = st.one_of(
    NUMBERS, st.booleans(), st.sampled_from(WORDS), st.text(max_size=6), st.lists(NUMBERS, max_size=3),
    st.sampled_from([10**30, -(10**400), 1e308, -1e308, 3.5e38, 1e-320, -1, 2**31, 2**63]),
)  # fmt: skip
RAW = st.one_of(
    VALUES.map(toml_value), st.sampled_from([*HUGE, "[" * 2000, "{a=" * 2000, "1979-05-27", "''''"])
)
SOUND = {
    "channels": {
        "column": ['"ay"', '"vx"'], "unit": ['"deg"', '"m/s"', '"g"', '"deg/s"', '"s"'], "sign": ["1", "-1"],
        "scale": ["2", "0.5"], "offset": ["0.1", "-3"], "delay": ["0.1", "0", "0.013"], "sing": ["1"],
    },
    "reader": {
        "separator": ['","', '";"', '" "'], "decimal": ['"."', '","'], "header_row": ["1", "2"],
        "first_data_row": ["2", "3"], "comment": ['"#"', '""'], "time_from_zero": ["true", "false"],
    },
}  # fmt: skip


@st.composite
def tables(draw: st.DrawFn, kind: str) -> dict[str, str]:
    """Keys of a table of a channel map, mostly with sound values."""
    keys = draw(st.lists(st.sampled_from(list(SOUND[kind])), max_size=4, unique=True))
    odd = draw(st.integers(0, 7))  # the place of an odd value, or none
    return {
        key: draw(RAW if place == odd else st.sampled_from(SOUND[kind][key]))
        for place, key in enumerate(keys)
    }


@st.composite
def maps(draw: st.DrawFn) -> str:
    """Text of a channel map."""
    usual = ["t", "vx", "ay", "yaw_rate", "steer"]
    names = draw(st.lists(st.sampled_from([*usual * 4, *UNITS, "vxx"]), max_size=3, unique=True))
    found = {f"channels.{name}": draw(tables("channels")) for name in names}
    if draw(st.booleans()):
        found["reader"] = draw(tables("reader"))
    if draw(st.integers(0, 3)) == 0:
        found["accelerometer"] = {"position": draw(st.one_of(RAW, st.just("[0.5, -0.1]")))}
    return "".join(
        f"[{table}]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())
        for table, keys in found.items()
    )


@st.composite
def vehicles(draw: st.DrawFn) -> str:
    """Text of a vehicle file."""
    lines = vehicle_text(load_vehicle("generic_compact")).splitlines()
    for _ in range(draw(st.integers(0, 2))):
        place = draw(st.integers(0, len(lines) - 1))
        lines[place] = f"{lines[place].split(' = ')[0]} = {draw(RAW)}"
    return "\n".join(lines)


@st.composite
def spoilt(draw: st.DrawFn, content: Callable[[], dict[str, Any]]) -> str:
    """A JSON content with some values replaced or left out, as text."""
    copy = json.loads(json.dumps(content()))
    for _ in range(draw(st.integers(0, 2))):
        holder: Any = copy
        while True:
            key = draw(st.sampled_from(list(holder) if isinstance(holder, dict) else range(len(holder))))
            if not holder[key] or not isinstance(holder[key], dict | list) or draw(st.integers(0, 5)) == 0:
                break
            holder = holder[key]
        if draw(st.integers(0, 9)) == 0 and len(holder) > 1:
            del holder[key]
        else:
            holder[key] = draw(st.one_of(VALUES, VALUES, VALUES, st.sampled_from([{}, None, [[[[]]]]])))
    return json.dumps(copy)


@cache
def small_artefact() -> dict[str, Any]:
    """A hybrid artefact with a tree of three nodes and networks of two neurons."""
    content = load_artefact("hybrid").model_dump(mode="json")
    tree, correction = content["tree"], content["correction"]
    classes = len(tree["shares"][0])
    tree.update(
        feature=[0, -2, -2], threshold=[0.5, 0.0, 0.0], left=[1, -1, -1], right=[2, -1, -1],
        shares=[[1.0 / classes] * classes] * 3, picks=[0, 0, classes - 1],
    )  # fmt: skip
    member = {
        "first": [[0.5, -0.5]], "first_bias": [0.1, 0.0], "second": [[1.0, 0.5], [0.5, 1.0]],
        "second_bias": [0.0, 0.1], "output": [1.0, -1.0], "output_bias": 0.1,
    }  # fmt: skip
    trees = {
        "baseline": [0.0], "roots": [0], "feature": [0, -1, -1], "threshold": [0.0] * 3,
        "left": [1, -1, -1], "right": [2, -1, -1], "value": [0.0, 1.0, -1.0],
    }  # fmt: skip
    content["choice"]["trees"] = {**trees, "baseline": [0.0] * classes}
    for part in ("network", "doubt"):
        correction[part].update(
            columns=[0], relative=[-1], mean=[0.0], scale=[1.0], members=[member], trees=trees
        )
    return {**content, "training": {}}


@cache
def small_tuned() -> dict[str, Any]:
    """Tuned noise of one filter."""
    entry = small_artefact()["filters"][0]
    tuned = {"name": entry["name"], "noise": entry["settings"]["noise"]}
    return {"schema_version": 1, "by": "error", "filters": [tuned]}


@cache
def drive(rows: int = 300) -> Signals:
    """A slalom at 20 m/s without noise."""
    t = np.arange(rows) / 100.0
    yaw_rate = 0.3 * np.sin(2.0 * t)
    columns = {"t": t, "vx": 20.0 + 0.0 * t, "ax": 0.0 * t, "ay": 20.0 * yaw_rate, "yaw_rate": yaw_rate}
    return Signals("drive", pd.DataFrame({**columns, "steer": 0.15 * yaw_rate}))


ABSURD = (
    *(np.nan, np.inf, -np.inf, 1e308, -1e308, 1e154, 1e39, -1e39, 571.9, 655.35, 1e-320, 0.0, 1e6, -1e6),
    *(50.0, -50.0, 3.0, 1e12),
)


@st.composite
def signals(draw: st.DrawFn) -> Signals:
    """A drive with absurd values, silent channels and gaps in it."""
    frame = drive().frame.copy()
    for _ in range(draw(st.integers(0, 5))):
        name = draw(st.sampled_from(list(frame.columns[1:])))
        first, length = draw(st.integers(0, len(frame) - 1)), draw(st.sampled_from([1, 1, 2, 10, 100, 300]))
        value = draw(st.one_of(st.sampled_from(ABSURD), st.floats()))
        frame.loc[first : first + length - 1, name] = value
    for _ in range(draw(st.integers(0, 2))):
        frame.loc[draw(st.integers(1, len(frame) - 1)) :, "t"] += draw(
            st.sampled_from([1e-9, 0.05, 1.5, 1e5, 1e9])
        )
    return Signals("fuzz", frame.replace([np.inf, -np.inf], np.nan))


def require_finite(estimate: LogEstimate) -> None:
    """Every row has an angle and how sure it is."""
    assert np.isfinite(estimate.beta).all(), "beta is not finite"
    assert np.isfinite(estimate.beta_std).all(), "beta_std is not finite"
    assert (np.abs(estimate.beta) <= np.pi).all(), "beta is no angle"


def write(name: str, data: bytes) -> Path:
    path = FOLDER / name
    path.write_bytes(data)
    return path


@cache
def shipped(name: str) -> Artefact:
    return load_artefact(name)


def read_a_log(data: bytes, packed: bool) -> None:
    log = read_log(write("log.csv.gz" if packed else "log.csv", gzip.compress(data, 1) if packed else data))
    assert (np.diff(log.t) > 0.0).all()
    assert not np.isinf(log.frame.to_numpy()).any()


def read_a_map(data: bytes) -> None:
    found = load_map(write("map.toml", data))
    assert isinstance(found, ChannelMap)
    log = write("mapped.csv", b"t,vx,ay,yaw_rate,steer\n0,1,1,1,1\n0.1,1,1,1,1\n0.2,2,1,1,1\n")
    read_log(log, found)
    apply_map(drive(20).frame, found, "drive")


def read_a_vehicle(data: bytes) -> None:
    car = load_vehicle(write("car.toml", data))
    assert all(math.isfinite(value) for value in car.model_dump().values() if isinstance(value, float))


def read_tuned(data: bytes) -> None:
    load_tuned(write("tuned.json", data), small_artefact_names())


def small_artefact_names() -> list[str]:
    return [entry["name"] for entry in small_artefact()["filters"]]


def read_an_artefact(data: bytes) -> None:
    artefact = load_artefact(write("artefact.json", data))
    if artefact.rate > 1000.0 or any(e.settings.get("particles", 0) > 1000 for e in artefact.filters):
        return  # sound, but slow
    require_finite(estimate_log(drive(), artefact.vehicle or car(), artefact))


@cache
def car() -> Vehicle:
    return load_vehicle("generic_compact")


def estimate_signals(log: Signals, artefact: str) -> None:
    require_finite(estimate_log(log, car(), shipped(artefact)))


@dataclass(frozen=True)
class Target:
    """What is fuzzed: what reads, what it is given, and how many of 2,000 inputs go to it."""

    run: Callable[..., None]
    inputs: tuple[st.SearchStrategy[Any], ...]
    share: int


TARGETS = {
    "log": Target(read_a_log, (changed(logs()), st.booleans()), 700),
    "map": Target(read_a_map, (changed(maps()),), 400),
    "vehicle": Target(read_a_vehicle, (changed(vehicles()),), 300),
    "tuned": Target(read_tuned, (changed(spoilt(small_tuned)),), 150),
    "artefact": Target(read_an_artefact, (changed(spoilt(small_artefact)),), 250),
    "signals": Target(estimate_signals, (signals(), st.sampled_from(["tree", "hybrid"])), 200),
}


class Tally:
    """What came of the inputs of a target."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.counts: Counter[str] = Counter()
        self.faults: dict[str, str] = {}  # traceback with its first input, by where it arose

    def take(self, *values: Any) -> None:
        """Run one input; what is raised is kept."""
        try:
            self.target.run(*values)
            self.counts["accepted"] += 1
        except UsageError:
            self.counts["refused"] += 1
        except Exception as error:
            self.counts["tracebacks"] += 1
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{type(error).__name__} {frame.filename}:{frame.lineno} {str(error)[:60]}"
            if place not in self.faults:
                shown = [
                    value.frame.to_csv() if isinstance(value, Signals) else repr(value) for value in values
                ]
                self.faults[place] = f"{traceback.format_exc()}input: {' '.join(shown)[:3000]}\n"

    def total(self) -> int:
        """Number of inputs that ran."""
        return sum(self.counts.values())


def test_of(target: Target, take: Callable[..., None], count: int) -> Callable[[], None]:
    """A hypothesis test that gives so many inputs of a target to `take`."""
    quiet = settings(
        max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink), print_blob=True,
    )  # fmt: skip
    return quiet(given(st.tuples(*target.inputs))(lambda values: take(*values)))


def main() -> None:
    """Fuzz, and say what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--only", choices=list(TARGETS), action="append")
    parser.add_argument("--seed", type=int, default=None, help="default: another one each time")
    parser.add_argument("--engine", choices=("hypothesis", "atheris"), default="hypothesis")
    asked = parser.parse_args()
    chosen = {name: target for name, target in TARGETS.items() if not asked.only or name in asked.only}
    start = int(time.time()) if asked.seed is None else asked.seed
    if asked.engine == "atheris":
        guided(next(iter(chosen.values())), asked.inputs)
    faults: list[str] = []
    print(f"seed {start}")
    for name, target in chosen.items():
        count, began = (
            asked.inputs * target.share // sum(t.share for t in chosen.values()),
            time.perf_counter(),
        )
        tally, number = Tally(target), start
        while tally.total() < count:  # hypothesis ends early where it finds nothing new
            before = tally.total()
            seed(number)(test_of(target, tally.take, count - tally.total()))()
            number += 1
            if tally.total() == before:
                break
        said = ", ".join(f"{tally.counts[kind]} {kind}" for kind in ("accepted", "refused", "tracebacks"))
        print(f"{name}: {tally.total()} inputs, {said}, {time.perf_counter() - began:.0f} s", flush=True)
        faults += tally.faults.values()
    for fault in faults:
        print(f"\n{fault}")
    print(f"{len(faults)} different tracebacks")
    sys.exit(1 if faults else 0)


def guided(target: Target, count: int) -> None:
    """Let atheris choose the inputs by what of the readers they reach; it stops at the first traceback."""
    import atheris

    def take(*values: Any) -> None:
        with suppress(UsageError):
            target.run(*values)

    atheris.instrument_all()
    test: Any = test_of(target, take, 1)
    atheris.Setup([sys.argv[0], f"-runs={count}", "-max_len=8192"], test.hypothesis.fuzz_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()

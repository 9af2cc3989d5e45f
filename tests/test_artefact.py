"""The artefact: comes back exactly, and is refused in one line where it is not sound."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.filters.catalogue import DEFAULT_FILTERS, make_filter, settings_of
from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.artefact import (
    SCHEMA_VERSION,
    SHIPPED,
    Artefact,
    load_artefact,
    parse_artefact,
    save_artefact,
)
from crosscomb.selection.switch import SwitchSettings
from crosscomb.selection.tree import Tree
from crosscomb.selection.windows import WindowSettings


def small_artefact(car: Vehicle) -> Artefact:
    """An artefact whose tree has numbers that are hard to write."""
    window = WindowSettings(features="raw", length=2)
    tree = Tree(
        feature=[3, -1, 0, -1, -1],
        threshold=[0.1 + 0.2, 0.0, -1e-300 / 3, 0.0, 0.0],
        left=[1, -1, 3, -1, -1],
        right=[2, -1, 4, -1, -1],
        shares=[[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        picks=[0, 0, 1, 1, 2],
        lowest=[-np.pi, -0.1, -1e22, -5e-324],
        highest=[np.e, 0.7, 1e22, 2.0],
    )
    return Artefact(
        selector_name="paper",
        rate=100.0,
        window=window,
        filters=[{"name": name, "settings": settings_of(make_filter(name, car))} for name in DEFAULT_FILTERS],
        fallback="dynamic_ekf",
        switch=SwitchSettings(dwell=0.1),
        tree=tree,
        vehicle=car,
        training={"seed": 3, "data": {"log": "00ff"}},
    )


@pytest.fixture
def content(car: Vehicle) -> dict[str, Any]:
    """A sound artefact as JSON content."""
    return small_artefact(car).model_dump(mode="json")


def refusal(content: object) -> str:
    with pytest.raises(UsageError) as caught:
        parse_artefact(json.dumps(content), "mine.json")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("mine.json: ")
    assert "{" not in message, "what is wrong, not all that was found"
    return message


def test_an_artefact_comes_back_exactly(car, tmp_path):
    artefact = small_artefact(car)
    save_artefact(artefact, tmp_path / "a.json")
    again = load_artefact(tmp_path / "a.json")
    assert again == artefact
    save_artefact(again, tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_the_file_says_all_settings_in_plain_json(content):
    assert content["schema_version"] == SCHEMA_VERSION
    assert content["rate"] == 100.0
    assert content["window"] == {"length": 2, "history": 10, "hop": 10, "features": "raw"}
    assert [entry["name"] for entry in content["filters"]] == list(DEFAULT_FILTERS)
    assert all(entry["settings"]["noise"] for entry in content["filters"])
    assert content["vehicle"]["mass"] > 0.0
    assert set(content["switch"]) == set(SwitchSettings.model_fields)


@pytest.mark.parametrize("version", [0, SCHEMA_VERSION + 1, str(SCHEMA_VERSION), None])
def test_another_schema_version_is_refused(content, version):
    content["schema_version"] = version
    message = refusal(content)
    assert "schema version" in message
    assert "train the artefact anew" in message


def test_a_file_without_schema_version_is_refused(content):
    del content["schema_version"]
    assert "schema version" in refusal(content)
    assert "schema version" in refusal([content])


def change(*keys: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def apply(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return apply


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (change("gain", value=1.0), ["unknown key gain"]),
        (change("window", "lenght", value=10), ["unknown key window.lenght"]),
        (change("tree", "depth", value=3), ["unknown key tree.depth"]),
        (change("switch", "dwell", value=-1.0), ["switch.dwell"]),
        (change("vehicle", "mass", value=-1500.0), ["vehicle.mass", "-1500"]),
        (change("vehicle", "colour", value="red"), ["unknown key vehicle.colour"]),
        (change("rate", value=0.0), ["rate"]),
        (change("fallback", value="oracle"), ["fallback oracle"]),
        (change("filters", 0, "name", value="magic"), ["magic", "catalogue", "crosscomb filters"]),
        (change("filters", 2, "name", value="rao_blackwell_pf"), ["what random_walk_pf runs by default"]),
        (change("filters", 0, "name", value="dynamic_ekf"), ["twice"]),
        (change("filters", value=[]), ["filters"]),
        (lambda content: content["filters"].pop(0), ["3 classes for 2 filters"]),
        (change("window", "length", value=3), ["4 features", "6"]),
        (change("filters", 0, "settings", "noise", "accel", value=-1.0), ["kinematic_kf", "noise.accel"]),
        (change("filters", 2, "settings", "swarm", value=1000), ["random_walk_pf", "swarm"]),
        (change("filters", 2, "settings", "particles", value=0.5), ["random_walk_pf", "particles"]),
        (change("tree", "left", 2, value=0), ["node 2", "child"]),
        (change("tree", "right", 0, value=99), ["node 0", "child", "99"]),
        (change("tree", "picks", 1, value=3), ["picks a class", "3"]),
        (change("tree", "feature", 2, value=4), ["node 2", "feature 4 of 4"]),
        (change("tree", "threshold", 0, value=float("nan")), ["tree.threshold.0"]),
        (change("tree", "threshold", value=[0.0]), ["differ in length"]),
        (lambda content: content.pop("tree"), ["key tree is missing"]),
        (change("tree", value="tree"), ["tree"]),
    ],
)
def test_an_unsound_artefact_is_refused_by_what_is_wrong(content, spoil, words):
    spoil(content)
    message = refusal(content)
    for word in words:
        assert word in message


def test_what_is_no_artefact_is_refused(tmp_path):
    files = {
        "none.json": None,
        "text.json": b"hello\n",
        "cut.json": b'{"schema_version": 1,\n "rate": 1',
        "binary.json": bytes(range(256)),
        "empty.json": b"",
        "folder.json": None,
    }
    (tmp_path / "folder.json").mkdir()
    for name, data in files.items():
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(UsageError) as caught:
            load_artefact(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)


def test_a_fault_changes_no_other_artefact(content):
    spoilt = copy.deepcopy(content)
    spoilt["tree"]["left"][2] = 0
    refusal(spoilt)
    assert parse_artefact(json.dumps(content), "mine.json").tree.left[2] == 3


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_artefacts_serve_any_car(name):
    artefact = load_artefact(name)
    assert artefact.vehicle is None, "it would stand in for the generic car without a warning"
    assert tuple(artefact.filter_names) == DEFAULT_FILTERS
    leaves = np.array(artefact.tree.left) < 0
    assert len(set(np.array(artefact.tree.picks)[leaves])) > 1


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_artefacts_record_their_training(name):
    record = load_artefact(name).training
    parts = record["parts"]
    members = [name for part in ("training", "validation", "test") for name in parts[part]]
    assert sorted(members) == sorted(record["data"])
    assert all(len(digest) == 64 for digest in record["data"].values())
    assert {"python", "numpy", "scikit-learn", "crosscomb"} <= set(record["versions"])


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_artefacts_are_as_crosscomb_writes_them(tmp_path, name):
    shipped = Path(__file__).resolve().parents[1] / "crosscomb" / "data" / f"{name}.json"
    save_artefact(load_artefact(name), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == shipped.read_bytes()


@pytest.mark.parametrize("text", ["[" * 100_000, '{"schema_version": ' + "9" * 5000 + "}"])
def test_what_no_artefact_holds_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "deep.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=r"^[^\n]*deep\.json: no artefact holds what this one holds: train"):
        load_artefact(path)

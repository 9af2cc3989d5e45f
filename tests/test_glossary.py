"""docs/glossary.md names every column, output and vehicle-file key of the code, each with its unit."""

import re
from functools import cache
from pathlib import Path

import pytest
from pydantic import BaseModel

from crosscomb.filters import columns
from crosscomb.filters.catalogue import CATALOGUE
from crosscomb.models.vehicle import Plant, Tyre, Vehicle
from crosscomb.signals import UNITS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "glossary.md"


@cache
def table(section: str) -> dict[str, str]:
    """Unit of each name in the table of a section, whose second column is the name and third the unit."""
    text = PAGE.read_text(encoding="utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    found: dict[str, str] = {}
    for row in re.findall(r"^\|[^|]*\| `(\S+)` \|([^|]*)\|", text, re.MULTILINE):
        name, unit = row
        assert name not in found, f"{name} stands twice"
        found[name] = unit.strip()
    return found


def test_every_signal_column_stands_in_it_with_its_unit() -> None:
    assert table("Signals") == UNITS


def test_every_column_of_samples_and_estimates_stands_in_it_with_a_unit() -> None:
    names = {name for name in vars(columns) if name.isupper()} - {"SAMPLE_WIDTH"}
    found = table("Samples and estimates")
    assert set(found) == names
    assert all(found.values())
    for name, unit in found.items():
        assert UNITS.get(name.lower(), unit) == unit, f"{name}: the signal has another unit"


def test_every_further_output_of_an_estimator_stands_in_it_with_its_unit() -> None:
    extras = {text for entry in CATALOGUE.values() for text in entry.load().extras}
    expected = dict(re.fullmatch(r"(\S+) \[(.+)\]", text).groups() for text in extras)  # type: ignore[union-attr]
    assert len(expected) == len(extras), "one name with two units"
    assert table("Further outputs") == expected


def keys(model: type[BaseModel], prefix: str = "") -> dict[str, str]:
    """Keys of a table of the vehicle file, each with its description."""
    fields = {name: field for name, field in model.model_fields.items() if name not in ("tyre", "plant")}
    return {f"{prefix}{name}": field.description or "" for name, field in fields.items()}


def test_every_key_of_the_vehicle_file_stands_in_it_with_its_unit() -> None:
    known = {**keys(Vehicle), **keys(Tyre, "tyre."), **keys(Plant, "plant.")}
    found = table("Vehicle file")
    assert list(found) == list(known)
    words = {"name", "tyre.model", "plant.drive", "plant.traction_control", "plant.anti_lock"}
    assert {key for key, unit in found.items() if not unit} == words
    for key, description in known.items():
        unit = re.search(r"\[(.+)\]", description)
        if unit:
            assert found[key] == unit[1], f"{key}: the vehicle file gives another unit"


def test_the_table_of_states_names_estimators_that_are_there() -> None:
    """Only that: a new estimator asks for one file and one line of the catalogue."""
    text = PAGE.read_text(encoding="utf-8").split("\n## States\n")[1].split("\n## ")[0]
    named = set(re.findall(r"`(\w+)`", text))
    assert {"kinematic_kf", "dynamic_ekf", "ratte_ekf", "random_walk_ekf"} <= named
    assert {name for name in named if name.endswith(("_kf", "_ekf", "_pf"))} <= set(CATALOGUE)


@pytest.mark.parametrize("name", re.findall(r"\]\((\S+\.md)\)", PAGE.read_text(encoding="utf-8")))
def test_its_links_lead_somewhere(name: str) -> None:
    assert (PAGE.parent / name).exists()

"""The picture of the data's way is that of the code as it stands."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    """The script that draws."""
    spec = importlib.util.spec_from_file_location("draw_data_flow", DOCS / "draw_data_flow.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


def test_the_picture_is_that_of_the_code(drawing: ModuleType) -> None:
    drawn = drawing.PICTURE.read_text(encoding="utf-8")
    assert drawn == drawing.draw(), "the code has changed: python docs/draw_data_flow.py"


def test_imports_are_read_from_the_code(drawing: ModuleType) -> None:
    found = drawing.uses()
    assert set(found) == set(drawing.BOXES), "a room is missing in the picture"
    assert {"filters", "models", "logs", "selector"} <= found["run"]
    assert found["signals"] == set()
    assert "cli" not in set().union(*found.values())


def test_arrows_leave_out_what_others_say(drawing: ModuleType) -> None:
    found = {"a": set(), "b": {"a"}, "c": {"a", "b"}, "d": {"a"}}
    assert drawing.needed(found) == [("a", "b"), ("a", "d"), ("b", "c")]


def test_the_page_names_every_station(drawing: ModuleType) -> None:
    text = (DOCS / "data_flow.md").read_text(encoding="utf-8")
    assert [room for room in drawing.BOXES if f"**{room}**" not in text and f"`{room}`" not in text] == [
        "cli",
        "sklearn_api",
    ]

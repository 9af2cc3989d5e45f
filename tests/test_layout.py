"""Rules of the house that no other tool checks: import names, layers, no pickles, no machine paths."""

import ast
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
SETTINGS = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
ROOMS: dict[str, str] = SETTINGS["setuptools"]["package-dir"]  # package -> folder
FOLDERS = ("crosscomb", "filters", "training", "models", "tests", "notebooks", "benchmarks", "docs")

PICKLES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "shelve", "marshal"}
BARE_ROOMS = {"filters", "training", "models"}
# A root folder, a drive, a package host: none of them belongs to the project.
MACHINE_NAME = re.compile(
    r"(?<![\w.])/(?:work|tmp|home|root|Users|opt|mnt|var|private)/|[A-Za-z]:\\+Users|pypi\.org|pythonhosted\."
)


def sources() -> Iterator[tuple[str, str]]:
    """Every Python file and notebook of the project, as name and code."""
    for folder in FOLDERS:
        for path in sorted((PROJECT / folder).rglob("*.py")):
            yield path.relative_to(PROJECT).as_posix(), path.read_text(encoding="utf-8")
    for path in notebooks():
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        lines = [line for line in "\n".join(code).splitlines() if not line.lstrip().startswith(("%", "!"))]
        yield path.relative_to(PROJECT).as_posix(), "\n".join(lines)


def notebooks() -> list[Path]:
    found = [path for folder in FOLDERS for path in sorted((PROJECT / folder).rglob("*.ipynb"))]
    return [path for path in found if ".ipynb_checkpoints" not in path.parts]


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


def bare_imports(code: str) -> list[str]:
    return [
        f"line {line}: {name}" for line, name in imported(ast.parse(code)) if name.split(".")[0] in BARE_ROOMS
    ]


def pickle_reads(code: str) -> list[str]:
    """Reading a pickle runs whatever is in it: an artefact or a log must never be able to."""
    tree = ast.parse(code)
    faults = [
        f"line {line}: {name}"
        for line, name in imported(tree)
        if name.split(".")[0] in PICKLES or name == "joblib.load"
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node) in {
            "joblib.load",
            "pd.read_pickle",
            "pandas.read_pickle",
        }:
            faults.append(f"line {node.lineno}: {ast.unparse(node)}")
        if (
            isinstance(node, ast.keyword)
            and node.arg == "allow_pickle"
            and ast.unparse(node.value) != "False"
        ):
            faults.append(f"line {node.value.lineno}: allow_pickle")
    return faults


@pytest.mark.parametrize(
    "code",
    [
        "import filters",
        "import models.vehicle as v",
        "from training import labels",
        "from filters.base import x",
    ],
)
def test_a_bare_import_is_seen(code: str) -> None:
    assert bare_imports(code)
    assert not bare_imports(re.sub(r"(filters|models|training)", r"crosscomb.\1", code, count=1))


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from cloudpickle import loads",
        "import joblib\njoblib.load('a')",
        "from joblib import load",
        "pd.read_pickle('a')",
        "np.load('a', allow_pickle=True)",
    ],
)
def test_reading_a_pickle_is_seen(code: str) -> None:
    assert pickle_reads(code)


def test_rooms_are_imported_by_their_full_names_only() -> None:
    assert {name: found for name, code in sources() if (found := bare_imports(code))} == {}


def test_nothing_reads_pickles() -> None:
    assert {name: found for name, code in sources() if (found := pickle_reads(code))} == {}


def test_notebooks_name_no_folder_of_one_machine() -> None:
    # In pieces, so that this file does not name one either.
    assert MACHINE_NAME.search('"text": "' + "/".join(["", "home", "me", "log.csv"]))
    assert MACHINE_NAME.search("\\\\".join(["C:", "Users", "me"]))
    assert not MACHINE_NAME.search("../shared/data/home/x and m/s, front/rear")
    assert [path.name for path in notebooks() if MACHINE_NAME.search(path.read_text(encoding="utf-8"))] == []


def layered_modules() -> set[str]:
    """Every module or room that a contract of layers places."""
    contracts = [c for c in SETTINGS["importlinter"]["contracts"] if c["type"] == "layers"]
    return {
        f"{container}.{name.strip()}"
        for contract in contracts
        for container in contract["containers"]
        for layer in contract["layers"]
        for name in re.split("[|:]", layer)
    }


@pytest.mark.parametrize("package", ["crosscomb", "crosscomb.filters", "crosscomb.training"])
def test_every_module_and_room_stands_in_a_layer(package: str) -> None:
    folder = PROJECT / ROOMS[package]
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    rooms = {path.parent.name for path in folder.glob("*/__init__.py")}
    mapped = {name.removeprefix("crosscomb.") for name in ROOMS if package == "crosscomb"} - {"crosscomb"}
    outside = {f"{package}.{name}" for name in modules | rooms | mapped} - layered_modules()
    assert not outside, "add them to the layers under [tool.importlinter] in pyproject.toml"


def test_every_folder_of_modules_is_packaged() -> None:
    packages = set(SETTINGS["setuptools"]["packages"])
    for package, folder in ROOMS.items():
        for path in (PROJECT / folder).rglob("*.py"):
            inside = path.parent.relative_to(PROJECT / folder).parts
            assert ".".join([package, *inside]) in packages, (
                f"{path.parent} is missing in [tool.setuptools] packages"
            )

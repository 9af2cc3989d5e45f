"""What a user gets: the wheel, built from the source archive, holds everything and takes no generic names."""

import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

PROJECT = Path(__file__).resolve().parents[1]
ROOMS: dict[str, str] = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
    "setuptools"
]["package-dir"]


def build(kind: str, tree: Path, out: Path) -> Path:
    """Build without a network: the environment's own setuptools, by the standard hook."""
    hook = f"from setuptools.build_meta import build_{kind}; build_{kind}({str(out)!r})"
    done = subprocess.run([sys.executable, "-c", hook], cwd=tree, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (built,) = [
        path for path in out.iterdir() if path.name.endswith(".whl" if kind == "wheel" else ".tar.gz")
    ]
    return built


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's content, by way of the source archive, as it would lie in site-packages."""
    try:
        found = version("setuptools")
    except PackageNotFoundError:
        found = "0"
    if int(found.split(".")[0]) < 77:
        pytest.skip(
            f'setuptools {found} is too old to build the wheel: pip install -e ".[test]" brings a newer one'
        )
    work = tmp_path_factory.mktemp("packaging")
    tree = work / "tree"
    tree.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (tree / name).write_bytes((PROJECT / name).read_bytes())
    for folder in ROOMS.values():
        copytree(PROJECT / folder, tree / folder, ignore=ignore_patterns("__pycache__", "*.egg-info"))
    archive = build("sdist", tree, work)
    with tarfile.open(archive) as packed:
        packed.extractall(work / "unpacked", filter="data")
    (source,) = (work / "unpacked").iterdir()
    wheel = build("wheel", source, work)
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(work / "installed")
    return work / "installed"


def test_wheel_puts_only_crosscomb_into_the_environment(installed: Path) -> None:
    names = {path.name for path in installed.iterdir()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"crosscomb"}


def test_wheel_holds_every_module_and_data_file(installed: Path) -> None:
    for package, folder in ROOMS.items():
        expected = {
            path.relative_to(PROJECT / folder)
            for path in (PROJECT / folder).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
        }
        assert expected, folder
        target = installed.joinpath(*package.split("."))
        assert {str(name) for name in expected if not (target / name).is_file()} == set()


def test_wheel_has_the_licence_and_the_command(installed: Path) -> None:
    (about,) = installed.glob("*.dist-info")
    assert "MIT License" in (about / "licenses" / "LICENSE").read_text(encoding="utf-8")
    assert "crosscomb = crosscomb.cli.main:main" in (about / "entry_points.txt").read_text(encoding="utf-8")


def test_installed_package_finds_its_rooms_and_vehicles(installed: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import crosscomb.filters, crosscomb.training\n"
        "from crosscomb.models import vehicle\n"
        "print(vehicle.__file__)\n"
        "print([vehicle.load_vehicle(name).name for name in vehicle.shipped_vehicles()])\n"
    )
    away = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(installed)],
        cwd=installed.parent,
        capture_output=True,
        text=True,
        env=away,
    )
    assert done.returncode == 0, done.stderr
    place, names = done.stdout.splitlines()
    assert Path(place).resolve().is_relative_to(installed.resolve())
    assert "Generic compact car" in names

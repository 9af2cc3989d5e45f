"""What `import crosscomb` gives, what it costs, and that the examples of the README run as they stand."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import crosscomb
from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle
from crosscomb.report.terminal import as_flags
from crosscomb.run.drive import require_known
from crosscomb.signals import Signals

README = Path(__file__).resolve().parents[1] / "README.md"
NAMES = {"read_log", "load_vehicle", "load_artefact", "estimate_log", "StreamingEstimator"}


def test_the_public_names_are_there() -> None:
    assert set(crosscomb.__all__) == NAMES
    assert set(dir(crosscomb)) >= NAMES | {"__version__"}
    for name in NAMES:
        thing = getattr(crosscomb, name)
        assert (thing.__name__, thing.__module__.split(".")[0]) == (name, "crosscomb")
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = crosscomb.no_such_name


def test_importing_crosscomb_imports_nothing_heavy() -> None:
    code = "import sys, crosscomb; dir(crosscomb); print({'numpy', 'pandas', 'pydantic', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.stdout.strip(), done.stderr) == ("set()", "")


def test_the_package_runs_as_a_module() -> None:
    line = [sys.executable, "-m", "crosscomb", "--version"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip()) == (0, crosscomb.__version__)


def test_the_examples_of_the_readme_run(
    simulated: list[Signals], car: Vehicle, write_log, write_vehicle, tmp_path: Path, monkeypatch, capsys
) -> None:
    examples = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.M | re.S)
    assert len(examples) >= 2
    write_log(simulated[0].frame, tmp_path / "log.csv")
    write_vehicle(tmp_path, car).rename(tmp_path / "car.toml")
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {}
    for example in examples:
        exec(example, known)
    assert "beta_random_walk_pf" in capsys.readouterr().out


def test_a_program_is_told_arguments_and_a_command_its_flags(
    crosscomb, write_log, simulated, tmp_path
) -> None:
    with pytest.raises(UsageError, match=r"^`filters` magic: not in the catalogue"):
        require_known(["magic"])
    log = write_log(simulated[0].frame, tmp_path / "log.csv")
    ran = crosscomb("estimate", log, "--filters", "magic", "-o", tmp_path / "out")
    assert ran.err.startswith("error: --filters magic: not in the catalogue")


def test_names_of_files_and_columns_are_no_flags() -> None:
    told = "with `vehicle` name.csv: column ay is missing (its other columns: `filters`, vx): map it (`channel_map`)"
    assert as_flags(told) == told.replace("(`channel_map`)", "(--map)")

"""What a command imports and compiles: as much as it needs. How long it takes is measured in benchmarks/."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from crosscomb.filters.catalogue import CATALOGUE, DEFAULT_FILTERS

PREFACE = "import sys, json; sys.argv = ['crosscomb', *json.loads(sys.argv[1])]\n"
MODULES = """
from crosscomb.cli.main import main
try:
    main()
except SystemExit as stop:
    code = stop.code
print(json.dumps([code, sorted(sys.modules)]))
"""
COMPILED = """
from numba.core import event
class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(str(event.data['dispatcher']))
    def on_end(self, event):
        pass
compiled = []
event.register('numba:compile', Listener())
from crosscomb.cli.main import main
try:
    main()
except SystemExit as stop:
    code = stop.code
print(json.dumps([code, compiled]))
"""
HEAVY = {"numpy", "pandas", "sklearn", "numba", "scipy", "matplotlib", "filterpy", "joblib"}


def run(program: str, *words: object, folder: Path | None = None) -> tuple[int, list[str]]:
    """Run a command in a process of its own; what the program prints last is JSON."""
    line = [sys.executable, "-c", PREFACE + program, json.dumps([str(word) for word in words])]
    done = subprocess.run(line, capture_output=True, text=True, encoding="utf-8", timeout=300, cwd=folder)
    assert done.returncode == 0, done.stderr
    code, found = json.loads(done.stdout.splitlines()[-1])
    return code, found


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("estimate", "--help"), ("train", "--help")])
def test_help_imports_nothing_heavy(words):
    code, modules = run(MODULES, *words)
    assert code == 0
    assert "typer" in modules
    assert HEAVY & set(modules) == set()


def test_estimate_imports_neither_scikit_learn_nor_filterpy_nor_matplotlib(data_set, tmp_path):
    log = sorted(data_set.glob("*.csv"))[0]
    code, modules = run(MODULES, "estimate", log, "-o", tmp_path)
    assert code == 0
    assert (tmp_path / f"{log.name.removesuffix('.csv')}.estimate.csv").exists()
    assert {"numpy", "pandas", "numba"} <= set(modules)
    assert {"sklearn", "filterpy", "matplotlib", "joblib"} & set(modules) == set()


def test_estimate_imports_only_the_estimators_it_runs(data_set, tmp_path):
    log = sorted(data_set.glob("*.csv"))[0]
    code, modules = run(MODULES, "estimate", log, "-o", tmp_path)
    assert code == 0
    estimators = {f"crosscomb.filters.{entry.place.partition(':')[0]}" for entry in CATALOGUE.values()}
    used = {f"crosscomb.filters.{CATALOGUE[name].place.partition(':')[0]}" for name in DEFAULT_FILTERS}
    assert estimators & set(modules) == used
    _, modules = run(MODULES, "estimate", log, "-o", tmp_path, "--filters", "luenberger")
    assert "crosscomb.filters.single_track.observers" in modules
    _, modules = run(MODULES, "filters")
    assert not estimators & set(modules)


def test_a_second_process_compiles_nothing(data_set, tmp_path):
    log = sorted(data_set.glob("*.csv"))[0]
    run(COMPILED, "estimate", log, "-o", tmp_path)
    code, compiled = run(COMPILED, "estimate", log, "-o", tmp_path)
    assert (code, compiled) == (0, [])


def test_compiling_would_be_seen(data_set, tmp_path):
    """With an empty cache every kernel is compiled, and the test above would fail."""
    code = COMPILED.replace(
        "from crosscomb.cli.main",
        "import crosscomb.selection.switch as s, numpy as np\nfrom crosscomb.cli.main",
    )
    code = code.replace(
        "try:\n    main()",
        "t = s.switch_times(s.SwitchSettings(), 0.01)\n"
        "s.switch(*[np.zeros((3, 1))] * 2, np.zeros(3), s.SwitchSettings(), 0.01, s.make_switch_state(1, 0, t))\n"
        "try:\n    main()",
    )
    line = [sys.executable, "-c", PREFACE + code, json.dumps(["--version"])]
    done = subprocess.run(
        line,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
    )
    assert done.returncode == 0, done.stderr
    assert "_switch_run" in done.stdout.splitlines()[-1]


def test_no_output_folder_is_made_by_looking(tmp_path):
    for words in (("--help",), ("filters",), ("estimate", "--help")):
        run(MODULES, *words, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []

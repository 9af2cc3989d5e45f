"""Every command once as a user calls it, and the record each run leaves."""

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import crosscomb as package
from crosscomb.filters.catalogue import CATALOGUE, DEFAULT_FILTERS
from crosscomb.models.vehicle import load_vehicle
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.suites import benchmark as suites

COMMANDS = [
    "filters", "vehicle", "simulate", "tune", "train", "identify", "estimate", "check", "benchmark", "demo",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(data_set, tmp_path_factory) -> Path:
    """Folder with what `crosscomb train` writes, by a real process."""
    folder = tmp_path_factory.mktemp("trained")
    done = shell("train", data_set, "-o", folder / "mine.json", "--jobs", 1)
    assert (done.returncode, done.stderr) == (0, "")
    (folder / "out.txt").write_text(done.stdout, encoding="utf-8")
    return folder


def shell(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command line in a process of its own."""
    code = "import sys; sys.argv[0] = 'crosscomb'; from crosscomb.cli.main import main; main()"
    line = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, encoding="utf-8", timeout=300)


def record(path: Path) -> dict:
    """Record of a run, checked for what every one must hold."""
    content = json.loads(path.read_text(encoding="utf-8"))
    assert set(content) == {"command", "settings", "versions", "inputs"}
    assert {"python", "crosscomb", "numpy", "numba", "pandas"} <= set(content["versions"])
    for name, digest in content["inputs"].items():
        assert digest == hashlib.sha256(Path(name).read_bytes()).hexdigest()
    return content


def test_help_lists_every_command():
    done = shell("--help")
    assert (done.returncode, done.stderr) == (0, "")
    listed = done.stdout.split("Commands:")[1].splitlines()
    assert [line.split()[0] for line in listed if line.strip()] == COMMANDS


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_help(crosscomb, command):
    ran = crosscomb(command, "--help")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith(f"Usage: crosscomb {command} ")
    assert not any(ord(letter) > 126 for letter in ran.out)  # a bare Windows console shows it


def test_the_installed_script_is_the_same_command():
    script = shutil.which("crosscomb", path=str(Path(sys.executable).parent))
    if script is None:
        pytest.skip("crosscomb is not installed in this environment: pip install -e .")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip()) == (0, package.__version__)


def test_without_a_command_the_help_is_shown(crosscomb):
    ran = crosscomb()
    assert (ran.code, ran.err) == (2, "")
    assert ran.out.startswith("Usage: crosscomb")


def test_filters_names_the_whole_catalogue(crosscomb):
    ran = crosscomb("filters")
    assert (ran.code, ran.err) == (0, "")
    for name, entry in CATALOGUE.items():
        assert name in ran.out
        assert entry.summary.split()[0] in ran.out


def test_vehicle_writes_a_file_that_can_be_used(crosscomb, tmp_path):
    path = tmp_path / "cars" / "mine.toml"
    words = ("vehicle", "My car", "--mass", 1500, "--wheelbase", 2.6, "--front-share", 0.6, "-o", path)
    assert crosscomb(*words).code == 0
    car = load_vehicle(path)
    assert (car.name, car.mass) == ("My car", 1500.0)
    assert car.wheelbase == pytest.approx(2.6, abs=1e-4)
    assert car.cg_to_rear_axle == pytest.approx(0.6 * 2.6, abs=1e-3)
    assert "estimate" in path.read_text(encoding="utf-8")
    before = path.read_bytes()
    ran = crosscomb(*words)
    assert ran.code == 2
    assert "--force" in ran.err
    assert path.read_bytes() == before
    assert crosscomb(*words, "--force").code == 0


def test_simulate_writes_logs_that_estimate_takes(crosscomb, tmp_path):
    logs, out = tmp_path / "logs", tmp_path / "out"
    ran = crosscomb("simulate", logs, "--vehicle", "volvo_v40", "--seed", 3, "--logs", 2, "--jobs", 1)
    assert (ran.code, ran.err) == (0, "")
    found = sorted(path.name for path in logs.iterdir())
    assert len([name for name in found if name.endswith(".csv.gz")]) == 2
    assert {"vehicle.toml", "dataset.json", "simulate.run.json"} <= set(found)
    assert record(logs / "simulate.run.json")["settings"]["seed"] == 3
    before = (logs / found[0]).read_bytes()
    ran = crosscomb("simulate", logs, "--logs", 1, "--jobs", 1)
    assert ran.code == 2
    assert "--force" in ran.err
    assert (logs / found[0]).read_bytes() == before
    ran = crosscomb("estimate", *sorted(logs.glob("*.csv.gz")), "-o", out)
    assert (ran.code, ran.err) == (0, "")
    assert len(list(out.glob("*.estimate.csv"))) == 2


def test_simulate_never_overwrites_the_vehicle_file_it_reads(crosscomb, car, write_vehicle, tmp_path):
    path = write_vehicle(tmp_path, car)
    before = path.read_bytes()
    ran = crosscomb("simulate", tmp_path, "--vehicle", path, "--logs", 1)
    assert ran.code == 2
    assert str(path) in ran.err
    assert [p.name for p in tmp_path.iterdir()] == ["vehicle.toml"]
    assert path.read_bytes() == before


def test_train_writes_the_artefact_and_its_report(trained, data_set):
    written = {"mine.json", "report.html", "confusion_matrix.csv", "confusion_matrix.png", "metrics.json"}
    written |= {"tree.txt", "tree.png"}
    assert {path.name for path in trained.iterdir()} == {*written, "mine.run.json", "out.txt"}
    artefact = load_artefact(trained / "mine.json")
    assert artefact.vehicle == load_vehicle(data_set / "vehicle.toml")
    content = record(trained / "mine.run.json")
    assert content["command"] == "train"
    assert {Path(name) for name in content["inputs"]} == set(data_set.iterdir())
    assert content["settings"]["folds"] == 5
    out = (trained / "out.txt").read_text(encoding="utf-8")
    for word in (
        "folds",
        "validation",
        "test",
        "oracle",
        "switch / best single filter",
        "Confusion matrix",
        "%",
        "[deg]",
    ):
        assert word in out
    for path in data_set.glob("*.csv"):
        assert path.name.removesuffix(".csv") in out


def test_train_with_the_same_seed_writes_the_same_bytes(crosscomb, trained, data_set, tmp_path):
    assert crosscomb("train", data_set, "-o", tmp_path / "mine.json", "--jobs", 1).code == 0
    for name in ("mine.json", "metrics.json", "confusion_matrix.csv", "report.html"):
        assert (tmp_path / name).read_bytes() == (trained / name).read_bytes()


def test_train_never_overwrites_a_log(crosscomb, data_set, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(data_set, folder)
    (folder / "vehicle.json").write_text("{}")
    (folder / "metrics.json").symlink_to(sorted(folder.glob("*.csv"))[0])
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    ran = crosscomb("train", folder, "-o", folder / "mine.json", "--jobs", 1)
    assert ran.code == 2
    assert "overwritten" in ran.err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_train_into_its_own_data_folder_does_no_harm(crosscomb, data_set, tmp_path):
    """The confusion matrix is a .csv too: the next training must not take it for a log."""
    folder = tmp_path / "data"
    shutil.copytree(data_set, folder)
    for path in sorted(folder.glob("*.csv"))[7:]:
        path.unlink()
    words = (
        "train",
        folder,
        "-o",
        folder / "mine.json",
        "--selector",
        "paper",
        "--jobs",
        1,
        "--tune-budget",
        0,
    )
    assert crosscomb(*words).code == 0
    first = (folder / "mine.json").read_bytes()
    ran = crosscomb(*words)
    assert (ran.code, ran.err) == (0, "")
    assert (folder / "mine.json").read_bytes() == first


def test_estimate_as_a_process_with_the_trained_artefact(trained, data_set, tmp_path):
    log = sorted(data_set.glob("*.csv"))[2]
    out = tmp_path / "new" / "out"
    done = shell("estimate", log, "--selector-file", trained / "mine.json", "-o", out, "--plot")
    assert (done.returncode, done.stderr) == (0, "")
    name = log.name.removesuffix(".csv")
    assert {path.name for path in out.iterdir()} == {
        f"{name}{end}" for end in (".estimate.csv", ".estimate.png", ".run.json")
    }
    assert len(pd.read_csv(out / f"{name}.estimate.csv")) == len(pd.read_csv(log))
    assert (out / f"{name}.estimate.png").read_bytes()[:4] == b"\x89PNG"
    content = record(out / f"{name}.run.json")
    assert content["command"] == "estimate"
    assert {Path(path) for path in content["inputs"]} == {
        log,
        trained / "mine.json",
        data_set / "vehicle.toml",
    }
    assert content["settings"]["artefact"] == str(trained / "mine.json")
    assert content["settings"]["vehicle"]["mass"] == load_vehicle(data_set / "vehicle.toml").mass
    for word in ("RMSE / max [deg]", name, "crosscomb", "kinematic_kf", "zero"):
        assert word in done.stdout


def test_estimate_is_the_same_bytes_each_time_and_in_company(crosscomb, data_set, tmp_path):
    logs = sorted(data_set.glob("*.csv"))[:3]
    assert crosscomb("estimate", *logs, "-o", tmp_path / "all").code == 0
    assert crosscomb("estimate", logs[1], "-o", tmp_path / "one").code == 0
    name = f"{logs[1].name.removesuffix('.csv')}.estimate.csv"
    assert (tmp_path / "all" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()


def test_estimate_says_that_a_log_without_truth_is_not_scored(crosscomb, simulated, write_log, tmp_path):
    frame = simulated[1].frame
    bare = write_log(frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]), tmp_path / "bare.csv")
    empty = write_log(frame.assign(beta_ref="", vx_ref="", vy_ref=""), tmp_path / "empty.csv")
    ran = crosscomb("estimate", bare, empty, "--vehicle", "generic_compact", "-o", tmp_path / "out")
    assert ran.code == 0
    for name in ("bare", "empty"):
        assert f"{name}: no ground truth, not scored" in ran.out
    assert "RMSE" not in ran.out
    files = [(tmp_path / "out" / f"{name}.estimate.csv").read_bytes() for name in ("bare", "empty")]
    assert files[0] == files[1]


def test_estimate_takes_a_channel_map(crosscomb, simulated, write_log, tmp_path):
    frame = simulated[1].frame
    plain = write_log(frame, tmp_path / "plain.csv")
    foreign = frame.assign(speed=frame["vx"] * 3.6).drop(columns="vx")
    other = write_log(foreign, tmp_path / "foreign.csv")
    (tmp_path / "map.toml").write_text('[channels.vx]\ncolumn = "speed"\nunit = "km/h"\n')
    words = ("--vehicle", "generic_compact", "-o", tmp_path / "out")
    assert crosscomb("estimate", plain, *words).code == 0
    ran = crosscomb("estimate", other, "--map", tmp_path / "map.toml", *words)
    assert ran.code == 0
    assert tmp_path / "map.toml" in map(Path, record(tmp_path / "out" / "foreign.run.json")["inputs"])
    one, two = (pd.read_csv(tmp_path / "out" / f"{name}.estimate.csv") for name in ("plain", "foreign"))
    assert (one["beta"] - two["beta"]).abs().max() < 1e-6


def test_check_says_what_is_in_a_log(crosscomb, data_set):
    log = sorted(data_set.glob("*.csv"))[1]
    ran = crosscomb("check", log)
    assert (ran.code, ran.err) == (0, "")
    for word in (
        str(log),
        "1500 rows",
        "15.0 s",
        "yaw_rate",
        "rad/s",
        "beta_ref",
        "torque_fl",
        "Generic compact car",
    ):
        assert word in ran.out


def test_check_refuses_what_estimate_refuses(crosscomb, simulated, write_log, tmp_path):
    frame = simulated[1].frame
    fast = write_log(frame.assign(vx=3.6 * frame["vx"]), tmp_path / "fast.csv")
    hand = write_log(frame.drop(columns="steer"), tmp_path / "hand.csv")
    ran = crosscomb("check", fast)
    assert ran.code == 2
    for word in ("error: column vx", "km/h", "[channels.vx]"):
        assert word in ran.out
    ran = crosscomb("check", hand)
    assert ran.code == 2
    assert "steer" in ran.err.splitlines()[-1]
    assert crosscomb("check", hand, "--vehicle", "generic_compact").code == 0


def test_benchmark_real_writes_its_table(crosscomb, data_set, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(data_set, data / "compact")
    for path in sorted((data / "compact").glob("*.csv"))[3:]:
        path.unlink()
    results = tmp_path / "results.md"
    ran = crosscomb("benchmark", "real", "--data", data, "-o", results, "--jobs", 1)
    assert (ran.code, ran.err) == (0, "")
    text = results.read_text(encoding="utf-8")
    for path in (data / "compact").glob("*.csv"):
        name = f"compact/{path.name.removesuffix('.csv')}"
        (row,) = [line for line in text.splitlines() if line.startswith(f"| {name} ")]
        assert row.count(" / ") == 6
        assert name in ran.out
    for word in ("zero", *DEFAULT_FILTERS, "switch", "oracle", "us per sample", "all (3)"):
        assert word in text
        assert word in ran.out


def test_benchmark_takes_other_estimators_beside_the_switch(crosscomb, data_set, tmp_path):
    data, results = tmp_path / "data", tmp_path / "results.md"
    shutil.copytree(data_set, data / "compact")
    words = ("benchmark", "real", "--data", data, "-o", results, "--jobs", 1)
    ran = crosscomb(*words, "--filters", "luenberger,kinematic_kf")
    assert ran.code == 0
    assert "luenberger" in ran.out
    header = next(line for line in results.read_text(encoding="utf-8").splitlines() if "recording" in line)
    assert header.count("kinematic_kf") == header.count("luenberger") == 1


def test_benchmark_simulated_prints_accuracy_and_speed(crosscomb, monkeypatch):
    monkeypatch.setattr(suites, "SIMULATED_LOGS", 2)
    ran = crosscomb("benchmark", "--jobs", 1)
    assert (ran.code, ran.err) == (0, "")
    for word in ("all (2)", "Accuracy", "Speed", "us per sample", "random_walk_pf"):
        assert word in ran.out


def test_demo_makes_everything(crosscomb, tmp_path):
    ran = crosscomb("demo", "-o", tmp_path / "demo")
    assert (ran.code, ran.err) == (0, "")
    made = tmp_path / "demo"
    assert (made / "report.html").exists()
    assert len(list((made / "estimates").glob("*.estimate.png"))) == 3
    assert len(list((made / "estimates").glob("*.estimate.csv"))) == 3
    assert load_artefact(made / "selector.json").vehicle == load_vehicle("generic_compact")


@pytest.mark.parametrize(
    "words",
    [
        ("filtres",),
        ("train",),
        ("estimate",),
        ("estimate", "x.csv", "--plto"),
        ("simulate", "x", "--logs", "many"),
        ("simulate", "x", "--logs", "0"),
        ("train", "x", "--folds", "1"),
        ("train", "x", "--seed", "-1"),
        ("vehicle", "x", "--mass", "1500"),
    ],
    ids=" ".join,
)
def test_a_wrong_command_line_is_one_line(crosscomb, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = crosscomb(*words)
    assert ran.code == 2
    assert ran.err.startswith("error: ")
    assert ran.err.count("\n") == 1
    assert "--help" in ran.err
    assert list(tmp_path.iterdir()) == []

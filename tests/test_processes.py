"""Runs that are stopped, meet a full disk or each other: one line, nothing half written, no process left."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from crosscomb.errors import UsageError
from crosscomb.files import locked, remove_unfinished, write_text, writing, writing_together

posix = pytest.mark.skipif(os.name != "posix", reason="sends signals")


def start(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "crosscomb", *map(str, words)]
    return subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )


def members(group: int) -> list[int]:
    """Living processes of a process group."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, own = entry.read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:
            continue
        if int(own) == group and state != "Z":
            found.append(int(entry.parent.name))
    return found


def wait_for(what, seconds: float = 60.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := what():
            return found
        time.sleep(0.05)
    raise AssertionError("it did not come")


def stop(run: subprocess.Popen[str], number: int, whole_group: bool = False) -> str:
    """Send a signal; within two seconds nothing may live. Gives what the run said on its error stream."""
    (os.killpg if whole_group else os.kill)(run.pid, number)
    began = time.monotonic()
    code = run.wait(5.0)
    assert code == 128 + number
    while members(run.pid):
        assert time.monotonic() - began < 2.0, members(run.pid)
        time.sleep(0.05)
    return run.communicate()[1]


@posix
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("number", "group", "delay"),
    [(signal.SIGTERM, False, 0.0), (signal.SIGINT, True, 0.7)],
)
def test_a_stopped_simulation_leaves_nothing(tmp_path: Path, number: int, group: bool, delay: float) -> None:
    out = tmp_path / "out"
    run = start("simulate", out, "--logs", 4000, "--jobs", 2, "--preset", "quick")
    wait_for(lambda: list(out.glob(".writing-*")))
    if delay:
        wait_for(lambda: list(out.glob(".writing-*/*.csv.gz")))
        time.sleep(delay)
    said = stop(run, number, group)
    assert said == f"error: {'terminated' if number == signal.SIGTERM else 'interrupted'}\n"
    assert list(out.iterdir()) == []


@posix
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_stopped_training_leaves_nothing_and_lets_no_other_in(
    crosscomb, tmp_path: Path, data_set: Path
) -> None:
    out = tmp_path / "out"
    run = start("train", data_set, "-o", out / "a.json", "--jobs", 2)
    wait_for(lambda: (out / ".crosscomb.lock").exists() and len(members(run.pid)) > 2)
    other = crosscomb("train", data_set, "-o", out / "a.json", "--jobs", 1)
    assert other.code == 2
    assert other.err.startswith(f"error: {out}: another run writes its outputs there now: wait for it")
    assert stop(run, signal.SIGTERM) == "error: terminated\n"
    assert not out.exists() or list(out.iterdir()) == []


@posix
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_end_with_a_parent_that_was_killed_and_its_lock_counts_no_more(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = start("simulate", out, "--logs", 4000, "--jobs", 2, "--preset", "quick")
    wait_for(lambda: list(out.glob(".writing-*/*.csv.gz")))
    run.kill()
    run.wait()
    wait_for(lambda: not members(run.pid), 2.0)
    assert (out / ".crosscomb.lock").exists()
    with locked(out):
        pass
    assert not (out / ".crosscomb.lock").exists()
    run.communicate()


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with locked(tmp_path), locked(tmp_path, "log"):
        with pytest.raises(UsageError, match="another run writes its outputs there now"), locked(tmp_path):
            pass
        assert sorted(path.name for path in tmp_path.iterdir()) == [".crosscomb.lock", ".log.lock"]
    with locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail() -> None:
        with writing_together(tmp_path) as folder:
            write_text(folder / "a.txt", "new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "old")]
    with writing_together(tmp_path) as folder:
        write_text(folder / "a.txt", "new")
        write_text(folder / "b.txt", "too")
        assert (tmp_path / "a.txt").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "b.txt"]
    assert (tmp_path / "a.txt").read_text() == "new"


def test_what_is_unfinished_can_be_removed_at_any_time(tmp_path: Path) -> None:
    def fail() -> None:
        with writing_together(tmp_path / "x") as folder, writing(folder / "a.txt") as temporary:
            assert temporary.name.endswith(".txt")
            remove_unfinished()

    with pytest.raises(UsageError, match=r"x/a\.txt: cannot be written"):
        fail()
    assert list((tmp_path / "x").iterdir()) == []


def full_disk(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Let the disk be full after some files."""
    rename, count = Path.write_bytes, iter(range(10_000))

    def write_bytes(self: Path, data: bytes) -> int:
        if next(count) >= after:
            rename(self, data[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return rename(self, data)

    monkeypatch.setattr(Path, "write_bytes", write_bytes)


@pytest.mark.parametrize("after", [0, 2])
def test_a_full_disk_gives_one_line_and_leaves_no_part_of_a_set(
    crosscomb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data_set: Path, after: int
) -> None:
    full_disk(monkeypatch, after)
    out, log = tmp_path / "out", next(data_set.glob("*.csv"))
    for command in (
        ("simulate", out, "--logs", 4, "--preset", "quick", "--jobs", 1),
        ("train", data_set, "-o", out / "a.json", "--jobs", 1, "--tune-budget", 0),
        *([("estimate", log, "-o", out)] if after == 0 else []),
    ):
        monkeypatch.undo()
        full_disk(monkeypatch, after)
        ran = crosscomb(*command)
        assert (ran.code, ran.err.count("\n")) == (2, 1)
        assert str(out) in ran.err
        assert "No space left on device" in ran.err
        assert ".writing" not in ran.err
        assert list(out.iterdir()) == []

"""Read files, write output files whole or not at all, and record what a run was made of."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

from crosscomb.errors import UsageError

RECORDED_PACKAGES = ("crosscomb", "numpy", "numba", "pandas", "scikit-learn", "scipy")


def refuse_overwriting(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse a run whose outputs would overwrite one of its inputs.

    Raises
    ------
    UsageError
    """
    written = {os.path.realpath(path) for path in outputs}
    for path in inputs:
        if os.path.realpath(path) in written:
            raise UsageError(f"{path}: would be overwritten by this run: let it write into another folder")


def open_file(path: Path, kind: str = "file", origin: str = "check the name") -> BinaryIO:
    """Open a file to read its bytes.

    Parameters
    ----------
    path : Path
    kind : str
        What it should be, for messages.
    origin : str
        What to do where there is none.

    Raises
    ------
    UsageError
        It is missing, a folder, a device or a pipe, or must not be read.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # reading may never end, nor even begin
            raise UsageError(f"{path}: is a device or a pipe: name a {kind} on the disk")
        return path.open("rb")
    except (FileNotFoundError, ValueError):  # a name with a zero byte is none
        raise UsageError(f"{path}: no such {kind}: {origin}") from None
    except OSError as error:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder: name the {kind} in it") from None
        raise UsageError(f"{path}: cannot be read ({error.strerror}): check its permissions") from None


def read_bytes(path: Path, most: int, kind: str = "file", origin: str = "check the name") -> bytes:
    """Read a file whole, if it has at most so many bytes; as `open_file`."""
    with open_file(path, kind, origin) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise UsageError(f"{path}: has more than {most} bytes, which no {kind} has: check the name")
    return data


_unfinished: set[Path] = set()
"""Temporary files and folders of this process."""


def remove_unfinished() -> None:
    """Remove all temporary files and folders of this process: it was stopped."""
    for path in list(_unfinished):
        _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)
    _unfinished.discard(path)


@contextmanager
def _unfinished_beside(path: Path, suffix: str = "") -> Iterator[Path]:
    """Give a name in the folder of `path`, which is made; what stands there at the end is removed."""
    temporary = path.parent / f".writing-{secrets.token_hex(6)}{suffix}"
    _unfinished.add(temporary)  # before it is there: a signal may come at any time
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
    except OSError as error:
        shown = Path(*(part for part in path.parts if not part.startswith(".writing-")))
        raise UsageError(
            f"{shown}: cannot be written ({error.strerror}): choose another folder, or make room"
        ) from None
    finally:
        _remove(temporary)


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Give a temporary file beside `path` to be filled, then rename it: no half-written file is ever seen.

    Raises
    ------
    UsageError
        The folder cannot be made or written, or the disk is full.
    """
    # The suffix stays: writers choose their format by it.
    with _unfinished_beside(path, "".join(path.suffixes[-2:])) as temporary:
        temporary.touch(0o644, exist_ok=False)
        yield temporary
        temporary.replace(path)


@contextmanager
def writing_together(folder: Path) -> Iterator[Path]:
    """Give a temporary folder for files that belong in `folder`: they appear there all at the end, or none does.

    Raises
    ------
    UsageError
        As in `writing`.
    """
    with _unfinished_beside(folder / "outputs") as temporary:
        temporary.mkdir()
        yield temporary
        for file in sorted(temporary.iterdir()):
            file.replace(folder / file.name)


@contextmanager
def locked(folder: Path, name: str = "") -> Iterator[None]:
    """Keep other runs from writing the same outputs in a folder; the lock of a process that died counts no more.

    Parameters
    ----------
    folder : Path
        Made when missing.
    name : str
        Of what is locked, such as a log; else it is the whole folder.

    Raises
    ------
    UsageError
        Another run holds the lock, or the folder cannot be made or written.
    """
    path = folder / f".{name or 'crosscomb'}.lock"
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _lock(path)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror}): choose another folder") from None
    if file is None:
        raise UsageError(
            f"{folder}: another run writes {name or 'its outputs'} there now: wait for it, or choose another folder"
        )
    try:
        yield
    finally:
        if os.name == "posix":  # while it is held: a run that opened it meanwhile sees that it is gone
            path.unlink(missing_ok=True)
        file.close()
        if os.name != "posix":
            with suppress(OSError):
                path.unlink(missing_ok=True)
        with suppress(OSError):  # who wrote nothing leaves no folder
            for each in made:
                each.rmdir()


def _lock(path: Path) -> BinaryIO | None:
    """Open and lock a file; None where another process holds it."""
    while True:
        file = path.open("ab")
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
                file.close()
                return None
            return file  # a file system without locks
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # the run that held it has just removed it


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a file, as in `writing`."""
    with writing(path) as temporary:
        write(temporary)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all, with the same bytes on every system."""
    write_file(path, lambda temporary: temporary.write_bytes(text.encode("utf-8", "backslashreplace")))


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in RECORDED_PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def existing_files(*paths: str | Path | None) -> list[Path]:
    """Those that are files: a vehicle may also be the name of a shipped one."""
    return [Path(path) for path in paths if path is not None and os.path.isfile(path)]


def run_record(command: str, settings: dict[str, Any], inputs: Iterable[Path]) -> dict[str, Any]:
    """What a run was made of: settings, versions and the hash of each input."""
    return {
        "command": command,
        "settings": settings,
        "versions": versions(),
        "inputs": {str(path): file_hash(path) for path in inputs},
    }


def write_json(path: Path, content: Any) -> None:
    """Write JSON for people and programs."""
    write_text(path, json.dumps(content, indent=1, default=str) + "\n")

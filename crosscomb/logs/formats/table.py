"""The table of log formats: what a log is called, and which file reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

from crosscomb.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd

    from crosscomb.logs.channel_map import Reader
    from crosscomb.logs.content import Content


@dataclass(frozen=True)
class Columns:
    """What a format finds in a log before it reads the numbers.

    Attributes
    ----------
    names : list of str
        Of the columns, as they stand in the log.
    place : str
        Where the names stand, for messages, such as ``row 1``.
    read : callable
        From a dict, the wanted columns by our name with their place in `names`, to float64 DataFrames of them, piece
        by piece and at least one, whose index called ``row`` holds the row numbers in the file; NaN means "no
        measurement".
    notes : list of str
        What was done to the rows, once all were read.
    """

    names: list[str]
    place: str
    read: Callable[[dict[str, int]], Iterable[pd.DataFrame]]
    notes: list[str] = field(default_factory=list)


class FormatReader(Protocol):
    """What the file of a format holds."""

    def recognises(self, data: bytes) -> bool:
        """Tell from the first bytes of a file, unpacked, whether it is of this format."""

    def open_log(self, content: Content, source: str, reader: Reader) -> Columns:
        """Find the columns in a file; `source` names it in messages."""


@dataclass(frozen=True)
class Format:
    """One format: its name, how its files end, and the module that reads it, imported when it is needed."""

    name: str
    endings: tuple[str, ...]
    place: str

    @property
    def reader(self) -> FormatReader:
        """The module."""
        return cast(FormatReader, import_module(self.place))


FORMATS = [
    Format("CSV", (".csv", ".csv.gz"), "crosscomb.logs.formats.csv"),
]
"""Every format there is. What ends in ``.gz`` is unpacked before it is read."""

HEAD = 4096
"""So many bytes tell a format [-]."""


def endings() -> str:
    """Endings of log files, in words."""
    *most, last = [ending for entry in FORMATS for ending in entry.endings]
    return f"{', '.join(most)} or {last}" if most else last


def ending(path: str | Path) -> str:
    """How the name of a log ends, as the table has it; empty where it is no name of a log."""
    name = Path(path).name.lower()
    found = [end for entry in FORMATS for end in entry.endings if name.endswith(end) and name != end]
    return max(found, key=len, default="")


def log_name(path: str | Path) -> str:
    """File name without its ending: it names the outputs.

    Raises
    ------
    UsageError
        No format has this ending.
    """
    end = ending(path)
    if not end:
        names = " or ".join(entry.name for entry in FORMATS)
        raise UsageError(
            f"{path}: not a {endings()} file: export the log as {names}, or rename it if it is that"
        )
    return Path(path).name[: -len(end)]


def find_format(path: str | Path, head: bytes) -> Format:
    """Format of a log by its name, or by the `HEAD` of its content where another one recognises that."""
    named = next(entry for entry in FORMATS if ending(path) in entry.endings)
    if named.reader.recognises(head):
        return named
    return next((entry for entry in FORMATS if entry.reader.recognises(head)), named)

"""From a file to signals: any format of the table, with or without a channel map, piece by piece or whole."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import FACTORS, ChannelMap, MapIntake, unit_name
from crosscomb.logs.content import open_content
from crosscomb.logs.formats.table import HEAD, Columns, find_format, log_name
from crosscomb.signals import UNITS, Intake, Signals


def read_log(path: str | Path, channel_map: ChannelMap | None = None) -> Signals:
    """Read one log.

    The format follows from the name, or from the content where that is plainly another: then a note says so.
    In CSV, separator and decimal comma are recognised unless the channel map states them, and rows are numbered
    as in the file: the header of a plain log is row 1.

    Parameters
    ----------
    path : str or Path
        A file of one of the formats in `crosscomb.logs.formats.table.FORMATS`.
    channel_map : ChannelMap, optional
        How foreign names, units and signs become ours. Without it the columns must be named as in
        `crosscomb.signals.UNITS`, in SI units.

    Raises
    ------
    UsageError
        The file cannot be read as a log; the message names the row or column and the mend.
    """
    log = open_log(path, channel_map)
    chunks = list(log.chunks())
    frames = [chunk.frame for chunk in chunks]
    frame = frames[0] if len(frames) == 1 else pd.concat(frames, ignore_index=True)
    return replace(chunks[0], frame=frame, notes=tuple(log.notes))


@dataclass
class LogFile:
    """A log on the disk, read in chunks as often as wanted; what is in it is checked each time.

    Attributes
    ----------
    path : Path
    name : str
        File name without its ending.
    notes : list of str
        As of `Signals`, once all chunks were read.
    """

    path: Path
    name: str
    channel_map: ChannelMap | None
    columns: Columns
    names: list[str]  # of the columns, without SI units
    doubt: str  # of what the file's name says
    notes: list[str] = field(default_factory=list)

    @property
    def is_foreign(self) -> bool:
        """Whether it has none of the channels that tell of cornering: some other table that lies among logs."""
        signs = self.channel_map or ChannelMap()
        return not any(
            signs.column(name) in self.names for name in ("ay", "yaw_rate", "steer", "steer_wheel")
        )

    def chunks(self) -> Iterator[Signals]:
        """The log in pieces that fit any memory, at least one.

        Raises
        ------
        UsageError
            As in `read_log`.
        """
        source, signs = str(self.path), self.channel_map or ChannelMap()
        with _doubting(self.doubt):
            wanted = signs.columns(self.names, source)
            for column in wanted:
                if self.names.count(column) > 1:
                    raise UsageError(
                        f"{source}: {self.columns.place}: column {column} is there twice: rename or delete one of them"
                    )
            intake = Intake(self.name, source, [name for name in self.names if name and name not in wanted])
            taking = intake if self.channel_map is None else MapIntake(self.channel_map, intake)
            for frame in self.columns.read({column: self.names.index(column) for column in wanted}):
                signals = taking.take(frame)
                if len(signals):
                    yield signals
            self.notes = [*self.columns.notes, *taking.finish(), *([self.doubt] if self.doubt else [])]


def open_log(path: str | Path, channel_map: ChannelMap | None = None) -> LogFile:
    """Find the columns of a log; `LogFile.chunks` reads it. Arguments and errors are those of `read_log`."""
    path, source = Path(path), str(path)
    content = open_content(path)
    name, doubts = log_name(path), []
    packed = path.suffix.lower() == ".gz"
    if content.packed != packed:
        doubts.append("gzip, a binary file" if content.packed else "damaged or not gzip")
    head = content.head(HEAD)
    kind = find_format(path, head)
    if not path.name.lower().endswith(kind.endings):
        doubts.append(kind.name)
    doubt = f"not what its name says: it is {' and '.join(doubts)}" if doubts else ""
    with _doubting(doubt):
        columns = kind.reader.open_log(content, source, (channel_map or ChannelMap()).reader)
        names = columns.names
        if channel_map is None:
            names = [_without_si_unit(column, names, source) for column in names]
    return LogFile(path, name, channel_map, columns, names, doubt)


@contextmanager
def _doubting(doubt: str) -> Iterator[None]:
    """Say in errors that a file is not what its name says."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"{error} ({doubt})" if doubt else str(error)) from None


def _without_si_unit(name: str, names: list[str], source: str) -> str:
    """Take ``vx [m/s]`` as vx; refuse ``vx [km/h]``, which only a channel map may turn into SI."""
    parts = re.fullmatch(r"(\w+)\s*[\[(]([^\])]*)[\])]", name)
    if not parts or parts[1] not in UNITS or parts[1] in names:
        return name
    known = FACTORS[UNITS[parts[1]]]
    unit = unit_name(parts[2])
    if known.get(unit) == 1.0:
        return parts[1]
    of = f'unit = "{unit}"' if unit in known else f"its unit, one of {', '.join(known)}"
    raise UsageError(
        f"{source}: column {name!r} is not in {UNITS[parts[1]]}: "
        f'write in a channel map (`channel_map`): [channels.{parts[1]}] column = "{name}", {of}'
    )

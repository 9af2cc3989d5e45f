"""From a file to signals: any format of the table, with or without a channel map."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable
from pathlib import Path

from crosscomb.errors import UsageError
from crosscomb.files import read_bytes
from crosscomb.logs.channel_map import FACTORS, ChannelMap, Reader, apply_map, unit_name
from crosscomb.logs.formats.table import Columns, find_format, log_name
from crosscomb.signals import UNITS, Signals, make_signals

GZIP = b"\x1f\x8b"
"""How packed content begins."""


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
    path, source = Path(path), str(path)
    data = read_bytes(path)
    name, doubts = log_name(path), []
    packed = path.suffix.lower() == ".gz"
    if data.startswith(GZIP):
        data = _unpack(data, source)
        doubts += [] if packed else ["gzip, a binary file"]
    elif packed:
        doubts.append("damaged or not gzip")
    kind = find_format(path, data)
    if not path.name.lower().endswith(kind.endings):
        doubts.append(kind.name)
    note = f"not what its name says: it is {' and '.join(doubts)}" if doubts else ""
    try:
        signals = _to_signals(kind.reader.open_log, data, name, source, channel_map)
    except UsageError as error:
        raise UsageError(f"{error} ({note})" if note else str(error)) from None
    return signals.with_columns(note) if note else signals


def _to_signals(
    open_log: Callable[[bytes, str, Reader], Columns],
    data: bytes,
    name: str,
    source: str,
    channel_map: ChannelMap | None,
) -> Signals:
    """Read those columns of a log that are ours, or that the channel map makes ours."""
    signs = channel_map or ChannelMap()
    columns = open_log(data, source, signs.reader)
    names = columns.names
    if channel_map is None:
        names = [_without_si_unit(column, names, source) for column in names]
    wanted = signs.columns(names, source)
    for column in wanted:
        if names.count(column) > 1:
            raise UsageError(
                f"{source}: {columns.place}: column {column} is there twice: rename or delete one of them"
            )
    frame = columns.read({column: names.index(column) for column in wanted})
    others = [column for column in names if column and column not in wanted]
    if channel_map is None:
        return make_signals(frame, name, source, others)
    return apply_map(frame, channel_map, name, source, others)


def _unpack(data: bytes, source: str) -> bytes:
    try:
        return gzip.decompress(data)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise UsageError(
            f"{source}: is damaged or not gzip: copy it anew, or unpack it and give what is inside"
        ) from None


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

"""From a file to signals: `.csv` and `.csv.gz`, with or without a channel map."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.files import read_bytes
from crosscomb.logs.channel_map import FACTORS, ChannelMap, apply_map, unit_name
from crosscomb.signals import UNITS, Signals, make_signals

MISSING_WORDS = ("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---", "?")
"""Cells that mean "no measurement", in any case of letters."""

# pandas reads every number exactly from 3.1 on, and has deprecated the option that asked for it.
_EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
_SEPARATORS = (",", ";", "\t")


def log_name(path: str | Path) -> str:
    """File name without ``.csv`` or ``.csv.gz``: it names the outputs.

    Raises
    ------
    UsageError
        The file is of another kind.
    """
    name = re.sub(r"\.csv(\.gz)?$", "", Path(path).name, flags=re.IGNORECASE)
    if name in ("", Path(path).name):
        raise UsageError(f"{path}: not a .csv or .csv.gz file: export the log as CSV")
    return name


def read_log(path: str | Path, channel_map: ChannelMap | None = None) -> Signals:
    """Read one log.

    Separator and decimal comma are recognised unless the channel map states them. Rows are numbered as in the
    file: the header of a plain log is row 1.

    Parameters
    ----------
    path : str or Path
        A ``.csv`` or ``.csv.gz`` file.
    channel_map : ChannelMap, optional
        How foreign names, units and signs become ours. Without it the columns must be named as in
        `crosscomb.signals.UNITS`, in SI units.

    Raises
    ------
    UsageError
        The file cannot be read as a log; the message names the row or column and the mend.
    """
    name, source = log_name(path), str(path)
    reader = (channel_map or ChannelMap()).reader
    text = _read_bytes(Path(path))
    lines = _Lines(_blank_comments(text, reader.comment))
    header_row = reader.header_row or lines.first_full_row()
    if header_row == 0 or header_row > lines.count:
        raise UsageError(f"{source}: the file is empty: nothing was recorded or the export failed")
    header = lines.line(header_row)
    separator = reader.separator or _guess_separator(header)
    first_row = reader.first_data_row or header_row + 1
    names = _header_names(header, separator, source, header_row)
    if channel_map is None:
        names = [_without_si_unit(column, names, source) for column in names]
    wanted = (channel_map or ChannelMap()).columns(names, source)
    _refuse_doubles(names, wanted, source, header_row)
    lines.refuse_ragged(first_row, len(names), separator, source)
    decimal = reader.decimal or _guess_decimal(lines, first_row, separator)
    frame = _parse(lines, first_row, names, wanted, separator, decimal, source)
    others = [column for column in names if column and column not in wanted]
    if channel_map is None:
        return make_signals(frame, name, source, others)
    return apply_map(frame, channel_map, name, source, others)


def _read_bytes(path: Path) -> bytes:
    try:
        data = read_bytes(path)
        if path.suffix.lower() == ".gz":
            data = gzip.decompress(data)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise UsageError(
            f"{path}: is damaged or not gzip: copy it anew, or unpack it and give the .csv"
        ) from None
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UsageError(f"{path}: is UTF-16 text: save it as UTF-8")
    if re.search(rb"[\x00-\x08\x0e-\x1f]", data):
        raise UsageError(f"{path}: is a binary file, not text: export the log as CSV")
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


def _blank_comments(data: bytes, comment: str) -> bytes:
    """Empty the lines that hold only a comment or only blanks; the row numbers stay."""
    mark = comment.encode()
    if mark and mark in data:
        data = re.sub(rb"(?m)^[ \t]*" + re.escape(mark) + rb".*$", b"", data)
    return re.sub(rb"(?m)^[ \t]+$", b"", data)


class _Lines:
    """The lines of a text file, numbered from 1, found without a Python loop over them."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._bytes = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(self._bytes == ord("\n"))
        if data and not data.endswith(b"\n"):
            ends = np.append(ends, len(data))
        self._ends = ends
        self._starts = np.concatenate([[0], ends[:-1] + 1]) if ends.size else ends
        self.count = len(ends)

    def line(self, row: int) -> str:
        line = self.data[self._starts[row - 1] : self._ends[row - 1]]
        try:
            return line.decode("utf-8")
        except UnicodeDecodeError:
            return line.decode("latin-1")

    def after(self, row: int) -> bytes:
        """Text from this row on."""
        return self.data[self._starts[row - 1] :] if row <= self.count else b""

    def first_full_row(self) -> int:
        """First row that is not blank; 0 where all are."""
        return next((row for row in range(1, self.count + 1) if self.line(row).strip()), 0)

    def full(self, first_row: int) -> np.ndarray:
        """Tell which of the rows from `first_row` on are not blank."""
        return self._ends[first_row - 1 :] > self._starts[first_row - 1 :]

    def refuse_ragged(self, first_row: int, columns: int, separator: str, source: str) -> None:
        """Raise where a row has another number of fields than the header."""
        if separator == " " or b'"' in self.data:
            return  # pandas finds too many fields there itself
        places = np.flatnonzero(self._bytes == ord(separator))
        up_to = np.searchsorted(places, self._ends)
        fields = np.diff(up_to, prepend=0) + 1
        wrong = np.flatnonzero((fields[first_row - 1 :] != columns) & self.full(first_row))
        if wrong.size == 0:
            return
        row = first_row + int(wrong[0])
        found = int(fields[row - 1])
        mend = "complete or delete that row"
        if separator == "," and found >= 2 * columns - 1:
            mend = "a decimal comma needs another separator, such as a semicolon: export the log anew"
        raise UsageError(f"{source}: row {row} has {found} fields, the header has {columns}: {mend}")


def _guess_separator(header: str) -> str:
    counts = {separator: header.count(separator) for separator in _SEPARATORS}
    best = max(counts, key=lambda separator: counts[separator])
    return best if counts[best] else " "


def _guess_decimal(lines: _Lines, first_row: int, separator: str) -> str:
    if separator == ",":
        return "."
    sample = lines.after(first_row)[:4000]
    return "," if re.search(rb"\d,\d", sample) and not re.search(rb"\d\.\d", sample) else "."


def _header_names(header: str, separator: str, source: str, row: int) -> list[str]:
    fields = header.split() if separator == " " else next(csv.reader([header], delimiter=separator))
    names = [field.strip() for field in fields]
    if all(re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?", name) for name in names):
        raise UsageError(f"{source}: row {row} holds numbers, not column names: add a header row")
    return names


def _refuse_doubles(names: list[str], wanted: list[str], source: str, row: int) -> None:
    for column in wanted:
        if names.count(column) > 1:
            raise UsageError(
                f"{source}: row {row}: column {column} is there twice: rename or delete one of them"
            )


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
        f'write in a channel map (--map): [channels.{parts[1]}] column = "{name}", {of}'
    )


def _parse(
    lines: _Lines,
    first_row: int,
    names: list[str],
    wanted: list[str],
    separator: str,
    decimal: str,
    source: str,
) -> pd.DataFrame:
    """Numbers of the wanted columns; the index called ``row`` holds the row numbers in the file."""
    places = [names.index(column) for column in wanted]
    full = lines.full(first_row)
    if not places or not full.any():
        return pd.DataFrame({column: np.empty(0) for column in wanted})
    try:
        frame = pd.read_csv(
            io.BytesIO(lines.after(first_row)),
            sep=r"\s+" if separator == " " else separator,
            header=None,
            names=range(len(names)),
            usecols=places,
            index_col=False,
            decimal=decimal,
            skip_blank_lines=False,
            skipinitialspace=True,
            na_values=["NAN", "---", "--", "-", "?"],
            encoding="latin-1",  # numbers are ASCII; a stray letter is reported by row below
            low_memory=False,
            **_EXACT,
        )
    except pd.errors.ParserError as error:
        raise UsageError(f"{source}: no regular table: {str(error).strip()}") from None
    frame = frame[places].set_axis(wanted, axis="columns")
    frame.index = pd.RangeIndex(first_row, first_row + len(frame), name="row")
    frame = frame[full[: len(frame)]]
    for column in wanted:
        if not pd.api.types.is_float_dtype(frame[column]) and not pd.api.types.is_integer_dtype(
            frame[column]
        ):
            frame[column] = _numbers(frame[column], decimal, source)
    return frame.astype(np.float64)


def _numbers(cells: pd.Series, decimal: str, source: str) -> pd.Series:
    """Turn cells that pandas did not take as numbers into numbers, or name the first that is none."""
    text = cells.astype(object).where(cells.notna(), "").astype(str).str.strip()
    missing = text.str.lower().isin(MISSING_WORDS)
    numbers = pd.to_numeric(text.str.replace(decimal, ".").mask(missing), errors="coerce").astype(np.float64)
    wrong = np.flatnonzero(numbers.isna() & ~missing)
    if wrong.size:
        row, cell = cells.index[wrong[0]], text.iloc[wrong[0]]
        mend = "correct the cell, or empty it if nothing was measured"
        if wrong[0] == 0:
            mend += (
                f"; for a row of units write in a channel map (--map): [reader] first_data_row = {row + 1}"
            )
        if decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", cell):
            mend = 'for a decimal comma write in a channel map (--map): [reader] decimal = ","'
        raise UsageError(f"{source}: row {row}, column {cells.name}: {cell[:40]!r} is not a number: {mend}")
    return numbers

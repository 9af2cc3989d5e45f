"""CSV: text with one header row; separator and decimal comma are recognised unless the channel map states them."""

from __future__ import annotations

import csv
import io
import re
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import Reader
from crosscomb.logs.formats.table import Columns

MISSING_WORDS = ("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---", "?")
"""Cells that mean "no measurement", in any case of letters."""

# pandas reads every number exactly from 3.1 on, and has deprecated the option that asked for it.
_EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
_SEPARATORS = (",", ";", "\t")
_WIDE = (b"\xff\xfe", b"\xfe\xff")
_BINARY = re.compile(rb"[\x00-\x08\x0e-\x1f]")


def recognises(data: bytes) -> bool:
    """Any text may be CSV."""
    return not _BINARY.search(data)


def open_log(data: bytes, source: str, reader: Reader) -> Columns:
    """Find the header; see `crosscomb.logs.formats.table.FormatReader`."""
    lines = _Lines(_blank_comments(_plain_text(data, source), reader.comment))
    header_row = reader.header_row or lines.first_full_row()
    if header_row == 0 or header_row > lines.count:
        raise UsageError(f"{source}: the file is empty: nothing was recorded or the export failed")
    header = lines.line(header_row)
    separator = reader.separator or _guess_separator(header)
    first_row = reader.first_data_row or header_row + 1
    names = _header_names(header, separator, source, header_row)

    def read(places: dict[str, int]) -> pd.DataFrame:
        lines.refuse_ragged(first_row, len(names), separator, source)
        decimal = reader.decimal or _guess_decimal(lines, first_row, separator)
        return _parse(lines, first_row, len(names), places, separator, decimal, source)

    return Columns(names, f"row {header_row}", read)


def _plain_text(data: bytes, source: str) -> bytes:
    """The bytes of a text that an ASCII reader understands, with one kind of line end."""
    if data.startswith(_WIDE):
        raise UsageError(f"{source}: is UTF-16 text: save it as UTF-8")
    if _BINARY.search(data):
        raise UsageError(f"{source}: is a binary file, not text: export the log as CSV")
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


def _parse(
    lines: _Lines,
    first_row: int,
    width: int,
    wanted: dict[str, int],
    separator: str,
    decimal: str,
    source: str,
) -> pd.DataFrame:
    """Numbers of the wanted columns; the index called ``row`` holds the row numbers in the file."""
    places = list(wanted.values())
    full = lines.full(first_row)
    if not places or not full.any():
        return pd.DataFrame({column: np.empty(0) for column in wanted})
    try:
        frame = pd.read_csv(
            io.BytesIO(lines.after(first_row)),
            sep=r"\s+" if separator == " " else separator,
            header=None,
            names=range(width),
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
    frame = frame[places].set_axis(list(wanted), axis="columns")
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
            mend += f"; for a row of units write in a channel map (`channel_map`): [reader] first_data_row = {row + 1}"
        if decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", cell):
            mend = 'for a decimal comma write in a channel map (`channel_map`): [reader] decimal = ","'
        raise UsageError(f"{source}: row {row}, column {cells.name}: {cell[:40]!r} is not a number: {mend}")
    return numbers

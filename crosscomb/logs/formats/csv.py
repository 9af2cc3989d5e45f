"""CSV: text with one header row; separator and decimal comma are recognised unless the channel map states them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import Reader
from crosscomb.logs.content import Content
from crosscomb.logs.formats.table import Columns

MISSING_WORDS = ("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---", "?")
"""Cells that mean "no measurement", in any case of letters."""

# pandas reads every number exactly from 3.1 on, and has deprecated the option that asked for it.
_EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
MOST_COLUMNS = 10_000
MOST_FIELD = 10_000
"""Characters of a field."""
MOST_LINE = 1 << 24
"""Characters of a line, or of lines in one pair of quotes."""
MOST_BLANK = 1_000_000
"""So many more rows may be empty than are not."""

_ANEW = "export the log anew"
_SEPARATORS = (",", ";", "\t")
_WIDE = (b"\xff\xfe", b"\xfe\xff")
_BINARY = re.compile(rb"[\x00-\x08\x0e-\x1f]")


def recognises(data: bytes) -> bool:
    """Any text may be CSV."""
    return not _BINARY.search(data)


def open_log(content: Content, source: str, reader: Reader) -> Columns:
    """Find the header; see `crosscomb.logs.formats.table.FormatReader`."""
    header_row, header = _find_header(_blocks(content, source, reader.comment), reader.header_row, source)
    separator = reader.separator or _guess_separator(header)
    first_row = reader.first_data_row or header_row + 1
    names = _header_names(header, separator, source, header_row)
    notes: list[str] = []

    def read(places: dict[str, int]) -> Iterator[pd.DataFrame]:
        table = _Table(source, first_row, len(names), separator, places, reader.decimal)
        notes.clear()
        for lines in _blocks(content, source, reader.comment) if places else ():
            if lines.end > first_row:
                lines, cut = lines.without_cut_row(len(names), separator)
                notes.extend(cut)
                frame = table.numbers(lines) if lines.end > first_row else table.empty()
                if len(frame):
                    yield frame
        if not table.begun:
            yield table.empty()

    return Columns(names, f"row {header_row}", read, notes)


def _blocks(content: Content, source: str, comment: str) -> Iterator[_Lines]:
    """The lines of a text in blocks: whole lines, one kind of line end, comments and blanks emptied."""
    row, blank, rest = 1, 0, b""
    for piece, last in _with_last(content.pieces()):
        data = _plain_text(rest + piece, source, first=row == 1)
        half = b"\r" if data.endswith(b"\r") and not last else b""  # of a line end
        if b"\r" in data:
            data = data.removesuffix(half).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        cut = len(data) if last else data.rfind(b"\n") + 1
        text, rest = _blank_comments(data[:cut], comment), data[cut:] + half
        if len(rest) > MOST_LINE:
            long = row + text.count(b"\n")
            raise UsageError(f"{source}: row {long} has more than {MOST_LINE} characters: {_ANEW}")
        if text.count(b'"') % 2 and not last and len(text) <= MOST_LINE:  # it may go on in the next piece
            text, rest = b"", text + rest
        if text:
            lines = _Lines(text, row, last)
            row = lines.end
            blank += lines.count - 2 * int(np.count_nonzero(lines.full(lines.row)))
            if blank > MOST_BLANK:
                raise UsageError(
                    f"{source}: {MOST_BLANK} more rows up to row {row - 1} are empty than are not: {_ANEW}"
                )
            yield lines


def _with_last(pieces: Iterator[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Each piece, and whether it is the last one; one empty piece where there is none."""
    held = next(pieces, b"")
    for piece in pieces:
        yield held, False
        held = piece
    yield held, True


def _find_header(blocks: Iterator[_Lines], row: int | None, source: str) -> tuple[int, str]:
    """Number and text of the header: that row, or the first one that is not blank."""
    for lines in blocks:
        found = row or lines.first_full_row()
        if 0 < found < lines.end:
            return found, lines.line(found)
    raise UsageError(f"{source}: the file is empty: nothing was recorded or the export failed")


def _plain_text(data: bytes, source: str, first: bool) -> bytes:
    """The bytes of a text that an ASCII reader understands; the `first` ones may hold a mark of the encoding."""
    if first and data.startswith(_WIDE):
        raise UsageError(f"{source}: is UTF-16 text: save it as UTF-8")
    codes = np.frombuffer(data, np.uint8)
    if (codes < 9).any() or (codes - np.uint8(14) < 18).any():  # as `_BINARY`, ten times as fast
        raise UsageError(f"{source}: is a binary file, not text: export the log as CSV")
    return data.removeprefix(b"\xef\xbb\xbf") if first else data


def _blank_comments(data: bytes, comment: str) -> bytes:
    """Empty the lines that hold only a comment or only blanks; the row numbers stay."""
    mark = comment.encode()
    if mark and mark in data:
        data = re.sub(rb"(?m)^[ \t]*" + re.escape(mark) + rb".*$", b"", data)
    starts = np.flatnonzero(np.frombuffer(data, np.uint8)[:-1] == ord("\n")) + 1
    if data[:1] in (b" ", b"\t") or np.isin(np.frombuffer(data, np.uint8)[starts], (9, 32)).any():
        data = re.sub(rb"(?m)^[ \t]+$", b"", data)
    return data


class _Lines:
    """Lines of a text file, numbered from `row` on, found without a Python loop over them."""

    def __init__(self, data: bytes, row: int, last: bool = False) -> None:
        self.data = data
        self.row = row
        self.unended = last and not data.endswith(b"\n")  # the last line of the file
        self._bytes = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(self._bytes == ord("\n"))
        if not data.endswith(b"\n"):
            ends = np.append(ends, len(data))
        self._ends = ends
        self._starts = np.concatenate([[0], ends[:-1] + 1])
        self.count = len(ends)

    @property
    def end(self) -> int:
        """Number of the row after the last one."""
        return self.row + self.count

    def line(self, row: int) -> str:
        line = self.data[self._starts[row - self.row] : self._ends[row - self.row]]
        try:
            return line.decode("utf-8")
        except UnicodeDecodeError:
            return line.decode("latin-1")

    def after(self, row: int) -> bytes:
        """Text from this row on."""
        return self.data[self._starts[row - self.row] :]

    def first_full_row(self) -> int:
        """First row that is not blank; 0 where all are."""
        return next((row for row in range(self.row, self.end) if self.line(row).strip()), 0)

    def full(self, first_row: int) -> np.ndarray:
        """Tell which of the rows from `first_row` on are not blank."""
        place = first_row - self.row
        return self._ends[place:] > self._starts[place:]

    def without_cut_row(self, columns: int, separator: str) -> tuple[_Lines, list[str]]:
        """These lines without a last one that was cut off while it was written, and a note on it."""
        row = self.end - 1
        if not self.unended or not self.full(row).any():
            return self, []
        line = self.line(row)
        fields = len(line.split()) if separator == " " else line.count(separator) + 1
        if fields >= columns and line.count('"') % 2 == 0:
            return self, []
        note = f"row {row}, the last one, dropped: it was cut off ({fields} of {columns} fields)"
        return _Lines(self.data[: self._starts[row - self.row]], self.row), [note]

    def refuse_long_fields(self, first_row: int, separator: str, source: str) -> None:
        """Raise where a field is longer than any number or word."""
        place = first_row - self.row
        long = np.flatnonzero(self._ends[place:] - self._starts[place:] > MOST_FIELD)
        for row in (first_row + long).tolist():
            for number, field in enumerate(self.line(row).split(separator), 1):
                if len(field) > MOST_FIELD:
                    raise UsageError(
                        f"{source}: row {row}, field {number} has {len(field)} characters, "
                        f"more than {MOST_FIELD}: correct the row, or {_ANEW}"
                    )

    def refuse_ragged(self, first_row: int, columns: int, separator: str, source: str) -> None:
        """Raise where a row has another number of fields than the header."""
        if separator == " " or b'"' in self.data:
            return  # pandas finds too many fields there itself
        places = np.flatnonzero(self._bytes == ord(separator))
        up_to = np.searchsorted(places, self._ends)
        fields = (np.diff(up_to, prepend=0) + 1)[first_row - self.row :]
        wrong = np.flatnonzero((fields != columns) & self.full(first_row))
        if wrong.size == 0:
            return
        row, found = first_row + int(wrong[0]), int(fields[wrong[0]])
        mend = "complete or delete that row"
        if separator == "," and found >= 2 * columns - 1:
            mend = "a decimal comma needs another separator, such as a semicolon: export the log anew"
        raise UsageError(f"{source}: row {row} has {found} fields, the header has {columns}: {mend}")


def _guess_separator(header: str) -> str:
    counts = {separator: header.count(separator) for separator in _SEPARATORS}
    best = max(counts, key=lambda separator: counts[separator])
    return best if counts[best] else " "


def _guess_decimal(sample: bytes, separator: str) -> str:
    if separator == ",":
        return "."
    return "," if re.search(rb"\d,\d", sample) and not re.search(rb"\d\.\d", sample) else "."


def _header_names(header: str, separator: str, source: str, row: int) -> list[str]:
    fields = header.split() if separator == " " else next(csv.reader([header], delimiter=separator))
    names = [field.strip() for field in fields]
    if len(names) > MOST_COLUMNS:
        raise UsageError(
            f"{source}: row {row} has {len(names)} columns, more than {MOST_COLUMNS}: export fewer of them"
        )
    longest = max(range(len(names)), key=lambda place: len(names[place]))
    if len(names[longest]) > MOST_FIELD:
        raise UsageError(
            f"{source}: row {row}, field {longest + 1} has {len(names[longest])} characters, "
            f"more than {MOST_FIELD}: this is no name of a column: write a header row"
        )
    if all(re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?", name) for name in names):
        raise UsageError(f"{source}: row {row} holds numbers, not column names: add a header row")
    return names


class _Table:
    """The wanted columns of a log on their way from text to numbers, block by block."""

    def __init__(
        self,
        source: str,
        first_row: int,
        width: int,
        separator: str,
        wanted: dict[str, int],
        decimal: str | None,
    ) -> None:
        self.source = source
        self.first_row = first_row  # of data; a block that begins below it begins at its own first row
        self.width = width
        self.separator = separator
        self.wanted = wanted
        self.decimal = decimal
        self.begun = False  # there was a row with data

    def empty(self) -> pd.DataFrame:
        """No rows of the wanted columns."""
        return pd.DataFrame({column: np.empty(0) for column in self.wanted}).rename_axis(index="row")

    def numbers(self, lines: _Lines) -> pd.DataFrame:
        """Numbers of the wanted columns; the index called ``row`` holds the row numbers in the file."""
        first_row = max(self.first_row, lines.row)
        lines.refuse_ragged(first_row, self.width, self.separator, self.source)
        lines.refuse_long_fields(first_row, self.separator, self.source)
        full = lines.full(first_row)
        if not self.wanted or not full.any():
            return self.empty()
        self.decimal = self.decimal or _guess_decimal(lines.after(first_row)[:4000], self.separator)
        frame = self._parse(lines.after(first_row))
        frame.index = pd.RangeIndex(first_row, first_row + len(frame), name="row")
        frame = frame[full[: len(frame)]]
        for column in self.wanted:
            if not pd.api.types.is_float_dtype(frame[column]) and not pd.api.types.is_integer_dtype(
                frame[column]
            ):
                frame[column] = _numbers(frame[column], self.decimal, self.source, not self.begun)
        self.begun = True
        return frame.astype(np.float64)

    def _parse(self, text: bytes) -> pd.DataFrame:
        places = list(self.wanted.values())
        try:
            frame = pd.read_csv(
                io.BytesIO(text),
                sep=r"\s+" if self.separator == " " else self.separator,
                header=None,
                names=range(self.width),
                usecols=places,
                index_col=False,
                decimal=self.decimal or ".",
                skip_blank_lines=False,
                skipinitialspace=True,
                na_values=["NAN", "---", "--", "-", "?"],
                encoding="latin-1",  # numbers are ASCII; a stray letter is reported by row below
                low_memory=False,
                **_EXACT,
            )
        except pd.errors.ParserError as error:
            raise UsageError(f"{self.source}: no regular table: {str(error).strip()}") from None
        return frame[places].set_axis(list(self.wanted), axis="columns")


def _numbers(cells: pd.Series, decimal: str, source: str, at_top: bool) -> pd.Series:
    """Turn cells that pandas did not take as numbers into numbers, or name the first that is none.

    The first cells of a log are `at_top`: there a word may be a unit.
    """
    text = cells.astype(object).where(cells.notna(), "").astype(str).str.strip()
    missing = text.str.lower().isin(MISSING_WORDS)
    numbers = pd.to_numeric(text.str.replace(decimal, ".").mask(missing), errors="coerce").astype(np.float64)
    wrong = np.flatnonzero(numbers.isna() & ~missing)
    if wrong.size:
        row, cell = cells.index[wrong[0]], text.iloc[wrong[0]]
        mend = "correct the cell, or empty it if nothing was measured"
        if wrong[0] == 0 and at_top:
            mend += f"; for a row of units write in a channel map (`channel_map`): [reader] first_data_row = {row + 1}"
        if decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", cell):
            mend = 'for a decimal comma write in a channel map (`channel_map`): [reader] decimal = ","'
        raise UsageError(f"{source}: row {row}, column {cells.name}: {cell[:40]!r} is not a number: {mend}")
    return numbers

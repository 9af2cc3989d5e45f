"""Bytes of a log, unpacked where they are gzip, piece by piece: no log is ever held whole for being long."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from crosscomb.errors import UsageError
from crosscomb.files import open_file

GZIP = b"\x1f\x8b"
"""How packed content begins."""

PIECE = 1 << 21
"""Bytes of a piece."""

MOST_RATIO = 400
"""Text of a log unpacks to 3 to 100 times its size; what unpacks to more than this is no log."""

LEAST_SUSPECT = 1 << 26
"""So many bytes are unpacked without a doubt."""


@dataclass(frozen=True)
class Content:
    """A file on the disk, read as often as wanted.

    Attributes
    ----------
    path : Path
    packed : bool
        It is gzip.
    """

    path: Path
    packed: bool

    def pieces(self) -> Iterator[bytes]:
        """Unpacked bytes, at most `PIECE` at a time.

        Raises
        ------
        UsageError
            The file is damaged, or unpacks to more than any log does.
        """
        with open_file(self.path) as file:
            if not self.packed:
                yield from iter(lambda: file.read(PIECE), b"")
                return
            size, total = self.path.stat().st_size, 0
            try:
                with gzip.GzipFile(fileobj=file) as unpacked:
                    while piece := unpacked.read(PIECE):
                        total += len(piece)
                        if total > max(LEAST_SUSPECT, MOST_RATIO * size):
                            raise UsageError(
                                f"{self.path}: unpacks to more than {MOST_RATIO} times its size, as no log does: "
                                f"unpack it and look what it holds"
                            )
                        yield piece
            except (EOFError, zlib.error, gzip.BadGzipFile):
                raise UsageError(
                    f"{self.path}: is damaged or not gzip: copy it anew, or unpack it and give what is inside"
                ) from None

    def head(self, size: int) -> bytes:
        """The first `size` bytes, fewer where there are no more."""
        return next(self.pieces(), b"")[:size]

    def whole(self) -> bytes:
        """All bytes, for formats that cannot be read in pieces."""
        return b"".join(self.pieces())


def open_content(path: Path) -> Content:
    """Find out whether a file is gzip, whatever its name says."""
    with open_file(path) as file:
        return Content(path, file.read(len(GZIP)) == GZIP)

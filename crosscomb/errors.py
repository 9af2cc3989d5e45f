"""The one kind of error a user can mend, and how what was found is shown in it."""

from __future__ import annotations

import reprlib
from typing import Any


class UsageError(Exception):
    """One line that names the file, row or column at fault and says the mend.

    The command line prints it without a traceback and exits with code 2.
    """


def shown(value: Any) -> str:
    """A value as a message shows it: short, however long, deep or large it is."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        return "a huge number"


def printable(text: str, but: str = "") -> str:
    """A text as a terminal may show it: names of files and columns cannot steer it, nor hide or reverse what is read.

    Characters that cannot be printed become escapes such as ``\\x1b``, all `but` these.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or char in but else char.encode("unicode_escape").decode("ascii")
        for char in text
    )

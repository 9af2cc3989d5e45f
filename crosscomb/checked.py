"""Checked files: TOML or JSON that must fit a model, else one line that says what to mend."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscomb.errors import UsageError, shown
from crosscomb.files import read_bytes

MOST_BYTES = {"TOML": 1 << 18, "JSON": 1 << 28}
"""So large may a file be."""

MOST_DOTS = 200
"""In a line of TOML: `tomllib` takes a time that grows with the square of the parts of a key, hours for a megabyte."""

LARGEST = 3.4028234663852886e38
"""Largest number of single precision, in which learned things are evaluated."""

Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""A number of a learned thing."""

Index = Annotated[int, Field(ge=-1, lt=2**31)]
"""A place in a list; -1 is none."""


class Record(BaseModel):
    """What a checked file holds: never changed, no key is unknown, numbers are finite, and nothing else is a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


AnyRecord = TypeVar("AnyRecord", bound=Record)


@dataclass(frozen=True)
class FileKind(Generic[AnyRecord]):
    """One kind of checked file.

    Attributes
    ----------
    name : str
        As messages call it.
    record : type of Record
        What it must fit.
    syntax : {"TOML", "JSON"}
    origin : str
        What to do where there is none.
    mend : str
        What to do where it is wrong; empty where the fault itself says so.
    version : int, optional
        The only ``schema_version`` that is read.
    check : callable, optional
        Raises `UsageError` where a record that fits is wrong all the same.
    """

    name: str
    record: type[AnyRecord]
    syntax: Literal["TOML", "JSON"]
    origin: str
    mend: str = ""
    version: int | None = None
    check: Callable[[AnyRecord], None] | None = None


def read_checked(path: str | Path, kind: FileKind[AnyRecord]) -> AnyRecord:
    """Read a checked file.

    Raises
    ------
    UsageError
        The file is missing, no file, no UTF-8 text, or not what it should be.
    """
    data = read_bytes(Path(path), MOST_BYTES[kind.syntax], kind.name, kind.origin)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise _fault(kind, f"{path}: cannot be read: the {kind.name} is no UTF-8 text") from None
    return parse_checked(text.replace("\r\n", "\n").replace("\r", "\n"), str(path), kind)


def parse_checked(text: str, source: str, kind: FileKind[AnyRecord]) -> AnyRecord:
    """Make a record from the text of a checked file; `source` names it in messages.

    Raises
    ------
    UsageError
    """
    if kind.syntax == "TOML" and any(line.count(".") > MOST_DOTS for line in text.splitlines()):
        raise _fault(kind, f"{source}: no {kind.name} has a line of more than {MOST_DOTS} dots")
    try:
        content: Any = tomllib.loads(text) if kind.syntax == "TOML" else json.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _fault(kind, f"{source}: no valid TOML: {str(error)[:200]}") from None
    except json.JSONDecodeError as error:
        raise _fault(kind, f"{source}: line {error.lineno}: no valid JSON") from None
    except (RecursionError, ValueError):  # nested too deeply, or a number of thousands of digits
        raise _fault(kind, f"{source}: no {kind.name} holds what this one holds") from None
    if kind.version is not None:
        version = content.get("schema_version") if isinstance(content, dict) else None
        if version != kind.version:
            found = f"schema version {shown(version)} of the {kind.name}, this crosscomb reads {kind.version}"
            raise UsageError(f"{source}: {found}: {kind.mend} with this version")
    try:
        record = kind.record.model_validate(content)
    except ValidationError as error:
        raise _fault(kind, f"{source}: {_first_fault(error)}") from None
    if kind.check is not None:
        try:
            kind.check(record)
        except UsageError as error:
            raise UsageError(f"{source}: {error}") from None
    return record


def _fault(kind: FileKind[AnyRecord], message: str) -> UsageError:
    return UsageError(f"{message}: {kind.mend}" if kind.mend else message)


def _first_fault(error: ValidationError) -> str:
    """Say the first fault of a checked file in one line."""
    first = error.errors()[0]
    key = ".".join(str(part)[:80] for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown key {key}: delete it or correct its spelling"
    if first["type"] == "missing":
        return f"key {key} is missing: add it"
    message = first["msg"].removeprefix("Value error, ")
    # A table or a list is many lines long, and the message says what is wrong in it.
    found = "" if isinstance(first["input"], dict | list) else f" (found {shown(first['input'])})"
    return f"{key}: {message}{found}" if key else message

"""Make pieces in a thread while the ones before them are used: kernels and parsers leave the interpreter free."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")

DEPTH = 2
"""So many pieces are made or wait at a time: memory does not grow with how many there are."""

_END: Any = object()


def ahead(pieces: Iterable[T]) -> Iterator[T]:
    """Give the same pieces in the same order, made a little before they are asked for.

    What making one raises comes where the piece would have come. A caller that stops early waits for those begun.
    """
    source = iter(pieces)
    with ThreadPoolExecutor(1) as worker:
        made = deque(worker.submit(next, source, _END) for _ in range(DEPTH))
        while (piece := made.popleft().result()) is not _END:
            yield piece
            del piece
            made.append(worker.submit(next, source, _END))

"""Ctrl-C and SIGTERM: whatever runs ends within two seconds, and leaves no temporary file and no worker behind."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

from crosscomb.files import remove_unfinished

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}

GRACE = 1.0
"""So long [s] a run may take to end by itself; compiled code sees no signal before it returns."""


PATIENCE = 0.4
"""So long [s] is waited for each part of the cleaning up: workers are killed first, and joined at leisure."""


class Stopped(BaseException):
    """A signal asked this run to end; no library takes it for an error of its own."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise `Stopped` in here when a signal comes, and end the process where that does not help in time."""
    _came.clear()
    heeded = [number for number in WORDS if signal.getsignal(number) != signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    threading.Thread(target=_watch, args=(ours,), daemon=True).start()
    wake = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    before = {number: signal.signal(number, _stop) for number in heeded}
    try:
        yield
    except Stopped:
        raise  # nothing more is heeded
    except BaseException:
        _put_back(before, wake, theirs)
        raise
    else:
        _put_back(before, wake, theirs)


def _put_back(before: Mapping[signal.Signals, object], wake: int, theirs: socket.socket) -> None:
    signal.set_wakeup_fd(wake)
    for number, handler in before.items():
        signal.signal(number, handler)  # type: ignore[arg-type]
    theirs.close()


_came: list[int] = []


def stopped_by() -> int:
    """The signal that asked this run to end, 0 where none came: libraries turn `Stopped` into errors of their own."""
    return _came[0] if _came else 0


def _stop(number: int, _: FrameType | None) -> None:
    for each in WORDS:
        signal.signal(each, signal.SIG_IGN)
    _came.append(number)
    threading.excepthook = lambda _: None  # what other threads meet while all ends is no news
    raise Stopped(number)


def _watch(ours: socket.socket) -> None:
    """Wait for a signal, then for the end of the process, and bring it about if it does not come."""
    numbers: list[int] = []
    while not numbers:
        data = ours.recv(16)
        if not data:
            return
        numbers = [number for number in data if number in WORDS]
    time.sleep(GRACE)
    clean_up(numbers[0])
    os._exit(128 + numbers[0])


def _end_workers() -> None:
    parallel = sys.modules.get("crosscomb.training.parallel")
    if parallel is not None:
        parallel.end_workers()


_cleaned = threading.Lock()


def clean_up(number: int) -> None:
    """End worker processes, remove what is unfinished, and say one line, once."""
    for work in (_end_workers, remove_unfinished):
        # Beside this thread: a library may hold a lock for ever that ending its workers needs.
        aside = threading.Thread(target=work, daemon=True)
        aside.start()
        aside.join(PATIENCE)
    if _cleaned.acquire(blocking=False):
        print(f"error: {WORDS[signal.Signals(number)]}", file=sys.stderr, flush=True)

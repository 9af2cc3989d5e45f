"""Many pieces of work side by side."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from threading import Thread
from typing import Any

from joblib import Parallel, delayed
from joblib.externals.loky import reusable_executor
from threadpoolctl import threadpool_limits


def in_parallel(
    work: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[], None] | None = None,
) -> list[Any]:
    """Do tasks in processes, one thread each, and give their results in order, which does not depend on how many.

    Parameters
    ----------
    work : callable
    tasks : iterable of tuple
        Arguments of each call.
    jobs : int
        Processes.
    progress : callable, optional
        Called after each.
    """
    # Nothing is mapped: kernels would be compiled anew for read-only arrays.
    parallel = Parallel(n_jobs=jobs, return_as="generator", max_nbytes=None)
    results, parent = [], os.getpid()
    try:
        for result in parallel(delayed(_alone)(work, task, parent) for task in tasks):
            results.append(result)
            if progress is not None:
                progress()
    except BaseException:
        end_workers()
        raise
    return results


def end_workers() -> None:
    """End all worker processes at once, whatever they do."""
    executor = reusable_executor._executor
    if executor is None:
        return
    workers = list((executor._processes or {}).values())
    for worker in workers:
        with suppress(OSError, AttributeError):  # it has ended, or has not quite begun
            os.kill(worker.pid, signal.SIGKILL) if os.name == "posix" else worker.terminate()
    for worker in workers:
        with suppress(OSError, AttributeError, AssertionError):
            worker.join(1.0)
    executor.shutdown(wait=False, kill_workers=True)


def _alone(work: Callable[..., Any], task: tuple[Any, ...], parent: int) -> Any:
    """Do a task on one thread, so that its sums are the same everywhere."""
    if os.getpid() != parent:
        _follow(parent)
    with threadpool_limits(1):
        return work(*task)


@cache
def _follow(parent: int) -> None:
    """Let a worker process heed its parent only: end when that is gone, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    if os.name == "posix":  # elsewhere a process is told the same parent for ever
        Thread(target=watch, daemon=True).start()

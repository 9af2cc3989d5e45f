"""Many pieces of work side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

LARGE = "100K"
"""Arrays from this size on go to other processes once, as files that all of them map."""


def in_parallel(
    work: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[], None] | None = None,
    shared: bool = False,
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
    shared : bool
        Tasks share large arrays: map them instead of sending them with each.
    """
    # Mapped to be written to, though no write is shared: kernels would be compiled anew for read-only arrays.
    parallel = Parallel(
        n_jobs=jobs, return_as="generator", max_nbytes=LARGE if shared else None, mmap_mode="c"
    )
    results = []
    for result in parallel(delayed(_alone)(work, task) for task in tasks):
        results.append(result)
        if progress is not None:
            progress()
    return results


def _alone(work: Callable[..., Any], task: tuple[Any, ...]) -> Any:
    """Do a task on one thread, so that its sums are the same everywhere."""
    with threadpool_limits(1):
        return work(*task)

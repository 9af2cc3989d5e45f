"""Many pieces of work side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal

from joblib import Parallel, delayed


def in_parallel(
    work: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    jobs: int,
    progress: Callable[[], None] | None = None,
    prefer: Literal["processes", "threads"] | None = None,
) -> list[Any]:
    """Do tasks at once and give their results in order, which do not depend on how many go at once.

    Parameters
    ----------
    work : callable
    tasks : iterable of tuple
        Arguments of each call.
    jobs : int
        How many at once.
    progress : callable, optional
        Called after each.
    prefer : str, optional
        ``threads`` instead of processes.
    """
    # max_nbytes: arrays from mapped files are read-only, and kernels would be compiled anew for them.
    parallel = Parallel(n_jobs=jobs, return_as="generator", max_nbytes=None, prefer=prefer)
    results = []
    for result in parallel(delayed(work)(*task) for task in tasks):
        results.append(result)
        if progress is not None:
            progress()
    return results

"""Kernels are compiled once for each installation, not once for each process."""

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from crosscomb.filters import columns as at
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.models.vehicle import load_vehicle

PROGRAM = """
import json, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.models.vehicle import load_vehicle

vehicle = load_vehicle("generic_compact")
samples = np.zeros((30, at.SAMPLE_WIDTH))
samples[:, at.VX] = 20.0
for name in CATALOGUE:
    estimator = make_filter(name, vehicle)
    estimator.run(Inputs(0.01, samples))
    estimator.step(estimator.start(0.01), samples[0])

kernels = {}
for module in [m for n, m in list(sys.modules.items()) if n.startswith("crosscomb.")]:
    for kernel in vars(module).values():
        if isinstance(kernel, Dispatcher) and kernel.signatures:
            stats = kernel.stats
            name = f"{kernel.__module__}.{kernel.__name__}"
            kernels[name] = [sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]
print(json.dumps(kernels))
"""


def kernels_used() -> dict[str, tuple[int, int]]:
    """Cache hits and misses of every kernel that a fresh process used."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return {name: (hits, misses) for name, (hits, misses) in json.loads(done.stdout).items()}


def test_a_second_process_compiles_nothing() -> None:
    kernels_used()  # whatever has not been compiled yet on this machine is compiled here
    second = kernels_used()
    assert {name for name, (_, misses) in second.items() if misses} == set()
    loaded = {name for name, (hits, _) in second.items() if hits}
    for kernel in (
        "kinematic.kf.kinematic",
        "single_track.ekf.dynamic",
        "random_walk.rao_blackwell_pf.blackwell",
    ):
        assert f"crosscomb.filters.{kernel}_run" in loaded


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_run_lets_go_of_what_it_was_handed(name: str) -> None:
    """Kernels that do not count who holds an array must not be called with what they would keep for ever."""
    estimator = make_filter(name, load_vehicle("generic_compact"))
    samples = np.zeros((3, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 20.0
    started = estimator.start(0.01)
    parts = [samples, *flat(started.state)]
    before = [sys.getrefcount(part) for part in parts]
    for k in range(3):
        estimator.step(started, samples[k])
    out = np.zeros((3, 3 + len(estimator.extras)))
    estimator.run_kernel(started.state, samples, estimator.car, estimator.noise, 0.01, out)
    assert [sys.getrefcount(part) for part in parts] == before


def flat(state: Any) -> list[Any]:
    """The arrays and generators in a state of named tuples."""
    if not isinstance(state, tuple):
        return [] if isinstance(state, int | float) else [state]
    return [part for field in state for part in flat(field)]

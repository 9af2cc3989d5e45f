"""Speed of the kernels beside their twins on filterpy and numpy, measured on this machine.

A twin on filterpy is what a user of filterpy would write: its class, with the model in plain Python and numpy. It
calls the model functions of the kernel, uncompiled, and once more compiled, which leaves filterpy's own cost.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, KernelFilter
from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.filters.twins.table import FILTERPY, NUMPY, TWINS, Twin
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.run.drive import require_known

STEPS = 20_000
"""Samples that a kernel runs over; its time could not be measured on as few as its twin takes."""

LEAST_STEPS = 40
"""Samples that the slowest twin runs over: a little more than the horizon of the receding filter."""

RUN_TIME = 0.03
"""What one timed run shall take [s], of the kernel as of the twin: both are then disturbed alike."""

LEAST_REPEATS, MOST_REPEATS = 3, 9
PAIR_TIME = 2.5
"""No further repeat begins after this [s], so that all pairs together take less than two minutes."""

PAPER_PARTICLES = (1000, 10_000)
CAR = "golf_gti_2018"

Answer = TypeVar("Answer")

# What other programs take of the processor does not count, where the clock for that is fine enough.
CLOCK = time.perf_counter if sys.platform == "win32" else time.process_time


@dataclass(frozen=True)
class Pair:
    """An estimator and one of its twins."""

    name: str
    made_of: str  # filterpy or numpy
    estimator: KernelFilter
    twin: Twin


@dataclass(frozen=True)
class Speed:
    """How fast a kernel and its twin are, measured in turn.

    Attributes
    ----------
    pair : Pair
    kernel, twin : float
        Time per sample [us], the twin on models in plain Python; medians.
    ratio, low, high : float
        Twin over kernel: median and quartiles over the repeats.
    compiled : float
        The same ratio, median, of the twin on the kernel's compiled models.
    apart : float
        Largest difference of their beta [deg].
    """

    pair: Pair
    kernel: float
    twin: float
    ratio: float
    low: float
    high: float
    compiled: float
    apart: float


def pairs_of(names: Sequence[str] = ()) -> list[Pair]:
    """The named estimators, or all that have one, each with its twins.

    Raises
    ------
    UsageError
        A named estimator has no twin.
    """
    vehicle = load_vehicle(CAR)
    require_known(names)
    for name in names:
        if name not in TWINS:
            raise UsageError(f"`filters` {name}: has no twin to be timed against: take of {', '.join(TWINS)}")
    pairs = []
    for name in names or [name for name in CATALOGUE if name in TWINS]:
        estimators = {name: make_filter(name, vehicle)}
        if name == "random_walk_pf":  # its twins draw the forces, as the paper does
            estimators = {
                f"{name} ({n:,} particles, forces drawn)": make_filter(
                    name, vehicle, {"particles": n, "forces": "drawn"}
                )
                for n in PAPER_PARTICLES
            }
        pairs += [
            Pair(text, made_of, estimator, twins[name])
            for text, estimator in estimators.items()
            for made_of, twins in (("filterpy", FILTERPY), ("numpy", NUMPY))
            if name in twins
        ]
    return pairs


def timed(run: Callable[[], Answer], repeats: int = 5) -> tuple[Answer, float]:
    """Answer of a run and its time [s]: the shortest of some, after one that may compile."""
    answer, times = run(), []
    for _ in range(repeats):
        start = CLOCK()
        run()
        times.append(CLOCK() - start)
    return answer, min(times)


def measure(pair: Pair, inputs: Inputs) -> Speed:
    """Time a kernel and its twin in turn on the same drive."""
    estimator, twin = pair.estimator, pair.twin

    def answer(given: Inputs) -> Estimate:
        return twin(estimator, given)

    compiled = plan(answer, inputs)  # first: a kernel that a twin calls cannot be compiled on plain models
    with plain_models():
        theirs = plan(answer, inputs)
    # A twin that takes the fewest samples has a slow kernel, and its start counts for both.
    few = theirs.inputs if len(theirs.inputs.samples) == LEAST_STEPS else inputs
    ours = plan(estimator.run, few)
    rows: list[list[float]] = []
    begin = time.perf_counter()
    while len(rows) < LEAST_REPEATS or (len(rows) < MOST_REPEATS and time.perf_counter() - begin < PAIR_TIME):
        row = [ours.time()]
        with plain_models():
            row.append(theirs.time())
        rows.append([*row, compiled.time()])
    times = np.array(rows)
    ratio, ratio_compiled = times[:, 1] / times[:, 0], times[:, 2] / times[:, 0]
    apart = np.abs(estimator.run(compiled.inputs).beta - answer(compiled.inputs).beta).max()
    kernel, plain, _ = np.median(times, axis=0).tolist()
    middle, low, high = np.quantile(ratio, [0.5, 0.25, 0.75]).tolist()
    return Speed(
        pair, kernel, plain, middle, low, high, float(np.median(ratio_compiled)), float(np.degrees(apart))
    )


@dataclass(frozen=True)
class Run:
    """What is timed: a function, its inputs, and how many calls of it at a stretch."""

    function: Callable[[Inputs], Estimate]
    inputs: Inputs
    calls: int

    def time(self) -> float:
        """Time per sample [us]."""
        begin = CLOCK()
        for _ in range(self.calls):
            self.function(self.inputs)
        return (CLOCK() - begin) / (self.calls * len(self.inputs.samples)) * 1e6


def plan(function: Callable[[Inputs], Estimate], inputs: Inputs) -> Run:
    """Choose samples and calls so that a run takes about `RUN_TIME`; compiles what has to be."""
    function(Inputs(inputs.dt, inputs.samples[:3]))
    few = Run(function, Inputs(inputs.dt, inputs.samples[:LEAST_STEPS]), 1)
    most = RUN_TIME / max(1e-6 * few.time(), 1e-9)
    steps = int(np.clip(most, LEAST_STEPS, len(inputs.samples)))
    return Run(function, Inputs(inputs.dt, inputs.samples[:steps]), max(round(most / steps), 1))


def slalom(vehicle: Vehicle, steps: int) -> Inputs:
    """Noisy samples of a slalom at 100 Hz between 12 and 28 m/s, with wheel speeds and five GNSS fixes a second."""
    rng, dt = np.random.default_rng(0), 0.01
    t = dt * np.arange(steps)
    vx, steer = 20.0 + 8.0 * np.sin(0.3 * t), 0.04 * np.sin(2.0 * t)
    yaw_rate = vx * steer / (vehicle.wheelbase + 0.0025 * vx**2)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = vx + rng.normal(0.0, 0.03, steps)
    samples[:, at.STEER] = steer
    samples[:, at.YAW_RATE] = yaw_rate + rng.normal(0.0, 0.002, steps)
    samples[:, at.AY] = vx * yaw_rate + rng.normal(0.0, 0.2, steps)
    samples[:, at.AX] = 2.4 * np.cos(0.3 * t) + rng.normal(0.0, 0.2, steps)
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * vehicle.mass * samples[:, at.AX]
    samples[:, at.VFL :] = np.nan
    samples[:, at.VFL] = samples[:, at.VFR] = samples[:, at.VX]
    heading = dt * np.cumsum(samples[:, at.YAW_RATE])
    samples[::20, at.GNSS_SPEED] = samples[::20, at.VX]
    samples[::20, at.HEADING] = np.arctan2(np.sin(heading), np.cos(heading))[::20]
    samples[::20, at.GNSS_COURSE] = samples[::20, at.HEADING]
    return Inputs(dt, samples)


@contextmanager
def plain_models() -> Iterator[None]:
    """Take the compilation off every function of crosscomb that was imported, until the end of the context."""
    compiled = [
        (module, name, value)
        for key, module in list(sys.modules.items())
        if key.startswith("crosscomb.")
        for name, value in vars(module).items()
        if hasattr(value, "py_func")
    ]
    for module, name, value in compiled:
        setattr(module, name, value.py_func)
    try:
        yield
    finally:
        for module, name, value in compiled:
            setattr(module, name, value)


def measure_all(pairs: Sequence[Pair], progress: Callable[[], None] | None = None) -> list[Speed]:
    """Time the pairs one after the other; `progress` is called after each."""
    inputs = slalom(load_vehicle(CAR), STEPS)
    speeds = []
    for pair in pairs:
        speeds.append(measure(pair, inputs))
        if progress is not None:
            progress()
    return speeds

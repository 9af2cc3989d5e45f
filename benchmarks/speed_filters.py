"""Speed of the filter kernels against other implementations of the same filters, side by side in one run.

    python benchmarks/speed_filters.py [--repeats 15] [--steps 2000] [--particles 10000]

Each repeat runs kernel and rival one after the other, in turn with the other pairs, so that both see the same
machine; CPU time counts. Only the ratios mean anything on a machine that does other work.

A filterpy twin is what a user of filterpy would write: its class, with the model in plain Python and numpy. It calls
the same model functions as the kernel, uncompiled; the bars are for this one. The column "compiled" gives the ratio
to the same twin when it calls our compiled models, which leaves filterpy's own cost.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from crosscomb.filters import base
from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, KernelFilter
from crosscomb.filters.kinematic.kf import KinematicKF
from crosscomb.filters.random_walk.pf import FAR_OFF, FIRST_SPREAD, MOST_DOUBT, RandomWalkPF
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.filters.twins.basic import twin_dynamic_ekf, twin_kinematic_kf
from crosscomb.models.single_track import body_rates
from crosscomb.models.vehicle import Vehicle, load_vehicle

KERNEL_STEPS = 20
"""The Kalman kernels run this many times the samples of their rivals, or their time could not be measured."""


@dataclass(frozen=True)
class Pair:
    """A kernel, its rival, the samples each of them takes, and how much faster the kernel has to be."""

    name: str
    rival: str
    run_kernel: Callable[[], Estimate]
    run_rival: Callable[[], Estimate]
    kernel_steps: int
    rival_steps: int
    bar: float
    run_compiled: Callable[[], Estimate] | None = None  # the rival once more, on our compiled models


def slalom(vehicle: Vehicle, steps: int) -> Inputs:
    """Noisy samples of a slalom at 100 Hz, between 12 and 28 m/s."""
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(steps)
    vx, steer = 20.0 + 8.0 * np.sin(0.3 * t), 0.04 * np.sin(2.0 * t)
    yaw_rate = vx * steer / (vehicle.wheelbase + 0.0025 * vx**2)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = vx + rng.normal(0.0, 0.03, steps)
    samples[:, at.STEER] = steer
    samples[:, at.YAW_RATE] = yaw_rate + rng.normal(0.0, 0.002, steps)
    samples[:, at.AY] = vx * yaw_rate + rng.normal(0.0, 0.2, steps)
    samples[:, at.AX] = 2.4 * np.cos(0.3 * t) + rng.normal(0.0, 0.2, steps)
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * vehicle.mass * samples[:, at.AX]
    return Inputs(0.01, samples)


def numpy_random_walk_pf(estimator: RandomWalkPF, inputs: Inputs, ekf: Estimate) -> Estimate:
    """Random-walk particle filter as one writes it well in numpy: no loop over particles, no needless copies.

    Without the EKF whose answer `ekf` is, which the kernel has to run itself.
    """
    noise, car, dt, n = estimator.noise, estimator.car, inputs.dt, estimator.particles
    rng = np.random.Generator(np.random.SFC64(estimator.seed))
    scale = np.array([1.0, 1.0, car.mass, car.mass, car.mass, car.mass])[:, None]
    width = np.array([noise.yaw_acceleration, noise.slip_rate, *[noise.force] * 4])[:, None] * scale
    width *= np.sqrt(12.0 * dt)
    half = scale * np.array(FIRST_SPREAD)[:, None]
    p_yaw, p_a = 0.5 / noise.yaw_rate**2, 0.5 / noise.accel**2
    p_beta = 0.5 * dt / (noise.pseudo**2 + np.minimum(ekf.beta_std, MOST_DOUBT) ** 2)
    places = np.arange(n)
    x, random, log_weights = np.empty((6, n)), np.empty((6, n)), np.empty(n)
    out = np.empty((len(inputs.samples), 2))
    running = False
    for k, sample in enumerate(inputs.samples):
        vx, z_ax, z_ay, z_yaw, steer, steer_rear = sample[:6].tolist()
        if base.below_gate(sample) or not running:
            answer = np.empty(3)
            base.low_speed_answer(sample, car, answer)
            out[k] = answer[:2]
            running = not base.below_gate(sample)
            if running:
                rng.random(out=x)
                x -= 0.5
                x *= 2.0 * half
                fyf, fyr = car.mass * z_ay * np.array([car.b, car.a]) / (car.a + car.b)
                x += np.array([z_yaw, ekf.beta[k], sample[at.FXF], sample[at.FXR], fyf, fyr])[:, None]
                log_weights[:] = 0.0
            continue
        rng.random(out=random)
        random -= 0.5
        random *= width
        x[2:] += random[2:]
        yaw_acceleration, beta_rate, ax, ay = body_rates.py_func(
            x[2], x[3], x[4], x[5], vx, x[0],
            np.cos(steer), np.sin(steer), np.cos(steer_rear), np.sin(steer_rear), np.cos(x[1]), np.sin(x[1]),
            car.mass, car.yaw_inertia, car.a, car.b,
        )  # fmt: skip
        x[0] += dt * yaw_acceleration
        x[0] += random[0]
        x[1] += dt * beta_rate
        x[1] += random[1]
        np.clip(x[1], -base.MAX_BETA, base.MAX_BETA, out=x[1])
        log_weights -= (
            np.minimum(p_yaw * (x[0] - z_yaw) ** 2, FAR_OFF)
            + np.minimum(p_a * (ax - z_ax) ** 2, FAR_OFF)
            + np.minimum(p_a * (ay - z_ay) ** 2, FAR_OFF)
            + p_beta[k] * (x[1] - ekf.beta[k]) ** 2
        )
        log_weights -= log_weights.max()
        weights = np.exp(log_weights)
        weights /= weights.sum()
        beta = weights @ x[1]
        out[k] = beta, np.sqrt(weights @ (x[1] - beta) ** 2)
        if 1.0 / (weights @ weights) < 0.5 * n:
            source = np.searchsorted(np.cumsum(weights), (places + rng.random()) / n)
            np.take(x, source, axis=1, mode="clip", out=random)
            x, random = random, x
            log_weights[:] = 0.0
    return Estimate(out[:, 0], out[:, 1], np.full(len(out), np.nan))


@contextmanager
def plain_models() -> Iterator[None]:
    """Take the compilation off every function of crosscomb that was imported, until the end of the context."""
    compiled = [
        (module, name, value)
        for key, module in sys.modules.items()
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


def twin_pair(
    name: str,
    estimator: KernelFilter,
    twin: Callable[..., Estimate],
    short: Inputs,
    long: Inputs,
    bar: float,
    rival: str = "filterpy",
) -> Pair:
    """A filter on the long samples with its twin on the short ones."""

    def run_plain() -> Estimate:
        with plain_models():
            return twin(estimator, short)

    return Pair(
        name, rival, lambda: estimator.run(long), run_plain, len(long.samples), len(short.samples), bar,
        lambda: twin(estimator, short),
    )  # fmt: skip


def make_pairs(steps: int, particles: int) -> list[Pair]:
    """The comparisons: Kalman kernels with filterpy, the particle kernel with numpy."""
    vehicle = load_vehicle("golf_gti_2018")
    short, long = slalom(vehicle, steps), slalom(vehicle, steps * KERNEL_STEPS)
    kf, linear, dugoff = KinematicKF(vehicle), DynamicEKF(vehicle, tyre="linear"), DynamicEKF(vehicle)
    pf = RandomWalkPF(vehicle, particles=particles)
    few = Inputs(short.dt, short.samples[: max(steps // 20, 20)])
    ekf = DynamicEKF(vehicle, pf.noise.ekf).run(few)
    return [
        twin_pair("kinematic KF", kf, twin_kinematic_kf, short, long, 300.0),
        twin_pair("dynamic EKF, linear tyre", linear, twin_dynamic_ekf, short, long, 300.0),
        twin_pair("dynamic EKF, Dugoff tyre", dugoff, twin_dynamic_ekf, short, long, 300.0),
        Pair(
            f"random-walk PF, {particles:,} particles",
            "numpy, vectorised",
            lambda: pf.run(few),
            lambda: numpy_random_walk_pf(pf, few, ekf),
            len(few.samples),
            len(few.samples),
            2.5,
        ),
    ]


def measure(pairs: list[Pair], repeats: int) -> np.ndarray:
    """CPU time per step ``(repeats, pairs, 3) [us]`` of kernel, rival and rival on compiled models, NaN if none."""
    runs = [
        [(pair.run_kernel, pair.kernel_steps), (pair.run_rival, pair.rival_steps),
         *([(pair.run_compiled, pair.rival_steps)] if pair.run_compiled else [])]
        for pair in pairs
    ]  # fmt: skip
    for of_pair in runs:  # compiles the kernels, fills the caches
        for run, _ in of_pair:
            run()
    times = np.full((repeats, len(pairs), 3), np.nan)
    for repeat in range(repeats):
        for i, of_pair in enumerate(runs):
            for j, (run, steps) in enumerate(of_pair):
                begin = time.process_time()
                run()
                times[repeat, i, j] = (time.process_time() - begin) / steps * 1e6
    return times


def print_pairs(pairs: list[Pair], repeats: int) -> None:
    """Measure the pairs and print a row for each."""
    times = measure(pairs, repeats)
    table = Table(title=f"CPU time per sample, best of {repeats}; ratios of the best times and median ratio")
    table.add_column("filter")
    table.add_column("rival")
    for heading in ("kernel us", "rival us", "ratio", "median", "compiled", "at least"):
        table.add_column(heading, justify="right")
    table.add_column("")
    best, median = times.min(axis=0), np.median(times[:, :, 1] / times[:, :, 0], axis=0)
    for pair, (kernel, rival, compiled), middle in zip(pairs, best, median, strict=True):
        figures = (f"{kernel:.3f}", f"{rival:.1f}", f"{rival / kernel:.1f}", f"{middle:.1f}")
        beside = f"{compiled / kernel:.1f}" if np.isfinite(compiled) else ""
        verdict = "met" if rival >= pair.bar * kernel else "missed"
        table.add_row(pair.name, pair.rival, *figures, beside, f"{pair.bar:g}", verdict)
    Console(width=120).print(table)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--steps", type=int, default=2000, help="samples that filterpy takes")
    parser.add_argument("--particles", type=int, default=10_000)
    options = parser.parse_args()
    print_pairs(make_pairs(options.steps, options.particles), options.repeats)


if __name__ == "__main__":
    main()

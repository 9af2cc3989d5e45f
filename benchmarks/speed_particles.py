"""Particle filters on the random-walk model: what accuracy costs, side by side in one run.

    python benchmarks/speed_particles.py [--seeds 20] [--logs 12] [--duration 8] [--real FOLDER] [--reference 100000]

Two tables over the same logs: a balanced set as `crosscomb simulate` makes it, and with --real the shared real logs of
that folder, cut to the same duration. The first: time per sample, RMSE against the truth, and how far the estimates of
single seeds scatter about their mean. The bars are those of the default against the filter that was the default, 1,000
particles with their forces drawn: a quarter of its time, 1/60 of that of 10,000, at no larger RMSE than 10,000 have,
on the whole, and on no log by more than these scatter from seed to seed. The second, log by log: RMSE with its scatter
over seeds, and how far mean and standard deviation are from those of a plain filter with very many particles, which is
what all of them approach; its last column is the same for another seed of that filter, and shows how far the measure
itself scatters.

Every seed runs all filters in turn, and CPU time counts: only the ratios of times mean anything.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, make_inputs
from crosscomb.filters.random_walk.adaptive_pf import AdaptivePF
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import MIN_SPEED
from crosscomb.training.recordings import read_recordings
from crosscomb.training.simulation.presets import Job, plan_jobs
from crosscomb.training.simulation.simulate import simulate_log
from crosscomb.training.suites.benchmark import SHARED_SET

OLD, MANY, DEFAULT = "drawn, 1,000", "drawn, 10,000", "default"
SHARE_OF_OLD, SHARE_OF_MANY = 1 / 4, 1 / 60
DT = 0.01
SETTLED = 100
"""Samples after the start that do not count: the uniform first particles are still there."""

AnyPF = RandomWalkPF | AdaptivePF


@dataclass(frozen=True)
class Case:
    """One log: its samples, its truth and the answer of very many particles, of two seeds."""

    name: str
    vehicle: Vehicle
    inputs: Inputs
    beta: np.ndarray
    counts: np.ndarray
    many: tuple[Estimate, Estimate]


def make_case(
    name: str, vehicle: Vehicle, inputs: Inputs, beta: np.ndarray, counted: np.ndarray, reference: int
) -> Case:
    """Run the reference filters on a log."""
    counts = counted.copy()
    counts[:SETTLED] = False
    many = RandomWalkPF(vehicle, particles=reference, forces="drawn")
    first, second = (replace(many, seed=900 + i).run(inputs) for i in range(2))
    return Case(name, vehicle, inputs, beta, counts, (first, second))


def simulated_case(vehicle: Vehicle, job: Job, duration: float, reference: int) -> Case:
    """Simulate a log."""
    log = simulate_log(
        vehicle, job.manoeuvre, (7, job.number), duration=duration, surface=job.surface, sensors=job.profile
    )
    inputs = make_inputs(complete(log, vehicle), vehicle, DT)
    counted = (inputs.samples[:, at.VX] > MIN_SPEED) & np.isfinite(log.beta_ref)
    return make_case(job.name, vehicle, inputs, log.beta_ref, counted, reference)


def real_cases(folder: Path, duration: float, reference: int) -> Iterator[Case]:
    """The beginnings of the shared real logs, from where they count."""
    for recording in read_recordings(folder)[0]:
        if recording.name in SHARED_SET:
            inputs, beta, counted = max(recording.stretches(1.0 / DT), key=lambda each: each[2].sum())
            first = int(np.argmax(counted))
            part = slice(first, first + round(duration / DT))
            taken = replace(inputs, samples=inputs.samples[part])
            yield make_case(recording.name, recording.vehicle, taken, beta[part], counted[part], reference)


def rms(values: np.ndarray) -> float:
    """Root mean square of angles [rad], in deg."""
    return float(np.degrees(np.sqrt(np.mean(values**2))))


def measure(
    filters: dict[str, AnyPF], cases: list[Case], seeds: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Time per sample [us], RMSE, RMS distance of mean and of std from very many particles [deg], and scatter.

    Returns
    -------
    dict of str to (seeds, logs, 4)
    dict of str to (logs,)
        RMS distance of single seeds from their mean [deg].
    """
    results = {name: np.empty((seeds, len(cases), 4)) for name in filters}
    scatter = {name: np.empty(len(cases)) for name in filters}
    for estimator in filters.values():  # compiles the kernels
        estimator.run(replace(cases[0].inputs, samples=cases[0].inputs.samples[:10]))
    for j, case in enumerate(track(cases, "logs")):
        betas: dict[str, list[np.ndarray]] = {name: [] for name in filters}
        for seed in range(seeds):
            for name, estimator in filters.items():
                seeded = replace(estimator, vehicle=case.vehicle, seed=seed)
                begin = time.process_time()
                estimate = seeded.run(case.inputs)
                duration = (time.process_time() - begin) / len(case.beta) * 1e6
                results[name][seed, j] = duration, *distances(estimate, case)
                betas[name].append(estimate.beta[case.counts])
        for name, runs in betas.items():
            scatter[name][j] = rms(np.std(runs, axis=0, ddof=1)) if seeds > 1 else np.nan
    return results, scatter


def distances(estimate: Estimate, case: Case) -> tuple[float, float, float]:
    """RMSE, and RMS distance of mean and of standard deviation from very many particles [deg]."""
    many, counts = case.many[0], case.counts
    return (
        rms((estimate.beta - case.beta)[counts]),
        rms((estimate.beta - many.beta)[counts]),
        rms((estimate.beta_std - many.beta_std)[counts]),
    )


def speed_table(results: dict[str, np.ndarray], scatter: dict[str, np.ndarray]) -> Table:
    """Time and RMSE of each filter."""
    seeds, logs, _ = results[MANY].shape
    table = Table(title=f"Time and accuracy, mean over {logs} logs and {seeds} seeds")
    headings = (
        "particles",
        "us per sample",
        "of 1,000",
        "of 10,000",
        "RMSE deg",
        "worst seed",
        "scatter deg",
    )
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "particles" else "right")
    for name, result in results.items():
        rmse = result[:, :, 1].mean(axis=1)
        table.add_row(
            name, f"{np.median(result[:, :, 0]):.2f}",
            f"1/{1 / share(results, name, OLD):.1f}", f"1/{1 / share(results, name, MANY):.1f}",
            f"{rmse.mean():.4f}", f"{rmse.max():.4f}", f"{scatter[name].mean():.4f}",
        )  # fmt: skip
    return table


def share(results: dict[str, np.ndarray], name: str, of: str) -> float:
    """Time of a filter over that of another, median over logs and seeds."""
    return float(np.median(results[name][:, :, 0] / results[of][:, :, 0]))


def bars(results: dict[str, np.ndarray], cases: list[Case]) -> list[str]:
    """Say of each bar what was found."""
    ours, theirs = results[DEFAULT][:, :, 1], results[MANY][:, :, 1]
    worse = ours.mean(axis=0) - theirs.mean(axis=0)
    allowed = np.hypot(ours.std(axis=0, ddof=1), theirs.std(axis=0, ddof=1))
    beyond = [case.name for case, is_worse in zip(cases, worse > allowed, strict=True) if is_worse]
    found = [
        (f"time of {DEFAULT} at most 1/{1 / bar:.0f} of {of}", share(results, DEFAULT, of) <= bar)
        for of, bar in ((OLD, SHARE_OF_OLD), (MANY, SHARE_OF_MANY))
    ]
    found += [
        (f"RMSE {ours.mean():.4f} at most {theirs.mean():.4f} deg", ours.mean() <= theirs.mean()),
        (f"on no log beyond the scatter of seeds {', '.join(beyond)}", not beyond),
    ]
    return [f"{text}: {'met' if met else 'missed'}" for text, met in found]


def posterior_table(results: dict[str, np.ndarray], cases: list[Case], reference: int) -> Table:
    """RMSE and distance from very many plain particles, log by log."""
    table = Table(
        title=f"RMSE +- over seeds; distance of mean / std of beta from {reference:,} drawn particles: all deg"
    )
    for heading in ("log", OLD, MANY, DEFAULT, f"drawn, {reference:,}, other seed"):
        table.add_column(heading, justify="left" if heading == "log" else "right")
    for j, case in enumerate(cases):
        row = []
        for name in (OLD, MANY, DEFAULT):
            mean, std = np.sqrt(np.mean(results[name][:, j, 2:] ** 2, axis=0))
            rmse = results[name][:, j, 1]
            row.append(f"{rmse.mean():.2f} +- {rmse.std():.2f}; {mean:.3f} / {std:.3f}")
        rmse_other, mean, std = distances(case.many[1], case)
        table.add_row(case.name, *row, f"{rmse_other:.2f}; {mean:.3f} / {std:.3f}")
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--logs", type=int, default=12)
    parser.add_argument("--duration", type=float, default=8.0, help="of each log [s]")
    parser.add_argument("--real", type=Path, help="folder of the real logs")
    parser.add_argument("--reference", type=int, default=100_000, help="very many particles")
    options = parser.parse_args()
    vehicle = load_vehicle("generic_compact")
    filters: dict[str, AnyPF] = {
        OLD: RandomWalkPF(vehicle, particles=1000, forces="drawn"),
        MANY: RandomWalkPF(vehicle, particles=10_000, forces="drawn"),
        "adaptive": AdaptivePF(vehicle),
        DEFAULT: RandomWalkPF(vehicle),
        **{f"solved, {n:,}": RandomWalkPF(vehicle, particles=n) for n in (50, 100, 500, 1000)},
    }
    cases = [
        simulated_case(vehicle, job, options.duration, options.reference)
        for job in track(plan_jobs(vehicle, options.logs), "reference")
    ]
    if options.real:
        cases += real_cases(options.real, options.duration, options.reference)
    results, scatter = measure(filters, cases, options.seeds)
    console = Console()
    console.print(speed_table(results, scatter))
    console.print("\n".join(bars(results, cases)))
    console.print(posterior_table(results, cases, options.reference))


if __name__ == "__main__":
    main()

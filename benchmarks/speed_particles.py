"""Particle filters on the random-walk model: what accuracy costs, side by side in one run.

    python benchmarks/speed_particles.py [--seeds 20] [--logs 12] [--duration 8] [--reference 100000]

Two tables over the same simulated logs, a balanced set as `crosscomb simulate` makes it. The first: time per sample,
and RMSE against the truth, of plain filters, of the adaptive one and of Rao-Blackwellised ones; slides weigh most in
the mean, hence the median log beside it. The bar is a tenth of the time of 10,000 plain particles at equal or better
RMSE. The second, log by log: RMSE, and how far mean and standard deviation are from those of a plain filter with very
many particles, which is what all of them approach; its last column is the same for another seed of that filter, and
shows how far the measure itself scatters.

Every seed runs all filters in turn, and CPU time counts: only the ratios of times mean anything.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, make_inputs
from crosscomb.filters.random_walk.adaptive_pf import AdaptivePF
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.rao_blackwell_pf import RaoBlackwellPF
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import MIN_SPEED
from crosscomb.training.simulation.presets import Job, plan_jobs
from crosscomb.training.simulation.simulate import simulate_log

BAR = "plain, 10,000"
SETTLED = 100
"""Samples after the start that do not count: the uniform first particles are still there."""

AnyPF = RandomWalkPF | RaoBlackwellPF | AdaptivePF


@dataclass(frozen=True)
class Case:
    """One simulated log: its samples, its truth and the answer of very many particles, of two seeds."""

    job: Job
    inputs: Inputs
    beta: np.ndarray
    counts: np.ndarray
    many: tuple[Estimate, Estimate]


def make_case(vehicle: Vehicle, job: Job, duration: float, reference: int) -> Case:
    """Simulate a log and run the reference filters on it."""
    log = simulate_log(
        vehicle, job.manoeuvre, (7, job.number), duration=duration, surface=job.surface, sensors=job.profile
    )
    inputs = make_inputs(complete(log, vehicle), vehicle, 0.01)
    counts = (inputs.samples[:, at.VX] > MIN_SPEED) & np.isfinite(log.beta_ref)
    counts[:SETTLED] = False
    first, second = (RandomWalkPF(vehicle, particles=reference, seed=900 + i).run(inputs) for i in range(2))
    return Case(job, inputs, log.beta_ref, counts, (first, second))


def rms(values: np.ndarray) -> float:
    """Root mean square of angles [rad], in deg."""
    return float(np.degrees(np.sqrt(np.mean(values**2))))


def measure(filters: dict[str, AnyPF], cases: list[Case], seeds: int) -> dict[str, np.ndarray]:
    """Time per sample [us], RMSE, RMS distance of mean and of std from very many particles [deg].

    Returns
    -------
    dict of str to (seeds, logs, 4)
    """
    results = {name: np.empty((seeds, len(cases), 4)) for name in filters}
    for estimator in filters.values():  # compiles the kernels
        estimator.run(replace(cases[0].inputs, samples=cases[0].inputs.samples[:10]))
    for seed in track(range(seeds), "seeds"):
        for j, case in enumerate(cases):
            for name, estimator in filters.items():
                seeded = replace(estimator, seed=seed)
                begin = time.process_time()
                estimate = seeded.run(case.inputs)
                duration = (time.process_time() - begin) / len(case.beta) * 1e6
                results[name][seed, j] = duration, *distances(estimate, case)
    return results


def distances(estimate: Estimate, case: Case) -> tuple[float, float, float]:
    """RMSE, and RMS distance of mean and of standard deviation from very many particles [deg]."""
    many, counts = case.many[0], case.counts
    return (
        rms((estimate.beta - case.beta)[counts]),
        rms((estimate.beta - many.beta)[counts]),
        rms((estimate.beta_std - many.beta_std)[counts]),
    )


def speed_table(results: dict[str, np.ndarray]) -> Table:
    """Time and RMSE of each filter, and whether it meets the bar."""
    seeds, logs, _ = results[BAR].shape
    table = Table(title=f"Time and accuracy, mean over {logs} simulated logs and {seeds} seeds")
    headings = (
        "particles",
        "us per sample",
        "share of time",
        "RMSE deg",
        "worst seed",
        "median log",
        "bar 0.1",
    )
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "particles" else "right")
    rmse_bar = results[BAR][:, :, 1].mean()
    for name, result in results.items():
        share = np.median(result[:, :, 0] / results[BAR][:, :, 0])
        rmse = result[:, :, 1].mean(axis=1)
        met = share <= 0.1 and rmse.mean() <= rmse_bar
        table.add_row(
            name, f"{np.median(result[:, :, 0]):.1f}", f"{share:.3f}", f"{rmse.mean():.3f}", f"{rmse.max():.3f}",
            f"{np.median(result[:, :, 1].mean(axis=0)):.3f}",
            "met" if met else "",
        )  # fmt: skip
    return table


def posterior_table(results: dict[str, np.ndarray], cases: list[Case], reference: int) -> Table:
    """RMSE and distance from very many plain particles, log by log."""
    shown = (BAR, "Rao-Blackwell, 200", "Rao-Blackwell, 500")
    table = Table(
        title=f"RMSE; RMS distance of mean and std of beta from {reference:,} plain particles: all deg"
    )
    for heading in ("log", *shown, f"plain, {reference:,}, other seed"):
        table.add_column(heading, justify="left" if heading == "log" else "right")
    for j, case in enumerate(cases):
        rows = [np.sqrt(np.mean(results[name][:, j, 1:] ** 2, axis=0)) for name in shown]
        rows.append(np.array(distances(case.many[1], case)))
        table.add_row(case.job.name, *(f"{e:.2f}; {m:.3f} / {s:.3f}" for e, m, s in rows))
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--logs", type=int, default=12)
    parser.add_argument("--duration", type=float, default=8.0, help="of each log [s]")
    parser.add_argument("--reference", type=int, default=100_000, help="very many particles")
    options = parser.parse_args()
    vehicle = load_vehicle("generic_compact")
    filters: dict[str, AnyPF] = {
        "plain, 1,000": RandomWalkPF(vehicle, particles=1000),
        BAR: RandomWalkPF(vehicle, particles=10_000),
        "adaptive": AdaptivePF(vehicle),
        **{f"Rao-Blackwell, {n:,}": RaoBlackwellPF(vehicle, particles=n) for n in (50, 100, 200, 500, 1000)},
    }
    cases = [
        make_case(vehicle, job, options.duration, options.reference)
        for job in track(plan_jobs(vehicle, options.logs), "reference")
    ]
    results = measure(filters, cases, options.seeds)
    console = Console()
    console.print(speed_table(results))
    console.print(posterior_table(results, cases, options.reference))


if __name__ == "__main__":
    main()

"""How often understeer and oversteer are told right, on simulated logs whose true axle slips are known.

    python benchmarks/handling_simulated.py [--logs 34] [--seed 77] [--vehicle generic_compact ...]

Each log is simulated twice from the same seed: with faulty sensors, to be estimated, and with perfect ones, for the
truth. The car on the road differs from its file. Countersteering counts as oversteer told right.
"""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table

from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.run.handling import STATES
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.simulation.presets import plan_jobs
from crosscomb.training.simulation.simulate import simulate_log
from handling_score import count_states, true_states

VEHICLES = ("generic_compact", "sports_mid_engine", "golf_gti_2018")


def main() -> None:
    """Print a table per vehicle."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=34)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--vehicle", nargs="*", default=VEHICLES)
    options = parser.parse_args()
    artefact = load_artefact()
    for name in options.vehicle:
        car, parts = load_vehicle(name), []
        for job in plan_jobs(car, options.logs):
            log, perfect = (
                simulate_log(
                    car, job.manoeuvre, (options.seed, job.number), duration=25.0, surface=job.surface,
                    sensors=job.profile, faults=faults,
                )
                for faults in (True, False)
            )  # fmt: skip
            parts.append(count_states(estimate_log(log, car, artefact), true_states(perfect, car)))
        counts = sum(parts[1:], parts[0])
        table = Table(title=f"{name}: samples by true state (rows) and estimated state, % of the row")
        table.add_column("true")
        for heading in ("samples", *STATES, "right"):
            table.add_column(heading, justify="right")
        for state, row in counts.iterrows():
            right = row[state] + (row["countersteer"] if state == "oversteer" else 0)
            shares = [f"{100.0 * value / row.sum():.1f}" for value in (*row, right)]
            table.add_row(str(state), str(row.sum()), *shares)
        Console(width=110, markup=False).print(table)


if __name__ == "__main__":
    main()

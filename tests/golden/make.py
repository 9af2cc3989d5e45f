"""Make the golden logs: ten short drives with what the shipped artefacts answer, see tests/test_golden.py.

    python tests/golden/make.py             # answers anew, after a change that is meant to alter them
    python tests/golden/make.py --drives    # new drives too, from the simulation

The drives are kept in the files because a simulation need not give the same last bits on two machines.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import SHIPPED, load_artefact
from crosscomb.signals import Signals

FOLDER = Path(__file__).parent
CAR = "generic_compact"
INPUTS = ["t", "vx", "ax", "ay", "yaw_rate", "steer"]
LOGS, ROWS, FIRST = 10, 250, 500


def drives() -> dict[str, pd.DataFrame]:
    """New drives of every kind, by name, rounded to what their files hold."""
    from crosscomb.training.simulation.presets import plan_jobs
    from crosscomb.training.simulation.simulate import simulate_log

    car, found = load_vehicle(CAR), {}
    for job in plan_jobs(car, LOGS):
        log = simulate_log(
            car, job.manoeuvre, (14, job.number), surface=job.surface, duration=8.0, name=job.name
        )
        found[job.name] = log.frame[INPUTS].iloc[FIRST : FIRST + ROWS].round(6)
    return found


def answers(drive: pd.DataFrame) -> pd.DataFrame:
    """What the shipped artefacts and each of their filters say ``(rows, answers) [rad]``."""
    found = {}
    for name in SHIPPED:
        estimate = estimate_log(Signals(name, drive), load_vehicle(CAR), load_artefact(name))
        filters = {f"{name}:{key}": beta for key, beta in estimate.filters.items()}
        found |= {name: estimate.beta, f"{name}:std": estimate.beta_std, **filters}
    return pd.DataFrame(found)


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drives", action="store_true", help="make new drives too")
    if parser.parse_args().drives:
        for path in FOLDER.glob("*.csv"):
            path.unlink()
        made = drives()
    else:
        made = {
            path.stem: pd.read_csv(path, dtype=str).astype(float)[INPUTS]
            for path in sorted(FOLDER.glob("*.csv"))
        }
    for name, drive in made.items():
        table = pd.concat(
            [drive.reset_index(drop=True), answers(drive.reset_index(drop=True)).round(12)], axis=1
        )
        table.to_csv(FOLDER / f"{name}.csv", index=False, lineterminator="\n")
    print(f"{len(made)} golden logs written")


if __name__ == "__main__":
    main()

"""Speed of the simulation plant on one core, and of a data set on two.

Run with ``python benchmarks/speed_plant.py``. Prints how many seconds of driving one second of computing
gives, at a step of 1 ms with the driver in the loop, and the time of a `full` data set of 100 logs.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.simulation.manoeuvres import MANOEUVRES
from crosscomb.training.simulation.road import draw_road
from crosscomb.training.simulation.scene import Scene
from crosscomb.training.simulation.simulate import run_script, simulate_data_set
from crosscomb.training.simulation.spread import draw_driver, draw_plant

SECONDS = 40.0
REPEATS = 3


def real_time_factor(manoeuvre: str) -> float:
    """Simulated seconds per second of one core (others may use the machine, too), the best of some runs."""
    vehicle = load_vehicle("generic_compact")
    rng = np.random.default_rng(1)
    plant = draw_plant(vehicle, manoeuvre, rng)
    road = draw_road(vehicle, "dry", None, round(SECONDS * 100.0), rng)
    script = MANOEUVRES[manoeuvre](Scene(plant, vehicle.plant.top_speed, road, rng))
    driver = draw_driver(rng)
    times = []
    for _ in range(REPEATS + 1):
        begin = time.process_time()
        run_script(script, plant, driver)
        times.append(time.process_time() - begin)
    return SECONDS / min(times[1:])


def main() -> None:
    for manoeuvre in ("country_road", "slalom", "sine_with_dwell", "drift"):
        print(f"{manoeuvre:20s} {real_time_factor(manoeuvre):6.0f} times real time")
    for jobs in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            simulate_data_set(load_vehicle("generic_compact"), Path(folder), 1, 100, jobs=jobs)
            print(f"100 logs, preset full, {jobs} jobs: {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main()

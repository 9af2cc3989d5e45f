"""The simulation plant against real logs: yaw rate and sideslip under recorded steering and speed.

Run with ``python benchmarks/plant_against_logs.py ../shared/data``. Writes its table into docs/results.md,
between the markers of the section.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import GRAVITY, MIN_SPEED, Signals, make_signals
from replay import replay_linear, replay_plant

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results.md"
BEGIN, END = "<!-- plant:begin -->", "<!-- plant:end -->"
SETTLING = 1.0  # [s] left out at the begin of a log
FRICTION_MARGIN = 1.15
"""Tyre friction over the largest lateral acceleration of a log [g]: the axles do not peak at once."""


@dataclass(frozen=True)
class Source:
    """A folder of logs, its vehicle, and what the road-wheel angle reads straight ahead [rad]."""

    folder: str
    vehicle: str
    steer_offset: float = 0.0
    counts: bool = False


SOURCES = (
    # The hand-wheel zeros stand in the README of the logs: 0.04 and 0.030 rad.
    Source("kth_volvo_s90", "volvo_s90", 0.04 / 15.6, counts=True),
    Source("kth_volvo_v40", "volvo_v40", 0.030 / 17.0, counts=True),
    Source("revs_ferrari_250lm", "ferrari_250lm", counts=True),
    Source("liu_course", "golf_liu"),
    Source("stanford_audi_tts_2011", "audi_tts"),
    Source("stanford_gti_2018", "golf_gti_2018"),
    Source("stanford_gti_2019", "golf_gti_2018"),
    Source("stanford_gti_2021", "golf_gti_2021"),
    Source("stanford_gti_limits", "golf_gti_limits"),
)

HEAD = """\
## The simulation plant against real logs

The plant and a linear single track, both with the parameters of the car's vehicle file, are driven with the
recorded steering angle and speed of each log. RMSE over all rows above 3 m/s, the first second left out.
The plant needs the friction of the road, too: that of the vehicle file, or 1.15 times the largest lateral
acceleration of the log where that is more. Neither is told bank, slope or wind. Stiffness and place of the
centre of gravity are those of the files, and some are known to be off (`volvo_s90.toml`, `volvo_v40.toml`):
the errors are not the plant's alone. The defaults of the plant that no file gives (roll stiffness share,
tyre curve, steering lag) were chosen with a look at these logs; one set of defaults serves all cars.
"""


def rmse(error: np.ndarray) -> float:
    """Root of the mean square in degrees, missing values left out."""
    return float(np.degrees(np.sqrt(np.nanmean(error**2))))


def largest_cornering(log: Signals, speed: np.ndarray, rows: np.ndarray) -> float:
    """Largest lateral acceleration [g] of the reference velocities, averaged over 0.2 s."""
    lateral = np.nan_to_num(speed * np.tan(log.beta_ref))
    width = int(0.2 / float(np.median(np.diff(log.t)))) | 1
    window = np.ones(width) / width
    turning = np.convolve(speed * np.nan_to_num(log.column("yaw_rate")), window, mode="same")
    turning += np.gradient(np.convolve(lateral, window, mode="same"), log.t)
    inner = rows.copy()
    inner[: 2 * width] = inner[-2 * width :] = False
    return float(np.percentile(np.abs(turning[inner]), 99.8)) / GRAVITY


def compare(path: Path, source: Source) -> list[float] | None:
    """Friction, then RMSE [deg/s] of the yaw rate and [deg] of beta: plant, linear, beta = 0."""
    log = make_signals(pd.read_csv(path), path.name.split(".")[0])
    speed = log.column("vx_ref") if log.has("vx_ref") else log.column("vx")
    rows = (speed > MIN_SPEED) & (log.t > log.t[0] + SETTLING) & np.isfinite(log.beta_ref)
    if not rows.any():
        return None
    vehicle = load_vehicle(source.vehicle)
    friction = max(vehicle.friction, FRICTION_MARGIN * largest_cornering(log, speed, rows))
    vehicle = vehicle.model_copy(update={"friction": friction})
    yaw_rate, beta = log.column("yaw_rate")[rows], log.beta_ref[rows]
    values = [friction]
    runs = [run(log, vehicle, source.steer_offset) for run in (replay_plant, replay_linear)]
    values += [rmse(run[0][rows] - yaw_rate) for run in runs]
    values += [rmse(run[1][rows] - beta) for run in runs]
    return [*values, rmse(beta)]


def table(data: Path) -> str:
    """The section's text: a line for each log, and the means of the cars that the plant is measured by."""
    lines = [
        "| log | friction | yaw rate: plant | linear [deg/s] | beta: plant | linear | beta = 0 [deg] |",
        "|---|---|---|---|---|---|---|",
    ]
    means = []
    for source in SOURCES:
        found = []
        for path in sorted((data / source.folder).glob("*.csv*")):
            values = compare(path, source)
            if values is None:
                continue
            found.append(values)
            name = f"{source.folder}/{path.name.split('.')[0]}"
            lines.append(f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |")
            print(lines[-1], flush=True)
        if source.counts:
            mean = np.mean(found, axis=0)
            better = mean[1] < mean[2] and mean[3] < mean[4]
            cells = " | ".join(f"{value:.2f}" for value in mean[1:])
            means.append(f"| **{source.folder}**, mean{'' if better else ' (not better)'} | | {cells} |")
    print("\n".join(means))
    return "\n".join([HEAD, *lines, *means])


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: plant_against_logs.py FOLDER_OF_REAL_LOGS")
    section = table(Path(sys.argv[1]))
    text = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else f"# Results\n\n{BEGIN}\n{END}\n"
    if BEGIN not in text:
        text += f"\n{BEGIN}\n{END}\n"
    before, rest = text.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    RESULTS.write_text(f"{before}{BEGIN}\n\n{section}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Simulated logs with ground truth: one log, and a balanced data set in a folder with its data card."""

from __future__ import annotations

import gzip
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.files import locked, write_file, write_json, write_text, writing_together
from crosscomb.logs.formats.table import ending
from crosscomb.logs.prepare import complete
from crosscomb.models.plant import PlantParameters
from crosscomb.models.vehicle import Vehicle, vehicle_text
from crosscomb.signals import Signals, make_signals
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import CARD, Recording
from crosscomb.training.simulation.data_card import data_card, log_entry
from crosscomb.training.simulation.driver import run_manoeuvre, start
from crosscomb.training.simulation.manoeuvres import MANOEUVRES
from crosscomb.training.simulation.presets import Job, plan_jobs
from crosscomb.training.simulation.road import SURFACES, draw_road
from crosscomb.training.simulation.scene import Scene, Script
from crosscomb.training.simulation.schedule import CONTROL_PERIOD, RECORD, Driver
from crosscomb.training.simulation.sensors import PERFECT, PROFILES, draw_faults, measure
from crosscomb.training.simulation.spread import draw_driver, draw_plant

STEP = 0.001
"""Integration step [s]."""

VEHICLE_FILE = "vehicle.toml"


def simulate_log(
    vehicle: Vehicle,
    manoeuvre: str,
    seed: int | tuple[int, ...],
    friction: float | None = None,
    duration: float = 40.0,
    *,
    surface: str = "dry",
    spread: bool = True,
    faults: bool = True,
    sensors: str = "production",
    name: str | None = None,
) -> Signals:
    """Simulate one log.

    Parameters
    ----------
    vehicle : Vehicle
    manoeuvre : str
        One of `MANOEUVRES`.
    seed : int or tuple of int
        Everything random follows from it.
    friction : float, optional
        Friction coefficient; drawn for the surface when left out.
    duration : float
        [s], at least 5.
    surface : str
        One of `SURFACES`; friction changes suddenly on ``jump`` and differs left to right on ``split``.
    spread : bool
        Draw mass, tyres, centre of gravity, slope and bank of the road, as the car on the road differs from
        its file; else the car of the file on a level road.
    faults : bool
        Faulty sensors of the profile; else perfect ones.
    sensors : str
        Sensor profile: ``production`` or ``test``.
    name : str, optional
        Name of the log.

    Returns
    -------
    Signals
        100 Hz, with production signals and ground truth. Its notes say what was drawn.

    Raises
    ------
    UsageError
        Unknown manoeuvre, surface or sensors, or a duration or friction out of range.
    """
    _require(manoeuvre, MANOEUVRES, "manoeuvre")
    _require(surface, SURFACES, "surface")
    _require(sensors, PROFILES, "sensor profile")
    if not 5.0 <= duration <= 3600.0:
        raise UsageError(f"duration {duration:g} s: a simulated log lasts 5 to 3600 s")
    if friction is not None and not 0.05 <= friction <= 2.0:
        raise UsageError(f"friction {friction:g}: a friction coefficient lies between 0.05 and 2")
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed)))
    n = round(duration / CONTROL_PERIOD)
    plant = draw_plant(vehicle, manoeuvre, rng, spread)
    road = draw_road(vehicle, surface, friction, n, rng, level=not spread)
    script = MANOEUVRES[manoeuvre](Scene(plant, vehicle.plant.top_speed, road, rng))
    truth = run_script(script, plant, draw_driver(rng))
    wrong = draw_faults(rng, PROFILES[sensors], n) if faults else PERFECT
    log = make_signals(measure(truth, vehicle, wrong, rng), name or manoeuvre, "simulation")
    return replace(log, notes=_notes(road.grip, plant, vehicle))


def simulate_recording(
    vehicle: Vehicle, manoeuvre: str, seed: int | tuple[int, ...], **options: Any
) -> Recording:
    """Simulate one log as training takes it; for the options see `simulate_log`."""
    log = simulate_log(vehicle, manoeuvre, seed, **options)
    return Recording(log.name, Path(log.name), vehicle, complete(log, vehicle))


def _require(name: str, known: object, what: str) -> None:
    names = list(known)  # type: ignore[call-overload]
    if name not in names:
        raise UsageError(f"{name}: no such {what}: take one of {', '.join(names)}")


def _notes(grip: np.ndarray, plant: PlantParameters, vehicle: Vehicle) -> tuple[str, ...]:
    aids = {"anti-lock": plant.anti_lock, "traction control": plant.traction_control}
    return (
        f"friction {grip.min():.3f} to {grip.max():.3f}",
        f"mass {plant.mass:.0f} kg, centre of gravity {plant.front:.3f} m behind the front axle",
        f"tyre stiffness per axle {2.0 * plant.tyre_front.stiffness:.0f} "
        f"and {2.0 * plant.tyre_rear.stiffness:.0f} N/rad",
        f"on: {', '.join(name for name, on in aids.items() if on) or 'no driving aids'}",
    )


def run_script(script: Script, plant: PlantParameters, driver: Driver, step: float = STEP) -> np.ndarray:
    """Simulate a script; returns the truth ``(n, RECORD)`` at 100 Hz, SI (columns of `training.schedule`)."""
    record = np.empty((len(script.schedule), RECORD))
    run_manoeuvre(start(script.speed, plant), script.schedule, script.path, driver, plant, step, record)
    return record


def simulate_data_set(
    vehicle: Vehicle,
    out_dir: Path,
    seed: int,
    logs: int,
    force: bool = False,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
    preset: str = "full",
) -> list[Path]:
    """Write a balanced data set: logs, the vehicle file and the data card ``dataset.json``.

    Parameters
    ----------
    vehicle : Vehicle
    out_dir : Path
        Made when missing.
    seed : int
        Log i follows from (seed, i) alone, whatever the number of jobs.
    logs : int
        Number of logs.
    force : bool
        Replace the logs of an earlier run in the folder.
    jobs : int
        Processes.
    progress : callable, optional
        Called after each log.
    preset : str
        One of `crosscomb.training.simulation.presets.PRESETS`: which manoeuvres, surfaces and sensors.

    Returns
    -------
    list of Path
        The logs, in order.

    Raises
    ------
    UsageError
        The folder holds logs already, or cannot be written, or there is no such preset.
    """
    if logs < 1:
        raise UsageError(f"logs {logs}: ask for at least one log")
    work = plan_jobs(vehicle, logs, preset)
    old = _earlier(out_dir, force)
    with locked(out_dir), writing_together(out_dir) as folder:
        entries = in_parallel(_write_log, [(vehicle, folder, seed, job) for job in work], jobs, progress)
        write_text(folder / VEHICLE_FILE, vehicle_text(vehicle))
        write_json(folder / CARD, data_card(vehicle, seed, preset, entries))
        for path in old:
            path.unlink(missing_ok=True)
    return [out_dir / f"{job.name}.csv.gz" for job in work]


def _write_log(vehicle: Vehicle, out_dir: Path, seed: int, job: Job) -> dict[str, object]:
    log = simulate_log(
        vehicle,
        job.manoeuvre,
        (seed, job.number),
        duration=job.duration,
        surface=job.surface,
        sensors=job.profile,
        name=job.name,
    )
    buffer = io.BytesIO()
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0, compresslevel=6) as stream:
        stream.write(log.frame.to_csv(index=False, float_format="%.7g", lineterminator="\n").encode())
    write_file(out_dir / f"{job.name}.csv.gz", lambda temporary: temporary.write_bytes(buffer.getvalue()))
    return log_entry(job, log)


def _earlier(out_dir: Path, force: bool) -> list[Path]:
    """Logs of an earlier run, which go with force; foreign logs never do."""
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        old = sorted(p for p in out_dir.iterdir() if ending(p))
        if old and not force:
            raise UsageError(f"{out_dir}: holds logs already ({old[0].name}): take another folder or `force`")
        ours = _earlier_logs(out_dir)
        return [path for path in old if path.name.removesuffix(".csv.gz") in ours]
    except OSError as error:
        raise UsageError(f"{out_dir}: cannot write there ({error.strerror}): choose another folder") from None


def _earlier_logs(out_dir: Path) -> set[str]:
    try:
        card = json.loads((out_dir / CARD).read_text(encoding="utf-8"))
        return {str(entry["log"]) for entry in card["logs"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return set()

"""Simulated logs with ground truth: one log, and a balanced data set in a folder with its data card."""

from __future__ import annotations

import gzip
import io
import json
import os
import platform
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed

from crosscomb.errors import UsageError
from crosscomb.models.plant import PlantParameters, make_plant
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import MIN_SPEED, Signals, make_signals
from crosscomb.training.driver import CONTROL_PERIOD, RECORD, Driver, run_manoeuvre, start
from crosscomb.training.manoeuvres import KINDS, MANOEUVRES, SLIDING
from crosscomb.training.scene import Plan, Scene
from crosscomb.training.sensors import PERFECT, draw_faults, measure

STEP = 0.001
"""Integration step [s]."""

MASS_SPREAD = 0.10
STIFFNESS_SPREAD = 0.15
SLIDE_POWER = 120.0
SLIDE_LOCK = 80.0
"""Least drive power [W/kg] and differential lock [N m s/rad] where the manoeuvre is a slide."""

SURFACES: dict[str, tuple[float, float]] = {"dry": (0.9, 1.0), "wet": (0.55, 0.65), "snow": (0.25, 0.35)}
"""Ranges of the friction coefficient."""

CARD = "dataset.json"
VEHICLE_FILE = "vehicle.toml"


class Job(NamedTuple):
    """One log of a data set: its place, manoeuvre and surface."""

    number: int
    kind: str
    manoeuvre: str
    surface: str

    @property
    def name(self) -> str:
        """Name of the log."""
        return f"{self.number:03d}_{self.manoeuvre}_{self.surface}"


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
        One of `SURFACES` or ``jump``, where the friction changes suddenly.
    spread : bool
        Draw mass within 10 % and tyre stiffness within 15 % of the vehicle's, as the car on the road differs
        from its file.
    faults : bool
        Production sensors; else perfect ones.
    name : str, optional
        Name of the log.

    Returns
    -------
    Signals
        100 Hz, with production signals and ground truth.

    Raises
    ------
    UsageError
        Unknown manoeuvre or surface, or a duration too short.
    """
    if manoeuvre not in MANOEUVRES:
        raise UsageError(f"{manoeuvre}: no such manoeuvre: take one of {', '.join(MANOEUVRES)}")
    if surface not in (*SURFACES, "jump"):
        raise UsageError(f"{surface}: no such surface: take one of {', '.join((*SURFACES, 'jump'))}")
    if not 5.0 <= duration <= 3600.0:
        raise UsageError(f"duration {duration:g} s: a simulated log lasts 5 to 3600 s")
    if friction is not None and not 0.05 <= friction <= 2.0:
        raise UsageError(f"friction {friction:g}: a friction coefficient lies between 0.05 and 2")
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed)))
    plant = _draw_plant(vehicle, manoeuvre, rng, spread)
    road = _draw_friction(surface, friction, round(duration / CONTROL_PERIOD), rng)
    plan = MANOEUVRES[manoeuvre](Scene(plant, road, rng))
    truth = run_plan(plan, plant, _draw_driver(rng))
    sensors = draw_faults(rng) if faults else PERFECT
    log = make_signals(measure(truth, vehicle, sensors, rng), name or manoeuvre, "simulation")
    return replace(log, notes=(f"friction {road.min():.3f} to {road.max():.3f}",))


def run_plan(plan: Plan, plant: PlantParameters, driver: Driver, step: float = STEP) -> np.ndarray:
    """Simulate a plan; returns the truth ``(n, RECORD)`` at 100 Hz, SI (columns of `training.driver`)."""
    record = np.empty((len(plan.schedule), RECORD))
    run_manoeuvre(start(plan.speed, plant), plan.schedule, plan.path, driver, plant, step, record)
    return record


def _draw_plant(vehicle: Vehicle, manoeuvre: str, rng: np.random.Generator, spread: bool) -> PlantParameters:
    mass = 1.0 + MASS_SPREAD * rng.uniform(-1.0, 1.0) * spread
    front, rear = 1.0 + STIFFNESS_SPREAD * rng.uniform(-1.0, 1.0, 2) * spread
    plant = make_plant(vehicle, mass, front, rear)
    if manoeuvre in SLIDING:
        power = max(plant.power, SLIDE_POWER * vehicle.mass)
        plant = plant._replace(power=power, differential_lock=max(plant.differential_lock, SLIDE_LOCK))
    return plant


def _draw_driver(rng: np.random.Generator) -> Driver:
    return Driver(
        preview=rng.uniform(0.5, 0.8),
        steer_rate=rng.uniform(0.7, 1.2),
        acceleration=rng.uniform(1.5, 4.0),
        deceleration=rng.uniform(4.0, 7.0),
        wheel_spin=rng.uniform(0.3, 0.8),
    )


def _draw_friction(surface: str, friction: float | None, n: int, rng: np.random.Generator) -> np.ndarray:
    """Friction coefficient ``(n,)``; a jump goes to and fro between two surfaces every 5 to 12 s."""
    if surface != "jump":
        return np.full(n, rng.uniform(*SURFACES[surface]) if friction is None else friction)
    high = rng.uniform(0.6, 1.0) if friction is None else friction
    low = high * rng.uniform(0.35, 0.6)
    road, at, slippery = np.empty(n), 0, False
    while at < n:
        end = at + int(rng.uniform(5.0, 12.0) / CONTROL_PERIOD)
        road[at:end] = low if slippery else high
        at, slippery = end, not slippery
    return road


def plan_jobs(logs: int) -> list[Job]:
    """Share out a number of logs: kinds in turn, each through its manoeuvres, over changing surfaces."""
    surfaces = ("dry", "snow", "wet", "dry", "snow", "jump")
    kinds = list(KINDS)
    jobs = []
    for index in range(logs):
        kind = kinds[index % len(kinds)]
        turn = index // len(kinds)
        names = list(KINDS[kind])
        # Each round through the manoeuvres starts at another surface, so that all pairs come up.
        surface = surfaces[(turn + turn // len(names) + index % len(kinds)) % len(surfaces)]
        jobs.append(Job(index, kind, names[turn % len(names)], surface))
    return jobs


def simulate_data_set(
    vehicle: Vehicle,
    out_dir: Path,
    seed: int,
    logs: int,
    force: bool = False,
    jobs: int = 1,
    progress: Callable[[], None] | None = None,
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
        Number of logs, a third each of normal driving, driving at the limit, and slides.
    force : bool
        Replace the logs of an earlier run in the folder.
    jobs : int
        Processes.
    progress : callable, optional
        Called after each log.

    Returns
    -------
    list of Path
        The logs, in order.

    Raises
    ------
    UsageError
        The folder holds logs already, or cannot be written.
    """
    if logs < 1:
        raise UsageError(f"logs {logs}: ask for at least one log")
    _clear(out_dir, force)
    work = plan_jobs(logs)
    results = Parallel(n_jobs=jobs, return_as="generator")(
        delayed(_write_log)(vehicle, out_dir, seed, job) for job in work
    )
    entries = []
    for entry in results:
        entries.append(entry)
        if progress is not None:
            progress()
    _write(out_dir / VEHICLE_FILE, _vehicle_text(vehicle).encode())
    card = {
        "seed": seed,
        "vehicle": vehicle.name,
        "versions": {
            "crosscomb": version("crosscomb"),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "spread": {"mass": MASS_SPREAD, "tyre_stiffness": STIFFNESS_SPREAD, "friction": SURFACES},
        "logs": entries,
    }
    _write(out_dir / CARD, (json.dumps(card, indent=1) + "\n").encode())
    return [out_dir / f"{job.name}.csv.gz" for job in work]


def _write_log(vehicle: Vehicle, out_dir: Path, seed: int, job: Job) -> dict[str, object]:
    log = simulate_log(vehicle, job.manoeuvre, (seed, job.number), surface=job.surface, name=job.name)
    buffer = io.BytesIO()
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0, compresslevel=6) as stream:
        stream.write(log.frame.to_csv(index=False, float_format="%.7g", lineterminator="\n").encode())
    _write(out_dir / f"{job.name}.csv.gz", buffer.getvalue())
    # By total speed: a car that spun moves backwards.
    moving = np.hypot(log.column("vx_ref"), log.column("vy_ref")) > MIN_SPEED
    beta = np.abs(np.degrees(log.beta_ref[moving]))
    return {
        "log": job.name,
        "kind": job.kind,
        "manoeuvre": job.manoeuvre,
        "surface": job.surface,
        "friction": log.notes[0].removeprefix("friction "),
        "duration_s": round(float(log.t[-1]), 2),
        "max_beta_deg": round(float(beta.max(initial=0.0)), 2),
        "share_beta_above_5_deg": round(float(np.mean(beta > 5.0)), 4) if beta.size else 0.0,
        "spun": bool(beta.max(initial=0.0) > 90.0),
    }


def _clear(out_dir: Path, force: bool) -> None:
    """Make the folder; logs of an earlier run are removed with force, foreign logs never."""
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        old = sorted(p for p in out_dir.iterdir() if p.name.endswith((".csv", ".csv.gz")))
        if old and not force:
            raise UsageError(f"{out_dir}: holds logs already ({old[0].name}): take another folder or --force")
        ours = _earlier_logs(out_dir)
        for path in old:
            if path.name.removesuffix(".csv.gz") in ours:
                path.unlink()
    except OSError as error:
        raise UsageError(f"{out_dir}: cannot write there ({error.strerror}): choose another folder") from None


def _earlier_logs(out_dir: Path) -> set[str]:
    try:
        card = json.loads((out_dir / CARD).read_text(encoding="utf-8"))
        return {str(entry["log"]) for entry in card["logs"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _write(path: Path, data: bytes) -> None:
    """Write through a temporary name, so that no half file is ever seen."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    temporary.write_bytes(data)
    temporary.replace(path)


def _vehicle_text(vehicle: Vehicle) -> str:
    """The vehicle as the text of a vehicle file."""
    values = vehicle.model_dump()
    tables = {key: values.pop(key) for key in ("tyre", "plant")}
    lines = [f"{key} = {_toml(value)}" for key, value in values.items()]
    for table, content in tables.items():
        lines += ["", f"[{table}]", *(f"{key} = {_toml(value)}" for key, value in content.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    # A JSON string, number or truth value is a valid TOML one.
    return json.dumps(value, ensure_ascii=False)

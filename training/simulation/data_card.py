"""The data card of a simulated data set: what is in it, and how it came about."""

from __future__ import annotations

import platform
from importlib.metadata import version
from itertools import pairwise

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY, MIN_SPEED, Signals
from crosscomb.training.simulation import road, sensors
from crosscomb.training.simulation.presets import Job
from crosscomb.training.simulation.spread import SPREADS

BETA_EDGES = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 90.0, 180.0)
"""Edges [deg] of the classes in which |beta| is counted."""
AY_EDGES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 2.0)
"""Edges [g] of the classes in which the lateral acceleration is counted."""
SPEED_EDGES = (0.0, 3.0, 6.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 100.0)
"""Edges [m/s] of the classes in which the speed is counted."""

SPUN = 90.0
"""Sideslip [deg] beyond which a log is labelled as spun."""


def log_entry(job: Job, log: Signals) -> dict[str, object]:
    """What the card says of one log."""
    # By total speed: a car that spun moves backwards. One that reverses has not spun.
    speed = np.hypot(log.column("vx_ref"), log.column("vy_ref"))
    moving = speed > MIN_SPEED
    beta = np.abs(np.degrees(log.beta_ref))
    turning = np.abs(log.column("vx_ref") * log.column("yaw_rate")) / GRAVITY
    spun = job.manoeuvre != "reversing" and bool(np.any(beta[moving] > SPUN))
    return {
        "log": job.name,
        "kind": job.kind,
        "manoeuvre": job.manoeuvre,
        "surface": job.surface,
        "sensors": job.profile,
        "unknowns": list(log.notes),
        "duration_s": round(float(log.t[-1]), 2),
        "max_beta_deg": round(float(beta[moving].max(initial=0.0)), 2),
        "share_beta_above_5_deg": round(float(np.mean(beta[moving] > 5.0)), 4) if moving.any() else 0.0,
        "spun": spun,
        "counts": {
            "beta": np.histogram(beta[moving], BETA_EDGES)[0].tolist(),
            "ay": np.histogram(turning[moving], AY_EDGES)[0].tolist(),
            "speed": np.histogram(speed, SPEED_EDGES)[0].tolist(),
        },
    }


def data_card(
    vehicle: Vehicle, seed: int, preset: str, entries: list[dict[str, object]]
) -> dict[str, object]:
    """Make the card: how the set came about, how its values are distributed, and its logs."""
    return {
        "seed": seed,
        "preset": preset,
        "vehicle": vehicle.name,
        "versions": {
            "crosscomb": version("crosscomb"),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "spread": {
            **SPREADS,
            "friction_over_that_of_the_vehicle": road.OF_THE_CAR,
            "friction": road.OF_THE_ROAD,
            "slope": road.SLOPE_SPREAD,
            "bank": road.BANK_SPREAD,
            "sensors": {name: profile._asdict() for name, profile in sensors.PROFILES.items()},
            "sensor_channels": sensors.CHANNELS,
        },
        "distribution": {
            "beta_deg": _shares(entries, "beta", BETA_EDGES),
            "turning_g": _shares(entries, "ay", AY_EDGES),
            "speed_m_s": _shares(entries, "speed", SPEED_EDGES),
            "manoeuvres": _numbers(entries, "manoeuvre"),
            "surfaces": _numbers(entries, "surface"),
            "spun": sum(bool(entry["spun"]) for entry in entries),
        },
        "logs": [{key: value for key, value in entry.items() if key != "counts"} for entry in entries],
    }


def _shares(entries: list[dict[str, object]], key: str, edges: tuple[float, ...]) -> dict[str, float]:
    """Share of all samples in each class: |beta|, |vx yaw_rate| above 3 m/s, and speed."""
    total = np.zeros(len(edges) - 1)
    for entry in entries:
        counts = entry["counts"]
        assert isinstance(counts, dict)
        total += counts[key]
    shares = total / max(total.sum(), 1.0)
    names = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
    return {name: round(float(share), 4) for name, share in zip(names, shares, strict=True)}


def _numbers(entries: list[dict[str, object]], key: str) -> dict[str, int]:
    values = [str(entry[key]) for entry in entries]
    return {value: values.count(value) for value in sorted(set(values))}

"""The road of one log: friction left and right, slope, bank, crests and dips, all over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.training.simulation.schedule import CONTROL_PERIOD

OF_THE_CAR: dict[str, tuple[float, float]] = {"dry": (0.92, 1.08), "wet": (0.60, 0.85)}
"""Friction on hard road, over the friction coefficient of the vehicle file."""

OF_THE_ROAD: dict[str, tuple[float, float]] = {"snow": (0.22, 0.40), "ice": (0.08, 0.16)}
"""Friction coefficient where the road decides, not the tyre."""

CHANGING = ("split", "jump")
"""Friction that differs left to right, and friction that changes suddenly."""

SURFACES = (*OF_THE_CAR, *OF_THE_ROAD, *CHANGING)

BANK_SPREAD, SLOPE_SPREAD = 0.02, 0.02
"""Standard deviation of the bank and the slope of a road; a third of the logs is driven on a level one."""
ROUGH = 1.0
"""Standard deviation of the vertical acceleration that a rough road gives [m/s^2] at 20 m/s."""


@dataclass(frozen=True)
class Road:
    """The road over time: arrays ``(n,)``, one value per `CONTROL_PERIOD`, columns as in the schedule."""

    left: np.ndarray
    right: np.ndarray
    slope: np.ndarray
    bank: np.ndarray
    dip: np.ndarray

    @property
    def grip(self) -> np.ndarray:
        """Friction coefficient of the whole car ``(n,)``."""
        return 0.5 * (self.left + self.right)


def level_road(friction: np.ndarray) -> Road:
    """A level road of the same friction ``(n,)`` left and right."""
    flat = np.zeros(len(friction))
    return Road(friction, friction, flat, flat, flat)


def draw_road(
    vehicle: Vehicle,
    surface: str,
    friction: float | None,
    n: int,
    rng: np.random.Generator,
    level: bool = False,
) -> Road:
    """Draw a road.

    Parameters
    ----------
    vehicle : Vehicle
        Its friction coefficient counts on hard road.
    surface : str
        One of `SURFACES`.
    friction : float or None
        Friction coefficient of the surface, of its grippier part where it changes; None: drawn.
    n : int
        Number of control periods.
    rng : numpy.random.Generator
    level : bool
        Neither slope nor bank.
    """
    high = _coefficient(vehicle, surface, rng) if friction is None else friction
    left, right = np.full(n, high), np.full(n, high)
    if surface == "jump":
        left[_slippery(n, rng)] *= rng.uniform(0.3, 0.7)
        right = left.copy()
    elif surface == "split":
        side = left if rng.random() < 0.5 else right
        side[_slippery(n, rng)] *= rng.uniform(0.25, 0.7)
    if level or rng.random() < 1.0 / 3.0:
        return Road(left, right, *np.zeros((3, n)))
    slope = _smooth_chance(n, rng.normal(0.0, SLOPE_SPREAD), 0.5 * SLOPE_SPREAD, 8.0, rng)
    bank = _smooth_chance(n, rng.normal(0.0, BANK_SPREAD), 0.5 * BANK_SPREAD, 6.0, rng)
    dip = _smooth_chance(n, 0.0, ROUGH / 400.0, 0.4, rng)
    return Road(left, right, slope, bank, dip)


def _coefficient(vehicle: Vehicle, surface: str, rng: np.random.Generator) -> float:
    if surface in OF_THE_ROAD:
        return float(rng.uniform(*OF_THE_ROAD[surface]))
    return float(vehicle.friction * rng.uniform(*OF_THE_CAR.get(surface, (0.7, 1.05))))


def _slippery(n: int, rng: np.random.Generator) -> np.ndarray:
    """Where ``(n,)`` a changing road is slippery: to and fro every 3 to 10 s."""
    where, at, slippery = np.zeros(n, dtype=bool), 0, bool(rng.random() < 0.5)
    while at < n:
        end = at + int(rng.uniform(3.0, 10.0) / CONTROL_PERIOD)
        where[at:end] = slippery
        at, slippery = end, not slippery
    return where


def _smooth_chance(n: int, mean: float, spread: float, period: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth chance ``(n,)`` that changes over a period [s]."""
    values = mean + spread * rng.standard_normal(int(n * CONTROL_PERIOD / period) + 3)
    where = np.arange(n) * CONTROL_PERIOD / period
    i = where.astype(int)
    blend = 0.5 - 0.5 * np.cos(np.pi * (where - i))
    return values[i] * (1.0 - blend) + values[i + 1] * blend

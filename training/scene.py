"""What a manoeuvre is planned with: the scene, the plan, and the pieces plans are made of."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from crosscomb.models.plant import PlantParameters
from crosscomb.signals import GRAVITY
from crosscomb.training.driver import (
    COLUMNS,
    CONTROL_PERIOD,
    MODE,
    OPEN_LOOP,
    SPEED,
    SURFACE,
    critical_speed,
    understeer,
)

TOP_SPEED = 36.0
NO_PATH = np.zeros((1, 3))


@dataclass
class Plan:
    """What the driver is to do: start speed [m/s], schedule ``(n, COLUMNS)``, path ``(m, 3)``."""

    speed: float
    schedule: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class Scene:
    """What a manoeuvre is planned for: car, friction over time ``(n,)``, and the source of chance."""

    plant: PlantParameters
    friction: np.ndarray
    rng: np.random.Generator

    @property
    def t(self) -> np.ndarray:
        """Time ``(n,) [s]``."""
        return np.arange(len(self.friction)) * CONTROL_PERIOD

    @property
    def grip(self) -> float:
        """Lateral acceleration [m/s^2] that the most slippery part of the road bears."""
        return float(self.friction.min()) * GRAVITY

    def top_speed(self) -> float:
        """Speed [m/s] not to be passed: road, friction and, for an oversteering car, stability."""
        road = TOP_SPEED * min(1.0, 0.45 + 0.6 * float(self.friction.min()))
        return min(road, 0.85 * critical_speed(self.plant))

    def steer_for(self, ay: float, speed: float) -> float:
        """Road-wheel angle [rad] that gives a small lateral acceleration [m/s^2] in steady state."""
        geometric = (self.plant.front + self.plant.rear) / speed**2
        angle = ay * max(geometric + understeer(self.plant), 0.3 * geometric)
        return min(angle, 0.95 * self.plant.max_steer)

    def throw(self, low: float, high: float, speed: float) -> float:
        """Steering to a chance side, for a chance share of the grip between two bounds [rad]."""
        return float(self.rng.choice([-1.0, 1.0])) * self.steer_for(
            self.rng.uniform(low, high) * self.grip, speed
        )

    def plan(self, speed: float, path: np.ndarray = NO_PATH, mode: float = OPEN_LOOP) -> Plan:
        """A plan that holds a speed [m/s] straight ahead, or along a path."""
        schedule = np.zeros((len(self.friction), COLUMNS))
        schedule[:, SPEED] = speed
        schedule[:, MODE] = mode
        schedule[:, SURFACE] = self.friction
        return Plan(speed, schedule, path)


def wander(scene: Scene, size: float, period: float) -> np.ndarray:
    """Smooth chance ``(n,)`` of standard deviation about `size` that changes over `period` [s]."""
    knots = np.arange(0.0, scene.t[-1] + 3.0 * period, period)
    values = scene.rng.normal(0.0, size, len(knots))
    where = scene.t / period
    i = where.astype(int)
    blend = 0.5 - 0.5 * np.cos(np.pi * (where - i))
    return values[i] * (1.0 - blend) + values[i + 1] * blend


def segments(scene: Scene, low: float, high: float) -> list[slice]:
    """Cut the time into pieces of `low` to `high` seconds."""
    cuts, n = [0], len(scene.t)
    while cuts[-1] < n:
        cuts.append(cuts[-1] + int(scene.rng.uniform(low, high) / CONTROL_PERIOD))
    return [slice(a, min(b, n)) for a, b in pairwise(cuts)]


def curve_path(curvature: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Path ``(m, 3)`` from the curvature [1/m] and speed [m/s] at every metre."""
    heading = np.concatenate(([0.0], np.cumsum(curvature)[:-1]))
    return np.column_stack((np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), speed))


def speed_profile(curvature: np.ndarray, ay: float, top: float, pull: float, brake: float) -> np.ndarray:
    """Fastest speed [m/s] at every metre under limits of lateral and longitudinal acceleration [m/s^2]."""
    squared = np.minimum(ay / np.maximum(np.abs(curvature), 1e-6), top**2)
    for i in range(len(squared) - 2, -1, -1):
        squared[i] = min(squared[i], squared[i + 1] + 2.0 * brake)
    for i in range(1, len(squared)):
        squared[i] = min(squared[i], squared[i - 1] + 2.0 * pull)
    return np.sqrt(squared)


def smooth(distance: np.ndarray, length: float) -> np.ndarray:
    """Rise from 0 to 1 over a length, without kinks."""
    share = np.clip(distance / length, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)

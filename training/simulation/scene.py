"""What a manoeuvre is planned with: the scene, the script, and the pieces scripts are made of."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from crosscomb.models.plant import PlantParameters, critical_speed, understeer
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.road import Road
from crosscomb.training.simulation.schedule import (
    COLUMNS,
    CONTROL_PERIOD,
    FRICTION_LEFT,
    FRICTION_RIGHT,
    MODE,
    OPEN_LOOP,
    ROAD_BANK,
    ROAD_DIP,
    ROAD_SLOPE,
    SPEED,
)

NO_PATH = np.zeros((1, 4))


@dataclass
class Script:
    """What the driver is to do: start speed [m/s], schedule ``(n, COLUMNS)``, path ``(m, 4)``."""

    speed: float
    schedule: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class Scene:
    """What a manoeuvre is planned for: car, its highest speed [m/s], road, and the source of chance."""

    plant: PlantParameters
    top_speed: float
    road: Road
    rng: np.random.Generator

    @property
    def t(self) -> np.ndarray:
        """Time ``(n,) [s]``."""
        return np.arange(len(self.road.left)) * CONTROL_PERIOD

    @property
    def grip(self) -> float:
        """Lateral acceleration [m/s^2] that the most slippery part of the road bears."""
        return float(self.road.grip.min()) * GRAVITY

    @property
    def side(self) -> float:
        """A chance side: 1 is left."""
        return float(self.rng.choice([-1.0, 1.0]))

    def highest(self) -> float:
        """Speed [m/s] not to be passed: car, friction and, for an oversteering car, stability."""
        friction = self.grip / GRAVITY
        return min(self.top_speed * min(1.0, 0.35 + 0.75 * friction), 0.85 * critical_speed(self.plant))

    def speed(self, low: float, high: float) -> float:
        """A chance speed between two bounds [m/s], slow and fast ones alike; none above the highest."""
        top = self.highest()
        low, high = min(low, max(0.6 * top, 3.5)), min(high, top)
        return float(np.exp(self.rng.uniform(np.log(low), np.log(max(high, low)))))

    def cornering(self, low: float, high: float, most: float = 20.0) -> float:
        """A chance lateral acceleration [m/s^2] between two shares of the grip, at most `most`."""
        return min(float(self.rng.uniform(low, high)) * self.grip, most)

    def radius(self, low: float, high: float) -> float:
        """A chance radius between two bounds [m], tight and wide ones alike; wide on slippery road."""
        radius = float(np.exp(self.rng.uniform(np.log(low), np.log(high))))
        return max(radius, 60.0 / self.grip)

    def steer_for(self, ay: float, speed: float) -> float:
        """Road-wheel angle [rad] that gives a small lateral acceleration [m/s^2] in steady state."""
        geometric = (self.plant.front + self.plant.rear) / speed**2
        angle = ay * max(geometric + understeer(self.plant), 0.3 * geometric)
        return min(angle, 0.95 * self.plant.max_steer)

    def throw(self, low: float, high: float, speed: float) -> float:
        """Steering to a chance side, for a chance share of the grip between two bounds [rad]."""
        return self.side * self.steer_for(self.rng.uniform(low, high) * self.grip, speed)

    def script(self, speed: float, path: np.ndarray = NO_PATH, mode: float = OPEN_LOOP) -> Script:
        """A script that holds a speed [m/s] straight ahead, or along a path."""
        schedule = np.zeros((len(self.t), COLUMNS))
        schedule[:, SPEED] = speed
        schedule[:, MODE] = mode
        schedule[:, FRICTION_LEFT] = self.road.left
        schedule[:, FRICTION_RIGHT] = self.road.right
        schedule[:, ROAD_SLOPE] = self.road.slope
        schedule[:, ROAD_BANK] = self.road.bank
        schedule[:, ROAD_DIP] = self.road.dip
        return Script(speed, schedule, path)


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
    """Path ``(m, 4)`` from the curvature [1/m] and speed [m/s] at every metre."""
    heading = np.concatenate(([0.0], np.cumsum(curvature)[:-1]))
    return np.column_stack((np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), heading, speed))


def lane_path(side: np.ndarray, speed: float) -> np.ndarray:
    """Path ``(m, 4)`` straight ahead with an offset to the side [m] at every metre."""
    along = np.arange(len(side), dtype=float)
    return np.column_stack((along, side, np.arctan(np.gradient(side)), np.full(len(side), speed)))


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

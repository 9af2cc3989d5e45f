"""The catalogue of manoeuvres: each makes a script for the driver from a scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crosscomb.training.simulation import manoeuvres_path as path
from crosscomb.training.simulation import manoeuvres_slide as slide
from crosscomb.training.simulation import manoeuvres_steer as steering
from crosscomb.training.simulation.scene import Scene, Script, segments, wander
from crosscomb.training.simulation.schedule import PROFILE, SPEED


def stop_and_go(scene: Scene) -> Script:
    """From standstill, town turns, and to standstill again."""
    script = scene.script(0.0)
    for i, part in enumerate(segments(scene, 4.0, 9.0)):
        script.schedule[part, SPEED] = 0.0 if i % 3 == 0 else scene.speed(3.0, 14.0)
    limit = scene.steer_for(min(3.0, 0.4 * scene.grip), 8.0)
    script.schedule[:, PROFILE] = np.clip(wander(scene, 0.6 * limit, 2.0), -limit, limit)
    return script


def u_turn(scene: Scene) -> Script:
    """U-turns near full lock at walking pace to 6 m/s, with runs straight ahead between."""
    script = scene.script(scene.speed(3.5, 6.0))
    for i, part in enumerate(segments(scene, 4.0, 8.0)):
        lock = min(
            scene.rng.uniform(0.5, 0.95) * scene.plant.max_steer, abs(scene.throw(0.6, 0.6, script.speed))
        )
        script.schedule[part, PROFILE] = scene.side * lock if i % 2 else 0.0
    return script


def reversing(scene: Scene) -> Script:
    """Forwards, a stop, backwards with steering, a stop, and so on."""
    script = scene.script(0.0)
    for i, part in enumerate(segments(scene, 4.0, 7.0)):
        script.schedule[part, SPEED] = (scene.speed(3.0, 8.0), 0.0, -scene.rng.uniform(1.0, 4.0), 0.0)[i % 4]
    script.schedule[:, PROFILE] = np.clip(wander(scene, 0.1, 2.0), -0.25, 0.25)
    return script


Builder = Callable[[Scene], Script]

NORMAL: dict[str, Builder] = {
    "country_road": path.country_road,
    "slalom": steering.slalom,
    "oval": path.oval,
    "stop_and_go": stop_and_go,
    "circle": path.circle,
    "town": path.town,
    "motorway": path.motorway,
    "lap": path.lap,
    "u_turn": u_turn,
    "straight": path.straight,
    "reversing": reversing,
}
LIMIT: dict[str, Builder] = {
    "road_limit": path.road_limit,
    "double_lane_change": path.double_lane_change,
    "step_steer": steering.step_steer,
    "lap_limit": path.lap_limit,
    "sine_with_dwell": steering.sine_with_dwell,
    "brake_in_turn": path.brake_in_turn,
    "slalom_limit": steering.slalom_limit,
    "circle_speed_rise": path.circle_speed_rise,
    "lane_change": path.lane_change,
    "power_in_turn": path.power_in_turn,
    "j_turn": steering.j_turn,
    "constant_speed_circles": steering.constant_speed_circles,
    "ramp_steer": steering.ramp_steer,
    "frequency_sweep": steering.frequency_sweep,
    "pulse_steer": steering.pulse_steer,
    "pedals_in_turn": path.pedals_in_turn,
    "brake_and_go": steering.brake_and_go,
}
REAR: dict[str, Builder] = {
    "rear_steer": steering.rear_steer,
    "front_and_rear_steer": steering.front_and_rear_steer,
}
"""Only for a car whose rear axle steers; they count among the limit manoeuvres."""
SLIDING: dict[str, Builder] = {
    "drift": slide.drift,
    "road_slide": path.road_slide,
    "drift_transitions": slide.drift_transitions,
    "handbrake_turn": slide.handbrake_turn,
}
KINDS: dict[str, dict[str, Builder]] = {"normal": NORMAL, "limit": {**LIMIT, **REAR}, "sliding": SLIDING}
"""Manoeuvres by kind, most telling first: a small data set takes them in this order."""

MANOEUVRES: dict[str, Builder] = {**NORMAL, **LIMIT, **REAR, **SLIDING}

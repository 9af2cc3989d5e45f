"""Manoeuvres of prescribed steering: slalom, steps, ramps, pulses, sweeps, and steering of the rear axle."""

from __future__ import annotations

import numpy as np

from crosscomb.training.simulation.scene import Scene, Script, segments, wander
from crosscomb.training.simulation.schedule import (
    CONTROL_PERIOD,
    EXTRA_BRAKE,
    EXTRA_DRIVE,
    MODE,
    PROFILE,
    PROFILE_REAR,
    SPEED,
    STRAIGHTEN,
)


def _time(part: slice) -> np.ndarray:
    return np.arange(part.stop - part.start) * CONTROL_PERIOD


def _events(scene: Scene, low: float, high: float, every: float) -> tuple[Script, list[slice]]:
    """Speed between two bounds [m/s], and pieces that each follow 2 s of straightening up."""
    script = scene.script(scene.speed(low, high))
    parts = []
    for part in segments(scene, every, every + 2.0):
        calm = min(part.start + 200, part.stop)
        script.schedule[part.start : calm, MODE] = STRAIGHTEN
        if calm < part.stop:
            parts.append(slice(calm, part.stop))
    return script, parts


def _sines(scene: Scene, low: float, high: float, slow: float, fast: float) -> Script:
    speed = scene.speed(slow, fast)
    script = scene.script(speed)
    for part in segments(scene, 8.0, 14.0):
        # Cones 18 or 36 m apart set the frequency.
        frequency = min(speed / (2.0 * scene.rng.choice([18.0, 36.0])), 1.0) * scene.rng.uniform(0.8, 1.2)
        t = _time(part)
        size = scene.steer_for(scene.cornering(low, high), speed)
        script.schedule[part, PROFILE] = size * np.sin(2.0 * np.pi * frequency * t) * np.clip(t, 0.0, 1.0)
        pause = slice(max(part.stop - 200, part.start), part.stop)
        script.schedule[pause, MODE] = STRAIGHTEN
    return script


def slalom(scene: Scene) -> Script:
    """Slalom below the limit, at 6 to 20 m/s."""
    return _sines(scene, 0.15, 0.6, 6.0, 20.0)


def slalom_limit(scene: Scene) -> Script:
    """Slalom at the limit."""
    return _sines(scene, 0.8, 1.4, 9.0, 28.0)


def step_steer(scene: Scene) -> Script:
    """Step steers to either side (ISO 7401), from gentle to past the limit."""
    script, parts = _events(scene, 12.0, 35.0, 6.0)
    for part in parts:
        script.schedule[part, PROFILE] = scene.throw(0.3, 1.6, script.speed)
    return script


def j_turn(scene: Scene) -> Script:
    """J-turns: a large step held while the car coasts."""
    script, parts = _events(scene, 12.0, 27.0, 7.0)
    for part in parts:
        script.schedule[part, PROFILE] = scene.throw(1.2, 2.5, script.speed)
        script.schedule[part.start : min(part.start + 350, part.stop), SPEED] = np.nan
    return script


def pulse_steer(scene: Scene) -> Script:
    """Short pulses of steering to either side."""
    script, parts = _events(scene, 12.0, 35.0, 4.0)
    for part in parts:
        width = scene.rng.uniform(0.3, 0.8)
        pulse = np.sin(np.pi * np.clip(_time(part) / width, 0.0, 1.0))
        script.schedule[part, PROFILE] = scene.throw(0.3, 1.2, script.speed) * pulse
    return script


def ramp_steer(scene: Scene) -> Script:
    """Slowly growing steering past the limit at constant speed (Pieralice 2018)."""
    script, parts = _events(scene, 12.0, 30.0, 13.0)
    for part in parts:
        size = scene.throw(1.2, 2.0, script.speed)
        script.schedule[part, PROFILE] = np.linspace(0.0, size, part.stop - part.start)
    return script


def constant_speed_circles(scene: Scene) -> Script:
    """Constant speed, steering held in steps: circles that grow tighter up to near the limit."""
    script = scene.script(scene.speed(6.0, 30.0))
    side = scene.side
    parts = segments(scene, 5.0, 8.0)
    for share, part in zip(np.linspace(0.1, 0.9, len(parts)), parts, strict=True):
        script.schedule[part, PROFILE] = side * scene.steer_for(share * scene.grip, script.speed)
    return script


def frequency_sweep(scene: Scene) -> Script:
    """Sine steering of rising frequency, 0.2 to 4 Hz."""
    script = scene.script(scene.speed(12.0, 35.0))
    for part in segments(scene, 18.0, 22.0):
        t = _time(part)
        rise = np.log(4.0 / 0.2) / 20.0
        phase = 2.0 * np.pi * 0.2 * (np.exp(rise * t) - 1.0) / rise
        script.schedule[part, PROFILE] = scene.throw(0.15, 0.6, script.speed) * np.sin(phase)
    return script


def sine_with_dwell(scene: Scene) -> Script:
    """One period of 0.7 Hz with a dwell of 0.5 s at the second peak (ISO 19365), coasting."""
    script, parts = _events(scene, 15.0, 28.0, 7.0)
    for part in parts:
        size = scene.throw(0.5, 1.6, script.speed)
        phase = np.interp(
            _time(part), [0.0, 0.75 / 0.7, 0.75 / 0.7 + 0.5, 1.0 / 0.7 + 0.5], [0.0, 0.75, 0.75, 1.0]
        )
        script.schedule[part, PROFILE] = size * np.sin(2.0 * np.pi * phase)
        after = slice(min(part.start + 300, part.stop), part.stop)
        script.schedule[part.start : after.start, SPEED] = np.nan
        script.schedule[after, MODE] = STRAIGHTEN
    return script


def brake_and_go(scene: Scene) -> Script:
    """Hard braking and full acceleration straight ahead; on split friction the driver holds the car."""
    script = scene.script(scene.speed(10.0, 35.0), mode=STRAIGHTEN)
    for i, part in enumerate(segments(scene, 3.0, 5.0)):
        press = slice(part.start, min(part.start + int(scene.rng.uniform(100, 250)), part.stop))
        column, most = ((EXTRA_BRAKE, 1.05), (EXTRA_DRIVE, 0.6))[i % 2]
        script.schedule[press, SPEED] = np.nan
        script.schedule[press, column] = scene.rng.uniform(0.2, most) * scene.road.grip[press]
    return script


def rear_steer(scene: Scene) -> Script:
    """Steps and sines of the rear axle alone."""
    script, parts = _events(scene, 6.0, 28.0, 5.0)
    for part in parts:
        script.schedule[part, PROFILE_REAR] = _rear_size(scene, script.speed) * _shape(scene, _time(part))
    return script


def front_and_rear_steer(scene: Scene) -> Script:
    """Both axles steered at once, in the same sense or in the opposite one."""
    script, parts = _events(scene, 6.0, 28.0, 5.0)
    for part in parts:
        shape = _shape(scene, _time(part))
        script.schedule[part, PROFILE] = scene.throw(0.2, 0.8, script.speed) * shape
        script.schedule[part, PROFILE_REAR] = _rear_size(scene, script.speed) * shape
    script.schedule[:, PROFILE_REAR] += wander(scene, 0.02 * scene.plant.max_steer_rear, 2.0)
    return script


def _rear_size(scene: Scene, speed: float) -> float:
    """Rear angle [rad] to a chance side, for at most 0.7 of the grip."""
    return min(scene.steer_for(0.7 * scene.grip, speed), scene.plant.max_steer_rear) * scene.rng.uniform(
        -1.0, 1.0
    )


def _shape(scene: Scene, t: np.ndarray) -> np.ndarray:
    if scene.rng.random() < 0.5:
        return np.clip(t / 0.2, 0.0, 1.0)
    return np.sin(2.0 * np.pi * scene.rng.uniform(0.2, 0.8) * t)

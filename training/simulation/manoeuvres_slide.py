"""Manoeuvres that slide on purpose: drifts held by counter-steering and bends entered with the handbrake."""

from __future__ import annotations

import numpy as np

from crosscomb.training.simulation.scene import Scene, Script, segments, smooth
from crosscomb.training.simulation.schedule import (
    CONTROL_PERIOD,
    DRIFT,
    EXTRA_HANDBRAKE,
    MODE,
    PROFILE,
    SLIDE,
    STRAIGHTEN,
)


def drift(scene: Scene) -> Script:
    """Drifts to one side, each held by counter-steering for seconds, with runs straight ahead between."""
    return _drifts(scene, 4.0, 8.0, alternate=False)


def drift_transitions(scene: Scene) -> Script:
    """Drifts thrown from side to side."""
    return _drifts(scene, 2.0, 4.0, alternate=True)


def _drifts(scene: Scene, low: float, high: float, alternate: bool) -> Script:
    speed = min(scene.rng.uniform(4.0, 6.0) * np.sqrt(scene.grip), scene.highest())
    script = scene.script(speed, mode=STRAIGHTEN)
    side, at, last = scene.side, 300, 0.0
    while at < len(scene.t):
        hold = at + int(scene.rng.uniform(low, high) / CONTROL_PERIOD)
        script.schedule[at:hold, MODE] = DRIFT
        slide = side * np.radians(scene.rng.uniform(8.0, 30.0))
        swing = (1.2 if last else 0.8) / np.sqrt(scene.road.grip[at])
        n = len(script.schedule[at:hold])
        script.schedule[at:hold, SLIDE] = last + (slide - last) * smooth(np.arange(n) * CONTROL_PERIOD, swing)
        side = -side if alternate else scene.side
        last = slide if alternate and scene.rng.random() < 0.7 else 0.0
        at = hold + (0 if last else int(scene.rng.uniform(3.0, 5.0) / CONTROL_PERIOD))
    return script


def handbrake_turn(scene: Scene) -> Script:
    """Bends entered with the handbrake: large slides, at times a spin."""
    script = scene.script(scene.speed(8.0, 20.0))
    for part in segments(scene, 7.0, 9.0):
        calm = min(part.start + 250, part.stop)
        script.schedule[part.start : calm, MODE] = STRAIGHTEN
        pull = min(calm + int(scene.rng.uniform(50, 110)), part.stop)
        script.schedule[calm:pull, PROFILE] = scene.throw(0.5, 1.0, script.speed)
        script.schedule[calm + 30 : pull, EXTRA_HANDBRAKE] = 1.3 * scene.road.grip[part.start]
        script.schedule[pull : part.stop, MODE] = STRAIGHTEN
    return script

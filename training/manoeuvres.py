"""The catalogue of manoeuvres: each makes a plan for the driver from a scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crosscomb.training.driver import (
    CONTROL_PERIOD,
    DRIFT,
    EXTRA_BRAKE,
    EXTRA_DRIVE,
    EXTRA_HANDBRAKE,
    FOLLOW_PATH,
    MODE,
    PROFILE,
    SLIDE,
    SPEED,
    STRAIGHTEN,
)
from crosscomb.training.scene import (
    TOP_SPEED,
    Plan,
    Scene,
    curve_path,
    segments,
    smooth,
    speed_profile,
    wander,
)


def _road(scene: Scene, ay: float, tightest: float) -> Plan:
    """A winding road of random bends, driven at a lateral acceleration [m/s^2]."""
    top = scene.top_speed() * scene.rng.uniform(0.6, 1.0)
    length = int(top * (scene.t[-1] + 5.0)) + 300
    curvature = np.zeros(length)
    at = 40
    while at < length:
        run = int(scene.rng.uniform(25.0, 110.0))
        bend = scene.rng.choice([-1.0, 1.0]) / np.exp(scene.rng.uniform(np.log(tightest), np.log(250.0)))
        # No bend turns by more than 150 degrees.
        run = min(run, max(int(2.6 / abs(bend)), 10))
        ramp = np.minimum(1.0, np.minimum(np.arange(run), np.arange(run)[::-1]) / max(0.3 * run, 1.0))
        curvature[at : at + run] = (bend * ramp)[: max(length - at, 0)]
        at += run + int(scene.rng.exponential(20.0))
    speed = speed_profile(curvature, ay, top, min(2.5, 0.4 * scene.grip), min(3.5, 0.5 * scene.grip))
    plan = scene.plan(top, curve_path(curvature, speed), FOLLOW_PATH)
    plan.speed = float(speed[0])
    return plan


def circuit(scene: Scene) -> Plan:
    """Winding road well below the limit."""
    return _road(scene, scene.rng.uniform(0.3, 0.6) * scene.grip, 15.0)


def circuit_limit(scene: Scene) -> Plan:
    """Winding road at the limit."""
    return _road(scene, scene.rng.uniform(0.85, 1.05) * scene.grip, 20.0)


def circuit_slide(scene: Scene) -> Plan:
    """Winding road too fast, with power or handbrake in the bends."""
    plan = _road(scene, scene.rng.uniform(0.9, 1.1) * scene.grip, 20.0)
    column = EXTRA_HANDBRAKE if scene.plant.share_front == 1.0 else EXTRA_DRIVE
    size = 1.2 if scene.plant.share_front == 1.0 else 0.7
    for part in segments(scene, 2.0, 5.0):
        burst = slice(part.start, part.start + int(scene.rng.uniform(0.5, 1.4) / CONTROL_PERIOD))
        plan.schedule[burst, column] = size * scene.friction[part.start]
    return plan


def straight(scene: Scene) -> Plan:
    """Straight driving at changing speed with small corrections of the steering."""
    top = scene.top_speed()
    plan = scene.plan(scene.rng.uniform(0.3, 1.0) * top)
    for part in segments(scene, 4.0, 10.0):
        plan.schedule[part, SPEED] = scene.rng.uniform(0.3, 1.0) * top
    plan.schedule[:, PROFILE] = wander(scene, 0.003, 1.0)
    return plan


def stop_and_go(scene: Scene) -> Plan:
    """From standstill, town turns, and to standstill again."""
    plan = scene.plan(0.0)
    for i, part in enumerate(segments(scene, 3.5, 8.0)):
        plan.schedule[part, SPEED] = 0.0 if i % 3 == 0 else scene.rng.uniform(4.0, 14.0)
    limit = scene.steer_for(min(3.0, 0.4 * scene.grip), 8.0)
    plan.schedule[:, PROFILE] = np.clip(wander(scene, 0.6 * limit, 2.0), -limit, limit)
    return plan


def circle(scene: Scene) -> Plan:
    """Constant radius, speed held in steps below the limit."""
    radius = scene.rng.uniform(12.0, 80.0)
    plan = _circle(scene, radius)
    for part in segments(scene, 6.0, 12.0):
        plan.schedule[part, SPEED] = np.sqrt(scene.rng.uniform(0.1, 0.6) * scene.grip * radius)
    return plan


def circle_speed_rise(scene: Scene) -> Plan:
    """Constant radius, speed rising past the limit (ISO 4138)."""
    radius = scene.rng.uniform(30.0, 100.0)
    plan = _circle(scene, radius)
    limit = min(np.sqrt(scene.grip * radius), TOP_SPEED)
    plan.schedule[:, SPEED] = np.interp(scene.t, [0.0, 0.8 * scene.t[-1]], [0.4 * limit, 1.1 * limit])
    plan.speed = 0.4 * limit
    return plan


def _circle(scene: Scene, radius: float) -> Plan:
    length = int(TOP_SPEED * scene.t[-1]) + 200
    curvature = scene.rng.choice([-1.0, 1.0]) / radius * np.clip((np.arange(length) - 20.0) / 20.0, 0.0, 1.0)
    plan = scene.plan(0.0, curve_path(curvature, np.full(length, TOP_SPEED)), FOLLOW_PATH)
    plan.speed = float(np.sqrt(0.2 * scene.grip * radius))
    return plan


def _sines(scene: Scene, low: float, high: float, top: float) -> Plan:
    speed = scene.rng.uniform(0.35, 1.0) * scene.top_speed()
    plan = scene.plan(speed)
    for part in segments(scene, 8.0, 14.0):
        frequency = scene.rng.uniform(0.2, top)
        t = np.arange(part.stop - part.start) * CONTROL_PERIOD
        size = scene.steer_for(scene.rng.uniform(low, high) * scene.grip, speed)
        plan.schedule[part, PROFILE] = size * np.sin(2.0 * np.pi * frequency * t) * np.clip(t, 0.0, 1.0)
        pause = slice(part.stop - 200, part.stop)
        plan.schedule[pause, MODE] = STRAIGHTEN
    return plan


def slalom(scene: Scene) -> Plan:
    """Slalom below the limit."""
    return _sines(scene, 0.2, 0.5, 0.6)


def slalom_limit(scene: Scene) -> Plan:
    """Slalom at the limit."""
    return _sines(scene, 0.8, 1.4, 0.8)


def _event_plan(scene: Scene, low: float, high: float, every: float) -> tuple[Plan, list[slice]]:
    """Speed in a share of the top speed, and pieces that start with 2.5 s of straightening up."""
    plan = scene.plan(scene.rng.uniform(low, high) * scene.top_speed())
    parts = []
    for part in segments(scene, every, every + 2.0):
        calm = min(part.start + 250, part.stop)
        plan.schedule[part.start : calm, MODE] = STRAIGHTEN
        if calm < part.stop:
            parts.append(slice(calm, part.stop))
    return plan, parts


def step_steer(scene: Scene) -> Plan:
    """Step steers to either side (ISO 7401), up to past the limit."""
    plan, parts = _event_plan(scene, 0.5, 1.0, 6.0)
    for part in parts:
        size = scene.throw(0.4, 1.6, plan.speed)
        plan.schedule[part, PROFILE] = size
    return plan


def ramp_steer(scene: Scene) -> Plan:
    """Slowly growing steering past the limit at constant speed."""
    plan, parts = _event_plan(scene, 0.5, 0.9, 13.0)
    for part in parts:
        size = scene.throw(2.0, 2.0, plan.speed)
        plan.schedule[part, PROFILE] = np.linspace(0.0, size, part.stop - part.start)
    return plan


def sine_with_dwell(scene: Scene) -> Plan:
    """One period of 0.7 Hz with a dwell of 0.5 s at the second peak (ISO 19365), coasting."""
    plan, parts = _event_plan(scene, 0.6, 0.9, 8.0)
    for part in parts:
        size = scene.throw(0.8, 2.2, plan.speed)
        t = np.arange(part.stop - part.start) * CONTROL_PERIOD
        phase = np.interp(t, [0.0, 0.75 / 0.7, 0.75 / 0.7 + 0.5, 1.0 / 0.7 + 0.5], [0.0, 0.75, 0.75, 1.0])
        plan.schedule[part, PROFILE] = size * np.sin(2.0 * np.pi * phase)
        after = slice(min(part.start + 300, part.stop), part.stop)
        plan.schedule[slice(part.start, after.start), SPEED] = np.nan
        plan.schedule[after, MODE] = STRAIGHTEN
    return plan


def double_lane_change(scene: Scene) -> Plan:
    """Double lane changes of the ISO 3888-2 kind, one after the other, to either side."""
    speed = min(scene.rng.uniform(0.8, 1.15) * np.sqrt(scene.grip * 40.0), scene.top_speed())
    length = int(speed * scene.t[-1]) + 300
    side = np.zeros(length)
    gap = int(max(60.0, 3.5 * speed))
    for at in range(30, length, 61 + gap):
        offset = scene.rng.choice([-1.0, 1.0]) * scene.rng.uniform(2.5, 3.6)
        along = np.arange(length) - float(at)
        side += offset * (smooth(along, 13.5) - smooth(along - 24.5, 12.5))
    path = np.column_stack((np.arange(length, dtype=float), side, np.full(length, TOP_SPEED)))
    return scene.plan(speed, path, FOLLOW_PATH)


def brake_in_turn(scene: Scene) -> Plan:
    """Braking or lifting off in a bend (ISO 7975), up to locked wheels."""
    return _pedal_in_turn(scene, EXTRA_BRAKE, 1.05)


def power_in_turn(scene: Scene) -> Plan:
    """Accelerating in a bend, up to spinning wheels."""
    return _pedal_in_turn(scene, EXTRA_DRIVE, 0.6)


def _pedal_in_turn(scene: Scene, column: int, most: float) -> Plan:
    radius = scene.rng.uniform(25.0, 90.0)
    plan = _circle(scene, radius)
    speed = min(float(np.sqrt(scene.rng.uniform(0.5, 0.9) * scene.grip * radius)), scene.top_speed())
    plan.schedule[:, SPEED] = speed
    plan.speed = 0.8 * speed
    for part in segments(scene, 6.0, 9.0):
        begin = min(part.start + 400, part.stop)
        press = slice(begin, min(begin + int(scene.rng.uniform(80, 200)), part.stop))
        plan.schedule[press, SPEED] = np.nan
        plan.schedule[press, column] = scene.rng.uniform(0.0, most) * scene.friction[press]
    return plan


def drift(scene: Scene) -> Plan:
    """Drifts to one side, each held by counter-steering for seconds, with runs straight ahead between."""
    return _drifts(scene, 4.0, 8.0, alternate=False)


def drift_transitions(scene: Scene) -> Plan:
    """Drifts thrown from side to side."""
    return _drifts(scene, 2.0, 4.0, alternate=True)


def _drifts(scene: Scene, low: float, high: float, alternate: bool) -> Plan:
    speed = min(scene.rng.uniform(4.0, 6.0) * np.sqrt(scene.grip), scene.top_speed())
    plan = scene.plan(speed, mode=STRAIGHTEN)
    side, at, last = scene.rng.choice([-1.0, 1.0]), 300, 0.0
    while at < len(scene.t):
        hold = at + int(scene.rng.uniform(low, high) / CONTROL_PERIOD)
        plan.schedule[at:hold, MODE] = DRIFT
        slide = side * np.radians(scene.rng.uniform(12.0, 30.0))
        swing = (1.2 if last else 0.8) / np.sqrt(scene.friction[at])
        n = len(plan.schedule[at:hold])
        plan.schedule[at:hold, SLIDE] = last + (slide - last) * smooth(np.arange(n) * CONTROL_PERIOD, swing)
        side = -side if alternate else scene.rng.choice([-1.0, 1.0])
        last = slide if alternate and scene.rng.random() < 0.7 else 0.0
        at = hold + (0 if last else int(scene.rng.uniform(3.0, 5.0) / CONTROL_PERIOD))
    return plan


def handbrake_turn(scene: Scene) -> Plan:
    """Bends entered with the handbrake: large slides, at times a spin."""
    plan, parts = _event_plan(scene, 0.35, 0.6, 7.0)
    for part in parts:
        size = scene.throw(0.6, 1.1, plan.speed)
        pull = min(part.start + int(scene.rng.uniform(60, 150)), part.stop)
        plan.schedule[part.start : pull, PROFILE] = size
        plan.schedule[part.start + 30 : pull, EXTRA_HANDBRAKE] = 1.3 * scene.friction[part.start]
        plan.schedule[pull : part.stop, MODE] = STRAIGHTEN
    return plan


Builder = Callable[[Scene], Plan]

NORMAL: dict[str, Builder] = {
    "circuit": circuit,
    "slalom": slalom,
    "stop_and_go": stop_and_go,
    "circle": circle,
    "straight": straight,
}
LIMIT: dict[str, Builder] = {
    "circuit_limit": circuit_limit,
    "double_lane_change": double_lane_change,
    "step_steer": step_steer,
    "sine_with_dwell": sine_with_dwell,
    "brake_in_turn": brake_in_turn,
    "circle_speed_rise": circle_speed_rise,
    "slalom_limit": slalom_limit,
    "power_in_turn": power_in_turn,
    "ramp_steer": ramp_steer,
}
SLIDING: dict[str, Builder] = {
    "drift": drift,
    "circuit_slide": circuit_slide,
    "drift_transitions": drift_transitions,
    "handbrake_turn": handbrake_turn,
}
KINDS: dict[str, dict[str, Builder]] = {"normal": NORMAL, "limit": LIMIT, "sliding": SLIDING}
"""Manoeuvres by kind, most telling first: a small data set takes them in this order."""

MANOEUVRES: dict[str, Builder] = {**NORMAL, **LIMIT, **SLIDING}

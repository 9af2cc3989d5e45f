"""Manoeuvres along a path: roads, closed laps, ovals, circles and lane changes."""

from __future__ import annotations

import numpy as np

from crosscomb.training.simulation.scene import (
    Scene,
    Script,
    curve_path,
    lane_path,
    segments,
    smooth,
    speed_profile,
)
from crosscomb.training.simulation.schedule import (
    CONTROL_PERIOD,
    EXTRA_BRAKE,
    EXTRA_DRIVE,
    EXTRA_HANDBRAKE,
    FOLLOW_PATH,
    SPEED,
)


def _driven(scene: Scene, curvature: np.ndarray, ay: float, top: float) -> Script:
    """Follow a path of a curvature [1/m] per metre at a lateral acceleration [m/s^2] up to a speed [m/s]."""
    speed = speed_profile(curvature, ay, top, min(2.5, 0.4 * scene.grip), min(3.5, 0.5 * scene.grip))
    script = scene.script(top, curve_path(curvature, speed), FOLLOW_PATH)
    script.speed = float(speed[0])
    return script


def _length(scene: Scene, top: float) -> int:
    return int(top * (scene.t[-1] + 5.0)) + 300


def _bends(scene: Scene, top: float, tightest: float, widest: float) -> np.ndarray:
    """Curvature [1/m] per metre of a winding road of random bends."""
    length = _length(scene, top)
    curvature = np.zeros(length)
    at = 20
    while at < length:
        run = int(scene.rng.uniform(1.0, 4.0) * max(tightest, 20.0))
        bend = scene.side / scene.radius(tightest, widest)
        # No bend turns by more than 150 degrees.
        run = min(run, max(int(2.6 / abs(bend)), 10))
        ramp = np.minimum(1.0, np.minimum(np.arange(run), np.arange(run)[::-1]) / max(0.3 * run, 1.0))
        curvature[at : at + run] = (bend * ramp)[: max(length - at, 0)]
        at += run + int(scene.rng.exponential(max(15.0, 0.5 * top)))
    return curvature


def _lap(scene: Scene, top: float, size: float) -> np.ndarray:
    """Curvature [1/m] per metre of laps of a closed course: a circle of a radius [m] with random waves."""
    turn = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    radius = np.ones_like(turn)
    for wave in range(2, 6):
        radius += (
            scene.rng.uniform(0.1, 0.45) / wave * np.cos(wave * turn + scene.rng.uniform(0.0, 2.0 * np.pi))
        )
    x, y = size * radius * np.cos(turn), size * radius * np.sin(turn)
    dx, dy = (np.diff(v, append=v[:1]) for v in (x, y))
    heading = np.unwrap(np.arctan2(dy, dx))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(dx, dy))))
    metres = np.arange(int(along[-1]))
    heading = np.interp(metres, along[:-1], heading)
    lap = np.diff(heading, append=heading[0] + 2.0 * np.pi)
    # The driver rounds corners off over some metres.
    lap = np.convolve(np.concatenate((lap[-4:], lap, lap[:4])), np.ones(9) / 9.0, mode="valid")
    return scene.side * np.resize(np.clip(lap, -1.0 / 8.0, 1.0 / 8.0), _length(scene, top))


def town(scene: Scene) -> Script:
    """Tight bends of 7 to 40 m at 3 to 14 m/s, as in a town or on a handling course driven calmly."""
    top = scene.speed(5.0, 14.0)
    return _driven(scene, _bends(scene, top, 7.0, 40.0), scene.cornering(0.2, 0.5, 5.0), top)


def country_road(scene: Scene) -> Script:
    """Winding road at 0.15 to 0.5 of the grip."""
    top = scene.speed(12.0, 35.0)
    widest = max(top**2 / 1.5, 60.0)
    return _driven(scene, _bends(scene, top, 20.0, widest), scene.cornering(0.15, 0.5, 5.0), top)


def motorway(scene: Scene) -> Script:
    """Wide bends and gentle changes of lane at the speed of a motorway."""
    top = scene.speed(22.0, 45.0)
    curvature = _bends(scene, top, 400.0, 3000.0)
    swing = np.zeros(len(curvature))
    for at in range(100, len(swing) - 300, int(scene.rng.uniform(5.0, 12.0) * top)):
        run = int(scene.rng.uniform(3.5, 6.0) * top)
        bend = scene.side * 2.0 * np.pi * 3.5 / run**2 * np.sin(2.0 * np.pi * np.arange(run) / run)
        swing[at : at + run] = bend[: len(swing) - at]
    return _driven(scene, curvature + swing, scene.cornering(0.2, 0.5, 4.0), top)


def oval(scene: Scene) -> Script:
    """Laps of a small oval: half circles of 7 to 25 m, mostly geometric sideslip."""
    radius, straight = scene.radius(7.0, 25.0), scene.rng.uniform(10.0, 80.0)
    top = scene.speed(6.0, 13.0)
    half = np.concatenate((np.zeros(int(straight)), np.full(round(np.pi * radius), 1.0 / radius)))
    lap = np.convolve(np.resize(half, _length(scene, top) + 8), np.ones(9) / 9.0, mode="valid")
    return _driven(scene, scene.side * lap, scene.cornering(0.2, 0.65, 6.5), top)


def lap(scene: Scene) -> Script:
    """Laps of a closed course, well below the limit."""
    top = scene.speed(10.0, 40.0)
    return _driven(scene, _lap(scene, top, 1.5 * scene.radius(20.0, 80.0)), scene.cornering(0.25, 0.6), top)


def lap_limit(scene: Scene) -> Script:
    """Laps of a closed course at the limit, as on a race track."""
    top = scene.speed(20.0, 65.0)
    size = scene.rng.uniform(40.0, 90.0) * max(top / 30.0, 1.0)
    return _driven(scene, _lap(scene, top, size), scene.cornering(0.8, 1.02), top)


def road_limit(scene: Scene) -> Script:
    """Winding road at the limit."""
    top = scene.speed(15.0, 36.0)
    return _driven(scene, _bends(scene, top, 20.0, 250.0), scene.cornering(0.85, 1.05), top)


def road_slide(scene: Scene) -> Script:
    """Winding road with power or handbrake in the bends; the driver catches the slide and goes on."""
    top = scene.speed(12.0, 25.0)
    script = _driven(scene, _bends(scene, top, 15.0, 80.0), scene.cornering(0.75, 0.95), top)
    pull = scene.plant.share_front == 1.0
    column, size = (EXTRA_HANDBRAKE, 1.2) if pull else (EXTRA_DRIVE, 0.6)
    for part in segments(scene, 3.0, 6.0):
        burst = slice(part.start, part.start + int(scene.rng.uniform(0.4, 1.2) / CONTROL_PERIOD))
        script.schedule[burst, column] = size * scene.road.grip[part.start]
    return script


def _circle(scene: Scene, radius: float) -> Script:
    length = _length(scene, scene.highest())
    curvature = scene.side / radius * np.clip((np.arange(length) - 10.0) / 20.0, 0.0, 1.0)
    script = scene.script(0.0, curve_path(curvature, np.full(length, scene.highest())), FOLLOW_PATH)
    script.speed = min(float(np.sqrt(0.15 * scene.grip * radius)), scene.highest())
    return script


def circle(scene: Scene) -> Script:
    """Constant radius, speed held in steps below the limit."""
    radius = scene.radius(8.0, 100.0)
    script = _circle(scene, radius)
    for part in segments(scene, 6.0, 12.0):
        script.schedule[part, SPEED] = np.sqrt(scene.cornering(0.05, 0.6) * radius)
    return script


def circle_speed_rise(scene: Scene) -> Script:
    """Constant radius, speed rising past the limit (ISO 4138)."""
    radius = scene.radius(25.0, 100.0)
    script = _circle(scene, radius)
    limit = np.sqrt(scene.grip * radius)
    script.schedule[:, SPEED] = np.interp(scene.t, [0.0, 0.8 * scene.t[-1]], [0.4 * limit, 1.1 * limit])
    return script


def lane_change(scene: Scene) -> Script:
    """Single lane changes to and fro, from gentle to at the limit."""
    speed = scene.speed(8.0, 40.0)
    share = scene.rng.uniform(0.15, 1.0)
    side = np.zeros(_length(scene, speed))
    at, where = 30, 0.0
    while at < len(side):
        width = 3.5 if where == 0.0 else -where
        # The steepest part of the smooth step has 6 width / length^2 of curvature.
        length = max(speed * np.sqrt(6.0 * 3.5 / (share * scene.grip)), 12.0)
        side += width * smooth(np.arange(len(side)) - float(at), length)
        where += width
        at += int(length + scene.rng.uniform(2.0, 5.0) * speed)
    return scene.script(speed, lane_path(scene.side * side, speed), FOLLOW_PATH)


def double_lane_change(scene: Scene) -> Script:
    """Double lane changes to either side: lengths of ISO 3888-1 above 20 m/s, of ISO 3888-2 below."""
    speed = min(scene.rng.uniform(0.7, 1.15) * np.sqrt(scene.grip * 40.0), scene.highest())
    out, stay, back = (30.0, 25.0, 25.0) if speed > 20.0 else (13.5, 11.0, 12.5)
    side = np.zeros(_length(scene, speed))
    gap = int(max(60.0, 3.5 * speed))
    for at in range(30, len(side), int(out + stay + back) + gap):
        offset = scene.side * scene.rng.uniform(2.5, 3.6)
        along = np.arange(len(side)) - float(at)
        side += offset * (smooth(along, out) - smooth(along - out - stay, back))
    return scene.script(speed, lane_path(side, speed), FOLLOW_PATH)


def straight(scene: Scene) -> Script:
    """Straight driving at changing speed, wandering a little in the lane."""
    top = scene.speed(15.0, 45.0)
    side = (
        0.3
        * np.cumsum(np.convolve(scene.rng.standard_normal(_length(scene, top) + 60), np.ones(61), "valid"))
        / 61.0
    )
    script = scene.script(top, lane_path(0.05 * side, top), FOLLOW_PATH)
    for part in segments(scene, 5.0, 12.0):
        script.schedule[part, SPEED] = scene.speed(5.0, top)
    return script


def brake_in_turn(scene: Scene) -> Script:
    """Braking or lifting off in a bend (ISO 7975), up to locked wheels."""
    return _pedals_in_turn(scene, (EXTRA_BRAKE,), 1.05)


def power_in_turn(scene: Scene) -> Script:
    """Accelerating in a bend, up to spinning wheels."""
    return _pedals_in_turn(scene, (EXTRA_DRIVE,), 0.6)


def pedals_in_turn(scene: Scene) -> Script:
    """Braking and accelerating in a bend by turns."""
    return _pedals_in_turn(scene, (EXTRA_BRAKE, EXTRA_DRIVE), 0.6)


def _pedals_in_turn(scene: Scene, columns: tuple[int, ...], most: float) -> Script:
    radius = scene.radius(20.0, 90.0)
    script = _circle(scene, radius)
    script.schedule[:, SPEED] = min(float(np.sqrt(scene.cornering(0.4, 0.9) * radius)), scene.highest())
    for i, part in enumerate(segments(scene, 5.0, 8.0)):
        begin = min(part.start + 300, part.stop)
        press = slice(begin, min(begin + int(scene.rng.uniform(80, 200)), part.stop))
        script.schedule[press, SPEED] = np.nan
        size = scene.rng.uniform(0.0, most)
        script.schedule[press, columns[i % len(columns)]] = size * scene.road.grip[press]
    return script

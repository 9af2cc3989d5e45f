"""Tyre curves of both axles: slip angles and forces from the logs, and the laws fitted to them.

Slip angles come from the ground truth; without it from the fitted single track, and where that leaves its range
from integrating the accelerometer over the slide, tied to the model before and after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from crosscomb.models.magic_formula import magic_formula
from crosscomb.models.single_track import axle_use
from crosscomb.models.tyres import rational_tyre
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.identification.parameters import Fit, tyre_car
from crosscomb.training.identification.response import Sensing, road_wheel_angle, run_model
from crosscomb.training.identification.trace import RATE, Trace, settled

LONGEST_SLIDE = 4.0
"""Seconds over which accelerations are integrated at most: an offset of 0.05 m/s^2 adds 0.6 deg at 20 m/s."""
BIN = np.radians(0.25)
LEAST_IN_BIN = 10
RATIONAL_REACH, MAGIC_REACH = 1.0, 1.5
"""Linear force at the largest slip over the friction from which on a law's curve can be told."""


@dataclass(frozen=True)
class AxleCurve:
    """Measured tyre curve of one axle, and the laws that fit it.

    Attributes
    ----------
    slip, force, error : ndarray
        ``(bins,)`` mean slip angle [rad], median force over load [-] and its standard deviation.
    reach : float
        Linear force at the largest slip over the friction.
    rational : dict or None
        c1 [rad^2], c2 [N/rad] of Di Biase 2020, eq. 4 and table 1, as (value, standard deviation).
    magic : dict or None
        B [1/rad], C, D [-, over load] of the Magic Formula; E is the vehicle file's.
    """

    slip: np.ndarray
    force: np.ndarray
    error: np.ndarray
    load: float
    reach: float
    rational: dict[str, tuple[float, float]] | None
    magic: dict[str, tuple[float, float]] | None


def tyre_curves(traces: list[Trace], vehicle: Vehicle, fit: Fit) -> dict[str, AxleCurve] | None:
    """Tyre curves of the front and rear axle; None where there is too little to draw one.

    Parameters
    ----------
    traces : list of Trace
    vehicle : Vehicle
        As identified.
    fit : Fit
        Of `crosscomb.training.identification.handling.fit`, for the same traces.
    """
    parts = [_points(trace, vehicle, fit, i) for i, trace in enumerate(traces)]
    points = np.concatenate(parts, axis=1)
    if points.shape[1] < 10 * LEAST_IN_BIN:
        return None
    share = vehicle.cg_to_rear_axle / vehicle.wheelbase
    weight = vehicle.mass * GRAVITY
    return {
        "front": _curve(points[0], points[1], weight * share, vehicle, vehicle.cornering_stiffness_front),
        "rear": _curve(
            points[2], points[3], weight * (1.0 - share), vehicle, vehicle.cornering_stiffness_rear
        ),
    }


def _points(trace: Trace, vehicle: Vehicle, fit: Fit, i: int) -> np.ndarray:
    """Slip angle [rad] and force over load [-] of the front, then of the rear axle ``(4, m)``."""
    sensing = fit.sensing(i)
    steer = road_wheel_angle(trace, sensing, vehicle.plant.steer_lag)
    yaw_rate, ay = _corrected(trace, sensing)
    turning, pull = np.gradient(yaw_rate, trace.t), np.gradient(trace.vx, trace.t)
    beta = _sideslip(trace, vehicle, fit, sensing, yaw_rate, ay)
    vx = np.maximum(trace.vx, 1.0)
    use = axle_use(yaw_rate, turning, beta, vx, pull, ay, steer, trace.steer_rear, vehicle)
    return use[:, settled(trace.wild) & np.isfinite(beta)]


def _corrected(trace: Trace, sensing: Sensing) -> tuple[np.ndarray, np.ndarray]:
    """Yaw rate [rad/s] and ay [m/s^2] at the centre of gravity, in step with the steering, without gravity."""
    yaw_rate = np.interp(trace.t + sensing.yaw_delay, trace.t, trace.yaw_rate) - sensing.yaw_bias
    felt = np.interp(trace.t + sensing.ay_delay, trace.t, trace.ay) - sensing.ay_bias
    felt = felt - sensing.position * np.gradient(yaw_rate, trace.t)
    return yaw_rate, felt / (1.0 + GRAVITY * sensing.roll_gradient)


def _sideslip(
    trace: Trace, vehicle: Vehicle, fit: Fit, sensing: Sensing, yaw_rate: np.ndarray, ay: np.ndarray
) -> np.ndarray:
    """Sideslip angle ``(n,) [rad]``; NaN where nothing tells it."""
    if np.isfinite(trace.beta).any():
        return np.interp(trace.t + sensing.beta_delay, trace.t, trace.beta) - sensing.beta_bias
    car = tyre_car(vehicle, fit.car)
    response = run_model(trace, trace.normal, car, fit.car["friction"], sensing)
    good = settled(trace.normal)
    lateral = np.where(good, trace.vx * np.tan(response.beta), np.nan)
    known = np.flatnonzero(good)
    change = (ay - trace.vx * yaw_rate) / RATE
    for start, stop in pairwise(known):
        if 1 < stop - start <= LONGEST_SLIDE * RATE and trace.wild[start:stop].all():
            inside = lateral[start] + np.cumsum(change[start:stop])
            drift = lateral[stop] - inside[-1]
            lateral[start + 1 : stop] = (inside + drift * np.linspace(0.0, 1.0, stop - start))[:-1]
    return np.arctan(lateral / np.maximum(trace.vx, 1.0))


def _curve(slip: np.ndarray, force: np.ndarray, load: float, vehicle: Vehicle, stiffness: float) -> AxleCurve:
    """Medians over slip of both sides together, and the laws fitted to them."""
    side = np.where(slip < 0.0, -1.0, 1.0)
    slip, force = np.abs(slip), force * side
    number = (slip / BIN).astype(int)
    rows = []
    for one in np.unique(number):
        inside = force[number == one]
        if len(inside) >= LEAST_IN_BIN:
            spread = 1.48 * float(np.median(np.abs(inside - np.median(inside))))
            # Neighbours in time are alike: a bin holds about one independent value in ten.
            rows.append(
                [slip[number == one].mean(), np.median(inside), spread / np.sqrt(0.1 * len(inside)) + 0.01]
            )
    centre, median, error = np.array(rows).T
    reach = float(centre[-1] * stiffness / load / vehicle.friction)
    guess = [0.02, stiffness / vehicle.friction]
    shape, bend = vehicle.tyre.shape, vehicle.tyre.curvature
    rational = magic = None
    if reach >= RATIONAL_REACH and len(rows) > 4:
        friction = vehicle.friction

        def by_rational(x: np.ndarray) -> np.ndarray:
            return np.array([rational_tyre(s, x[0], x[1], friction, 1.0)[0] / load for s in centre])

        wide = [(0.05 * one, 20.0 * one) for one in guess]
        rational = _fit(by_rational, guess, wide, median, error, ("c1", "c2"))
    if reach >= MAGIC_REACH and len(rows) > 6:

        def by_magic(x: np.ndarray) -> np.ndarray:
            return np.array([magic_formula(s, x[0], x[1], x[2], bend)[0] for s in centre])

        first = [stiffness / load / shape / vehicle.friction, shape, vehicle.friction]
        sane = [(0.2 * first[0], 5.0 * first[0]), (1.01, 1.99), (0.1, 3.0)]
        magic = _fit(by_magic, first, sane, median, error, ("B", "C", "D"))
    return AxleCurve(centre, median, error, load, reach, rational, magic)


def _fit(
    law: Callable[[np.ndarray], np.ndarray],
    guess: list[float],
    bounds: list[tuple[float, float]],
    force: np.ndarray,
    error: np.ndarray,
    names: tuple[str, ...],
) -> dict[str, tuple[float, float]] | None:
    """Least squares in the logarithms of positive parameters; each with its relative standard deviation.

    None where a parameter ends at its bound: then the curve does not tell it.
    """
    low, high = np.log(bounds).T

    def misses(x: np.ndarray) -> np.ndarray:
        return (law(np.exp(x)) - force) / error

    start = np.clip(np.log(guess), low + 0.01, high - 0.01)
    found = least_squares(misses, start, loss="soft_l1", bounds=(low, high))
    if np.any(found.active_mask):
        return None
    jacobian = np.asarray(found.jac)
    scale = max(2.0 * found.cost / max(len(force) - len(guess), 1), 1.0)
    spread = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * scale)
    return {name: (float(np.exp(x)), float(s)) for name, x, s in zip(names, found.x, spread, strict=True)}

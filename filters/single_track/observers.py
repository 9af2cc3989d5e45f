"""Deterministic observers of the single track: Luenberger, extended Luenberger, sliding mode.

State [yaw_rate, beta], corrected by the measured yaw rate and ay (Chindamo 2018, section 2, table 1):

    x_dot = f(x, u) + L e
    e = [yaw_rate - yaw_rate_hat, ay - ay_hat]
    L = [[a11 + p1, 0], [a21 - l c21, l]]

with A = df/dx and C = dh/dx. A - L C is then triangular, with the poles -p1 and a22 - l c22. The first is
set to `yaw_pole` times the car's own yaw damping (a^2 Cf + b^2 Cr) / (Iz vx). With l = (1 - slip_pole) / vx
the second is `slip_pole` times the car's own slip damping (Cf + Cr) / (m vx): at 1 beta is that of the
model alone, at 0 the kinematic integral of ay. Both follow the speed.

- `Luenberger`: the linear single track, small angles.
- `ExtendedLuenberger`: the nonlinear one with its tyre law, A and C anew at each step (Ding et al. 2014).
- `SlidingMode`: the nonlinear model with K sat(e / layer): inside the boundary layer the same gains,
  outside a constant pull, so that a wild measurement or a wrong model moves the state no faster (first
  order).

A deterministic observer knows no covariance: beta_std is a stated measure and no posterior. It adds up, as
squares, `floor`, the `share` of beta, and what the running mean square of the ay innovation (over `memory`)
amounts to as slip angle, m rms(e_ay) / (Cf + Cr). There is no NIS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import KernelFilter, bounded_slip, starting
from crosscomb.filters.single_track.shared import rates_at, start_motion, wrong_front_force
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.linear_single_track import linear_single_track_rates, yaw_damping
from crosscomb.models.single_track import stable_substeps

MAX_YAW_RATE = 3.0
"""The state is held inside [rad/s]."""

NO_LAYERS = (math.inf, math.inf)
"""Boundary layers of an observer that has none."""


class ObserverGains(NamedTuple):
    """Settings of the Luenberger observers."""

    yaw_pole: float = 3.0  # over the car's own yaw damping
    slip_pole: float = 0.5  # over the car's own slip damping, 0 to 1
    floor: float = 0.008  # least beta_std [rad]
    share: float = 0.2  # of |beta| in beta_std
    memory: float = 2.0  # time constant of the innovation's mean square [s]
    missing_steer: float = 0.06  # error of a held steering angle [rad]


class SlidingGains(NamedTuple):
    """Settings of the sliding-mode observer."""

    yaw_pole: float = 3.0  # inside the boundary layer, over the car's own yaw damping
    slip_pole: float = 0.5  # inside the boundary layer, over the car's own slip damping, 0 to 1
    floor: float = 0.008  # least beta_std [rad]
    share: float = 0.2  # of |beta| in beta_std
    memory: float = 2.0  # time constant of the innovation's mean square [s]
    missing_steer: float = 0.06  # error of a held steering angle [rad]
    yaw_layer: float = 0.1  # boundary layer of the yaw rate [rad/s]
    ay_layer: float = 2.0  # boundary layer of ay [m/s^2]


class Observer(NamedTuple):
    """State of an observer, changed in place by its kernel."""

    mean: np.ndarray  # (2,) yaw_rate [rad/s], beta [rad]
    error2: np.ndarray  # (1,) running mean square of the ay innovation [m^2/s^4]
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below


@inlined
def gains(a11, a21, c21, beta, vx, car, settings):
    """Gains l11, l21, l22 [1/s, 1/s, rad s/m] that place the poles; l12 is 0."""
    cosine = math.cos(beta)
    l22 = (1.0 - min(settings.slip_pole, 1.0)) * cosine * cosine / vx
    return a11 + settings.yaw_pole * yaw_damping(car) / (car.yaw_inertia * vx), a21 - l22 * c21, l22


@inlined
def saturate(value, layer):
    """Boundary layer of the sliding mode: linear inside, constant outside."""
    return min(max(value, -layer), layer)


@inlined
def move(mean, yaw_rate, beta):
    """Change the state by so much and hold it inside meaningful ranges."""
    mean[0] = min(max(mean[0] + yaw_rate, -MAX_YAW_RATE), MAX_YAW_RATE)
    mean[1] = bounded_slip(mean[1] + beta)


@inlined
def observer_start(state, sample, car, out):
    """Answer where the car is slow and start on the first sample above the gate; True where it did either."""
    if not starting(state.running, sample, car, out):
        return False
    start_motion(state.mean, sample, out)
    state.error2[0] = ((car.stiffness_front + car.stiffness_rear) / car.mass * 0.5 * out[at.BETA_STD]) ** 2
    return True


@inlined
def observer_answer(state, sample, ay, car, settings, dt, out):
    """Write beta and the stated measure of its error (see the head of this file)."""
    stiffness = car.stiffness_front + car.stiffness_rear
    error2 = (wrong_front_force(sample, car, settings) / car.mass) ** 2
    if math.isfinite(sample[at.AY]):
        error2 += (sample[at.AY] - ay) ** 2
    else:
        error2 += max(state.error2[0], (stiffness / car.mass * 0.02) ** 2)  # nothing known: as at the start
    state.error2[0] += (1.0 - math.exp(-dt / settings.memory)) * (min(error2, 400.0) - state.error2[0])
    out[at.BETA] = state.mean[1]
    spread = math.sqrt(state.error2[0]) * car.mass / stiffness
    out[at.BETA_STD] = math.hypot(math.hypot(settings.floor, settings.share * out[at.BETA]), spread)
    out[at.NIS] = math.nan


@inlined
def correct(state, sample, ay, a11, a21, c21, c22, car, settings, layers, dt):
    """Correct the predicted state with the innovations, held inside their layers, over the whole sample.

    What the gains do to an error over dt is taken exactly, so the poles hold at every rate.
    """
    mean = state.mean
    if not math.isfinite(sample[at.YAW_RATE]):  # ay alone cannot hold the observer: it runs on its model
        return
    l11, l21, l22 = gains(a11, a21, c21, mean[1], sample[at.VX], car, settings)
    error_yaw = saturate(sample[at.YAW_RATE] - mean[0], layers[0])
    if math.isfinite(sample[at.AY]):
        growth = min(l22 * max(-c22, 1e-6) * dt, 20.0)
        gain = l22 * dt * math.expm1(growth) / growth if growth > 0.0 else 0.0
        correction = l21 * dt * error_yaw + gain * saturate(sample[at.AY] - ay, layers[1])
    else:  # without l22 it is a21 that keeps the yaw error out of beta
        correction = a21 * dt * error_yaw
    move(mean, -math.expm1(-l11 * dt) * error_yaw, correction)


@inlined
def luenberger_step(state, sample, car, settings, dt, out):
    """One sample of the linear observer; `out` ``(3,)`` gets beta, its stated error and NaN."""
    if observer_start(state, sample, car, out):
        return
    mean, vx, steer, steer_rear = state.mean, sample[at.VX], sample[at.STEER], sample[at.STEER_REAR]
    steps = stable_substeps(vx, dt, car)
    h = dt / steps
    for _ in range(steps):
        rates, _, _ = linear_single_track_rates(mean[0], mean[1], vx, steer, steer_rear, car)
        move(mean, h * rates[0], h * rates[1])
    _, ay, (a11, a21, c21, _, _, c22) = linear_single_track_rates(
        mean[0], mean[1], vx, steer, steer_rear, car
    )
    correct(state, sample, ay, a11, a21, c21, c22, car, settings, NO_LAYERS, dt)
    observer_answer(state, sample, ay, car, settings, dt, out)


@inlined
def nonlinear_step(state, sample, car, settings, layers, dt, out):
    """One sample on the nonlinear single track; boundary layers (2,) of the innovations; `out` as the linear one."""
    if observer_start(state, sample, car, out):
        return
    mean = state.mean
    steps = stable_substeps(sample[at.VX], dt, car)
    h = dt / steps
    for _ in range(steps):
        rates, _, _ = rates_at(mean[0], mean[1], sample, car)
        move(mean, h * rates[0], h * rates[1])
    _, (_, ay), (a11, a21, _, c21, _, _, _, c22) = rates_at(mean[0], mean[1], sample, car)
    correct(state, sample, ay, a11, a21, c21, c22, car, settings, layers, dt)
    observer_answer(state, sample, ay, car, settings, dt, out)


@kernel
def luenberger_run(state, samples, car, settings, dt, out):
    """All samples of the linear observer."""
    for k in range(samples.shape[0]):
        luenberger_step(state, samples[k], car, settings, dt, out[k])


@kernel
def extended_run(state, samples, car, settings, dt, out):
    """All samples of the extended observer."""
    for k in range(samples.shape[0]):
        nonlinear_step(state, samples[k], car, settings, NO_LAYERS, dt, out[k])


@kernel
def sliding_run(state, samples, car, settings, dt, out):
    """All samples of the sliding-mode observer."""
    layers = settings.yaw_layer, settings.ay_layer
    for k in range(samples.shape[0]):
        nonlinear_step(state, samples[k], car, settings, layers, dt, out[k])


@dataclass(frozen=True)
class _SlipObserver(KernelFilter):
    noise: ObserverGains | SlidingGains

    divisors = (*KernelFilter.divisors, "memory")

    def make_state(self) -> Any:
        """Make an unstarted observer."""
        return Observer(np.zeros(2), np.zeros(1), np.zeros(1, dtype=np.int64))


@dataclass(frozen=True)
class Luenberger(_SlipObserver):
    """Luenberger observer on the linear single track; `tyre` is not used."""

    noise: ObserverGains = ObserverGains()

    run_kernel = staticmethod(luenberger_run)


@dataclass(frozen=True)
class ExtendedLuenberger(_SlipObserver):
    """Luenberger observer on the nonlinear single track."""

    noise: ObserverGains = ObserverGains()

    run_kernel = staticmethod(extended_run)


@dataclass(frozen=True)
class SlidingMode(_SlipObserver):
    """First-order sliding-mode observer on the nonlinear single track."""

    noise: SlidingGains = SlidingGains()

    divisors = (*_SlipObserver.divisors, "yaw_layer", "ay_layer")
    run_kernel = staticmethod(sliding_run)

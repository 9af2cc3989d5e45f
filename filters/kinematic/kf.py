"""Kinematic Kalman filter: integrates the accelerometers and learns their errors.

State [vx, vy, ax bias, ay bias]; inputs ax, ay and yaw rate; measurement vx (Atheupe 2023, eq. 18 to 21, with
biases after Ryu and Gerdes 2004). Needs no tyre, so slides do not hurt it. Bank and slope count as biases.

The speed tells about vy only while the car turns. Where the car is driven gently the rear axle is taken to move
along its wheels, vy = b r + vx tan(steer_rear), a pseudo-measurement: kinematic, as it knows no tyre, but for the
slip of the rear tyres as its noise, which grows with ay. It counts in the share

    exp(-((yaw_rate - rolling yaw rate) / disagreement)^2 - (ay / demand)^2)

where the rolling yaw rate is that of a car whose tyres do not slip, by its steering. A slide shows in one of the
two: on a grippy road in ay, on a slippery one in a yaw rate that is not what was steered. So vy and the biases are
held together in normal driving, and in a slide nothing is forgotten.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import (
    MAX_BETA,
    KernelFilter,
    normal_log_density,
    starting,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import input_gain, rolling_curvature, rolling_rear, rotation
from crosscomb.signals import MIN_SPEED

BIAS_AX, BIAS_AY = 2, 3
"""States behind vx and vy: accelerometer biases, bank and slope included [m/s^2]."""


class KinematicNoise(NamedTuple):
    """Noise settings of the kinematic filter; densities, so that they hold at every rate."""

    accel: float = 0.15  # accelerometer error beside the bias [m/s^2 per sqrt(Hz)]
    ay_scale: float = 0.03  # the same over ay, of scale and body roll [1 per sqrt(Hz)]
    speed: float = 0.1  # measured vx [m/s]
    accel_bias: float = 0.3  # size of the accelerometer biases, bank and slope included [m/s^2]
    bias_time: float = 100.0  # time in which they change [s]
    rolling: float = 0.03  # error of a rolling rear axle's vy [m/s per sqrt(Hz)]
    rear_slip: float = 0.01  # slip of the rear tyres over ay, counted once per second [rad per m/s^2]
    disagreement: float = 0.15  # yaw rate beside the steered one from which on the car may slide [rad/s]
    demand: float = 3.0  # ay from which on it may slide [m/s^2]
    missing_accel: float = 3.0  # accelerometer error while a channel is missing [m/s^2 per sqrt(Hz)]


BLIND = 10.0
"""Error of vy = 0 while the yaw rate is missing [m/s per sqrt(Hz)]: it may be a slide or a straight."""

LEAST_SHARE = 1e-3
"""A smaller share of rolling than this is none."""

MOST_BIAS = 6.0
"""Biases are held inside this times their size."""

MOST_ACCEL, MOST_YAW_RATE = 50.0, 10.0
"""No car does more [m/s^2, rad/s]: such a sample counts as missing."""


BRIDGE = 0.1
"""So long [s] accelerations and yaw rate are held where one of them is missing: no car changes its motion in it."""

MEAN_TIME = 0.04
"""Time constant of the mean that is then held [s]: a single sample may be vibration."""

BRIDGE_ACCEL = 0.5
"""Error of held accelerations [m/s^2 per sqrt(Hz)]."""


class Kinematic(NamedTuple):
    """State of the filter, as `Gaussian` with the inputs; changed in place by its kernel."""

    mean: np.ndarray  # (4,)
    cov: np.ndarray  # (4, 4)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    evidence: np.ndarray  # (1,) sum of the innovations' log densities; (0,) where nobody asks for it
    held: (
        np.ndarray
    )  # (4,) means of ax, ay [m/s^2] and yaw rate [rad/s]; for how long one of them is missing [s]


def kinematic_state(noise: Any) -> Kinematic:
    """Make an unstarted filter of four states, which knows no more of its biases than their size."""
    cov = np.diag([1.0, 1.0, noise.accel_bias**2, noise.accel_bias**2])
    held = np.array([math.nan, math.nan, math.nan, 0.0])
    return Kinematic(np.zeros(4), cov, np.zeros(1, dtype=np.int64), np.empty(0), held)


@inlined
def inertial_known(ax, ay, yaw_rate):
    """Tell whether accelerations and yaw rate are there and possible."""
    return abs(ax) < MOST_ACCEL and abs(ay) < MOST_ACCEL and abs(yaw_rate) < MOST_YAW_RATE


@inlined
def held_input(held, i, value, most, dt):
    """A measured input, or where it is missing the mean of those before."""
    if not abs(value) < most:
        return held[i]
    held[i] = value if math.isnan(held[i]) else held[i] + min(dt / MEAN_TIME, 1.0) * (value - held[i])
    return value


@inlined
def take_inputs(state, sample, dt):
    """Take ax, ay and yaw rate of a sample, over short holes means of those before; tell whether one is such a mean."""
    ax, ay, yaw_rate, held = sample[at.AX], sample[at.AY], sample[at.YAW_RATE], state.held
    missing = not inertial_known(ax, ay, yaw_rate)
    held[3] = held[3] + dt if missing else 0.0
    felt_x, felt_y = held_input(held, 0, ax, MOST_ACCEL, dt), held_input(held, 1, ay, MOST_ACCEL, dt)
    turning = held_input(held, 2, yaw_rate, MOST_YAW_RATE, dt)
    if held[3] > BRIDGE + 1e-9:
        return ax, ay, yaw_rate, False
    return felt_x, felt_y, turning, missing


@inlined
def kinematic_predict(state, ax, ay, yaw_rate, felt, other, noise, dt):
    """Predict the state over dt with held accelerations; missing ones keep the velocity and widen it.

    Parameters
    ----------
    felt : float
        Share in which the accelerometer's ay counts.
    other : float [m/s^2]
        Lateral acceleration to be added to it.
    """
    mean, cov = state.mean, state.cov
    density, scaled, felt_x = noise.accel, noise.ay_scale * felt * ay, 1.0
    if not inertial_known(ax, ay, yaw_rate):
        ax, ay, yaw_rate, other, felt_x, felt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        density, scaled = noise.missing_accel, 0.0
    f00, f01, f10, f11 = rotation(yaw_rate, dt)
    g00, g01, g10, g11 = input_gain(yaw_rate, dt)
    vx, vy = mean[0], mean[1]
    along, across = felt_x * (ax - mean[BIAS_AX]), felt * (ay - mean[BIAS_AY]) + other
    mean[0] = f00 * vx + f01 * vy + g00 * along + g01 * across
    mean[1] = f10 * vx + f11 * vy + g10 * along + g11 * across
    propagate_biased(
        cov, f00, f01, f10, f11, -g00 * felt_x, -g01 * felt, -g10 * felt_x, -g11 * felt,
        density * density * dt, (density * density + scaled * scaled) * dt,
    )  # fmt: skip
    drift_biases(state, noise, dt)


@inlined
def predict_felt(state, sample, noise, dt):
    """Predict the state over dt with what accelerometers and yaw rate sensor say, or said a moment ago."""
    ax, ay, yaw_rate, bridged = take_inputs(state, sample, dt)
    kinematic_predict(state, ax, ay, yaw_rate, 1.0, 0.0, noise, dt)
    if bridged:
        for i in range(2):
            state.cov[i, i] += BRIDGE_ACCEL**2 * dt


@inlined
def propagate_biased(cov, f00, f01, f10, f11, g00, g01, g10, g11, q00, q11):
    """Propagate the covariance ``(4, 4)`` of velocity and constant biases in place.

    F P F' + Q with F = [[F_v, G], [0, I]] and Q = diag(q00, q11, 0, 0), in scalars.
    """
    p00, p01, p11 = cov[0, 0], cov[0, 1], cov[1, 1]
    c02, c03, c12, c13 = cov[0, 2], cov[0, 3], cov[1, 2], cov[1, 3]
    b22, b23, b33 = cov[2, 2], cov[2, 3], cov[3, 3]
    # [M N] = [F_v G] P, two rows of four
    m00, m01 = f00 * p00 + f01 * p01 + g00 * c02 + g01 * c03, f00 * p01 + f01 * p11 + g00 * c12 + g01 * c13
    m10, m11 = f10 * p00 + f11 * p01 + g10 * c02 + g11 * c03, f10 * p01 + f11 * p11 + g10 * c12 + g11 * c13
    n02, n03 = f00 * c02 + f01 * c12 + g00 * b22 + g01 * b23, f00 * c03 + f01 * c13 + g00 * b23 + g01 * b33
    n12, n13 = f10 * c02 + f11 * c12 + g10 * b22 + g11 * b23, f10 * c03 + f11 * c13 + g10 * b23 + g11 * b33
    cov[0, 0] = m00 * f00 + m01 * f01 + n02 * g00 + n03 * g01 + q00
    cov[0, 1] = cov[1, 0] = m00 * f10 + m01 * f11 + n02 * g10 + n03 * g11
    cov[1, 1] = m10 * f10 + m11 * f11 + n12 * g10 + n13 * g11 + q11
    cov[0, 2] = cov[2, 0] = n02
    cov[0, 3] = cov[3, 0] = n03
    cov[1, 2] = cov[2, 1] = n12
    cov[1, 3] = cov[3, 1] = n13


@inlined
def drift_biases(state, noise, dt):
    """Let the biases change over dt as a first-order Gauss-Markov process of their size and time."""
    mean, cov = state.mean, state.cov
    keep = math.exp(-dt / noise.bias_time)
    added = noise.accel_bias**2 * (1.0 - keep * keep)
    for i in range(2, 4):
        mean[i] *= keep
        for j in range(2):
            cov[i, j] *= keep
            cov[j, i] = cov[i, j]
    cov[2, 2] = keep * keep * cov[2, 2] + added
    cov[3, 3] = keep * keep * cov[3, 3] + added
    cov[2, 3] = cov[3, 2] = keep * keep * cov[2, 3]


@inlined
def kinematic_start(state, sample, car, noise, dt, out):
    """Answer where the car is slow and start on the first sample above the gate; True where it did either.

    A stop makes the filter forget its motion, not what it knows of its sensors.
    """
    mean, cov = state.mean, state.cov
    if not starting(state.running, sample, car, out):
        return False
    drift_biases(state, noise, dt)
    if state.running[0] == 0:
        return True
    vx = sample[at.VX]
    mean[0], mean[1] = vx, vx * math.tan(out[at.BETA])
    for i in range(2):
        for j in range(4):
            cov[i, j] = cov[j, i] = 0.0
    cov[0, 0], cov[1, 1] = noise.speed**2, (vx * out[at.BETA_STD]) ** 2
    return True


@inlined
def velocity_update(state, h0, h1, innovation, variance):
    """Update the four states with one measurement h0 vx + h1 vy, in Joseph form.

    Parameters
    ----------
    innovation : float
        Measured minus predicted.
    variance : float
        Of the measurement noise.

    Returns
    -------
    nis : float
        innovation^2 over its variance.
    innovation_variance : float
    """
    mean, cov = state.mean, state.cov
    p00, p01, p11 = cov[0, 0], cov[0, 1], cov[1, 1]
    c02, c03, c12, c13 = cov[0, 2], cov[0, 3], cov[1, 2], cov[1, 3]
    b22, b23, b33 = cov[2, 2], cov[2, 3], cov[3, 3]
    g0, g1, g2, g3 = p00 * h0 + p01 * h1, p01 * h0 + p11 * h1, c02 * h0 + c12 * h1, c03 * h0 + c13 * h1
    projected = h0 * g0 + h1 * g1
    s = projected + variance
    inverse = 1.0 / s
    k0, k1, k2, k3 = g0 * inverse, g1 * inverse, g2 * inverse, g3 * inverse
    mean[0] += k0 * innovation
    mean[1] += k1 * innovation
    mean[2] += k2 * innovation
    mean[3] += k3 * innovation
    # K R - (I - K H) P H', the factor of K' in the Joseph form
    e0, e1 = k0 * variance - g0 + k0 * projected, k1 * variance - g1 + k1 * projected
    e2, e3 = k2 * variance - g2 + k2 * projected, k3 * variance - g3 + k3 * projected
    cov[0, 0] = p00 - k0 * g0 + e0 * k0
    cov[1, 1] = p11 - k1 * g1 + e1 * k1
    cov[2, 2] = b22 - k2 * g2 + e2 * k2
    cov[3, 3] = b33 - k3 * g3 + e3 * k3
    cov[0, 1] = cov[1, 0] = p01 - k1 * g0 + e1 * k0
    cov[0, 2] = cov[2, 0] = c02 - k2 * g0 + e2 * k0
    cov[0, 3] = cov[3, 0] = c03 - k3 * g0 + e3 * k0
    cov[1, 2] = cov[2, 1] = c12 - k2 * g1 + e2 * k1
    cov[1, 3] = cov[3, 1] = c13 - k3 * g1 + e3 * k1
    cov[2, 3] = cov[3, 2] = b23 - k3 * g2 + e3 * k2
    return innovation * innovation * inverse, s


@inlined
def kinematic_update(state, sample, noise):
    """Update with the measured vx; give the NIS and the innovation [m/s], NaN where vx is only held."""
    mean = state.mean
    if sample[at.VX_HELD] == 0.0:
        innovation = sample[at.VX] - mean[0]
        nis, s = velocity_update(state, 1.0, 0.0, innovation, noise.speed**2)
        if state.evidence.size > 0:
            state.evidence[0] += normal_log_density(nis, s)
        return nis, innovation
    mean[0] = max(mean[0], MIN_SPEED)  # the gate cannot see the car stop
    return math.nan, math.nan


@inlined
def rolling_measurement(sample, vx, bias_ay, car, noise, dt):
    """What a gently driven car tells about its velocity: h vx + vy = rest, with a variance.

    Parameters
    ----------
    vx : float [m/s]
    bias_ay : float [m/s^2]

    Returns
    -------
    h : float
    rest : float [m/s]
    variance : float [m^2/s^2]
        Infinite where the car may slide.
    """
    ay, yaw_rate = sample[at.AY], sample[at.YAW_RATE]
    if not abs(yaw_rate) < MOST_YAW_RATE:
        return 0.0, 0.0, BLIND * BLIND / dt
    side = ay - bias_ay if abs(ay) < MOST_ACCEL else vx * yaw_rate
    # While the steering angle is missing only a straight is known to be one.
    known = sample[at.STEER_HELD] == 0.0
    steered = vx * rolling_curvature(sample[at.STEER], sample[at.STEER_REAR], car.a + car.b) if known else 0.0
    astray, used = (yaw_rate - steered) / noise.disagreement, side / noise.demand
    share = math.exp(-astray * astray - used * used)
    h, rest = rolling_rear(yaw_rate, sample[at.STEER_REAR], car.b)
    if share < LEAST_SHARE:
        return h, rest, math.inf
    slip = noise.rear_slip * side * vx
    return h, rest, (noise.rolling**2 + slip * slip) / (dt * share)


@inlined
def rolling_update(state, sample, car, noise, dt):
    """Update with a rear axle that moves along its wheels, as far as the car is driven gently.

    Gives the innovation [m/s], NaN where the car may slide; that of vy = 0 while the yaw rate is missing.
    """
    mean = state.mean
    h, rest, variance = rolling_measurement(sample, mean[0], mean[BIAS_AY], car, noise, dt)
    if not variance < math.inf:
        return math.nan
    innovation = rest - h * mean[0] - mean[1]
    velocity_update(state, h, 1.0, innovation, variance)
    return innovation


@inlined
def blind_update(state, yaw_rate, dt):
    """Hold vy near 0 while the yaw rate is missing."""
    if not abs(yaw_rate) < MOST_YAW_RATE:
        velocity_update(state, 0.0, 1.0, -state.mean[1], BLIND * BLIND / dt)


@inlined
def limit_slip(mean):
    """Hold the state [vx, vy, ...] where beta stays inside `MAX_BETA`."""
    mean[0] = max(mean[0], 0.5 * MIN_SPEED)
    most = math.tan(MAX_BETA) * mean[0]
    mean[1] = min(max(mean[1], -most), most)


@inlined
def limit_biases(mean, noise):
    """Hold the biases inside `MOST_BIAS` times their size."""
    most = MOST_BIAS * noise.accel_bias
    mean[BIAS_AX] = min(max(mean[BIAS_AX], -most), most)
    mean[BIAS_AY] = min(max(mean[BIAS_AY], -most), most)


@inlined
def velocity_answer(state, out):
    """Write beta of the state [vx, vy, ...] and its standard deviation."""
    mean, cov = state.mean, state.cov
    speed2 = mean[0] * mean[0] + mean[1] * mean[1]
    out[at.BETA] = math.atan2(mean[1], mean[0])
    # beta = atan2(vy, vx): its gradient is [-vy, vx] / V^2
    spread = mean[1] ** 2 * cov[0, 0] - 2.0 * mean[0] * mean[1] * cov[0, 1] + mean[0] ** 2 * cov[1, 1]
    out[at.BETA_STD] = math.sqrt(spread) / speed2


@inlined
def kinematic_step(state, sample, car, noise, dt, out):
    """One sample of the kinematic filter; `out` ``(3,)`` gets beta, its standard deviation and the NIS.

    Gives the innovations of vx and of the rolling rear axle's vy [m/s], NaN where nothing was updated.
    """
    if kinematic_start(state, sample, car, noise, dt, out):
        return math.nan, math.nan
    predict_felt(state, sample, noise, dt)
    out[at.NIS], innovation_vx = kinematic_update(state, sample, noise)
    limit_slip(state.mean)
    innovation_vy = rolling_update(state, sample, car, noise, dt)
    limit_slip(state.mean)
    limit_biases(state.mean, noise)
    velocity_answer(state, out)
    return innovation_vx, innovation_vy


@kernel
def kinematic_run(state, samples, car, noise, dt, out):
    """All samples; `out` ``(n, 5)`` gets the innovations too, as in `KinematicKF.extras`."""
    for k in range(samples.shape[0]):
        out[k, at.NIS + 1], out[k, at.NIS + 2] = kinematic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class KinematicKF(KernelFilter):
    """Kinematic Kalman filter of one vehicle."""

    noise: KinematicNoise = KinematicNoise()

    divisors = (*KernelFilter.divisors, "rolling", "demand", "disagreement", "bias_time")
    extras = ("innovation_vx [m/s]", "innovation_vy [m/s]")
    odd_innovations = extras[1:]
    told_by_likelihood = ("accel", "speed", "accel_bias")
    run_kernel = staticmethod(kinematic_run)

    def make_state(self) -> Kinematic:
        """Make an unstarted filter."""
        return kinematic_state(self.noise)

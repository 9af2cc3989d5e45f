"""Dynamic observer aided by GNSS: extended Kalman filter on the single track, with a disturbance.

State [yaw_rate, beta, disturbance of the slip rate] (Chindamo 2018, section 2.3 and table 1, "GPS +
observer"; the disturbance after Nguyen et al. 2013). Yaw rate and ay correct it at every sample, course
minus heading (= beta) at every fix that has both (two antennas). The disturbance stands for what tyres and
road do otherwise; what the fixes have taught of it carries on into an outage.

Fixes count at the sample they stand in: a receiver's delay belongs into the channel map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import joseph_update, propagate_cov
from crosscomb.filters.base import KernelFilter, bounded_slip, starting
from crosscomb.filters.kinematic.gnss_kf import wrap
from crosscomb.filters.single_track.shared import (
    ay_variance,
    motion_noise,
    rates_at,
    start_doubt,
    start_motion,
)
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.single_track import stable_substeps


class GnssDynamicNoise(NamedTuple):
    """Noise settings of the dynamic observer; process densities, so that they hold at every rate."""

    yaw_acceleration: float = 0.6  # model error [rad/s^2 per sqrt(Hz)]
    slip_rate: float = 0.04  # model error beside the disturbance [rad/s per sqrt(Hz)]
    yaw_rate: float = 0.02  # measured yaw rate [rad/s]
    ay: float = 2.0  # measured ay, with what the tyre law gets wrong [m/s^2]
    missing_steer: float = 0.06  # error of a held steering angle, lasting about a second [rad]
    disturbance: float = 0.1  # size of the lasting model error of the slip rate [rad/s]
    disturbance_time: float = 2.0  # time for which it lasts [s]
    gnss_velocity: float = 0.1  # GNSS velocity across the course [m/s]
    heading: float = 0.01  # two-antenna heading [rad]


class GnssDynamic(NamedTuple):
    """State of the dynamic observer, changed in place by its kernel."""

    mean: np.ndarray  # (3,) yaw_rate [rad/s], beta [rad], disturbance of the slip rate [rad/s]
    cov: np.ndarray  # (3, 3)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    transition: np.ndarray  # (3, 3) scratch
    added: np.ndarray  # (3, 3) scratch: process noise
    row: np.ndarray  # (3,) scratch: row of the measurement matrix
    work: np.ndarray  # (3, 3) scratch


@inlined
def disturbed_predict(state, sample, car, noise, dt):
    """Predict [yaw_rate, beta, disturbance] by Euler steps, as many as keep the stiff modes stable."""
    mean, f, q = state.mean, state.transition, state.added
    of_yaw, of_both, of_slip = motion_noise(sample, car, noise)
    steps = stable_substeps(sample[at.VX], dt, car)
    h = dt / steps
    keep = math.exp(-h / noise.disturbance_time)
    for _ in range(steps):
        rates, _, (yaw_r, slip_r, _, _, yaw_b, slip_b, _, _) = rates_at(mean[0], mean[1], sample, car)
        mean[0] += h * rates[0]
        mean[1] = bounded_slip(mean[1] + h * (rates[1] + mean[2]))
        mean[2] *= keep
        f[0, 0], f[0, 1], f[0, 2] = 1.0 + h * yaw_r, h * yaw_b, 0.0
        f[1, 0], f[1, 1], f[1, 2] = h * slip_r, 1.0 + h * slip_b, h
        f[2, 0], f[2, 1], f[2, 2] = 0.0, 0.0, keep
        q[0, 0] = of_yaw * h
        q[0, 1] = q[1, 0] = of_both * h
        q[1, 1] = of_slip * h
        q[2, 2] = noise.disturbance**2 * (1.0 - keep * keep)
        propagate_cov(state.cov, f, q, state.work)


@inlined
def disturbed_update(state, sample, car, noise):
    """Update with the yaw rate, ay and fix that are there; give the NIS, NaN without any.

    One after the other with the Jacobian of the prediction, which equals the joint update.
    """
    mean, row = state.mean, state.row
    yaw_prior, beta_prior = mean[0], mean[1]
    _, (_, ay), jacobian = rates_at(mean[0], mean[1], sample, car)
    nis, count = 0.0, 0
    if math.isfinite(sample[at.YAW_RATE]):
        row[0], row[1] = 1.0, 0.0
        nis += joseph_update(
            mean, state.cov, row, sample[at.YAW_RATE] - yaw_prior, noise.yaw_rate**2, state.work
        )
        count += 1
    if math.isfinite(sample[at.AY]):
        row[0], row[1] = jacobian[3], jacobian[7]
        expected = ay + row[0] * (mean[0] - yaw_prior) + row[1] * (mean[1] - beta_prior)
        variance = ay_variance(sample, car, noise)
        nis += joseph_update(mean, state.cov, row, sample[at.AY] - expected, variance, state.work)
        count += 1
    if math.isfinite(sample[at.GNSS_COURSE]) and math.isfinite(sample[at.HEADING]):
        row[0], row[1] = 0.0, 1.0
        course = noise.gnss_velocity * math.cos(beta_prior) / sample[at.VX]
        innovation = wrap(sample[at.GNSS_COURSE] - sample[at.HEADING] - mean[1])
        nis += joseph_update(mean, state.cov, row, innovation, course**2 + noise.heading**2, state.work)
        count += 1
    return nis if count > 0 else math.nan


@inlined
def gnss_dynamic_step(state, sample, car, noise, dt, out):
    """One sample of the dynamic observer; `out` ``(3,)`` gets beta, its standard deviation and the NIS."""
    mean, cov = state.mean, state.cov
    if starting(state.running, sample, car, out):
        start_motion(mean, sample, out)
        mean[2] = 0.0
        start_doubt(cov, noise, out)
        cov[2, 2] = noise.disturbance**2
        return
    disturbed_predict(state, sample, car, noise, dt)
    out[at.NIS] = disturbed_update(state, sample, car, noise)
    mean[1] = bounded_slip(mean[1])
    most = 6.0 * noise.disturbance
    mean[2] = min(max(mean[2], -most), most)
    out[at.BETA], out[at.BETA_STD] = mean[1], math.sqrt(cov[1, 1])


@kernel
def gnss_dynamic_run(state, samples, car, noise, dt, out):
    """All samples of the dynamic observer."""
    for k in range(samples.shape[0]):
        gnss_dynamic_step(state, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class GnssDynamicObserver(KernelFilter):
    """Dynamic EKF that takes GNSS course minus heading as a measurement of beta."""

    noise: GnssDynamicNoise = GnssDynamicNoise()

    divisors = (*KernelFilter.divisors, "disturbance_time")
    run_kernel = staticmethod(gnss_dynamic_run)

    def make_state(self) -> Any:
        """Make an unstarted filter."""
        f, q, work = np.zeros((3, 3, 3))
        running = np.zeros(1, dtype=np.int64)
        return GnssDynamic(np.zeros(3), np.eye(3), running, f, q, np.zeros(3), work)

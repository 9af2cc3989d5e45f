"""What every estimator takes and gives: samples, estimates and the shared low-speed answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd

from crosscomb.models.compiled import bare, inlined
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.single_track import SingleTrack, single_track
from crosscomb.models.tyres import TYRE_LAWS
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GNSS, GRAVITY, MIN_SPEED, TORQUES, WHEEL_SPEEDS, Signals

VX, AX, AY, YAW_RATE, STEER, STEER_REAR, FXF, FXR, VX_HELD, STEER_HELD = range(10)
VFL, VFR, VRL, VRR, GNSS_SPEED, GNSS_COURSE, HEADING = range(10, 17)
"""Columns of a sample: what kernels read."""

SAMPLE_WIDTH = 17

BETA, BETA_STD, NIS = range(3)
"""Columns of an estimate: what kernels write."""

LOW_SPEED_STD = math.radians(2.0)
"""Standard deviation of the low-speed answer [rad]: tyre slip and steering offset at walking speed."""

LOG_2_PI = math.log(2.0 * math.pi)

MAX_BETA = math.radians(80.0)
"""Models with the speed vx / cos(beta) lose their meaning near 90 deg; states are held inside [rad]."""


@dataclass(frozen=True)
class Inputs:
    """Samples at a regular rate as filters take them.

    Attributes
    ----------
    dt : float
        Time from sample to sample [s].
    samples : (n, 17) float64
        Columns vx [m/s], ax, ay [m/s^2] without roll gravity, yaw_rate [rad/s], steer, steer_rear [rad],
        fxf, fxr [N], and 1 where vx and where steer is held over a missing sample, else 0; then the four wheel
        speeds [m/s], GNSS speed [m/s], course and heading [rad]. NaN means "no measurement" in ax, ay, yaw_rate
        and in all from the wheel speeds on; the others are always finite.
    """

    dt: float
    samples: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """Answer of one estimator.

    Attributes
    ----------
    beta, beta_std : (n,) [rad]
        Sideslip angle and its standard deviation, finite at every sample.
    nis : (n,)
        Normalised innovation squared of the sample's update; NaN where nothing was updated.
    extra : dict of str to (n,)
        Further answers by the name and unit of `KernelFilter.extras`, such as axle forces.
    """

    beta: np.ndarray
    beta_std: np.ndarray
    nis: np.ndarray
    extra: dict[str, np.ndarray] = field(default_factory=dict)


class Started(NamedTuple):
    """A filter under way: what `KernelFilter.step` changes from sample to sample."""

    dt: float
    state: Any  # the kernels' state
    out: np.ndarray  # (3 + extras,)


@dataclass(frozen=True)
class KernelFilter:
    """An algorithm applied to the model of one vehicle. Holds settings only; what changes lives in the state.

    A filter names its two kernels, ``step_kernel(state, sample, car, noise, dt, out)`` and ``run_kernel``, which
    calls it for each sample: batch and step results are the same bit for bit.
    """

    vehicle: Vehicle
    noise: Any
    tyre: str = "dugoff"

    step_kernel: ClassVar[Callable[..., None]]
    run_kernel: ClassVar[Callable[..., None]]
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": tuple(TYRE_LAWS)}
    """Words that a setting may take."""
    tables: ClassVar[Mapping[str, Callable[[str, Any], Any]]] = {}
    """Settings that are tables of their own, each with the function that checks it: (where, value) to setting."""
    extras: ClassVar[tuple[str, ...]] = ()
    """Columns that the kernels write behind `NIS`, each as ``name [unit]``."""
    told_by_likelihood: ClassVar[tuple[str, ...]] = ()
    """Noise settings that the likelihood of the measurements tells; none where the kernels do not keep it."""

    @cached_property
    def car(self) -> SingleTrack:
        """Parameters as the kernels take them."""
        return single_track(self.vehicle, self.tyre)

    def make_state(self) -> Any:
        """Make the kernels' state before the first sample."""
        return gaussian()

    def start(self, dt: float) -> Started:
        """Make the state before the first sample, for samples dt [s] apart."""
        return Started(dt, self.make_state(), np.full(3 + len(self.extras), np.nan))

    def step(self, started: Started, sample: np.ndarray) -> tuple[float, float, float]:
        """Take one sample and change `started`.

        Parameters
        ----------
        started : Started
        sample : (17,)
            Columns as in `Inputs`.

        Returns
        -------
        beta, beta_std : float [rad]
        nis : float
        """
        self.step_kernel(started.state, sample, self.car, self.noise, started.dt, started.out)
        beta, beta_std, nis = started.out[:3]
        return float(beta), float(beta_std), float(nis)

    def run(self, inputs: Inputs) -> Estimate:
        """Estimate a whole log; bit-identical to `step` sample by sample."""
        out = np.full((len(inputs.samples), 3 + len(self.extras)), np.nan)
        self.run_kernel(self.make_state(), inputs.samples, self.car, self.noise, inputs.dt, out)
        beta, beta_std, nis, *extra = out.T.copy()
        return Estimate(beta, beta_std, nis, dict(zip(self.extras, extra, strict=True)))

    def log_likelihood(self, inputs: Inputs) -> float:
        """Log density of a log's measurements, each given those before it (the sum over the innovations).

        Only for filters with `told_by_likelihood`.
        """
        state = self.make_state()._replace(evidence=np.zeros(1))
        out = np.empty((len(inputs.samples), 3 + len(self.extras)))
        self.run_kernel(state, inputs.samples, self.car, self.noise, inputs.dt, out)
        return float(state.evidence[0])


class Gaussian(NamedTuple):
    """Mean and covariance of a filter of n states, changed in place by its kernel."""

    mean: np.ndarray  # (n,)
    cov: np.ndarray  # (n, n)
    running: np.ndarray  # (1,) 1 above the low-speed gate, 0 below
    evidence: np.ndarray  # (1,) sum of the innovations' log densities; (0,) where nobody asks for it


def gaussian() -> Gaussian:
    """Make an unstarted two-state filter."""
    return Gaussian(np.zeros(2), np.eye(2), np.zeros(1, dtype=np.int64), np.empty(0))


@bare
def below_gate(sample):
    """Tell whether the car is too slow for tyre slip to matter (also when it reverses)."""
    return not sample[VX] > MIN_SPEED


@bare
def low_speed_answer(sample, car, out):
    """Write the sideslip angle of rolling without tyre slip."""
    out[BETA] = slip_of_rolling_rear(sample[STEER], sample[STEER_REAR], car.a, car.b)
    out[BETA_STD] = LOW_SPEED_STD
    out[NIS] = math.nan


@bare
def normal_log_density(nis, variance):
    """Log density of an innovation with its NIS and variance."""
    return -0.5 * (nis + math.log(variance) + LOG_2_PI)


@inlined
def scalar_update(state, h0, h1, innovation, variance):
    """Update a two-state filter with one scalar measurement, in Joseph form.

    Parameters
    ----------
    state : Gaussian
        Changed in place, its evidence too where it is asked for.
    h0, h1 : float
        Row of the measurement matrix.
    innovation : float
        Measured minus predicted.
    variance : float
        Of the measurement noise.

    Returns
    -------
    nis : float
        innovation^2 over its variance.
    """
    mean, cov = state.mean, state.cov
    p00, p01, p11 = cov[0, 0], cov[0, 1], cov[1, 1]
    ph0, ph1 = p00 * h0 + p01 * h1, p01 * h0 + p11 * h1
    s = h0 * ph0 + h1 * ph1 + variance
    k0, k1 = ph0 / s, ph1 / s
    mean[0] += k0 * innovation
    mean[1] += k1 * innovation
    # (I - K H) P (I - K H)' + K R K'
    a00, a01, a10, a11 = 1.0 - k0 * h0, -k0 * h1, -k1 * h0, 1.0 - k1 * h1
    b00, b01 = a00 * p00 + a01 * p01, a00 * p01 + a01 * p11
    b10, b11 = a10 * p00 + a11 * p01, a10 * p01 + a11 * p11
    cov[0, 0] = b00 * a00 + b01 * a01 + k0 * k0 * variance
    cov[0, 1] = cov[1, 0] = b00 * a10 + b01 * a11 + k0 * k1 * variance
    cov[1, 1] = b10 * a10 + b11 * a11 + k1 * k1 * variance
    nis = innovation * innovation / s
    if state.evidence.size > 0:
        state.evidence[0] += normal_log_density(nis, s)
    return nis


@inlined
def propagate(cov, f00, f01, f10, f11, q00, q01, q11):
    """Propagate a 2x2 covariance in place: F P F' + Q."""
    p00, p01, p11 = cov[0, 0], cov[0, 1], cov[1, 1]
    b00, b01 = f00 * p00 + f01 * p01, f00 * p01 + f01 * p11
    b10, b11 = f10 * p00 + f11 * p01, f10 * p01 + f11 * p11
    cov[0, 0] = b00 * f00 + b01 * f01 + q00
    cov[0, 1] = cov[1, 0] = b00 * f10 + b01 * f11 + q01
    cov[1, 1] = b10 * f10 + b11 * f11 + q11


def make_inputs(signals: Signals, vehicle: Vehicle, dt: float) -> Inputs:
    """Turn a log at the working rate into what filters take.

    vx, steer and steer_rear are held over missing samples (0 before the first). Roll gravity is taken out of ay:
    in a body that rolls outward by roll_gradient times ay the sensor reads ay (1 + g roll_gradient).

    Parameters
    ----------
    signals : Signals
        Complete (vx, ax, steer are there) and at a regular rate.
    vehicle : Vehicle
    dt : float [s]
    """
    samples = np.empty((len(signals), SAMPLE_WIDTH))
    samples[:, VX] = hold(signals.column("vx"))
    samples[:, AX] = signals.column("ax")
    samples[:, AY] = signals.column("ay") / (1.0 + GRAVITY * vehicle.roll_gradient)
    samples[:, YAW_RATE] = signals.column("yaw_rate")
    samples[:, STEER] = hold(signals.column("steer"))
    samples[:, STEER_REAR] = hold(signals.column("steer_rear"))
    samples[:, FXF], samples[:, FXR] = longitudinal_forces(signals, vehicle)
    for column, name in zip(range(VFL, HEADING + 1), (*WHEEL_SPEEDS, *GNSS), strict=True):
        samples[:, column] = signals.column(name)
    samples[:, VX_HELD] = ~np.isfinite(signals.column("vx"))
    samples[:, STEER_HELD] = ~np.isfinite(signals.column("steer"))
    return Inputs(dt=dt, samples=samples)


def hold(values: np.ndarray) -> np.ndarray:
    """Fill missing samples ``(n,)`` with the last one before them, and with 0 before the first."""
    return pd.Series(values).ffill().fillna(0.0).to_numpy()


def longitudinal_forces(signals: Signals, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Longitudinal force of the front and rear axle ``(n,) [N]``, from wheel torques or else from ax.

    Without torques each axle is taken to push or brake in the share of its static load.
    """
    share_front = vehicle.cg_to_rear_axle / vehicle.wheelbase
    total = vehicle.mass * np.nan_to_num(signals.column("ax"))
    torques = [signals.column(name) for name in TORQUES]
    front = (torques[0] + torques[1]) / vehicle.wheel_radius
    rear = (torques[2] + torques[3]) / vehicle.wheel_radius
    known = np.isfinite(front) & np.isfinite(rear)
    return np.where(known, front, share_front * total), np.where(known, rear, (1.0 - share_front) * total)

"""What every estimator takes and gives: samples, estimates and the shared low-speed answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.single_track import SingleTrack, single_track
from crosscomb.models.tyres import TYRE_LAWS
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import COLUMN, GNSS, GRAVITY, MIN_SPEED, TORQUES, WHEEL_SPEEDS, Signals

INNOVATION = "innovation_"
"""Beginning of the names of those further columns that are innovations."""

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
    state: Any  # the kernel's state


@dataclass(frozen=True)
class KernelFilter:
    """An algorithm applied to the model of one vehicle. Holds settings only; what changes lives in the state.

    A filter names its kernel, ``run_kernel(state, samples, car, noise, dt, out)``, which goes from sample to sample:
    batch and step results are the same bit for bit.
    """

    vehicle: Vehicle
    noise: Any
    tyre: str = "dugoff"

    run_kernel: ClassVar[Callable[..., None]]
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"tyre": tuple(TYRE_LAWS)}
    """Words that a setting may take."""
    tables: ClassVar[Mapping[str, Callable[[str, Any], Any]]] = {}
    """Settings that are tables of their own, each with the function that checks it: (where, value) to setting."""
    extras: ClassVar[tuple[str, ...]] = ()
    """Columns that the kernel writes behind `NIS`, each as ``name [unit]``.

    Names that begin with `INNOVATION` are innovations: measured minus predicted, NaN where not measured.
    """
    odd_innovations: ClassVar[tuple[str, ...]] = ()
    """Those innovations that change sign when the drive is mirrored."""
    implied: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Settings that others imply where they are left out: what those meant before there was a choice."""
    divisors: ClassVar[tuple[str, ...]] = (
        "yaw_rate", "ax", "ay", "accel", "speed", "wheel_speed", "gnss_velocity", "heading",
    )  # fmt: skip
    """Settings, also inside tables, by which kernels divide: 0 is no answer there. Here errors of what is measured."""
    told_by_likelihood: ClassVar[tuple[str, ...]] = ()
    """Noise settings that the likelihood of the measurements tells; none where the kernel does not keep it."""

    @classmethod
    def innovations(cls) -> tuple[str, ...]:
        """Those of its `extras` that are innovations."""
        return tuple(name for name in cls.extras if name.startswith(INNOVATION))

    @cached_property
    def car(self) -> SingleTrack:
        """Parameters as the kernels take them."""
        return single_track(self.vehicle, self.tyre)

    def make_state(self) -> Any:
        """Make the kernel's state before the first sample."""
        return gaussian()

    def start(self, dt: float) -> Started:
        """Make the state before the first sample, for samples dt [s] apart."""
        return Started(dt, self.make_state())

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
        estimate = self.advance(started, sample[None])
        return float(estimate.beta[0]), float(estimate.beta_std[0]), float(estimate.nis[0])

    def advance(self, started: Started, samples: np.ndarray) -> Estimate:
        """Take the next samples ``(n, 17)`` and change `started`; the same bit for bit however they are cut."""
        out = np.full((len(samples), 3 + len(self.extras)), np.nan)
        self.run_kernel(started.state, samples, self.car, self.noise, started.dt, out)
        beta, beta_std, nis, *extra = out.T  # no copy: to touch fresh memory takes a fifth of a kernel's time
        return Estimate(beta, beta_std, nis, dict(zip(self.extras, extra, strict=True)))

    def run(self, inputs: Inputs) -> Estimate:
        """Estimate a whole log."""
        return self.advance(self.start(inputs.dt), inputs.samples)

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


@inlined
def below_gate(sample):
    """Tell whether the car is too slow for tyre slip to matter (also when it reverses)."""
    return not sample[at.VX] > MIN_SPEED


@inlined
def low_speed_answer(sample, car, out):
    """Write the sideslip angle of rolling without tyre slip."""
    out[at.BETA] = slip_of_rolling_rear(sample[at.STEER], sample[at.STEER_REAR], car.a, car.b)
    out[at.BETA_STD] = LOW_SPEED_STD
    out[at.NIS] = math.nan


@inlined
def starting(running, sample, car, out):
    """Gate and start: answer where the car is slow and on the first sample above the gate; True where it did.

    There the caller sets its state to that answer, so that it starts from the newest one.
    """
    slow = below_gate(sample)
    if not slow and running[0] == 1:
        return False
    low_speed_answer(sample, car, out)
    running[0] = 0 if slow else 1
    return True


@inlined
def or_zero(value):
    """A measurement, 0 where it is missing."""
    return value if math.isfinite(value) else 0.0


@inlined
def bounded_slip(beta):
    """Hold beta inside `MAX_BETA`."""
    return min(max(beta, -MAX_BETA), MAX_BETA)


@inlined
def joined_nis(nis, part):
    """NIS of one more measurement added; NaN while there is none."""
    return part if math.isnan(nis) else nis + part


@inlined
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


class InputCar(NamedTuple):
    """What the inputs take of a vehicle."""

    roll_gain: float  # ay in the rolled body over ay
    mass: float  # [kg]
    share_front: float  # of the static load
    wheel_radius: float  # [m]


def input_car(vehicle: Vehicle) -> InputCar:
    """Take from a vehicle what the inputs need."""
    return InputCar(
        1.0 + GRAVITY * vehicle.roll_gradient,
        vehicle.mass,
        vehicle.cg_to_rear_axle / vehicle.wheelbase,
        vehicle.wheel_radius,
    )


HELD = ("vx", "steer", "steer_rear")
"""Channels that are held over missing samples, 0 before the first."""


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
    return next_inputs(np.zeros(len(HELD)), signals.rows(), vehicle, dt)


def next_inputs(held: np.ndarray, points: np.ndarray, vehicle: Vehicle, dt: float) -> Inputs:
    """Turn the next grid points of a stretch into what filters take, see `make_inputs`.

    Parameters
    ----------
    held : (3,)
        Last values of the channels `HELD`, zeros at the start; changed in place.
    points : (n, columns)
        As of `crosscomb.signals.Signals.rows`.
    vehicle : Vehicle
    dt : float [s]
    """
    samples = np.empty((len(points), at.SAMPLE_WIDTH))
    _inputs_run(held, points, input_car(vehicle), samples)
    return Inputs(dt=dt, samples=samples)


_HELD_FROM = tuple(COLUMN[name] for name in HELD)
_HELD_TO = (at.VX, at.STEER, at.STEER_REAR)
_PLAIN_FROM = tuple(COLUMN[name] for name in ("ax", "yaw_rate", *WHEEL_SPEEDS, *GNSS))
_PLAIN_TO = (at.AX, at.YAW_RATE, *range(at.VFL, at.HEADING + 1))
_AY_FROM = COLUMN["ay"]
_TORQUE_FL, _TORQUE_FR, _TORQUE_RL, _TORQUE_RR = (COLUMN[name] for name in TORQUES)


@kernel
def _inputs_run(held, points, car, samples):
    for k in range(points.shape[0]):
        point, sample = points[k], samples[k]
        for i in range(len(_HELD_FROM)):
            if math.isfinite(point[_HELD_FROM[i]]):
                held[i] = point[_HELD_FROM[i]]
            sample[_HELD_TO[i]] = held[i]
        for i in range(len(_PLAIN_FROM)):
            sample[_PLAIN_TO[i]] = point[_PLAIN_FROM[i]]
        sample[at.AY] = point[_AY_FROM] / car.roll_gain
        sample[at.FXF], sample[at.FXR] = _longitudinal_forces(point, sample[at.AX], car)
        sample[at.VX_HELD] = 0.0 if math.isfinite(point[_HELD_FROM[0]]) else 1.0
        sample[at.STEER_HELD] = 0.0 if math.isfinite(point[_HELD_FROM[1]]) else 1.0


@kernel
def _longitudinal_forces(point, ax, car):
    """Longitudinal force of the front and rear axle [N], from wheel torques or else from ax.

    Without torques each axle is taken to push or brake in the share of its static load.
    """
    front = (point[_TORQUE_FL] + point[_TORQUE_FR]) / car.wheel_radius
    rear = (point[_TORQUE_RL] + point[_TORQUE_RR]) / car.wheel_radius
    if math.isfinite(front) and math.isfinite(rear):
        return front, rear
    total = car.mass * ax if math.isfinite(ax) else 0.0
    return car.share_front * total, (1.0 - car.share_front) * total

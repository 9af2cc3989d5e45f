"""Sensors: from the simulated truth to what a car's bus, or a test instrument, would log.

The production profile has the figures of the CAN signals of a Volvo S90 beside a reference: noise and offsets
at standstill, latencies, wheel speeds 0.6 to 0.9 % low. The test-grade profile has the small offsets of an
inertial measurement system whose raw accelerometers feel the vibration of the body, as in the logs of the
Stanford cars: there vibration leaves up to 0.4 m/s^2 below 3 Hz. What no log shows (drift, scale errors,
lever arm, share of dropouts) is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from crosscomb.models.plant import HEAVE, ROLL, SPIN, SQUAT, VX, VY, YAW_RATE
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import WHEEL_SPEEDS
from crosscomb.training.simulation.schedule import ASKED_STEER, ASKED_STEER_REAR, AX, AY, CONTROL_PERIOD
from crosscomb.training.simulation.vehicle_speed import vehicle_speed

REFERENCE_SPEED = 1.0
"""Below this speed [m/s] the reference gives no sideslip angle."""

CHANNELS = ("ax", "ay", "yaw_rate", "steer_wheel", "steer_rear", "wheel")


class Profile(NamedTuple):
    """Spread of the faults of a kind of sensors; per channel in the order of `CHANNELS`, SI units."""

    noise: tuple[float, ...]
    bias: tuple[float, ...]  # standard deviation between logs, cut at 2.5 of them
    drift: tuple[float, ...]  # change of the bias over a log of 60 s, standard deviation
    scale: tuple[float, ...]  # relative error, standard deviation
    step: tuple[float, ...]  # quantisation; 0 is none
    latest: tuple[float, ...]  # latency, uniform from 0 [s]
    vibration: tuple[float, float]  # accelerometer noise over speed [m/s^2 per m/s], log-uniform
    wheel_scale: tuple[float, float]  # error of all wheel speeds, uniform
    wheel_spread: float  # radius error of each wheel beside it, uniform to either side
    lever_arm: float  # place of the accelerometers along and across, standard deviation [m]
    tilt: float  # misalignment in roll and pitch, standard deviation [rad]
    drop_out: float  # share of logs with dropouts
    speed_from_wheels: bool


PRODUCTION = Profile(
    noise=(0.027, 0.028, 0.0014, 0.0003, 0.0002, 0.02),
    bias=(0.10, 0.12, 0.0017, 0.03, 0.001, 0.0),
    drift=(0.02, 0.02, 0.0003, 0.0, 0.0, 0.0),
    scale=(0.01, 0.01, 0.005, 0.01, 0.01, 0.0),
    step=(0.01, 0.01, 0.0005, 0.0017, 0.0002, 1.0 / 64.0),
    latest=(0.03, 0.03, 0.04, 0.01, 0.01, 0.01),
    vibration=(0.002, 0.012),
    wheel_scale=(-0.010, 0.004),
    wheel_spread=0.002,
    lever_arm=0.10,
    tilt=0.005,
    drop_out=0.15,
    speed_from_wheels=True,
)
TEST_GRADE = Profile(
    noise=(0.01, 0.01, 0.0005, 0.0003, 0.0002, 0.02),
    bias=(0.05, 0.06, 0.0005, 0.015, 0.0005, 0.0),
    drift=(0.01, 0.01, 0.0001, 0.0, 0.0, 0.0),
    scale=(0.002, 0.002, 0.001, 0.005, 0.005, 0.0),
    step=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    latest=(0.01, 0.05, 0.01, 0.01, 0.01, 0.01),
    vibration=(0.004, 0.10),
    wheel_scale=(-0.006, 0.006),
    wheel_spread=0.002,
    lever_arm=0.03,
    tilt=0.003,
    drop_out=0.15,
    speed_from_wheels=False,
)
PROFILES = {"production": PRODUCTION, "test": TEST_GRADE}


class DropOut(NamedTuple):
    """No measurements of some columns in the rows from `begin` to before `end`."""

    columns: tuple[str, ...]
    begin: int
    end: int


@dataclass(frozen=True)
class SensorFaults:
    """What is wrong with the sensors of one log; dictionaries have the keys of `CHANNELS`, SI units."""

    noise: dict[str, float]
    bias: dict[str, float]
    drift: dict[str, float]
    scale: dict[str, float]
    step: dict[str, float]
    latency: dict[str, float]
    wheel_scale: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    vibration: float = 0.0
    lever_arm: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)
    drop_outs: tuple[DropOut, ...] = ()
    speed_from_wheels: bool = True


def _each(values: np.ndarray | tuple[float, ...]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(CHANNELS, values, strict=True)}


_NONE = _each((0.0,) * len(CHANNELS))
PERFECT = SensorFaults(_NONE, _NONE, _NONE, _NONE, _NONE, _NONE)
"""Sensors without fault, noise or quantisation."""


def draw_faults(rng: np.random.Generator, profile: Profile, n: int) -> SensorFaults:
    """Draw the faults of one log of n rows."""

    def normal() -> np.ndarray:
        return np.clip(rng.standard_normal(len(CHANNELS)), -2.5, 2.5)

    return SensorFaults(
        noise=_each(profile.noise),
        bias=_each(profile.bias * normal()),
        drift=_each(profile.drift * normal()),
        scale=_each(profile.scale * normal()),
        step=_each(profile.step),
        latency=_each(profile.latest * rng.uniform(0.0, 1.0, len(CHANNELS))),
        wheel_scale=tuple(
            (rng.uniform(*profile.wheel_scale) + profile.wheel_spread * rng.uniform(-1.0, 1.0, 4)).tolist()
        ),
        vibration=float(np.exp(rng.uniform(*np.log(profile.vibration)))),
        lever_arm=(profile.lever_arm * float(normal()[0]), profile.lever_arm * float(normal()[0])),
        tilt=(profile.tilt * float(normal()[0]), profile.tilt * float(normal()[0])),
        drop_outs=_draw_drop_outs(rng, profile, n),
        speed_from_wheels=profile.speed_from_wheels,
    )


def _draw_drop_outs(rng: np.random.Generator, profile: Profile, n: int) -> tuple[DropOut, ...]:
    """Messages of one sensor lost for 20 to 300 ms, one to four times a log."""
    if rng.random() >= profile.drop_out or n < 200:
        return ()
    messages = (("ax", "ay", "yaw_rate"), ("ay",), ("steer", "steer_wheel"), ("vx", *WHEEL_SPEEDS))
    found = []
    for _ in range(rng.integers(1, 5)):
        begin = int(rng.integers(100, n - 50))
        found.append(DropOut(messages[rng.integers(len(messages))], begin, begin + int(rng.integers(2, 31))))
    return tuple(found)


def measure(
    truth: np.ndarray, vehicle: Vehicle, faults: SensorFaults, rng: np.random.Generator
) -> pd.DataFrame:
    """Make the log's table from the truth.

    Parameters
    ----------
    truth : ndarray
        ``(n, RECORD)`` rows of `run_manoeuvre`, one per 10 ms, SI.
    vehicle : Vehicle
    faults : SensorFaults
    rng : numpy.random.Generator
        Draws the noise.

    Returns
    -------
    pandas.DataFrame
        ``(n, columns)`` named and in units as in `crosscomb.signals.UNITS`; with ``steer_rear`` where the
        rear axle steers.
    """
    t = np.arange(len(truth)) * CONTROL_PERIOD
    vx, vy = truth[:, VX], truth[:, VY]
    shake = faults.vibration * np.abs(vx)

    def read(name: str, true: np.ndarray, extra: np.ndarray | float = 0.0) -> np.ndarray:
        late = np.interp(t - faults.latency[name], t, true) * (1.0 + faults.scale[name])
        late = late + faults.bias[name] + faults.drift[name] * t / 60.0
        late = late + np.hypot(faults.noise[name], extra) * rng.standard_normal(len(t))
        step = faults.step[name]
        return np.round(late / step) * step if step > 0.0 else late

    felt_x, felt_y = _felt(truth, vehicle, faults)
    ax, ay = read("ax", felt_x, shake), read("ay", felt_y, shake)
    yaw_rate = read("yaw_rate", truth[:, YAW_RATE])
    # The sensor sits at the steering wheel: lag, play and compliance come after it.
    steer_wheel = read("steer_wheel", truth[:, ASKED_STEER] * vehicle.steering_ratio)
    steer = steer_wheel / vehicle.steering_ratio
    rim = truth[:, SPIN : SPIN + 4] * vehicle.wheel_radius * (1.0 + np.array(faults.wheel_scale))
    wheels = np.column_stack([read("wheel", rim[:, i]) for i in range(4)])
    if faults.speed_from_wheels:
        speed = vehicle_speed(wheels, ax - faults.bias["ax"], yaw_rate, steer, vehicle)
        speed = np.round(speed, 2)
    else:
        speed = vx + faults.noise["ax"] * rng.standard_normal(len(t))
    columns = {"t": np.round(t, 3), "vx": speed, "ax": ax, "ay": ay, "yaw_rate": yaw_rate}
    columns |= {"steer": steer, "steer_wheel": steer_wheel}
    if vehicle.plant.max_steer_rear > 0.0:
        columns["steer_rear"] = read("steer_rear", truth[:, ASKED_STEER_REAR])
    columns |= {name: wheels[:, i] for i, name in enumerate(WHEEL_SPEEDS)}
    for lost in faults.drop_outs:
        for name in lost.columns:
            columns[name] = columns[name].copy()
            columns[name][lost.begin : lost.end] = np.nan
    total = np.hypot(vx, vy)
    columns["beta_ref"] = np.where(total > REFERENCE_SPEED, np.arctan2(vy, vx), np.nan)
    return pd.DataFrame(columns | {"vx_ref": vx, "vy_ref": vy})


def _felt(truth: np.ndarray, vehicle: Vehicle, faults: SensorFaults) -> tuple[np.ndarray, np.ndarray]:
    """What accelerometers on the body feel along and across ``(n,)`` [m/s^2].

    They lean with the body and feel the road's push upwards: in a left turn roll adds to ay. Bank and slope
    are in the truth already. A lever arm adds what rotation gives.
    """
    roll = vehicle.roll_gradient * truth[:, ROLL] + faults.tilt[0]
    pitch = vehicle.plant.pitch_gradient * truth[:, SQUAT] + faults.tilt[1]
    up = truth[:, HEAVE]
    along, across = faults.lever_arm
    yaw_rate = truth[:, YAW_RATE]
    turning = np.gradient(yaw_rate, CONTROL_PERIOD)
    felt_x = truth[:, AX] - turning * across - yaw_rate**2 * along
    felt_y = truth[:, AY] + turning * along - yaw_rate**2 * across
    return felt_x * np.cos(pitch) + up * np.sin(pitch), felt_y * np.cos(roll) + up * np.sin(roll)

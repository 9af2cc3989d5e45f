"""Production sensors: from the simulated truth to what a car's bus would log.

Figures: the CAN signals of a Volvo S90 beside a reference (noise and offsets at standstill, latencies, wheel
speeds 0.6 to 0.9 % low).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numba import njit

from crosscomb.models.plant import ROLL, SPIN, SQUAT, VX, VY, YAW_RATE
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY
from crosscomb.training.driver import ASKED_STEER, AX, AY, CONTROL_PERIOD

REFERENCE_SPEED = 1.0
"""Below this speed [m/s] the reference gives no sideslip angle."""

NOISE = {"ax": 0.027, "ay": 0.028, "yaw_rate": 0.0014, "steer_wheel": 0.0003, "wheel": 0.02}
VIBRATION = 0.004
"""Accelerometer noise that grows with speed [m/s^2 per m/s]."""
BIAS = {"ax": 0.10, "ay": 0.12, "yaw_rate": 0.0017, "steer_wheel": 0.03}
STEP = {"ax": 0.01, "ay": 0.01, "yaw_rate": 0.0005, "steer_wheel": 0.0017, "wheel": 1.0 / 64.0, "vx": 0.01}
LATENCY = {"ax": (0.0, 0.03), "ay": (0.01, 0.03), "yaw_rate": (0.01, 0.04), "steer_wheel": (0.0, 0.01)}
WHEEL_LATENCY = (0.0, 0.01)
WHEEL_SCALE = (-0.009, 0.002)
WHEEL_SPREAD = 0.002


@dataclass(frozen=True)
class SensorFaults:
    """What is wrong with the sensors of one log: biases [SI], latencies [s], relative wheel-speed errors."""

    bias: dict[str, float]
    latency: dict[str, float]
    wheel_scale: tuple[float, float, float, float]
    noise: float = 1.0


def draw_faults(rng: np.random.Generator) -> SensorFaults:
    """Draw the faults of one log: biases normal with the scale `BIAS`, latencies uniform in their ranges."""
    bias = {name: float(scale * np.clip(rng.normal(), -2.5, 2.5)) for name, scale in BIAS.items()}
    latency = {name: float(rng.uniform(*span)) for name, span in LATENCY.items()}
    latency["wheel"] = float(rng.uniform(*WHEEL_LATENCY))
    common = rng.uniform(*WHEEL_SCALE)
    a, b, c, d = (float(common + WHEEL_SPREAD * rng.uniform(-1.0, 1.0)) for _ in range(4))
    return SensorFaults(bias, latency, (a, b, c, d))


PERFECT = SensorFaults(dict.fromkeys(BIAS, 0.0), dict.fromkeys([*LATENCY, "wheel"], 0.0), (0.0,) * 4, 0.0)
"""Sensors without fault or noise; quantisation is off with them."""


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
        ``(n, 15)`` columns named and in units as in `crosscomb.signals.UNITS`.
    """
    t = np.arange(len(truth)) * CONTROL_PERIOD
    vx, vy = truth[:, VX], truth[:, VY]
    roll = vehicle.roll_gradient * truth[:, ROLL]
    pitch = vehicle.plant.pitch_gradient * truth[:, SQUAT]
    # The accelerometers sit on the body and feel gravity: roll to the right in a left turn adds to ay.
    felt_ay = truth[:, AY] * np.cos(roll) + GRAVITY * np.sin(roll)
    felt_ax = truth[:, AX] * np.cos(pitch) + GRAVITY * np.sin(pitch)
    shake = VIBRATION * np.abs(vx)

    def read(name: str, true: np.ndarray, extra: np.ndarray | float = 0.0) -> np.ndarray:
        late = np.interp(t - faults.latency[name], t, true) + faults.bias.get(name, 0.0)
        late = late + faults.noise * np.hypot(NOISE[name], extra) * rng.standard_normal(len(t))
        return _quantise(late, STEP[name], faults)

    ax, ay = read("ax", felt_ax, shake), read("ay", felt_ay, shake)
    yaw_rate = read("yaw_rate", truth[:, YAW_RATE])
    steer_wheel = read("steer_wheel", truth[:, ASKED_STEER] * vehicle.steering_ratio)
    steer = steer_wheel / vehicle.steering_ratio
    rim = truth[:, SPIN : SPIN + 4] * vehicle.wheel_radius * (1.0 + np.array(faults.wheel_scale))
    wheels = np.column_stack([read("wheel", rim[:, i]) for i in range(4)])
    half_tracks = 0.5 * np.outer([vehicle.track_front, vehicle.track_rear], [-1.0, 1.0]).ravel()
    speed = np.empty(len(t))
    _vehicle_speed(wheels, ax - faults.bias["ax"], yaw_rate, steer, half_tracks, CONTROL_PERIOD, speed)
    total = np.hypot(vx, vy)
    beta = np.where(total > REFERENCE_SPEED, np.arctan2(vy, vx), np.nan)
    return pd.DataFrame(
        {
            "t": np.round(t, 3),
            "vx": _quantise(speed, STEP["vx"], faults),
            "ax": ax,
            "ay": ay,
            "yaw_rate": yaw_rate,
            "steer": steer,
            "steer_wheel": steer_wheel,
            "vfl": wheels[:, 0],
            "vfr": wheels[:, 1],
            "vrl": wheels[:, 2],
            "vrr": wheels[:, 3],
            "beta_ref": beta,
            "vx_ref": vx,
            "vy_ref": vy,
        }
    )


def _quantise(values: np.ndarray, step: float, faults: SensorFaults) -> np.ndarray:
    return np.round(values / step) * step if faults.noise > 0.0 else values


@njit(cache=True)
def _vehicle_speed(wheels, ax, yaw_rate, steer, half_tracks, dt, speed):
    """Write the vehicle speed [m/s] as brake electronics make it from wheel speeds and ax.

    Wheel speeds are taken to the car's middle. The two nearest to dead reckoning by ax are believed where
    their mean is within 0.2 m/s of it; else they pull at 4 m/s^2. Slip of all wheels leaks in.
    """
    held = 0.25 * (wheels[0, 0] + wheels[0, 1] + wheels[0, 2] + wheels[0, 3])
    middle = np.empty(4)
    for k in range(wheels.shape[0]):
        held = held + ax[k] * dt
        for i in range(4):
            value = wheels[k, i] * (np.cos(steer[k]) if i < 2 else 1.0) - half_tracks[i] * yaw_rate[k]
            middle[i] = value - held
        first, second = 0, 1
        for i in range(4):
            if abs(middle[i]) < abs(middle[first]):
                first = i
        second = (first + 1) % 4
        for i in range(4):
            if i != first and abs(middle[i]) < abs(middle[second]):
                second = i
        error = 0.5 * (middle[first] + middle[second])
        if abs(error) < 0.2:
            held = held + 0.3 * error
        else:
            held = held + min(max(error, -4.0 * dt), 4.0 * dt)
        if wheels[k, 0] + wheels[k, 1] + wheels[k, 2] + wheels[k, 3] < 0.2:
            held = 0.0
        speed[k] = held

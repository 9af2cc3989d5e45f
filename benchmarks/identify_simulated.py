"""Identification on simulated logs whose truth is known: errors, and how often the intervals hold the truth.

Run with ``python benchmarks/identify_simulated.py [SEEDS] [--another]``. The plant of 29 states drives slaloms, sweeps,
ramps and stops; sensors get known noise, offsets, latencies and a place off the centre of gravity; identification
starts from a vehicle file with wrong stiffness, ratio, inertia and roll gradient. With ``--another`` the car driven
differs from the file also in what identification believes or only guesses: tyre curve, relaxation length, load
sensitivity, roll stiffness split, body frequency, height and place of the centre of gravity, compliance, lag and
play of the steering, friction of the differential.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np

from crosscomb.models.plant import make_plant
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import Signals, make_signals
from crosscomb.training.identification.identify import identify
from crosscomb.training.simulation.manoeuvres import MANOEUVRES
from crosscomb.training.simulation.road import draw_road
from crosscomb.training.simulation.scene import Scene
from crosscomb.training.simulation.schedule import CONTROL_PERIOD
from crosscomb.training.simulation.sensors import PERFECT, PRODUCTION, SensorFaults, draw_faults, measure
from crosscomb.training.simulation.simulate import run_script
from crosscomb.training.simulation.spread import draw_driver

EXCITED = (
    ("frequency_sweep", 30.0), ("slalom", 30.0), ("ramp_steer", 30.0), ("constant_speed_circles", 30.0),
    ("stop_and_go", 30.0),
)  # fmt: skip
BARS = {
    "cornering_stiffness_front": 0.05,
    "cornering_stiffness_rear": 0.05,
    "steering_ratio": 0.01,
    "steer_offset": 0.002,
    "yaw_delay": 0.005,
    "ay_delay": 0.005,
    "yaw_bias": 0.001,
    "ay_bias": 0.03,
    "ax_bias": 0.03,
}
RELATIVE = (
    "cornering_stiffness_front",
    "cornering_stiffness_rear",
    "steering_ratio",
    "yaw_inertia",
    "friction",
)


@dataclass(frozen=True)
class Case:
    """Logs of one car, the vehicle file given to the program, and what it should find."""

    logs: list[Signals]
    given: Vehicle
    truth: dict[str, float]


def make_case(seed: int, reference: bool = False, another: bool = False) -> Case:
    """Simulate one car's logs with errors drawn for the seed.

    Parameters
    ----------
    seed : int
    reference : bool
        Leave the ground truth in.
    another : bool
        The car driven differs from the file in more than what is sought.
    """
    rng = np.random.Generator(np.random.SFC64([seed, 5]))
    file = load_vehicle("generic_compact")
    true = _another(file, np.random.Generator(np.random.SFC64([seed, 6]))) if another else file
    faults = _faults(rng, true)
    logs = []
    for number, (manoeuvre, duration) in enumerate(EXCITED):
        log = _drive(true, manoeuvre, duration, faults, [seed, number])
        if not reference:
            log = replace(log, frame=log.frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]))
        logs.append(log)
    changes = {
        "steering_ratio": true.steering_ratio * rng.uniform(0.8, 1.25),
        "cornering_stiffness_front": true.cornering_stiffness_front * rng.uniform(0.7, 1.4),
        "cornering_stiffness_rear": true.cornering_stiffness_rear * rng.uniform(0.7, 1.4),
        "yaw_inertia": true.yaw_inertia * rng.uniform(0.8, 1.25),
        "roll_gradient": true.roll_gradient * rng.uniform(0.5, 1.5),
    }
    # The driver's command is held for a control period: in the mean it acts half of one later than it is logged.
    lag = true.plant.steer_lag + 0.5 * CONTROL_PERIOD - faults.latency["steer_wheel"]
    truth = {name: float(getattr(true, name)) for name in changes} | {
        "steer_offset": faults.bias["steer_wheel"] / true.steering_ratio,
        "yaw_bias": faults.bias["yaw_rate"],
        "ay_bias": faults.bias["ay"],
        "ax_bias": faults.bias["ax"],
        "position": faults.lever_arm[0],
        # The steering angle is taken at the hand wheel: what lies between it and the road wheel is latency, too.
        "yaw_delay": lag + faults.latency["yaw_rate"],
        "ay_delay": lag + faults.latency["ay"],
    }
    return Case(logs, file.model_copy(update=changes), truth)


def _another(file: Vehicle, rng: np.random.Generator) -> Vehicle:
    """A car that differs from its file in what no user measures; uniform to either side."""

    def by(share: float) -> float:
        return float(np.exp(share * rng.uniform(-1.0, 1.0)))

    tyre = file.tyre.model_copy(
        update={
            "shape": file.tyre.shape + 0.1 * rng.uniform(-1.0, 1.0),
            "curvature": file.tyre.curvature + 0.5 * rng.uniform(-1.0, 1.0),
            "relaxation_length": file.tyre.relaxation_length * by(0.25),
            "load_sensitivity": file.tyre.load_sensitivity * by(0.7),
            "stiffness_peak_load": file.tyre.stiffness_peak_load * by(0.4),
        }
    )
    plant = file.plant.model_copy(
        update={
            "roll_share_front": file.plant.roll_share_front + 0.07 * rng.uniform(-1.0, 1.0),
            "body_frequency": file.plant.body_frequency * by(0.2),
            "compliance_front": file.plant.compliance_front * by(0.7),
            "steer_lag": file.plant.steer_lag * by(0.5),
            "steer_free_play": 0.001 * rng.uniform(),
            "differential_lock": file.plant.differential_lock * by(0.7),
        }
    )
    back = 0.02 * rng.uniform(-1.0, 1.0)
    return file.model_copy(
        update={
            "cg_height": file.cg_height * by(0.05),
            "cg_to_front_axle": file.cg_to_front_axle + back,
            "cg_to_rear_axle": file.cg_to_rear_axle - back,
            "tyre": tyre,
            "plant": plant,
        }
    )


def _faults(rng: np.random.Generator, true: Vehicle) -> SensorFaults:
    drawn = draw_faults(rng, PRODUCTION, 100)
    return replace(
        PERFECT, noise=drawn.noise, bias=drawn.bias, step=drawn.step, latency=drawn.latency, vibration=drawn.vibration,
        lever_arm=(float(rng.uniform(-1.5, 1.0)), 0.0), wheel_scale=(0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip


def _drive(true: Vehicle, manoeuvre: str, duration: float, faults: SensorFaults, seed: list[int]) -> Signals:
    rng = np.random.Generator(np.random.SFC64(seed))
    n = round(duration * 100)
    road = draw_road(true, "dry", 0.9, n, rng, level=True)
    script = MANOEUVRES[manoeuvre](Scene(make_plant(true), true.plant.top_speed, road, rng))
    return make_signals(
        measure(run_script(script, make_plant(true), draw_driver(rng)), true, faults, rng), manoeuvre
    )


def main() -> None:
    """Print for each parameter: mean and largest error, seeds within the bar, coverage and width of the intervals."""
    words = sys.argv[1:]
    another = "--another" in words
    seeds = int(next((word for word in words if word.isdigit()), 50))
    errors: dict[str, list[tuple[float, bool, float, bool]]] = {}
    for seed in range(seeds):
        case = make_case(seed, another=another)
        judgements = identify(case.logs, case.given).judgements
        for name, true in case.truth.items():
            one = judgements[name]
            value = one.after if one.taken else 0.5 * (one.low + one.high)
            size = true if name in RELATIVE else 1.0
            row = (
                (value - true) / size,
                one.low <= true <= one.high,
                0.5 * (one.high - one.low) / size,
                one.taken,
            )
            errors.setdefault(name, []).append(row)
    print(
        f"{'parameter':28s} {'taken':>6s} {'mean':>9s} {'largest':>9s} {'bar':>7s} {'in bar':>7s} {'covered':>8s} "
        f"{'half width':>10s}"
    )
    for name, rows in errors.items():
        error, held, half, taken = np.array(rows).T
        # A value that was not taken is a miss, however near.
        inside = (np.abs(error) <= BARS.get(name, np.nan)) & (taken > 0.0)
        print(
            f"{name:28s} {taken.mean():6.0%} {error.mean():9.4f} {np.abs(error).max():9.4f} "
            f"{BARS.get(name, np.nan):7.3f} {inside.mean():7.0%} {held.mean():8.0%} {np.median(half):10.4f}"
        )


if __name__ == "__main__":
    main()

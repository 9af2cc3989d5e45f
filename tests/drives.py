"""Drives that tests share: samples of slaloms, smooth or rough, and what can be done to them."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import Estimate, Inputs, make_inputs
from crosscomb.logs.prepare import complete
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.linear_single_track import linear_single_track_rates
from crosscomb.models.single_track import SingleTrack, single_track, single_track_rates, stable_substeps
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.signals import MIN_SPEED, Signals
from crosscomb.training.simulation.simulate import simulate_log

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")
MOTION = [at.AX, at.AY, at.YAW_RATE]
"""What the inertial sensors measure."""
FIXES = [at.GNSS_SPEED, at.GNSS_COURSE, at.HEADING]
HELD = ((at.VX, at.VX_HELD), (at.STEER, at.STEER_HELD))
"""Channels that are held where they are missing, each with the column that says so."""
SIDEWAYS = [at.AY, at.YAW_RATE, at.STEER, at.STEER_REAR, at.GNSS_COURSE, at.HEADING]
"""What changes its sign when left and right are exchanged."""

TEST_CAR = Vehicle(
    name='car "with" quotes',
    mass=1400.0,
    yaw_inertia=2200.0,
    cg_to_front_axle=1.1,
    cg_to_rear_axle=1.5,
    cg_height=0.53,
    track_front=1.52,
    track_rear=1.50,
    wheel_radius=0.31,
    steering_ratio=16.0,
    cornering_stiffness_front=95e3,
    cornering_stiffness_rear=120e3,
    roll_gradient=0.007,
)
"""A car of which only what a vehicle file must hold is given."""


# Made.


def model_slalom(
    steps: int, car: SingleTrack, linear: bool = False, steer: float = 0.04, rear: float = 0.1
) -> tuple[Inputs, np.ndarray]:
    """Noiseless slalom of the single track at 12 to 24 m/s, and its beta ``(n,) [rad]``.

    Starts as the filters do: they take the first yaw rate as it is, and beta as of rolling.
    """
    t = DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 18.0 + 6.0 * np.sin(0.3 * t)
    samples[:, at.AX] = 1.8 * np.cos(0.3 * t)
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * car.mass * samples[:, at.AX]
    samples[:, at.STEER] = 0.02 + steer * np.sin(2.0 * t)
    samples[:, at.STEER_REAR] = rear * samples[:, at.STEER]
    state = np.array([0.1, slip_of_rolling_rear(*samples[0, [at.STEER, at.STEER_REAR]], car.a, car.b)])
    beta = np.empty(steps)

    def model(sample: np.ndarray) -> tuple[np.ndarray, float]:
        given = sample[[at.VX, at.STEER, at.STEER_REAR]]
        if linear:
            rates, ay, _ = linear_single_track_rates(*state, *given, car)
        else:
            rates, (_, ay), _ = single_track_rates(*state, *given, *sample[[at.FXF, at.FXR, at.AX]], 0.0, car)
        return np.array(rates), ay

    for k, sample in enumerate(samples):
        substeps = stable_substeps(sample[at.VX], DT, car) if k else 0
        for _ in range(substeps):
            state = state + DT / substeps * model(sample)[0]
        sample[at.YAW_RATE], beta[k] = state
        sample[at.AY] = model(sample)[1]
    return Inputs(DT, samples), beta


def rolling_slalom(
    steps: int, vx: float = 18.0, swing: float = 0.2, pace: float = 0.6, rear: float = -0.1
) -> Inputs:
    """Noisy samples of a slalom, braking and pushing, that the single track nearly drives."""
    rng = np.random.default_rng(4)
    t = DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = vx * (1.0 + swing * np.sin(pace * t))
    samples[:, at.STEER] = 0.03 * np.sin(2.0 * t)
    samples[:, at.STEER_REAR] = rear * samples[:, at.STEER]
    gain = samples[:, at.VX] / (GOLF.wheelbase + 0.003 * samples[:, at.VX] ** 2)
    samples[:, at.YAW_RATE] = gain * samples[:, at.STEER]
    samples[:, at.AX] = swing * pace * vx * np.cos(pace * t)
    samples[:, at.AY] = samples[:, at.VX] * samples[:, at.YAW_RATE]
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * GOLF.mass * samples[:, at.AX]
    samples[:, [at.VX, *MOTION]] += rng.normal(0.0, [0.05, 0.2, 0.3, 0.01], (steps, 4))
    return Inputs(DT, samples)


def rough_slalom() -> Inputs:
    """10 s of slalom with gaps, a stop, reverse driving, crawling about the gate and wild samples."""
    samples = rolling_slalom(1000).samples
    samples[50:90, at.AY] = samples[70:120, at.YAW_RATE] = samples[100:130, at.AX] = np.nan
    samples[200:260, at.VX], samples[200:260, at.VX_HELD] = samples[199, at.VX], 1.0
    samples[240:330, at.STEER], samples[240:330, at.STEER_HELD] = 0.05, 1.0
    samples[400:440, at.VX], samples[440:460, at.VX] = 0.0, -2.0
    samples[600:660, at.VX] = MIN_SPEED + 0.2 * np.sin(np.arange(60))
    samples[700:703, at.AY], samples[720:722, at.YAW_RATE], samples[740, at.AX] = 400.0, -20.0, 1e6
    samples[760:770, at.STEER] = 0.6
    return Inputs(DT, samples)


def limit_slalom(steps: int = 900) -> Inputs:
    """A slalom at the limit with gaps in every channel, stops, and fixes that come and go."""
    rng, t = np.random.default_rng(4), DT * np.arange(steps)
    samples = np.full((steps, at.SAMPLE_WIDTH), np.nan)
    samples[:, : at.VFL] = 0.0
    samples[:, at.VX] = 18.0 + 6.0 * np.sin(0.3 * t) + rng.normal(0.0, 0.05, steps)
    samples[:, at.STEER] = 0.08 * np.sin(2.0 * t)
    samples[:, at.YAW_RATE] = 0.4 * np.sin(2.0 * t - 0.2) + rng.normal(0.0, 0.01, steps)
    samples[:, at.AY] = 8.0 * np.sin(2.0 * t - 0.2) + rng.normal(0.0, 0.4, steps)
    samples[:, at.AX] = rng.normal(0.0, 0.3, steps)
    samples[::20, at.GNSS_SPEED] = samples[::20, at.VX]
    samples[::20, [at.GNSS_COURSE, at.HEADING]] = rng.uniform(-3.1, 3.1, (len(samples[::20]), 2))
    punch(samples, rng, 4)
    samples[400:440, at.VX] = 0.0
    samples[440:460, at.VX] = -2.0
    samples[800:860, at.VX] = MIN_SPEED + 0.2 * np.sin(np.arange(60))
    return Inputs(DT, samples)


def nonsense(held: bool = True) -> Inputs:
    """20 s of sensors that say anything, with gaps; in the long one the speed is held too, where asked for."""
    rng = np.random.default_rng(7)
    samples = np.zeros((2000, at.SAMPLE_WIDTH))
    samples[:, at.VX] = np.abs(20.0 + np.cumsum(rng.normal(0.0, 0.5, 2000)))
    samples[:, [at.AX, at.AY]] = rng.normal(0.0, 30.0, (2000, 2))
    samples[:, at.YAW_RATE] = rng.normal(0.0, 5.0, 2000)
    samples[:, at.STEER] = rng.uniform(-0.7, 0.7, 2000)
    samples[:, [at.FXF, at.FXR]] = rng.normal(0.0, 2e4, (2000, 2))
    samples[rng.random(2000) < 0.3, at.AY] = np.nan
    samples[700:900, MOTION] = np.nan
    samples[700:900, at.VX_HELD] = float(held)
    return Inputs(DT, samples)


def nothing(steps: int = 50) -> Inputs:
    """Samples of a log without any value."""
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, [*MOTION, *range(at.VFL, at.SAMPLE_WIDTH)]] = np.nan
    samples[:, [at.VX_HELD, at.STEER_HELD]] = 1.0
    return Inputs(DT, samples)


# Simulated: dear, so each is made once; to be read only.


@cache
def simulated_log(car: Vehicle, manoeuvre: str, seed: Any, **settings: Any) -> Signals:
    """A simulated log."""
    return simulate_log(car, manoeuvre, seed, **settings)


def simulated_inputs(car: Vehicle, manoeuvre: str, seed: Any, **settings: Any) -> tuple[Inputs, np.ndarray]:
    """Fresh samples of a simulated log, and its true beta ``(n,) [rad]``."""
    log = simulated_log(car, manoeuvre, seed, **settings)
    beta = np.arctan2(log.column("vy_ref"), log.column("vx_ref"))
    return make_inputs(complete(log, car), car, DT), beta


# Changed.


def noisy(inputs: Inputs, seed: int = 0) -> Inputs:
    """The samples with sensor noise on speed, accelerations and yaw rate."""
    rng = np.random.default_rng(seed)
    samples = inputs.samples.copy()
    samples[:, [at.VX, *MOTION]] += rng.normal(0.0, [0.05, 0.2, 0.4, 0.01], (len(samples), 4))
    return replace(inputs, samples=samples)


def punch(samples: np.ndarray, rng: np.random.Generator, gaps: int, first: int = 0, last: int = -60) -> None:
    """Make gaps of up to 0.6 s in every channel of samples, in place; first and last bound where they begin."""
    for column, held in (*((column, None) for column in MOTION), *HELD):
        for start in rng.integers(first or 1, len(samples) + last, gaps):
            stop = start + rng.integers(1, 60)
            if held is None:
                samples[start:stop, column] = np.nan
            else:
                samples[start:stop, column] = samples[start - 1, column]
                samples[start:stop, held] = 1.0


def with_gaps(inputs: Inputs, seed: int = 1) -> Inputs:
    """The samples with gaps of up to 0.6 s in every channel."""
    samples = inputs.samples.copy()
    punch(samples, np.random.default_rng(seed), max(len(samples) // 150, 1), last=0)
    return replace(inputs, samples=samples)


def with_stops(inputs: Inputs) -> Inputs:
    """The samples with a stop, a stretch in reverse and crawling about the gate."""
    samples = inputs.samples.copy()
    samples[400:440, at.VX] = 0.0
    samples[440:460, at.VX] = -2.0
    samples[800:860, at.VX] = MIN_SPEED + 0.2 * np.sin(np.arange(60))
    return replace(inputs, samples=samples)


def without(inputs: Inputs, columns: list[int], rows: slice = slice(None)) -> Inputs:
    """The samples with channels missing: NaN, or held at the value before and said so."""
    samples = inputs.samples.copy()
    start = rows.start or 0
    for column in columns:
        held = dict(HELD).get(column)
        samples[rows, column] = np.nan if held is None else samples[start - 1, column] if start else 0.0
        if held is not None:
            samples[rows, held] = 1.0
    return replace(inputs, samples=samples)


def mirrored(inputs: Inputs) -> Inputs:
    """The same drive with left and right exchanged."""
    samples = inputs.samples.copy()
    samples[:, SIDEWAYS] *= -1.0
    samples[:, [at.VFL, at.VFR, at.VRL, at.VRR]] = samples[:, [at.VFR, at.VFL, at.VRR, at.VRL]]
    return replace(inputs, samples=samples)


@cache
def named(name: str) -> Inputs:
    """Slaloms of the Golf on Dugoff tyres, 15 s, by name; to be read only."""
    steer = {"at the limit": 0.08, "spun": 0.15}.get(name, 0.04)
    clean, _ = model_slalom(1500, single_track(GOLF), steer=steer)
    if name == "clean":
        return clean
    return noisy(clean) if name == "noisy" else with_stops(with_gaps(noisy(clean)))


NAMED = ("clean", "noisy", "with gaps", "at the limit", "spun")
"""What `named` knows."""


# Compared.


def rmse_deg(beta: np.ndarray, truth: np.ndarray) -> float:
    """Root of the mean squared error [deg] of angles in rad."""
    return float(np.degrees(np.sqrt(np.mean((beta - truth) ** 2))))


def spread(runs: list[Estimate]) -> np.ndarray:
    """beta and beta_std at every 20th sample of independent runs ``(runs, 2 m)``."""
    return np.array([np.concatenate([run.beta[20::20], run.beta_std[20::20]]) for run in runs])


def welch(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Difference of the means of two lists of independent runs ``(runs, n)`` over its standard error."""
    error2 = first.var(axis=0, ddof=1) / len(first) + second.var(axis=0, ddof=1) / len(second)
    return (first.mean(axis=0) - second.mean(axis=0)) / np.sqrt(error2)

"""What every estimator must do, whatever it is: checks written once, for all of the catalogue and for new ones.

Each check takes ``make``, which makes the same estimator anew at each call. Those with random numbers should be
made with few particles: it is their conduct that is checked.
"""

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import drives
from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import LOW_SPEED_STD, MAX_BETA, Estimate, Inputs, KernelFilter, make_inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter, settings_of
from crosscomb.logs.grid import to_grid
from crosscomb.logs.prepare import complete
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import MIN_SPEED

Make = Callable[[], KernelFilter]
CAR = load_vehicle("generic_compact")
ODDLY = {"CrossCombinedUKF": 1e-6}  # roots of matrices, summed in another order
"""How far the answer to a mirrored drive may lie from the mirrored answer [rad], by class; 1e-9 for the others."""

LOPSIDED = {"SimplexUKF", "SphericalUKF", "NeuralNetwork"}
"""Classes that are not odd by themselves: sigma points that are not symmetric (asked on a milder drive in
test_planar_filters), weights trained on mirrored data."""

UNSURE = {"NeuralNetwork", "IMM", "MMAE", "SecondOrderEKF", "DualEKF"}
"""Classes whose standard deviation may say that nothing is known, more than half a turn, where sensors are absurd."""

EXACT = {"KinematicKF", "DynamicEKF"}
"""Classes whose arithmetic is the same on both sides: a mirrored drive gives the same bits."""


@cache
def lively() -> Inputs:
    """A simulated lane change with holes in every channel, a stop and a start."""
    log = drives.simulated_log(CAR, "double_lane_change", 5, surface="wet", duration=12.0)
    samples = make_inputs(to_grid(complete(log, CAR), 100.0)[0].signals, CAR, drives.DT).samples
    rng = np.random.default_rng(1)
    for column in drives.MOTION:
        samples[rng.random(len(samples)) < 0.02, column] = np.nan
    samples[400:500, drives.MOTION] = np.nan
    samples[700:760, at.VX] = 0.5
    return Inputs(drives.DT, samples)


@cache
def rough() -> dict[str, Inputs]:
    """Drives with all that may come, by name; to be read only."""
    return {
        "lively": lively(),
        "rough": drives.rough_slalom(),
        "limit": drives.limit_slalom(),
        **{name: drives.named(name) for name in drives.NAMED},
    }


def classes_of(make: Make) -> set[str]:
    """Names of the estimator's class and of those it is made from."""
    return {cls.__name__ for cls in type(make()).__mro__}


def assert_same_bits(first: Estimate, second: Estimate) -> None:
    """The same answer in every bit, NaN where the other is NaN."""
    for one, other in zip(answers(first), answers(second), strict=True):
        np.testing.assert_array_equal(one, other)


def answers(estimate: Estimate) -> list[np.ndarray]:
    return [estimate.beta, estimate.beta_std, estimate.nis, *estimate.extra.values()]


def assert_sound(make: Make, inputs: Inputs, absurd: bool = True) -> None:
    """Finite everywhere, beta inside the models' bounds, a positive standard deviation below half a turn."""
    estimate = make().run(inputs)
    assert np.isfinite(estimate.beta).all()
    assert np.isfinite(estimate.beta_std).all()
    assert np.abs(estimate.beta).max() <= MAX_BETA + 1e-9
    assert (estimate.beta_std > 0.0).all()
    if not (absurd and classes_of(make) & UNSURE):
        assert estimate.beta_std.max() < np.radians(180.0)


def by_steps(estimator: KernelFilter, inputs: Inputs) -> Estimate:
    """The estimate of a log sample by sample."""
    started = estimator.start(inputs.dt)
    steps = [answers(estimator.advance(started, sample[None])) for sample in inputs.samples]
    beta, beta_std, nis, *extra = np.array(steps)[:, :, 0].T
    return Estimate(beta, beta_std, nis, dict(zip(estimator.extras, extra, strict=True)))


def steps_give_the_bits_of_a_batch(make: Make) -> None:
    # A step of particles takes 0.2 ms, nearly all of it the way in: the drive with most in it must do.
    told = [drives.limit_slalom()] if hasattr(make(), "seed") else rough().values()
    for inputs in told:
        assert_same_bits(by_steps(make(), inputs), make().run(inputs))


def chunks_give_the_bits_of_a_batch(make: Make) -> None:
    inputs = drives.limit_slalom()
    estimator = make()
    started, ends = estimator.start(inputs.dt), [0, 1, 8, 137, 137, 405, 899, 900]
    parts = [estimator.advance(started, inputs.samples[begin:end]) for begin, end in itertools.pairwise(ends)]
    joined = [np.concatenate(pieces) for pieces in zip(*map(answers, parts), strict=True)]
    for found, expected in zip(joined, answers(make().run(inputs)), strict=True):
        np.testing.assert_array_equal(found, expected)


def answers_are_sound_whatever_comes(make: Make) -> None:
    for name, inputs in rough().items():
        assert_sound(make, inputs, absurd=name == "rough")
    assert_sound(make, drives.nonsense())


def a_wild_sample_is_survived(make: Make) -> None:
    wild = (
        (at.AX, 1e6),
        (at.AY, 1e6),
        (at.AY, -1e6),
        (at.YAW_RATE, 1e6),
        (at.STEER, 1.5),
        (at.GNSS_SPEED, 1e6),
    )
    for inputs in (drives.named("noisy"), drives.limit_slalom()):
        for column, value in wild:
            samples = inputs.samples.copy()
            samples[700, column] = value
            assert_sound(make, replace(inputs, samples=samples))


def a_missing_channel_is_survived(make: Make) -> None:
    """Each alone and all together, in a gap and from the first sample on."""
    channels = [at.VX, *drives.MOTION, at.STEER]
    sets = [[], *([channel] for channel in channels), drives.MOTION, channels]
    for rows in (slice(200, 600), slice(None)):
        for missing in sets:
            inputs = drives.without(drives.named("noisy"), missing, rows)
            assert_sound(make, inputs)


def a_log_without_any_value_gets_an_answer(make: Make) -> None:
    estimate = make().run(drives.nothing())
    np.testing.assert_array_equal(estimate.beta, 0.0)
    assert (estimate.beta_std > 0.0).all()
    driven = drives.nothing()
    driven.samples[:, at.VX], driven.samples[:, at.VX_HELD] = 18.0, 0.0
    assert_sound(make, driven)


def a_mirrored_drive_gives_the_mirrored_answer(make: Make) -> None:
    """Particles are shaken by the same random numbers on both sides: there only the mean of many runs mirrors."""
    if hasattr(make(), "seed"):
        mirrors_within_scatter(make)
        return
    if classes_of(make) & LOPSIDED:
        return
    tolerance = max([1e-9, *(ODDLY[name] for name in classes_of(make) & set(ODDLY))])
    for inputs in (drives.limit_slalom(), *map(drives.named, drives.NAMED)):
        estimate, other = make().run(inputs), make().run(drives.mirrored(inputs))
        if type(make()).__name__ in EXACT:
            assert_same_bits(replace(other, extra={}), replace(estimate, beta=-estimate.beta, extra={}))
        np.testing.assert_allclose(other.beta, -estimate.beta, rtol=0.0, atol=tolerance)


def mirrors_within_scatter(make: Make) -> None:
    inputs = drives.with_gaps(drives.noisy(drives.model_slalom(160, drives.single_track(drives.GOLF))[0]))
    flipped = [replace(make(), seed=seed).run(drives.mirrored(inputs)) for seed in range(30)]
    backed = drives.spread([replace(run, beta=-run.beta) for run in flipped])
    others = drives.spread([replace(make(), seed=100 + seed).run(inputs) for seed in range(30)])
    # One of 14 values of Welch's t (at least 29 degrees of freedom) is beyond 4.5 by chance in 1 of 700.
    assert np.abs(drives.welch(backed, others)).max() < 4.5


def runs_repeat_and_change_nothing(make: Make) -> None:
    """Nothing of a run stays behind: not in the input, the settings, this estimator or another one."""
    inputs, other_drive = drives.limit_slalom(), drives.named("noisy")
    before, estimator, bystander = inputs.samples.copy(), make(), make()
    settings = json.dumps(settings_of(estimator))
    first = estimator.run(inputs)
    estimator.run(other_drive)
    assert_same_bits(estimator.run(inputs), first)
    assert_same_bits(bystander.run(inputs), first)
    np.testing.assert_array_equal(inputs.samples, before)
    assert json.dumps(settings_of(estimator)) == settings
    assert estimator == make()


def two_under_way_do_not_touch_each_other(make: Make) -> None:
    estimator, inputs, other = make(), drives.limit_slalom(), drives.named("noisy")
    one, two = estimator.start(inputs.dt), estimator.start(other.dt)
    pairs = np.array(
        [
            (estimator.step(one, sample), estimator.step(two, beside))
            for sample, beside in zip(inputs.samples, other.samples, strict=False)
        ]
    )
    for k, told in enumerate((inputs, other)):
        alone = estimator.run(replace(told, samples=told.samples[: len(pairs)]))
        np.testing.assert_array_equal(pairs[:, k].T, [alone.beta, alone.beta_std, alone.nis])


def below_the_gate_the_car_rolls(make: Make) -> None:
    estimator = make()
    a, b = estimator.vehicle.cg_to_front_axle, estimator.vehicle.cg_to_rear_axle
    for inputs in (drives.rough_slalom(), drives.limit_slalom(), drives.named("with gaps")):
        slow = ~(inputs.samples[:, at.VX] > MIN_SPEED)
        assert slow.sum() > 60
        estimate = make().run(inputs)
        angles = inputs.samples[slow][:, [at.STEER, at.STEER_REAR]]
        np.testing.assert_array_equal(
            estimate.beta[slow], [slip_of_rolling_rear(*row, a, b) for row in angles]
        )
        np.testing.assert_array_equal(estimate.beta_std[slow], LOW_SPEED_STD)
        assert np.isnan(estimate.nis[slow]).all()


def the_first_sample_above_the_gate_is_still_a_rolling_car(make: Make) -> None:
    vehicle = make().vehicle
    for inputs in (drives.named("with gaps"), drives.limit_slalom()):
        slow = ~(inputs.samples[:, at.VX] > MIN_SPEED)
        after = np.flatnonzero(~slow & np.roll(slow, 1))
        assert len(after) > 3
        estimate = make().run(inputs)
        angles = inputs.samples[after][:, [at.STEER, at.STEER_REAR]]
        rolling = [
            slip_of_rolling_rear(*row, vehicle.cg_to_front_axle, vehicle.cg_to_rear_axle) for row in angles
        ]
        np.testing.assert_array_equal(estimate.beta[after], rolling)
        np.testing.assert_array_equal(estimate.beta_std[after], LOW_SPEED_STD)
        assert np.isnan(estimate.nis[after]).all()


def extras_are_named_and_finite(make: Make) -> None:
    """Innovations where there is something to measure, the others wherever the car drives."""
    estimator, inputs = make(), drives.limit_slalom()
    estimate = estimator.run(inputs)
    assert tuple(estimate.extra) == estimator.extras
    assert len(set(estimator.extras)) == len(estimator.extras)
    slow = ~(inputs.samples[:, at.VX] > MIN_SPEED)
    driving = ~slow & ~np.roll(slow, 1)
    driving[0] = False
    for name, values in estimate.extra.items():
        assert " [" in name, "each says its unit"
        assert name.endswith("]")
        assert np.isfinite(values[driving]).mean() > (0.5 if name in estimator.innovations() else 0.9), name
        assert not np.isinf(values).any(), name


def settings_survive_a_json_file(make: Make) -> None:
    estimator = make()
    name = next(name for name, entry in CATALOGUE.items() if entry.load() is type(estimator))
    read = json.loads(json.dumps(settings_of(estimator)))
    assert make_filter(name, estimator.vehicle, read) == estimator
    with pytest.raises(UsageError, match="unknown setting"):
        make_filter(name, estimator.vehicle, {"no_such_setting": 1.0})


def a_seed_gives_the_same_bits_and_another_seed_others(make: Make) -> None:
    """Nothing to say of an estimator without random numbers but that it has none."""
    inputs, estimator = drives.named("noisy"), make()
    estimate = estimator.run(inputs)
    assert_same_bits(make().run(inputs), estimate)
    if hasattr(estimator, "seed"):
        assert_same_bits(replace(estimator).run(inputs), estimate)
        other = replace(estimator, seed=estimator.seed + 1).run(inputs)
        assert np.mean(other.beta != estimate.beta) > 0.99


CHECKS: tuple[Callable[[Make], None], ...] = (
    steps_give_the_bits_of_a_batch,
    chunks_give_the_bits_of_a_batch,
    answers_are_sound_whatever_comes,
    a_wild_sample_is_survived,
    a_missing_channel_is_survived,
    a_log_without_any_value_gets_an_answer,
    a_mirrored_drive_gives_the_mirrored_answer,
    runs_repeat_and_change_nothing,
    two_under_way_do_not_touch_each_other,
    below_the_gate_the_car_rolls,
    the_first_sample_above_the_gate_is_still_a_rolling_car,
    extras_are_named_and_finite,
    settings_survive_a_json_file,
    a_seed_gives_the_same_bits_and_another_seed_others,
)


def check_estimator(make: Make) -> None:
    """Run every check on one estimator.

    Parameters
    ----------
    make : callable
        Makes the estimator, of a class in the catalogue; the same at each call.
    """
    for check in CHECKS:
        check(make)

"""What every estimator of the catalogue must do, whatever it is."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.filters.base import make_inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter, settings_of
from crosscomb.logs.grid import to_grid
from crosscomb.logs.prepare import complete
from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import load_vehicle
from crosscomb.signals import MIN_SPEED
from estimator_cases import CAR, FEW, SHORT, quick
from estimator_checks import assert_same_bits, assert_sound, by_steps, lively


@pytest.mark.parametrize("name", SHORT)
def test_the_whole_horizon_steps_as_the_batch(name):
    assert_same_bits(by_steps(quick(name), lively()), quick(name).run(lively()))
    assert_sound(partial(quick, name), lively())


def zeroed(settings, path=()):
    """Settings with one number set to zero, for each of them, with its place."""
    for key, value in settings.items():
        if isinstance(value, dict):
            for place, inner in zeroed(value, (*path, key)):
                yield place, {key: inner}
        elif isinstance(value, float):
            yield (*path, key), {key: 0.0}


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_setting_of_zero_is_refused_in_one_line_or_harmless(name):
    short, refused = replace(lively(), samples=lively().samples[350:800]), {}
    for place, settings in zeroed(settings_of(quick(name))):
        if place[0] == "network":
            continue
        few = {"particles": 50} if "particles" in FEW.get(name, {}) else {}
        try:
            beta = make_filter(name, CAR, few | settings).run(short).beta
        except UsageError as error:
            refused[".".join(place)] = str(error)
        else:
            assert np.isfinite(beta).all(), place
    assert all(place in text and "\n" not in text for place, text in refused.items())


def test_settings_beyond_reason_are_refused():
    for name, settings, words in (
        ("random_walk_pf", {"particles": 2_000_000}, "must be a whole number from 1 to 1000000"),
        ("adaptive_pf", {"most_particles": 10**12}, "most_particles"),
        ("kinematic_pf", {"particles": float("inf")}, "particles"),
        (
            "random_walk_pf",
            {"noise": {"pseudo": 0.0}},
            "noise.pseudo: 0.0 must be at least 1e-09: the filter",
        ),
        ("random_walk_pf", {"noise": {"ekf": {"ay": 1e-200}}}, "noise.ekf.ay"),
        ("kinematic_kf", {"noise": {"speed": 0}}, "noise.speed"),
    ):
        with pytest.raises(UsageError) as caught:
            make_filter(name, CAR, settings)
        assert words in str(caught.value)
    assert make_filter("kinematic_kf", CAR, {"noise": {"rear_slip": 0.0}}).noise.rear_slip == 0.0


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_entry_says_what_it_is_and_where_it_is_from(name):
    entry = CATALOGUE[name]
    assert len(entry.summary) > 20
    assert entry.source
    assert (entry.load().__doc__ or "").strip()


def real_logs(folder):
    """Recordings with the vehicle file beside them, else the generic car."""
    for path in sorted(folder.glob("*/*.csv*")):
        beside = path.with_name("vehicle.toml")
        yield path, load_vehicle(beside) if beside.exists() else CAR


def test_all_are_bounded_on_every_real_recording(data_dir):
    """Finite everywhere; no estimator runs away: RMSE below 30 deg where beta itself stays below 20 deg."""
    for path, car in real_logs(data_dir):
        signals = complete(read_log(path), car)
        for segment in to_grid(signals, 100.0):
            window = slice(0, 6000)  # a minute tells; the longest log has six
            inputs = make_inputs(segment.signals, car, 0.01)
            inputs = replace(inputs, samples=inputs.samples[window])
            beta_ref = segment.signals.beta_ref[window]
            counted = np.isfinite(beta_ref) & (inputs.samples[:, 0] > MIN_SPEED)
            for name in CATALOGUE:
                beta = quick(name, car).run(inputs).beta
                assert np.isfinite(beta).all(), (path.name, name)
                assert np.abs(beta).max() < np.pi, (path.name, name)
                if counted.any():
                    rmse = np.degrees(np.sqrt(np.mean((beta - beta_ref)[counted] ** 2)))
                    assert rmse < 30.0, (path.name, name, rmse)


def test_a_number_of_particles_alone_means_the_filter_that_draws_the_forces():
    """So artefacts say that were written before there was a choice."""
    chosen = [settings_of(make_filter("random_walk_pf", CAR, given)) for given in ({}, {"particles": 1000})]
    assert [(each["forces"], each["particles"]) for each in chosen] == [("solved", 200), ("drawn", 1000)]
    solved = {"particles": 50, "forces": "solved"}
    assert settings_of(make_filter("random_walk_pf", CAR, solved))["forces"] == "solved"
    assert [settings_of(make_filter("random_walk_pf", CAR, each)) for each in chosen] == chosen


def test_a_name_of_before_says_what_to_name_instead():
    with pytest.raises(
        UsageError, match=r"^filter rao_blackwell_pf: is what random_walk_pf runs by default now"
    ):
        make_filter("rao_blackwell_pf", CAR)

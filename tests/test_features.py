"""What the richer selectors see: innovations among the features, and what a mirrored drive makes of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from crosscomb.filters.catalogue import CATALOGUE, make_filter
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.drive import run_filters
from crosscomb.selection.features import (
    MEMORIES,
    MOST_INNOVATION,
    Layout,
    all_features,
    layout,
)
from crosscomb.selection.seen import Seen
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import Signals
from crosscomb.training.simulation.simulate import simulate_log

CAR = load_vehicle("generic_compact")
NAMES = ["kinematic_kf", "luenberger", "dynamic_ekf"]
RATE = 100.0
TOLD = {
    "innovation_vx kinematic_kf [m/s]": ("kinematic_kf", "innovation_vx [m/s]"),
    "innovation_vy kinematic_kf [m/s]": ("kinematic_kf", "innovation_vy [m/s]"),
    "innovation_yaw_rate dynamic_ekf [rad/s]": ("dynamic_ekf", "innovation_yaw_rate [rad/s]"),
    "innovation_ay dynamic_ekf [m/s^2]": ("dynamic_ekf", "innovation_ay [m/s^2]"),
}
"""The innovations' features without memory, in order, and where they come from."""


@pytest.fixture(scope="module")
def log() -> Signals:
    """A slide with holes in ay and yaw rate, and an accelerometer that strikes out."""
    log = simulate_log(CAR, "road_slide", 3, surface="wet", duration=8.0)
    frame = log.frame.copy()
    frame.loc[200:230, "ay"] = np.nan
    frame.loc[300:340, "yaw_rate"] = np.nan
    frame.loc[440:500, "ay"] += np.linspace(0.0, 60.0, 61)
    return replace(log, frame=frame)


def run_of(log: Signals, names: list[str]) -> Seen:
    """Filters over a log in one piece."""
    filters = [make_filter(name, CAR) for name in names]
    (run,) = run_filters(complete(log, CAR), CAR, filters, RATE, WindowSettings())
    return run


def mirrored(log: Signals) -> Signals:
    """The same drive with left and right exchanged."""
    odd = ["ay", "yaw_rate", "steer", "steer_wheel", "steer_rear", "beta_ref", "vy_ref"]
    swapped = {"vfl": "vfr", "vfr": "vfl", "vrl": "vrr", "vrr": "vrl"}
    swapped |= {f"torque_{key[1:]}": f"torque_{value[1:]}" for key, value in swapped.items()}
    frame = log.frame.assign(**{key: -log.frame[key] for key in odd if key in log.frame}).rename(
        columns=swapped
    )
    return replace(log, frame=frame[list(log.frame.columns)])


def test_innovations_stand_last_and_only_where_a_filter_gives_them():
    names = layout(NAMES).names
    channels = len(names) // len(MEMORIES)
    assert list(names[channels - len(TOLD) : channels]) == list(TOLD)
    assert names[-1] == "mean(innovation_ay dynamic_ekf [m/s^2], 5.0 s)"
    assert not any("innovation" in name for name in layout(["random_walk_pf", "luenberger"]).names)


def test_what_is_odd_what_networks_see_and_what_is_a_sideslip_angle():
    places = layout(NAMES)
    seen = {
        name: (bool(odd), bool(plain), bool(slip))
        for name, odd, plain, slip in zip(places.names, places.odd, places.plain, places.slip, strict=True)
    }
    assert all(len(flags) == len(places.names) for flags in (places.odd, places.plain, places.slip))
    for name in ("{}", "mean({}, 1.5 s)"):
        assert seen[name.format("innovation_vx kinematic_kf [m/s]")] == (False, False, False)
        for odd in list(TOLD)[1:]:
            assert seen[name.format(odd)] == (True, False, False)
        assert seen[name.format("beta dynamic_ekf [rad]")] == (True, True, True)
        assert seen[name.format("NIS dynamic_ekf")] == (False, False, False)
        assert seen[name.format("beta_std dynamic_ekf [rad]")] == (False, False, False)


@pytest.mark.parametrize("name", CATALOGUE)
def test_of_every_innovation_it_is_known_whether_it_is_odd(name):
    estimator = CATALOGUE[name].load()
    assert set(estimator.odd_innovations) <= set(estimator.innovations())
    assert name in NAMES or not estimator.innovations(), "the mirrored drive below must see them all"


def test_features_are_the_innovations_and_their_means(log):
    """Against the filters' own answers and scipy's recursive filter; what is missing counts as 0."""
    run, places = run_of(log, NAMES), layout(NAMES)
    features = all_features(run)
    missing, struck = set(), False
    for feature, (name, innovation) in TOLD.items():
        told = make_filter(name, CAR).run(run.inputs).extra[innovation]
        if np.isnan(told[1:]).any():
            missing.add(innovation)
        struck |= bool(np.nanmax(np.abs(told)) > MOST_INNOVATION)
        wanted = np.clip(np.where(np.isnan(told), 0.0, told), -MOST_INNOVATION, MOST_INNOVATION)
        for memory in MEMORIES:
            shown = feature if memory == 0.0 else f"mean({feature}, {memory} s)"
            keep = np.exp(-1.0 / (RATE * memory)) if memory else 0.0
            mean, _ = lfilter([1.0 - keep], [1.0, -keep], wanted, zi=[keep * wanted[0]])
            found = features[:, places.names.index(shown)]
            np.testing.assert_allclose(found, mean, rtol=1e-6, atol=1e-6, err_msg=shown)
    assert missing >= {"innovation_yaw_rate [rad/s]", "innovation_ay [m/s^2]", "innovation_vy [m/s]"}
    assert struck, "the log must hold a wild one"


def test_a_mirrored_drive_flips_just_the_odd_features(log):
    places: Layout = layout(NAMES)
    plain, other = (all_features(run_of(one, NAMES)) for one in (log, mirrored(log)))
    np.testing.assert_allclose(other, plain * np.where(places.odd, -1.0, 1.0), rtol=1e-4, atol=1e-6)
    innovations = [places.names.index(name) for name in TOLD]
    assert (np.abs(plain[:, innovations]).max(axis=0) > 1e-3).all(), "they must tell something"


@pytest.mark.parametrize("members", [[2, 0], [1], [1, 2], [0, 1, 2]])
def test_some_of_the_filters_have_the_features_of_a_run_of_their_own(log, members):
    run, alone = run_of(log, NAMES).only(members), run_of(log, [NAMES[member] for member in members])
    np.testing.assert_array_equal(all_features(run), all_features(alone))
    assert all_features(run).shape[1] == len(layout([NAMES[member] for member in members]).names)

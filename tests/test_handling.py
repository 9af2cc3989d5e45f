"""Understeer and oversteer: right where the truth is known, steady, and silent where it cannot be told."""

import numpy as np
import pandas as pd
import pytest

from crosscomb.filters import columns as at
from crosscomb.models.vehicle import load_vehicle
from crosscomb.report.pictures import estimate_figure
from crosscomb.run.estimate import estimate_log
from crosscomb.run.handling import (
    CONFIRM,
    COUNTERSTEER,
    ENTER,
    LEAVE,
    NEUTRAL,
    OVERSTEER,
    STATES,
    UNDERSTEER,
    UNKNOWN,
    Handling,
    handling_of,
    start_handling,
)  # fmt: skip
from crosscomb.run.motion import motion_of, start_motion
from crosscomb.selection.artefact import Artefact, load_artefact
from crosscomb.signals import Signals, make_signals
from crosscomb.training.recordings import find_logs
from crosscomb.training.simulation.simulate import simulate_log
from handling_score import count_states, true_slips, true_states

CAR = load_vehicle("generic_compact")
DT = 0.01
A, B = CAR.cg_to_front_axle, CAR.cg_to_rear_axle


@pytest.fixture(scope="module")
def artefact() -> Artefact:
    return load_artefact()


def drive(front, rear, yaw_rate=0.4, vx=20.0, beta_std=0.0, n=100, valid=True, ay=None) -> Handling:
    """Handling of a drive with these slip angles (floats or ``(n,)``) [rad], in a bend to the left."""
    front, rear = np.broadcast_to(front, n), np.broadcast_to(rear, n)
    samples = np.zeros((n, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.YAW_RATE], samples[:, at.AY] = (
        vx,
        yaw_rate,
        vx * yaw_rate if ay is None else ay,
    )
    tangent = np.tan(-rear) + B * samples[:, at.YAW_RATE] / vx  # that of beta
    samples[:, at.STEER] = front + np.arctan(tangent + A * samples[:, at.YAW_RATE] / vx)
    motion = motion_of(start_motion(), samples, CAR, DT)
    doubt, good = np.broadcast_to(float(beta_std), n).copy(), np.broadcast_to(valid, n).copy()
    return handling_of(start_handling(), samples, np.arctan(tangent), doubt, motion, good, CAR, DT)


def changes(state: np.ndarray) -> int:
    return int(np.sum(np.diff(state) != 0))


def test_slip_angles_are_those_of_the_axles():
    handling = drive(0.08, 0.03)
    np.testing.assert_allclose(handling.slip_front, 0.08, atol=1e-12)
    np.testing.assert_allclose(handling.slip_rear, 0.03, atol=1e-12)
    np.testing.assert_allclose(handling.understeer, 0.05, atol=1e-12)


def test_understeer_is_the_textbook_angle_at_small_angles():
    """Steering angle less wheelbase over radius."""
    front, rear, yaw_rate, vx = 0.03, 0.01, 0.1, 20.0
    beta = -rear + B * yaw_rate / vx
    steer = front + beta + A * yaw_rate / vx
    handling = drive(front, rear, yaw_rate, vx)
    np.testing.assert_allclose(handling.understeer, steer - CAR.wheelbase * yaw_rate / vx, atol=2e-4)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
@pytest.mark.parametrize(
    ("front", "rear", "state"),
    [
        (0.02, 0.01, NEUTRAL),
        (0.03, 0.03, NEUTRAL),
        (0.15, 0.05, UNDERSTEER),
        (0.05, 0.10, OVERSTEER),
        (0.05, 0.30, COUNTERSTEER),  # steer = 0.05 + beta + a r / vx is far to the outside
        (-0.02, 0.30, COUNTERSTEER),
    ],
)
def test_the_axle_that_slips_more_gives_the_word(front, rear, state, side):
    handling = drive(side * front, side * rear, yaw_rate=side * 0.4)
    assert set(handling.state[20:]) == {state}


def test_a_state_is_said_only_once_it_stood_and_left_later_than_entered():
    n, confirm = 400, round(CONFIRM / DT)
    rear = 0.02
    front = rear + np.concatenate([np.full(100, 0.0), np.full(100, 1.1 * ENTER), np.full(100, 1.05 * LEAVE),
                                   np.full(100, 0.95 * LEAVE)])  # fmt: skip
    state = drive(front, rear, n=n).state
    expected = [(confirm, NEUTRAL), (100 + confirm, UNDERSTEER), (300 + confirm, NEUTRAL)]
    starts = np.flatnonzero(np.diff(state, prepend=UNKNOWN))
    assert [(int(k), int(state[k])) for k in starts] == expected


def test_noise_about_a_threshold_does_not_chatter():
    rng = np.random.default_rng(1)
    front = 0.02 + ENTER + rng.normal(0.0, np.radians(0.5), 6000)
    plain = changes((front - 0.02 > ENTER).astype(int))
    assert plain > 1000
    assert changes(drive(front, 0.02, n=6000).state) < 60


def test_doubt_about_beta_does_not_hide_what_steering_and_yaw_rate_tell():
    """An error of beta moves both slips alike: their difference stays."""
    assert set(drive(0.10, 0.05, beta_std=np.radians(6.0)).state[20:]) == {UNDERSTEER}
    assert set(drive(0.05, 0.10, beta_std=np.radians(6.0)).state[20:]) == {OVERSTEER}
    assert set(drive(0.0, 0.0, yaw_rate=0.0, beta_std=np.radians(6.0)).state[20:]) == {NEUTRAL}


def test_where_doubt_about_beta_turns_it_over_nothing_is_said():
    """In a turn as tight as this the difference does depend on beta."""
    assert set(drive(0.01, 0.06, vx=4.0, yaw_rate=0.8, beta_std=0.5).state) == {UNKNOWN}
    assert set(drive(0.01, 0.06, vx=4.0, yaw_rate=0.8, beta_std=0.02).state[20:]) <= {OVERSTEER, COUNTERSTEER}


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
@pytest.mark.parametrize("beta_std", [0.5, np.pi], ids=["0.5 rad", "half a turn"])
def test_doubt_counts_to_both_sides_and_however_large_it_is(side, beta_std):
    """The tangent of beta comes back after half a turn, what is known of beta does not."""
    handling = drive(side * 0.01, side * 0.06, vx=4.0, yaw_rate=side * 0.8, beta_std=beta_std)
    assert set(handling.state) == {UNKNOWN}


def test_the_side_of_the_turn_is_that_of_ay_and_fades_near_zero():
    assert set(drive(0.10, 0.05, ay=4.0).state[20:]) == {UNDERSTEER}
    assert set(drive(0.10, 0.05, ay=-4.0).state[20:]) == {OVERSTEER}
    assert set(drive(0.10, 0.05, ay=0.2).state[20:]) == {NEUTRAL}
    held = np.where(np.arange(100) < 50, 4.0, np.nan)
    assert set(drive(0.10, 0.05, ay=held).state[20:]) == {UNDERSTEER}


def test_nothing_is_said_below_the_gate_or_when_the_estimate_is_invalid():
    for handling in (drive(0.1, 0.02, vx=2.0), drive(0.1, 0.02, valid=False)):
        assert set(handling.state) == {UNKNOWN}
        assert np.isnan(handling.slip_front).all()
        assert np.isnan(handling.understeer).all()


def test_a_missing_yaw_rate_silences_after_a_moment(artefact):
    log = simulate_log(CAR, "slalom", 2, duration=8.0)
    frame = log.frame.copy()
    frame.loc[400:500, "yaw_rate"] = np.nan
    state = estimate_log(make_signals(frame, "log"), CAR, artefact).handling.state
    assert "unknown" not in state[395:410]
    assert set(state[440:500]) == {"unknown"}


# Against the truth of simulated logs


def judged(manoeuvre: str, seed: int, artefact: Artefact, **settings) -> pd.DataFrame:
    """Samples by true and estimated state; the truth comes from the same drive with perfect sensors."""
    log, perfect = (
        simulate_log(CAR, manoeuvre, seed, duration=20.0, faults=faults, **settings)
        for faults in (True, False)
    )
    np.testing.assert_array_equal(log.column("vy_ref"), perfect.column("vy_ref"))
    return count_states(estimate_log(log, CAR, artefact), true_states(perfect, CAR))


def added(manoeuvre: str, artefact: Artefact, **settings) -> pd.DataFrame:
    parts = [judged(manoeuvre, seed, artefact, **settings) for seed in range(4)]
    return sum(parts[1:], parts[0])


def test_a_power_slide_oversteers(artefact):
    counts = added("drift", artefact, surface="wet").loc["oversteer"]
    assert counts.sum() > 500
    assert counts[["oversteer", "countersteer"]].sum() > 0.9 * counts.sum()
    assert counts["countersteer"] > 0
    assert counts["understeer"] < 0.05 * counts.sum()


@pytest.mark.parametrize("manoeuvre", ["j_turn", "lap_limit"])
def test_ploughing_on_snow_understeers(artefact, manoeuvre):
    counts = added(manoeuvre, artefact, surface="snow").loc["understeer"]
    assert counts.sum() > 400
    assert counts["understeer"] > 0.8 * counts.sum()
    assert counts[["oversteer", "countersteer"]].sum() < 0.02 * counts.sum()


@pytest.mark.parametrize("manoeuvre", ["country_road", "town", "motorway"])
def test_everyday_driving_is_neutral(artefact, manoeuvre):
    counts = added(manoeuvre, artefact, surface="dry")
    assert counts.loc["neutral"].sum() > 0.95 * counts.to_numpy().sum()
    assert counts.loc["neutral", "neutral"] > 0.97 * counts.loc["neutral"].sum()


def test_true_slips_are_those_of_the_tyres(artefact):
    """A neutral check of the truth itself: in a gentle bend slip is load over stiffness."""
    log = simulate_log(CAR, "circle", 1, duration=20.0, faults=False, spread=False)
    front, rear = true_slips(log, CAR)
    gentle = (np.abs(log.column("ay")) > 0.5) & (np.abs(log.column("ay")) < 2.5) & np.isfinite(front)
    gentle &= (np.abs(np.gradient(log.column("ay"), log.t)) < 1.0) & (np.abs(log.column("ax")) < 0.3)
    assert gentle.sum() > 100
    load = CAR.mass / CAR.wheelbase * log.column("ay")[gentle]
    for slip, arm, stiffness in (
        (front, B, CAR.cornering_stiffness_front),
        (rear, A, CAR.cornering_stiffness_rear),
    ):
        ratio = slip[gentle] / (load * arm / stiffness)
        assert 0.7 < np.median(ratio) < 1.5


# What users see


def test_shares_add_up_over_the_time_in_motion(artefact):
    log = simulate_log(CAR, "stop_and_go", 3, duration=12.0)
    estimate = estimate_log(log, CAR, artefact)
    shares = estimate.handling_shares()
    assert list(shares) == list(STATES)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["neutral"] > 0.8  # standstill does not count
    still = make_signals(log.frame.assign(vx=0.0), "still")
    assert sum(estimate_log(still, CAR, artefact).handling_shares().values()) == 0.0


def test_estimate_writes_and_says_the_handling(crosscomb, write_log, tmp_path):
    log: Signals = simulate_log(CAR, "drift", 0, duration=8.0, surface="wet")
    path = write_log(log.frame, tmp_path / "a.csv")
    ran = crosscomb(
        "estimate", path, "--vehicle", "generic_compact", "--handling", "--point", "1", "-o", tmp_path / "out"
    )
    assert (ran.code, ran.err) == (0, "")
    table = pd.read_csv(tmp_path / "out" / "a.handling.csv")
    assert list(table) == ["t", "slip_front", "slip_rear", "understeer", "state"]
    assert len(table) == len(log)
    assert set(table["state"]) <= set(STATES)
    assert any(line.startswith("a: neutral") and "of the time" in line for line in ran.out.splitlines())
    assert find_logs(tmp_path / "out") == []  # what estimate writes is no log to train on
    plain = crosscomb("estimate", path, "--vehicle", "generic_compact", "-o", tmp_path / "plain")
    assert plain.code == 0
    assert not (tmp_path / "plain" / "a.handling.csv").exists()


def test_the_picture_has_a_strip_for_it(artefact):
    log = simulate_log(CAR, "drift", 0, duration=8.0, surface="wet")
    figure = estimate_figure(estimate_log(log, CAR, artefact), "drift")
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels.index("handling") == labels.index("active") + 1
    legend = figure.axes[labels.index("handling")].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == list(STATES)

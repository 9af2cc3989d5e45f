"""Velocity of any point of the car: that of a rigid body, with a doubt that says what is not known."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscomb.filters import columns as at
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.run.motion import MOST_YAW_DOUBT, motion_of, point_velocity, start_motion
from crosscomb.run.stream import StreamingEstimator
from crosscomb.selection.artefact import Artefact, load_artefact
from crosscomb.signals import Signals, make_signals
from crosscomb.training.simulation.simulate import simulate_log

CAR = load_vehicle("generic_compact")
DT = 0.01


@pytest.fixture(scope="module")
def artefact() -> Artefact:
    return load_artefact()


@pytest.fixture(scope="module")
def log() -> Signals:
    return simulate_log(CAR, "slalom", 2, duration=8.0)


def samples(n: int = 50, vx: float = 20.0, yaw_rate: float = 0.3, steer: float = 0.0) -> np.ndarray:
    made = np.zeros((n, at.SAMPLE_WIDTH))
    made[:, at.VX], made[:, at.YAW_RATE], made[:, at.STEER] = vx, yaw_rate, steer
    return made


@settings(deadline=None)
@given(
    beta=st.floats(-1.2, 1.2), vx=st.floats(3.1, 60.0), yaw_rate=st.floats(-2.0, 2.0),
    x=st.floats(-3.0, 3.0), y=st.floats(-1.0, 1.0),
)  # fmt: skip
def test_a_point_moves_as_on_a_rigid_body(beta, vx, yaw_rate, x, y):
    """Against the derivative of the point's place on the ground."""
    velocity = vx + 1j * vx * math.tan(beta)  # complex: x is real, y imaginary
    expected = velocity + 1j * yaw_rate * (x + 1j * y)
    at = point_velocity(beta, 0.0, vx, yaw_rate / vx, 0.0, x, y)
    assert complex(at[0], at[1]) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert at[2] == pytest.approx(math.atan2(expected.imag, expected.real), abs=1e-9)


def test_at_the_centre_of_gravity_nothing_changes(artefact, log):
    estimate = estimate_log(log, CAR, artefact)
    here = estimate.at(0.0)
    np.testing.assert_allclose(here.beta, estimate.beta, atol=1e-12)
    np.testing.assert_allclose(here.beta_std, estimate.beta_std, rtol=1e-9)
    np.testing.assert_allclose(here.vy, estimate.motion.vx * np.tan(estimate.beta), rtol=1e-12)


def test_the_rear_axle_of_a_slow_car_follows_its_wheels_and_the_front_axle_the_steering(artefact):
    """Rolling without slip, also at standstill and in reverse."""
    for vx in (2.0, 0.0, -2.0):
        given = samples(vx=vx, steer=0.2)
        given[:, at.STEER_REAR] = -0.05
        motion = motion_of(start_motion(), given, CAR, DT)
        rolling = math.atan(
            (CAR.cg_to_rear_axle * math.tan(0.2) + CAR.cg_to_front_axle * math.tan(-0.05)) / CAR.wheelbase
        )
        one = [float(column[0]) for column in motion]
        assert point_velocity(rolling, 0.0, *one, CAR.cg_to_front_axle, 0.0)[2] == pytest.approx(0.2)
        assert point_velocity(rolling, 0.0, *one, -CAR.cg_to_rear_axle, 0.0)[2] == pytest.approx(-0.05)


@settings(deadline=None)
@given(
    beta=st.floats(-0.8, 0.8), curvature=st.floats(-0.1, 0.1), x=st.floats(-2.0, 2.0), y=st.floats(-1.0, 1.0)
)
def test_doubt_is_that_of_many_draws_linearised(beta, curvature, x, y):
    """Against finite differences by beta and by curvature."""
    step, beta_std, curvature_std = 1e-6, 0.02, 0.005

    def direction(b, c):
        return point_velocity(b, 0.0, 20.0, c, 0.0, x, y)[2]

    by_beta = (direction(beta + step, curvature) - direction(beta - step, curvature)) / (2.0 * step)
    by_curvature = (direction(beta, curvature + step) - direction(beta, curvature - step)) / (2.0 * step)
    expected = math.hypot(by_beta * beta_std, by_curvature * curvature_std)
    doubt = point_velocity(beta, beta_std, 20.0, curvature, curvature_std, x, y)[3]
    assert doubt == pytest.approx(expected, rel=1e-5)


def test_a_missing_yaw_rate_is_held_and_doubted_ever_more():
    given = samples(200)
    given[20:, at.YAW_RATE] = np.nan
    motion = motion_of(start_motion(), given, CAR, DT)
    np.testing.assert_allclose(motion.curvature, 0.3 / 20.0)
    assert np.all(motion.curvature_std[:20] == 0.0)
    assert np.all(np.diff(motion.curvature_std[19:100]) > 0.0)
    assert motion.curvature_std[-1] == pytest.approx(MOST_YAW_DOUBT / 20.0)
    never = motion_of(
        start_motion(), np.where(np.arange(at.SAMPLE_WIDTH) == at.YAW_RATE, np.nan, samples()), CAR, DT
    )
    assert (never.curvature[0], never.curvature_std[0]) == (0.0, MOST_YAW_DOUBT / 20.0)


def test_a_point_has_an_answer_in_every_row_whatever_is_missing(artefact, log):
    frame = log.frame.copy()
    frame.loc[100:300, "yaw_rate"] = np.nan
    frame.loc[250:400, ["vx", "vfl", "vfr", "vrl", "vrr"]] = np.nan
    frame.loc[500:600, ["vx", "ax"]] = 0.0
    estimate = estimate_log(make_signals(frame, "gaps"), CAR, artefact)
    point = estimate.point_table(1.5, 0.3)
    assert np.isfinite(point.to_numpy()).all()
    assert (point["beta_std"] > 0.0).all()
    whole = estimate_log(log, CAR, artefact).point_table(1.5, 0.3)
    assert point["beta_std"][220] > 2.0 * whole["beta_std"][220]


def test_the_true_direction_of_an_axle_is_found(artefact):
    """Perfect sensors: the front axle of the simulated car moves as estimated there."""
    log = simulate_log(CAR, "slalom", 2, duration=10.0, faults=False)
    estimate = estimate_log(log, CAR, artefact)
    x = CAR.cg_to_front_axle
    true = np.arctan2(log.column("vy_ref") + x * log.column("yaw_rate"), log.column("vx_ref"))
    known = np.isfinite(true) & (log.column("vx_ref") > 4.0)
    error, at_centre = (estimate.at(x).beta - true)[known], (estimate.beta - log.beta_ref)[known]
    assert np.sqrt(np.mean(error**2)) < 1.2 * np.sqrt(np.mean(at_centre**2)) + 1e-3


# From the command line


@pytest.mark.parametrize(
    ("point", "place"), [("-1.3", (-1.3, 0.0)), ("1.1,-0.4", (1.1, -0.4)), ("0", (0.0, 0.0))]
)
def test_estimate_writes_a_point(crosscomb, write_log, log, artefact, tmp_path, point, place):
    path = write_log(log.frame, tmp_path / "a.csv")
    ran = crosscomb(
        "estimate", path, "--vehicle", "generic_compact", "--point", point, "-o", tmp_path / "out"
    )
    assert (ran.code, ran.err) == (0, "")
    table = pd.read_csv(tmp_path / "out" / "a.point.csv")
    assert list(table) == ["t", "vx", "vy", "beta", "beta_std"]
    log = make_signals(pd.read_csv(path), "a")
    expected = StreamingEstimator(CAR, artefact).take(log).point_table(*place)
    np.testing.assert_allclose(table.to_numpy(), expected.to_numpy(), rtol=1e-9, atol=1e-12)
    assert list(pd.read_csv(tmp_path / "out" / "a.estimate.csv")).count("vy") == 0


@pytest.mark.parametrize("point", ["front", "1;2", "1,2,3", "nan", "200", "", "1,"])
def test_a_wrong_point_is_refused(crosscomb, write_log, log, tmp_path, point):
    path = write_log(log.frame, tmp_path / "a.csv")
    ran = crosscomb("estimate", path, "--point", point, "-o", tmp_path / "out")
    assert ran.code == 2
    assert ran.err.startswith(f"error: --point {point}".rstrip())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("ending", ["point", "handling"])
def test_an_input_is_never_overwritten(crosscomb, write_log, log, tmp_path, ending):
    """A log may be called a.point.csv."""
    path = write_log(log.frame, tmp_path / "a.csv")
    other = write_log(log.frame, tmp_path / f"a.{ending}.csv")
    before = other.read_bytes()
    ran = crosscomb("estimate", path, other, "--point", "1", "--handling", "-o", tmp_path)
    assert ran.code == 2
    assert "would be overwritten" in ran.err
    assert other.read_bytes() == before

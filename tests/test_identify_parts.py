"""The parts of identification against independent answers; the command and the files it leaves."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import least_squares

from crosscomb.logs.channel_map import Channel, ChannelMap, apply_map, load_map
from crosscomb.logs.read import read_log
from crosscomb.models.magic_formula import magic_formula
from crosscomb.models.plant import make_plant
from crosscomb.models.tyres import rational_tyre
from crosscomb.models.tyres_combined import combined_forces
from crosscomb.models.vehicle import load_vehicle, parse_vehicle, vehicle_text
from crosscomb.signals import GRAVITY, Signals, make_signals
from crosscomb.training.identification.files import fitted_map, identified_recording
from crosscomb.training.identification.fit import Dependence, covariance, solve
from crosscomb.training.identification.identify import identified_vehicle, identify
from crosscomb.training.identification.response import Sensing, run_model
from crosscomb.training.identification.sensors import kinematics
from crosscomb.training.identification.trace import RATE, Trace, low_pass, make_trace, settled
from crosscomb.training.identification.tyres import AxleCurve, _curve
from crosscomb.training.recordings import Recording
from crosscomb.training.simulation.simulate import simulate_log
from replay import replay_linear

CAR = load_vehicle("generic_compact")
PLAIN = CAR.model_copy(
    update={
        "cg_height": 0.05,
        "roll_gradient": 0.0,
        "friction": 3.0,
        "tyre": CAR.tyre.model_copy(update={"relaxation_length": 0.06, "stiffness_peak_load": 100.0}),
        "plant": CAR.plant.model_copy(
            update={"compliance_front": 0.0, "differential_lock": 0.0, "steer_lag": 0.005}
        ),
    }
)
"""The same with all that makes it more than a linear single track taken away."""


def test_robust_fit_finds_what_scipy_finds() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 3.0, 400)
    seen = 2.0 * np.exp(-0.7 * t) + rng.normal(0.0, 0.05, 400)
    seen[::25] += 3.0

    def residuals(x: np.ndarray) -> np.ndarray:
        return (x[0] * np.exp(-x[1] * t) - seen) / 0.05

    def slopes(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        decay = np.exp(-x[1] * t)
        return residuals(x), np.column_stack([decay, -x[0] * t * decay]) / 0.05

    def beliefs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 1e-6 * x, 1e-6 * np.eye(2)

    found = solve(residuals, slopes, beliefs, np.array([1.0, 0.2]))
    reference = least_squares(residuals, [1.0, 0.2], loss="soft_l1", f_scale=2.0).x
    np.testing.assert_allclose(found, reference, rtol=2e-3)


def test_intervals_know_that_errors_last() -> None:
    rng, n, errors, claimed = np.random.default_rng(4), 1000, [], []
    for _ in range(60):
        z = np.zeros(n)
        for k in range(1, n):
            z[k] = 0.9 * z[k - 1] + np.sqrt(1.0 - 0.81) * rng.normal()
        ones, belief = np.ones((n, 1)), np.full((1, 1), 1e-3)
        dependence = Dependence(np.arange(n) // 40, [slice(0, n)])
        errors.append(z.mean())
        claimed.append(np.sqrt(covariance(z - z.mean(), ones, belief, dependence)[0, 0]))
    # Errors that last 19 rows: independent ones would claim a quarter of this.
    assert np.mean(claimed) == pytest.approx(np.std(errors), rel=0.4)


def test_model_is_the_linear_single_track_while_the_tyres_are_linear() -> None:
    log = simulate_log(CAR, "frequency_sweep", 4, 0.9, 12.0, spread=False, faults=False)
    log = log.with_columns(steer=0.1 * log.column("steer"), steer_wheel=np.full(len(log), np.nan))
    yaw_rate, beta = replay_linear(log, PLAIN)
    trace = make_trace(log.with_columns(yaw_rate=yaw_rate), PLAIN)
    assert trace is not None
    response = run_model(trace, trace.normal, make_plant(PLAIN), PLAIN.friction, Sensing())
    tau, rows = log.t - log.t[0], settled(trace.normal)
    assert rows.sum() > 200
    for mine, other in ((response.yaw_rate, yaw_rate), (response.beta, beta)):
        wanted = low_pass(tau, other, trace.t)
        assert np.std((mine - wanted)[rows]) < 0.05 * np.std(wanted[rows])


def test_a_linear_single_track_is_found_again() -> None:
    logs = []
    for manoeuvre, size in (("frequency_sweep", 0.5), ("slalom", 0.5), ("stop_and_go", 1.0)):
        log = simulate_log(PLAIN, manoeuvre, 11, 0.9, 20.0, spread=False, faults=False)
        log = log.with_columns(
            steer=size * log.column("steer"),
            steer_wheel=size * log.column("steer_wheel"),
            vx=log.column("vx_ref"),
        )
        yaw_rate, beta = replay_linear(log, PLAIN)
        # At walking pace the replay turns on the spot, which would be taken for an offset of the sensor.
        yaw_rate = np.where(log.column("vx") > 3.0, yaw_rate, 0.0)
        ay = log.column("vx") * (np.gradient(beta, log.t) + yaw_rate)
        logs.append(log.with_columns(yaw_rate=yaw_rate, ay=ay))
    given = {
        "cornering_stiffness_front": 1.3 * PLAIN.cornering_stiffness_front,
        "cornering_stiffness_rear": 0.8 * PLAIN.cornering_stiffness_rear,
        "steering_ratio": 1.1 * PLAIN.steering_ratio,
    }
    result = identify(logs, PLAIN.model_copy(update=given), use_reference=False)
    for name in given:
        wanted = getattr(PLAIN, name)
        bar = 0.005 if name == "steering_ratio" else 0.025
        assert result.judgements[name].after == pytest.approx(wanted, rel=bar), name
    # The replay's tyres have no relaxation length, which a vehicle file cannot say.
    assert result.judgements["yaw_delay"].after == pytest.approx(0.0, abs=0.005)
    assert result.judgements["ay_delay"].after == pytest.approx(0.0, abs=0.005)


def test_ground_truth_alone_tells_position_and_latencies() -> None:
    traces = []
    for manoeuvre in ("frequency_sweep", "slalom"):
        log = simulate_log(CAR, manoeuvre, 5, 0.9, 25.0, spread=False, faults=False)
        felt = log.column("ay") - 1.2 * np.gradient(log.column("yaw_rate"), log.t)
        late = log.with_columns(
            ay=np.interp(log.t - 0.015, log.t, felt) + 0.2,
            yaw_rate=np.interp(log.t - 0.04, log.t, log.column("yaw_rate")),
        )
        traces.append(make_trace(late, CAR))
    assert None not in traces
    found = kinematics([trace for trace in traces if trace is not None], [{}, {}], CAR)
    assert found is not None
    assert found.position[0] == pytest.approx(-1.2, abs=0.05)
    assert found.ay_delay[0] == pytest.approx(0.015, abs=0.003)
    assert found.yaw_delay[0] == pytest.approx(0.04, abs=0.003)
    assert found.roll_gradient[0] == pytest.approx(CAR.roll_gradient, abs=5e-4)


def test_tyre_curve_gives_back_the_law_it_came_from() -> None:
    rng = np.random.default_rng(6)
    slip, load = rng.uniform(-0.14, 0.14, 4000), 8000.0
    car = CAR.model_copy(update={"friction": 0.9})
    c1, c2 = 0.008, 90e3
    force = np.array([rational_tyre(s, c1, c2, 0.9, 1.0)[0] for s in slip]) / load + rng.normal(
        0.0, 0.03, 4000
    )
    curve = _curve(slip, force, load, car, 0.9 * c2)
    assert curve.rational is not None
    assert curve.rational["c1"][0] == pytest.approx(c1, rel=0.1)
    assert curve.rational["c2"][0] == pytest.approx(c2, rel=0.05)
    gentle = np.abs(slip) < 0.03
    assert _curve(slip[gentle], force[gentle], load, car, 0.9 * c2).magic is None


@pytest.fixture(scope="module")
def slid() -> dict[str, AxleCurve]:
    """Tyre curves from slides on known tyres."""
    drives = (
        ("frequency_sweep", 5),
        ("slalom", 6),
        ("ramp_steer", 7),
        ("step_steer", 8),
        ("slalom_limit", 9),
    )
    logs = [simulate_log(CAR, name, seed, 0.9, 25.0, spread=False, faults=False) for name, seed in drives]
    tyres = identify(logs, CAR).tyres
    assert tyres is not None
    return tyres


def known_axle(axle: str) -> tuple[np.ndarray, np.ndarray]:
    """Slip angle [rad] and force over load of an axle in steady cornering, from its tyres."""
    plant = make_plant(CAR)
    if axle == "front":
        tyre, share, half_track = plant.tyre_front, plant.roll_share_front, plant.half_track_front
        compliance = plant.compliance_front
    else:
        tyre, share, half_track = plant.tyre_rear, 1.0 - plant.roll_share_front, plant.half_track_rear
        compliance = plant.compliance_rear
    slips, forces = np.tan(np.radians(np.arange(0.5, 13.0, 0.1))), []
    for slip in slips:
        force = 0.0
        for _ in range(20):
            ay = GRAVITY * force / (2.0 * tyre.load)
            across = 0.5 * CAR.mass * CAR.cg_height * ay * share / half_track
            force = sum(
                combined_forces(0.0, slip, tyre.load + side * across, CAR.friction, tyre)[1]
                for side in (-1.0, 1.0)
            )
        forces.append(force)
    return np.arctan(slips) + compliance * np.array(forces), np.array(forces) / (2.0 * tyre.load)


def test_slides_give_the_magic_formula_of_the_tyres(slid: dict[str, AxleCurve]) -> None:
    curve = slid["front"]
    assert np.degrees(curve.slip[-1]) > 8.0
    assert curve.magic is not None
    b, c, d = (curve.magic[key][0] for key in "BCD")
    # Load transfer takes a few percent of the axle's peak, and the shape is only told by what lies behind it.
    assert b * c * d * curve.load == pytest.approx(CAR.cornering_stiffness_front, rel=0.08)
    assert d == pytest.approx(CAR.friction, rel=0.06)
    assert c == pytest.approx(CAR.tyre.shape, rel=0.15)
    for slip in np.radians([1.0, 3.0, 5.0, 8.0]):
        fitted = magic_formula(slip, b, c, d, CAR.tyre.curvature)[0]
        assert fitted == pytest.approx(np.interp(slip, *known_axle("front")), abs=0.04)


@pytest.mark.parametrize("axle", ["front", "rear"])
def test_slides_give_the_rational_law_of_the_tyres(slid: dict[str, AxleCurve], axle: str) -> None:
    curve = slid[axle]
    assert curve.rational is not None
    c1, c2 = (curve.rational[key][0] for key in ("c1", "c2"))
    # The law falls faster behind its peak than these tyres do.
    for slip in np.radians([1.0, 2.0, 3.0, 4.0]):
        fitted = rational_tyre(slip, c1, c2, CAR.friction, 1.0)[0] / curve.load
        assert fitted == pytest.approx(np.interp(slip, *known_axle(axle)), abs=0.06)


def foreign(log: Signals) -> pd.DataFrame:
    """The log as a bus would write it: a hand-wheel angle in degrees, positive to the right."""
    frame = log.frame.drop(columns=["steer"]).rename(columns={"steer_wheel": "SWA"})
    return frame.assign(SWA=-np.degrees(frame["SWA"]))


def test_the_fitted_map_contains_the_map_the_logs_were_read_with() -> None:
    base = ChannelMap(
        channels={
            "steer_wheel": Channel(column="SWA", unit="deg", sign=-1),
            "yaw_rate": Channel(offset=0.01, delay=0.02),
        }
    )
    logs = [
        simulate_log(CAR, name, 7, 0.9, 20.0, spread=False, faults=False)
        for name in ("frequency_sweep", "slalom", "stop_and_go")
    ]
    # The sensor reads 0.015 too much; the map knows of 0.01.
    raw = [foreign(log).assign(yaw_rate=lambda f: f["yaw_rate"] + 0.015) for log in logs]
    read = [apply_map(frame, base, log.name) for frame, log in zip(raw, logs, strict=True)]
    result = identify(read, CAR)
    fitted = fitted_map(result, base)
    assert fitted.channels["yaw_rate"].offset == pytest.approx(0.015, abs=1e-3)
    assert fitted.channels["yaw_rate"].delay >= 0.02
    again = apply_map(raw[1], fitted, "again")
    steer, late = logs[1].column("steer"), max(channel.delay for channel in fitted.channels.values())
    true = np.interp(logs[1].t - (late - fitted.channels["steer"].delay), logs[1].t, steer)
    rows = np.isfinite(again.column("steer"))
    assert np.std((again.column("steer") - true)[rows]) < 0.02 * np.std(steer)


def test_vehicle_text_is_the_vehicle() -> None:
    text = vehicle_text(CAR, {"mass": "weighed", "tyre.shape": "fitted"})
    assert parse_vehicle(text, "text") == CAR
    assert "# weighed" in text
    assert "# fitted" in text


def test_recordings_that_say_nothing_change_nothing() -> None:
    log = simulate_log(CAR, "straight", 3, 0.9, 15.0, spread=False)
    parked = Recording("parked", Path("parked.csv"), CAR, log.with_columns(vx=np.zeros(len(log))))
    assert identified_vehicle([parked], CAR) == CAR
    assert identified_recording(parked, []) is parked


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of logs of one car, with the vehicle file of another."""
    place = tmp_path_factory.mktemp("drives")
    for name in ("frequency_sweep", "slalom"):
        log = simulate_log(CAR, name, 8, 0.9, 20.0, spread=False)
        log.frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]).to_csv(place / f"{name}.csv", index=False)
    given = CAR.model_copy(update={"steering_ratio": 18.0})
    (place / "vehicle.toml").write_text(vehicle_text(given), encoding="utf-8")
    return place


def test_identify_writes_what_estimate_takes(folder: Path, tmp_path: Path, crosscomb: Callable) -> None:
    given = folder / "vehicle.toml"
    untouched = given.read_bytes()
    fitted = tmp_path / "fitted.toml"
    ran = crosscomb("identify", folder, "--vehicle", given, "-o", fitted)
    assert ran.code == 0, ran.err
    assert "steering_ratio" in ran.out
    assert given.read_bytes() == untouched
    assert load_vehicle(fitted).steering_ratio == pytest.approx(CAR.steering_ratio, rel=0.03)
    assert load_map(tmp_path / "fitted.map.toml").channels["steer"].column == "steer_wheel"
    table = pd.read_csv(tmp_path / "fitted.csv")
    assert list(table.columns) == ["parameter", "unit", "before", "after", "low_95", "high_95", "word"]
    assert (tmp_path / "fitted.motion.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "fitted.tyres.png").exists()
    assert (tmp_path / "fitted.run.json").exists()
    words = ("estimate", folder / "slalom.csv", "--vehicle", fitted, "--map", tmp_path / "fitted.map.toml")
    assert crosscomb(*words, "-o", tmp_path / "estimates").code == 0
    first = {path.name: path.read_bytes() for path in tmp_path.glob("fitted.*")}
    assert crosscomb("identify", folder, "--vehicle", given, "-o", fitted).code == 0
    assert {path.name: path.read_bytes() for path in tmp_path.glob("fitted.*")} == first


def test_identify_never_overwrites_the_vehicle_file(folder: Path, crosscomb: Callable) -> None:
    given = folder / "vehicle.toml"
    untouched = given.read_bytes()
    ran = crosscomb("identify", folder, "--vehicle", given, "-o", given)
    assert ran.code == 2
    assert "would be overwritten" in ran.err
    assert given.read_bytes() == untouched
    wrong = crosscomb("identify", folder, "--vehicle", given, "-o", folder / "fitted.json")
    assert (wrong.code, "let its name end in .toml" in wrong.err) == (2, True)


def test_a_gap_in_a_log_is_not_driven_through() -> None:
    log = simulate_log(CAR, "slalom", 9, 0.9, 20.0, spread=False)
    hole = (log.t > 8.0) & (log.t < 9.0)
    torn = replace(log, frame=log.frame[~hole].reset_index(drop=True))
    trace = make_trace(make_signals(torn.frame, "torn"), CAR)
    assert isinstance(trace, Trace)
    inside = (trace.t > 8.05) & (trace.t < 8.95)
    assert inside.sum() > 0.8 * RATE
    assert not trace.normal[inside].any()
    assert not settled(trace.normal)[(trace.t > 9.0) & (trace.t < 9.5)].any()


def test_read_log_needs_no_truth_to_be_identified(folder: Path) -> None:
    logs = [read_log(path) for path in sorted(folder.glob("*.csv"))]
    result = identify(logs, CAR)
    assert result.kinematics is None
    assert "beta_delay" not in result.judgements

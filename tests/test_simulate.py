"""Simulated logs are what training needs: repeatable, balanced, with slides, seen by production sensors."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from crosscomb.errors import UsageError
from crosscomb.models.plant import make_plant
from crosscomb.models.vehicle import Plant, Vehicle, load_vehicle
from crosscomb.signals import GRAVITY, make_signals
from crosscomb.training.simulation.manoeuvres import MANOEUVRES, NORMAL, REAR
from crosscomb.training.simulation.presets import PRESETS, plan_jobs
from crosscomb.training.simulation.road import SURFACES, level_road
from crosscomb.training.simulation.scene import Scene
from crosscomb.training.simulation.schedule import AX, AY, PATH_HEADING, PATH_Y, PROFILE, SLIDE, Driver
from crosscomb.training.simulation.simulate import run_script, simulate_data_set, simulate_log
from drives import TEST_CAR as CAR

DRIVER = Driver(preview=0.6, steer_rate=1.0, acceleration=3.0, deceleration=5.0, wheel_spin=0.5)


def car_with(layout: str) -> Vehicle:
    return CAR.model_copy(update={"plant": Plant(drive=layout)})


def longest_run(inside: np.ndarray) -> float:
    """Longest unbroken stretch [s] of a 100 Hz condition."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(int), [0]))))
    return max(edges[1::2] - edges[::2], default=0) / 100.0


def scene(manoeuvre: str, friction: float, seconds: float = 10.0, seed: int = 3):
    plant = make_plant(car_with("rear"))
    road = level_road(np.full(round(seconds * 100), friction))
    return plant, MANOEUVRES[manoeuvre](Scene(plant, 36.0, road, np.random.default_rng(seed)))


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
@pytest.mark.parametrize("surface", ["dry", "jump"])
def test_every_manoeuvre_gives_a_whole_log(manoeuvre, surface):
    log = simulate_log(CAR, manoeuvre, 5, surface=surface, duration=12.0)
    assert list(log.frame) == (
        [
            "t",
            "vx",
            "ax",
            "ay",
            "yaw_rate",
            "steer",
            "steer_wheel",
            "vfl",
            "vfr",
            "vrl",
            "vrr",
            "beta_ref",
            "vx_ref",
            "vy_ref",
        ]
    )
    assert len(log) == 1200
    missing = log.frame.drop(columns="beta_ref").isna().mean()
    assert not missing[["t", "vx_ref", "vy_ref"]].any()
    assert missing.max() < 0.12
    fast = np.hypot(log.column("vx_ref"), log.column("vy_ref")) > 1.0
    assert fast.any()
    np.testing.assert_array_equal(np.isfinite(log.column("beta_ref")), fast)


@pytest.mark.parametrize("layout", ["front", "rear", "all"])
@pytest.mark.parametrize("surface", ["dry", "snow"])
def test_drifts_are_held_for_seconds(layout, surface):
    for seed in range(3):
        log = simulate_log(car_with(layout), "drift", seed, surface=surface)
        beta = np.abs(np.degrees(log.column("beta_ref")))
        assert longest_run((beta > 9.0) & (beta < 35.0)) > 2.0


def test_driver_counter_steers_in_a_drift():
    log = simulate_log(car_with("rear"), "drift", 1, surface="dry", faults=False)
    sliding = np.abs(np.degrees(log.column("beta_ref"))) > 12.0
    assert sliding.sum() > 300
    against = np.sign(log.column("steer")) == -np.sign(log.column("yaw_rate"))
    assert np.mean(against[sliding]) > 0.7


@pytest.mark.parametrize("manoeuvre", NORMAL)
def test_normal_driving_does_not_slide(manoeuvre):
    for seed, surface in enumerate(("dry", "wet", "snow")):
        log = simulate_log(CAR, manoeuvre, seed, surface=surface)
        moving = log.column("vx_ref") > 3.0
        # At low speed on tight bends beta is geometry: rear-axle distance over radius.
        geometric = np.arctan(
            CAR.cg_to_rear_axle * log.column("yaw_rate") / np.maximum(log.column("vx_ref"), 3.0)
        )
        assert np.nanmax(np.abs(np.degrees(log.beta_ref - geometric))[moving]) < 6.0
        assert np.nanmax(np.abs(log.column("vx") - log.column("vx_ref"))[moving]) < 1.5


@pytest.mark.parametrize("manoeuvre", ["lap_limit", "drift", "road_slide", "brake_in_turn"])
@pytest.mark.parametrize("friction", [0.3, 0.95])
def test_acceleration_is_bounded_by_friction(manoeuvre, friction):
    plant, script = scene(manoeuvre, friction, 20.0)
    truth = run_script(script, plant, DRIVER)
    total = np.hypot(truth[:, AX] + plant.drag / plant.mass * truth[:, 0] ** 2, truth[:, AY])
    assert total.max() < 1.03 * friction * GRAVITY
    assert total.max() > 0.6 * friction * GRAVITY


@pytest.mark.parametrize("manoeuvre", ["step_steer", "country_road", "drift"])
def test_mirrored_manoeuvre_gives_mirrored_motion(manoeuvre):
    plant, script = scene(manoeuvre, 0.9)
    left = run_script(script, plant, DRIVER)
    script.schedule[:, [PROFILE, SLIDE]] *= -1.0
    script.path = script.path * np.where(np.isin(np.arange(4), [PATH_Y, PATH_HEADING]), -1.0, 1.0)
    right = run_script(script, plant, DRIVER)
    assert np.abs(left[:, 1]).max() > 0.1
    np.testing.assert_allclose(left[:, 0], right[:, 0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(left[:, [1, 2, AY]], -right[:, [1, 2, AY]], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("manoeuvre", ["lap_limit", "drift"])
def test_half_the_step_changes_no_beta_with_the_driver_in_the_loop(manoeuvre):
    plant, script = scene(manoeuvre, 0.9)
    whole, half = (run_script(script, plant, DRIVER, step) for step in (0.001, 0.0005))
    beta, beta_half = (np.degrees(np.arctan2(x[:, 1], x[:, 0])) for x in (whole, half))
    assert np.abs(beta).max() > 1.0
    assert np.abs(beta - beta_half).max() < 0.01


def test_accelerometer_feels_the_roll_of_the_body():
    log = simulate_log(CAR, "circle", 2, friction=0.9, faults=False)
    kinematic = np.gradient(log.column("vy_ref"), 0.01) + log.column("vx_ref") * log.column("yaw_rate")
    steady = slice(500, None)
    slope = np.polyfit(kinematic[steady], log.column("ay")[steady], 1)[0]
    assert slope == pytest.approx(1.0 + GRAVITY * CAR.roll_gradient, rel=0.02)


def test_production_sensors_are_off_by_what_is_documented():
    perfect = simulate_log(CAR, "straight", 4, faults=False, duration=30.0)
    faulty = simulate_log(CAR, "straight", 4, duration=30.0)
    assert np.std(np.diff(faulty.column("yaw_rate"))) > 0.0005 > np.std(np.diff(perfect.column("yaw_rate")))
    means = [simulate_log(CAR, "slalom", seed, duration=6.0).frame.mean() for seed in range(8)]
    scales = [mean["vx"] / mean["vx_ref"] for mean in means]
    assert 0.985 < min(scales) < max(scales) < 1.006
    assert max(scales) - min(scales) > 0.002


def test_stop_and_go_stops_and_goes():
    log = simulate_log(CAR, "stop_and_go", 1, surface="dry")
    speed = log.column("vx_ref")
    assert speed[0] == 0.0
    assert speed.max() > 4.0
    assert longest_run(np.abs(speed) < 0.05) > 1.0


def test_log_is_repeatable_and_seeds_differ():
    one, again, other = (simulate_log(CAR, "town", seed, duration=8.0) for seed in (7, 7, 8))
    pd.testing.assert_frame_equal(one.frame, again.frame, check_exact=True)
    assert not one.frame.equals(other.frame)


def test_given_friction_is_used():
    log = simulate_log(CAR, "step_steer", 3, friction=0.4, faults=False)
    assert np.abs(log.column("vx_ref") * log.column("yaw_rate")).max() < 0.4 * GRAVITY * 1.3


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"manoeuvre": "loop"}, "road"),
        ({"surface": "moon"}, "snow"),
        ({"duration": 1.0}, "5 to 3600"),
        ({"friction": -0.3}, "0.05"),
        ({"sensors": "magic"}, "production"),
    ],
)
def test_wrong_requests_are_refused_with_the_mend(change, word):
    request = {"manoeuvre": "lap", **change}
    with pytest.raises(UsageError, match=word):
        simulate_log(CAR, seed=1, **request)


def test_jobs_are_balanced():
    jobs = plan_jobs(CAR, 40)
    counts = [sum(job.kind == kind for job in jobs) for kind in ("normal", "limit", "sliding")]
    assert counts == [16, 16, 8]
    assert len({job.name for job in jobs}) == 40
    surfaces = {job.surface for job in jobs if job.kind == "sliding"}
    assert {"dry", "wet", "snow"} <= surfaces


def test_data_set_is_the_same_bytes_whatever_the_jobs(tmp_path):
    ticks = []
    one = simulate_data_set(CAR, tmp_path / "a", 11, 4, progress=lambda: ticks.append(1))
    two = simulate_data_set(CAR, tmp_path / "b", 11, 4, jobs=2)
    assert len(ticks) == 4
    assert [p.name for p in one] == [p.name for p in two]
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == sorted([*(p.name for p in one), "vehicle.toml", "dataset.json"])
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_data_set_is_complete(tmp_path):
    paths = simulate_data_set(CAR, tmp_path, 2, 3)
    for path in paths:
        log = make_signals(pd.read_csv(path), path.name)
        assert log.has_reference
    assert load_vehicle(tmp_path / "vehicle.toml") == CAR
    card = json.loads((tmp_path / "dataset.json").read_text())
    assert card["seed"] == 2
    assert [entry["log"] + ".csv.gz" for entry in card["logs"]] == [p.name for p in paths]
    assert card["logs"][2]["max_beta_deg"] > 5.0


def test_card_tells_a_spin_from_a_slide(tmp_path):
    simulate_data_set(car_with("rear"), tmp_path, 1, 12)
    card = json.loads((tmp_path / "dataset.json").read_text())
    for entry in card["logs"]:
        log = pd.read_csv(tmp_path / f"{entry['log']}.csv.gz")
        backwards = (log["vx_ref"] < 0.0) & (np.hypot(log["vx_ref"], log["vy_ref"]) > 3.0)
        assert entry["spun"] is bool(backwards.any())
    assert {entry["spun"] for entry in card["logs"]} == {True, False}


def test_folder_with_logs_needs_force_and_keeps_foreign_logs(tmp_path):
    first = simulate_data_set(CAR, tmp_path, 1, 3)
    (tmp_path / "mine.csv").write_text("t\n0\n")
    with pytest.raises(UsageError, match="`force`"):
        simulate_data_set(CAR, tmp_path, 1, 1)
    assert all(p.exists() for p in first)
    second = simulate_data_set(CAR, tmp_path, 5, 1, force=True)
    logs = {p.name for p in tmp_path.iterdir() if p.name.endswith((".csv", ".csv.gz"))}
    assert logs == {second[0].name, "mine.csv"}


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_holds_what_it_says(preset):
    steered = car_with("rear").model_copy(update={"plant": Plant(drive="rear", max_steer_rear=0.06)})
    jobs = plan_jobs(steered, 120, preset)
    assert {job.surface for job in jobs} == set(PRESETS[preset].surfaces)
    wanted = set(PRESETS[preset].manoeuvres or MANOEUVRES)
    assert {job.manoeuvre for job in jobs} == wanted
    # A car whose rear axle does not steer is not asked to.
    assert not {job.manoeuvre for job in plan_jobs(CAR, 120, preset)} & set(REAR)


def test_full_preset_spreads_every_surface_over_every_kind():
    jobs = plan_jobs(CAR, 200)
    for kind in ("normal", "limit", "sliding"):
        assert {job.surface for job in jobs if job.kind == kind} == set(SURFACES)
    with pytest.raises(UsageError, match="quick"):
        plan_jobs(CAR, 5, "huge")


def test_normal_driving_covers_everyday_accelerations_and_speeds():
    turning, speed = [], []
    for job in plan_jobs(CAR, 60):
        if job.kind == "normal" and job.surface in ("dry", "wet"):
            log = simulate_log(CAR, job.manoeuvre, job.number, surface=job.surface, faults=False)
            moving = log.column("vx_ref") > 3.0
            speed.append(log.column("vx_ref")[moving])
            turning.append(np.abs(log.column("ay") / GRAVITY)[moving])
    turning, speed = np.concatenate(turning), np.concatenate(speed)
    for low, high, share in ((0.0, 0.1, 0.2), (0.1, 0.2, 0.1), (0.2, 0.3, 0.1), (0.3, 0.4, 0.05)):
        assert np.mean((turning >= low) & (turning < high)) > share
    for low, high, share in ((3.0, 8.0, 0.1), (8.0, 15.0, 0.1), (15.0, 25.0, 0.05), (25.0, 50.0, 0.03)):
        assert np.mean((speed >= low) & (speed < high)) > share


@pytest.mark.parametrize("layout", ["front", "rear"])
def test_slides_on_a_road_are_mostly_caught(layout):
    logs = [
        simulate_log(car_with(layout), "road_slide", seed, surface="dry", faults=False) for seed in range(8)
    ]
    beta = [np.nanmax(np.abs(np.degrees(log.beta_ref[log.column("vx_ref") > 3.0]))) for log in logs]
    assert sum(value > 8.0 for value in beta) >= 5
    spins = sum(bool(np.any(log.column("vx_ref") < -3.0)) for log in logs)
    assert spins <= 2
    # The driver goes on after a slide: no log ends in a crawl.
    assert np.mean([np.mean(log.column("vx_ref") > 5.0) for log in logs]) > 0.85


def test_reversing_goes_backwards_under_control():
    log = simulate_log(CAR, "reversing", 3, faults=False)
    speed = log.column("vx_ref")
    assert speed.min() < -0.8
    assert speed.max() > 2.0
    backwards = speed < -0.8
    turned = speed[backwards] * np.tan(log.column("steer")[backwards]) / CAR.wheelbase
    assert np.corrcoef(turned, log.column("yaw_rate")[backwards])[0, 1] > 0.9
    assert np.corrcoef(log.column("vx"), speed)[0, 1] > 0.99


def test_rear_steering_is_logged_where_the_car_has_it():
    steered = CAR.model_copy(update={"plant": Plant(max_steer_rear=0.06)})
    log = simulate_log(steered, "rear_steer", 2, duration=15.0)
    assert np.abs(log.column("steer_rear")).max() > 0.003
    assert not simulate_log(CAR, "slalom", 2, duration=6.0).has("steer_rear")


def test_some_logs_lose_messages_and_say_so_by_missing_values():
    logs = [simulate_log(CAR, "slalom", seed, duration=6.0) for seed in range(24)]
    lossy = [log for log in logs if log.frame.drop(columns="beta_ref").isna().any(axis=None)]
    assert 1 <= len(lossy) <= 10
    for log in lossy:
        assert np.all(np.isfinite(log.column("vx_ref")))


def test_bank_is_felt_by_the_accelerometer_without_turning():
    plant = make_plant(CAR)
    n = 600
    flat = np.zeros(n)
    friction = np.full(n, 0.9)
    road = replace(level_road(friction), bank=flat + 0.05)
    script = MANOEUVRES["straight"](Scene(plant, 36.0, road, np.random.default_rng(1)))
    truth = run_script(script, plant, DRIVER)
    assert np.mean(truth[200:, AY]) == pytest.approx(GRAVITY * 0.05, rel=0.15)
    assert abs(np.mean(truth[200:, 2])) < 0.01


def test_test_grade_sensors_are_better_than_production_ones_but_shake_more():
    offset, speed, shake = {}, {}, {}
    perfect = [simulate_log(CAR, "straight", s, duration=10.0, faults=False) for s in range(12)]
    for sensors in ("production", "test"):
        logs = [simulate_log(CAR, "straight", s, duration=10.0, sensors=sensors) for s in range(12)]
        yaw_rates = [
            log.column("yaw_rate") - true.column("yaw_rate") for log, true in zip(logs, perfect, strict=True)
        ]
        offset[sensors] = np.std([np.nanmean(error) for error in yaw_rates])
        speed[sensors] = np.std([np.nanmean(log.column("vx") - log.column("vx_ref")) for log in logs])
        shake[sensors] = np.median([np.nanstd(np.diff(log.column("ay"))) for log in logs])
    assert offset["test"] < 0.6 * offset["production"]
    assert speed["test"] < 0.3 * speed["production"]
    assert shake["test"] > 1.5 * shake["production"]


def test_card_says_how_the_set_is_distributed_and_what_slides_change(tmp_path):
    simulate_data_set(CAR, tmp_path, 4, 5, preset="quick")
    card = json.loads((tmp_path / "dataset.json").read_text())
    assert card["preset"] == "quick"
    for shares in (card["distribution"][key] for key in ("beta_deg", "turning_g", "speed_m_s")):
        assert sum(shares.values()) == pytest.approx(1.0, abs=2e-3)
    assert card["spread"]["changed_for_slides"]["least_power_W_per_kg"] == 120.0
    assert all(entry["duration_s"] == pytest.approx(19.99) for entry in card["logs"])


def test_vehicle_file_of_the_set_is_valid_toml_with_its_truth_values(tmp_path):
    car = CAR.model_copy(update={"plant": Plant(anti_lock=False, traction_control=True)})
    simulate_data_set(car, tmp_path, 4, 1, preset="quick")
    plant = tomllib.loads((tmp_path / "vehicle.toml").read_text(encoding="utf-8"))["plant"]
    assert plant["anti_lock"] is False
    assert plant["traction_control"] is True
    assert load_vehicle(tmp_path / "vehicle.toml") == car

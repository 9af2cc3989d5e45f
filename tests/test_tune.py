"""Tuning: finds wrong noise back, helps on logs it has not seen, refuses what does not, and says so."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import multivariate_normal, norm

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs, Started, make_inputs
from crosscomb.filters.catalogue import CATALOGUE, make_filter, settings_of
from crosscomb.filters.kinematic.kf import KinematicKF, KinematicNoise
from crosscomb.filters.random_walk.pf import RandomWalkPF
from crosscomb.filters.random_walk.shared import ParticleNoise
from crosscomb.filters.single_track.ekf import DynamicEKF, DynamicNoise
from crosscomb.models.kinematic import input_gain, rotation
from crosscomb.models.single_track import body_rates, single_track_rates
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.run.tuned import Tuned, TunedNoise, load_tuned, save_tuned, with_tuned
from crosscomb.selection.artefact import FilterSettings, load_artefact
from crosscomb.signals import Signals, make_signals
from crosscomb.training.recordings import Recording
from crosscomb.training.tuning import tune as tune_module
from crosscomb.training.tuning.first import keep_what_complements, tuned_entries
from crosscomb.training.tuning.noise import RANGE, noise_space
from crosscomb.training.tuning.scores import ERROR, LIKELIHOOD, TuneLog, losses, prepare, score_logs
from crosscomb.training.tuning.surrogate import minimise
from crosscomb.training.tuning.tune import is_tunable, tune

GOLF = load_vehicle("golf_gti_2018")
DT = 0.01
RATE = 100.0


def entry(name: str, **noise: float) -> FilterSettings:
    """A filter with all its settings, some of its noise changed."""
    settings = settings_of(make_filter(name, GOLF, {"noise": noise}))
    return FilterSettings(name=name, settings=settings)


# The search


def test_the_search_finds_the_minimum_of_a_jagged_bowl():
    target = np.array([0.4, -0.6, 0.1])

    def bowl(point: np.ndarray) -> float:
        return float(np.sum((point - target) ** 2) + 0.003 * np.sin(60.0 * point).sum())

    found = minimise(bowl, 3, 30, seed=1)
    assert np.abs(found.point - target).max() < 0.15
    assert found.value == bowl(found.point)
    assert found.evaluations <= 60
    again = minimise(bowl, 3, 30, seed=1)
    assert again.point.tolist() == found.point.tolist()


def test_the_search_stops_early_where_there_is_nothing_to_find():
    found = minimise(lambda point: 1.0, 2, 60, seed=0)
    assert found.evaluations < 60
    assert found.point.tolist() == [0.0, 0.0]


def test_the_search_stays_in_its_box_and_begins_in_the_middle():
    seen = []

    def corner(point: np.ndarray) -> float:
        seen.append(point)
        return float(-point.sum())

    found = minimise(corner, 4, 20, seed=0)
    assert seen[0].tolist() == [0.0] * 4
    assert np.abs(np.array(seen)).max() <= 1.0
    assert found.point.min() > 0.5


# What is tuned


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_filter_can_be_made_from_both_ends_of_its_noise(name):
    noise = settings_of(make_filter(name, GOLF))["noise"]
    space = noise_space(noise)
    assert space.noise_at(np.zeros(space.dimensions)) == noise
    for end in (-1.0, 1.0):
        made = settings_of(make_filter(name, GOLF, {"noise": space.noise_at(np.full(space.dimensions, end))}))
        for path in space.paths:
            was, now = noise, made["noise"]
            for key in path:
                was, now = was[key], now[key]
            assert now == pytest.approx(was * RANGE**end, rel=1e-3)
    assert is_tunable(name, ERROR) == (not name.startswith("network"))


def test_one_recording_cannot_outvote_many():
    before = np.ones(10)
    gains = np.full(10, 1.1)
    gains[0] = 1e-3
    assert losses(gains, before, ERROR).mean() > -0.13
    harm = np.full(10, 0.9)
    harm[0] = 20.0
    assert losses(harm, before, ERROR).mean() > 0.0
    assert losses(before, before, ERROR).tolist() == [0.0] * 10


# Likelihood


def kinematic_noise(**noise: float) -> KinematicNoise:
    """Noise of a kinematic filter that measures nothing but vx."""
    return KinematicNoise(disagreement=1e-9, **noise)


def kinematic_model(sample: np.ndarray, noise: KinematicNoise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transition (4, 4), input (4,) and process noise (4, 4) of the kinematic filter over a sample."""
    keep = np.exp(-DT / noise.bias_time)
    gain = np.reshape(input_gain(sample[at.YAW_RATE], DT), (2, 2))
    step = np.diag([1.0, 1.0, keep, keep])
    step[:2, :2], step[:2, 2:] = np.reshape(rotation(sample[at.YAW_RATE], DT), (2, 2)), -gain
    held = np.concatenate([gain @ sample[[at.AX, at.AY]], np.zeros(2)])
    drift = noise.accel_bias**2 * (1.0 - keep**2)
    across = noise.accel**2 + (noise.ay_scale * sample[at.AY]) ** 2
    return step, held, np.diag([noise.accel**2 * DT, across * DT, drift, drift])


def kinematic_log(noise: KinematicNoise, seed: int, steps: int = 3000) -> Signals:
    """A drive of the kinematic filter's own model with the noise that it assumes."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.YAW_RATE], samples[:, at.AY], samples[:, at.AX] = (
        0.3 * np.sin(0.8 * t),
        6.0 * np.sin(0.8 * t),
        np.cos(t),
    )
    states = np.empty((steps, 4))
    states[0] = 20.0, 0.0, *rng.normal(0.0, noise.accel_bias, 2)
    for k in range(1, steps):
        step, held, added = kinematic_model(samples[k], noise)
        states[k] = step @ states[k - 1] + held + rng.normal(0.0, np.sqrt(np.diag(added)))
    frame = pd.DataFrame(samples[:, [at.AX, at.AY, at.YAW_RATE]], columns=["ax", "ay", "yaw_rate"])
    vx = states[:, 0] + rng.normal(0.0, noise.speed, steps)
    beta = np.arctan2(states[:, 1], states[:, 0])
    return make_signals(frame.assign(t=t, vx=vx, steer=0.0, beta_ref=beta), f"log {seed}")


def inputs_of(signals: Signals) -> Inputs:
    """Samples of a log as filters take them."""
    return make_inputs(signals, GOLF, DT)


def test_the_likelihood_of_the_kalman_filter_is_that_of_all_measurements_at_once():
    noise = kinematic_noise(accel=0.4, speed=0.2, bias_time=2.0)
    inputs = inputs_of(kinematic_log(noise, seed=1, steps=12))
    filter_ = KinematicKF(GOLF, noise)
    # The joint Gaussian of all vx, from the start on the first sample: its mean and covariance by the model.
    mean = np.array([inputs.samples[0, at.VX], 0.0, 0.0, 0.0])
    start = np.diag([noise.speed, inputs.samples[0, at.VX] * np.radians(2.0), *[noise.accel_bias] * 2]) ** 2
    effect, added, means, rows = [np.eye(4)], [start], [], []
    for sample in inputs.samples[1:]:
        step, held, spread = kinematic_model(sample, noise)
        mean = step @ mean + held
        effect = [step @ part for part in effect] + [np.eye(4)]
        added.append(spread)
        means.append(mean[0])
        rows.append([part[0] for part in effect])
    n = len(rows)
    covariance = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            shared = zip(rows[i], rows[j], added, strict=False)
            covariance[i, j] = sum(left @ spread @ right for left, right, spread in shared)
    covariance += np.eye(n) * noise.speed**2
    expected = multivariate_normal(means, covariance).logpdf(inputs.samples[1:, at.VX])
    assert filter_.log_likelihood(inputs) == pytest.approx(expected, rel=1e-6)


def test_the_likelihood_of_the_particle_filter_is_the_mean_density_of_its_particles():
    noise = ParticleNoise(yaw_rate=0.3, accel=3.0, pseudo=1e3)
    filter_ = RandomWalkPF(GOLF, noise, particles=200, forces="drawn")
    state = filter_.make_state()._replace(evidence=np.zeros(1))
    samples = np.zeros((2, at.SAMPLE_WIDTH))
    samples[:, [at.VX, at.AX, at.AY, at.YAW_RATE]] = 20.0, 0.3, 2.0, 0.12
    started = Started(DT, state)
    filter_.step(started, samples[0])
    assert state.evidence[0] == 0.0  # where it starts nothing is weighed
    before = state.x.copy()
    filter_.step(started, samples[1])
    car = filter_.car
    densities = []
    for beta, (yaw_rate, _, *forces) in zip(before[1], state.x.T, strict=True):
        shape = (1.0, 0.0, 1.0, 0.0, np.cos(beta), np.sin(beta), car.mass, car.yaw_inertia, car.a, car.b)
        _, _, ax, ay = body_rates(*forces, 20.0, yaw_rate, *shape)
        found, spread = [yaw_rate, ax, ay], [noise.yaw_rate, noise.accel, noise.accel]
        densities.append(norm.pdf([0.12, 0.3, 2.0], found, spread).prod())
    assert state.evidence[0] == pytest.approx(np.log(np.mean(densities)), rel=1e-6)


def test_solved_forces_have_the_likelihood_of_very_many_drawn_ones():
    """Of the measurements after the first second: the first particles of the two differ."""
    inputs = inputs_of(kinematic_log(KinematicNoise(), seed=5, steps=300))
    noise = ParticleNoise(yaw_rate=0.1, accel=2.0)
    wider = noise._replace(accel=1.5)
    solved, drawn = (
        [
            np.mean(
                [
                    RandomWalkPF(GOLF, which, particles=number, forces=forces, seed=seed).log_likelihood(
                        inputs
                    )
                    for seed in range(4)
                ]
            )
            for which in (noise, wider)
        ]
        for forces, number in (("solved", 200), ("drawn", 20_000))
    )
    assert solved[0] - solved[1] == pytest.approx(drawn[0] - drawn[1], abs=1.0)
    assert solved[0] == pytest.approx(drawn[0], abs=3.0)


def test_likelihood_finds_the_noise_of_its_own_model_back():
    truth = kinematic_noise(accel=0.5, speed=0.1)
    logs = prepare(matched([kinematic_log(truth, seed) for seed in range(3)]), RATE, LIKELIHOOD)
    wrong = entry(
        "kinematic_kf", **truth._replace(speed=truth.speed * 10.0, accel=truth.accel * 3.0)._asdict()
    )
    before = score_logs(wrong, logs, LIKELIHOOD)
    space = noise_space(wrong.settings["noise"], KinematicKF.told_by_likelihood)

    def loss(point: np.ndarray) -> float:
        tried = FilterSettings(name=wrong.name, settings={"noise": space.noise_at(point)})
        return float(np.mean(losses(score_logs(tried, logs, LIKELIHOOD), before, LIKELIHOOD)))

    found = space.noise_at(minimise(loss, space.dimensions, 30, seed=0).point)
    assert 0.8 < found["speed"] / truth.speed < 1.25
    assert 0.5 < found["accel"] / truth.accel < 2.0


def test_asking_for_the_likelihood_changes_no_estimate():
    inputs = inputs_of(kinematic_log(KinematicNoise(), seed=5, steps=300))
    for filter_ in (
        KinematicKF(GOLF),
        DynamicEKF(GOLF),
        RandomWalkPF(GOLF, forces="drawn"),
        RandomWalkPF(GOLF),
    ):
        before = filter_.run(inputs).beta
        assert np.isfinite(filter_.log_likelihood(inputs))
        assert filter_.run(inputs).beta.tolist() == before.tolist()


# Tuning on recordings


WRONG = {"yaw_rate": 0.6, "ay": 60.0}
"""Thirty times the default measurement noise: the filter hardly looks at what it measures."""


TRUE = DynamicNoise(yaw_acceleration=0.3, slip_rate=0.05, yaw_rate=0.01, ay=0.3)


def dynamic_log(seed: int, steps: int = 2000) -> Signals:
    """A drive of the dynamic filter's own model with linear tyres and white noise, as it assumes them."""
    rng = np.random.default_rng(seed)
    car = DynamicEKF(GOLF, tyre="linear").car
    t = DT * np.arange(steps)
    steer = 0.03 * np.sin(1.5 * t) * np.sin(0.3 * t + seed)
    state, rows = np.zeros(2), []
    for angle in steer:
        rates, (_, ay), _ = single_track_rates(*state, 20.0, angle, 0.0, 0.0, 0.0, 0.0, 0.0, car)
        rows.append((state[0] + rng.normal(0.0, TRUE.yaw_rate), ay + rng.normal(0.0, TRUE.ay), state[1]))
        state = state + DT * np.array(rates)
        state += rng.normal(0.0, [TRUE.yaw_acceleration, TRUE.slip_rate]) * np.sqrt(DT)
    frame = pd.DataFrame(rows, columns=["yaw_rate", "ay", "beta_ref"])
    return make_signals(frame.assign(t=t, vx=20.0, ax=0.0, steer=steer), f"log {seed}")


def matched(logs: Sequence[Signals]) -> list[Recording]:
    """Recordings of the Golf."""
    return [Recording(log.name, Path(f"{log.name}.csv"), GOLF, log) for log in logs]


def test_wrong_noise_is_found_back_and_helps_on_other_logs():
    some = matched([dynamic_log(seed) for seed in range(4)])
    right = FilterSettings(name="dynamic_ekf", settings={"noise": TRUE._asdict(), "tyre": "linear"})
    far_off = TRUE._replace(yaw_rate=30.0 * TRUE.yaw_rate, ay=30.0 * TRUE.ay)
    wrong = right.model_copy(update={"settings": {**right.settings, "noise": far_off._asdict()}})
    result = tune(some, [wrong], RATE, evaluations=20, folds=2, seed=1).filters[0]
    best = score_logs(right, prepare(some, RATE), ERROR).mean()
    assert result.before.mean() > 1.3 * best
    assert result.accepted
    assert result.held_out.mean() < 1.05 * best
    assert result.kept.settings == {**wrong.settings, "noise": result.noise}
    # What all are multiplied with changes no estimate: only the ratio is to be found.
    ratio = (result.noise["ay"] / result.noise["slip_rate"]) / (TRUE.ay / TRUE.slip_rate)
    assert 1.0 / 3.0 < ratio < 3.0


def test_wrong_noise_on_the_plant_comes_out_as_good_as_the_default(recordings):
    result = tune(
        recordings, [entry("dynamic_ekf", **WRONG)], RATE, evaluations=20, rounds=1, folds=2, seed=1
    )
    right = score_logs(entry("dynamic_ekf"), prepare(recordings, RATE), ERROR)
    assert result.filters[0].accepted
    assert result.filters[0].held_out.mean() < 0.95 * result.filters[0].before.mean()
    assert result.filters[0].held_out.mean() < 1.1 * right.mean()


def test_the_result_does_not_depend_on_processes_or_calls(recordings):
    one, two = (
        tune(
            recordings[:3], [entry("kinematic_kf")], RATE, evaluations=6, folds=2, seed=3, jobs=jobs
        ).filters[0]
        for jobs in (1, 2)
    )
    assert one.noise == two.noise
    assert one.held_out.tolist() == two.held_out.tolist()


def test_a_recording_is_judged_by_noise_that_has_not_seen_it(recordings, monkeypatch):
    judged: list[tuple[str, str]] = []

    def spy(tried: FilterSettings, logs: Sequence[TuneLog], by: str) -> np.ndarray:
        if len(logs) == 1:
            judged.append((logs[0].name, json.dumps(tried.settings["noise"])))
        return score_logs(tried, logs, by)

    monkeypatch.setattr(tune_module, "score_logs", spy)
    some = recordings[:3]
    spoilt = replace(some[0].signals, frame=some[0].signals.frame.assign(beta_ref=0.1))
    for first in (some[0], replace(some[0], held=spoilt)):
        tune([first, *some[1:]], [entry("dynamic_ekf", **WRONG)], RATE, evaluations=6, folds=3, seed=1)
    plain, other = dict(judged[:3]), dict(judged[3:])
    assert set(plain) == set(other) == {recording.name for recording in some}
    assert plain[some[0].name] == other[some[0].name]  # its own truth changes nothing about its noise
    assert plain[some[1].name] != other[some[1].name]  # but that of the others


def test_an_overfit_is_refused(recordings):
    """Where the truth is another in each recording, what fits some cannot fit the others."""
    rng = np.random.default_rng(0)
    some = []
    for recording in recordings[:4]:
        n = len(recording.signals)
        walk = np.cumsum(rng.normal(0.0, 1.0, n))
        beta = np.radians(3.0) * walk / np.abs(walk).max()
        frame = recording.signals.frame.assign(beta_ref=beta)
        some.append(replace(recording, held=replace(recording.signals, frame=frame)))
    result = tune(some, [entry("dynamic_ekf")], RATE, evaluations=10, folds=4, seed=0).filters[0]
    assert losses(result.after, result.before, ERROR).mean() < -0.01
    assert not result.accepted
    assert result.kept == result.entry


def test_one_recording_is_not_enough(recordings):
    with pytest.raises(UsageError, match="at least two"):
        tune(recordings[:1], [entry("dynamic_ekf")], RATE)


def test_a_filter_without_likelihood_says_what_it_needs(recordings):
    with pytest.raises(UsageError, match="ground truth"):
        tune(recordings[:2], [entry("first_order_ekf")], RATE, by=LIKELIHOOD)


def test_training_tunes_first_but_leaves_what_was_given(recordings):
    entries = [entry("kinematic_kf"), entry("dynamic_ekf", **WRONG)]
    tuned = tuned_entries(recordings, entries, RATE, 12, seed=1)
    assert [each.name for each in tuned] == ["kinematic_kf", "dynamic_ekf"]
    assert tuned[1] != entries[1]
    given = Tuned(by="error", filters=[TunedNoise(name="dynamic_ekf", noise={"ay": 3.0})])
    assert tuned_entries(recordings, entries[1:], RATE, 12, leave=given) == entries[1:]


def test_a_filter_that_would_only_copy_another_is_not_taken_into_the_bank(recordings):
    """A particle filter tied hard to the EKF is as good as the EKF, and the choice between them worth nothing."""
    logs = prepare(recordings[:6], RATE, longest=10.0)
    free = entry("random_walk_pf")
    free.settings["particles"] = 200
    tied = free.model_copy(update={"settings": {**free.settings, "noise": {"pseudo": 1e-3}}})
    assert keep_what_complements([free], [tied], logs) == [tied]
    assert keep_what_complements([entry("dynamic_ekf"), free], [tied], logs) == [entry("dynamic_ekf"), free]


# The file and the commands


@pytest.fixture(scope="module")
def tuned_file(tmp_path_factory) -> Path:
    """A TUNED.json with one filter."""
    path = tmp_path_factory.mktemp("tuned") / "tuned.json"
    save_tuned(Tuned(by="error", filters=[TunedNoise(name="dynamic_ekf", noise={"ay": 7.0})]), path)
    return path


def test_tuned_noise_takes_the_place_of_the_artefacts(tuned_file, simulated, car):
    tuned = load_tuned(tuned_file, list(CATALOGUE))
    artefact = load_artefact()
    entries = with_tuned(artefact.filters, tuned)
    assert entries[1].settings["noise"] == {"ay": 7.0}
    assert entries[0] == artefact.filters[0]
    plain = estimate_log(simulated[0], car, artefact)
    other = estimate_log(simulated[0], car, artefact, tuned=tuned)
    assert other.filters["dynamic_ekf"].tolist() != plain.filters["dynamic_ekf"].tolist()
    assert other.filters["kinematic_kf"].tolist() == plain.filters["kinematic_kf"].tolist()


Change = Callable[[dict], object]
FAULTS: dict[str, tuple[Change | str, str]] = {
    "no JSON": ("{", "no valid JSON"),
    "a list": ("[]", "schema version"),
    "another schema": (lambda c: c.update(schema_version=2), "schema version 2"),
    "an unknown key": (lambda c: c.update(extra=1), "unknown key extra"),
    "no filters": (lambda c: c.pop("filters"), "filters is missing"),
    "an unknown filter": (lambda c: c["filters"][0].update(name="magic"), "magic"),
    "an unknown setting": (lambda c: c["filters"][0].update(noise={"q": 1.0}), "unknown setting q"),
    "a negative value": (lambda c: c["filters"][0].update(noise={"ay": -1.0}), "not negative"),
    "a word for a number": (lambda c: c["filters"][0].update(noise={"ay": "big"}), "no number"),
    "a filter twice": (lambda c: c["filters"].append(c["filters"][0]), "twice"),
    "a filter that does not run": (lambda c: c["filters"][0].update(name="ratt_ekf"), "--filters"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_tuned_file_gives_one_line_and_no_output(crosscomb, tuned_file, data_set, tmp_path, fault):
    change, words = FAULTS[fault]
    path = tmp_path / "bad.json"
    if isinstance(change, str):
        path.write_text(change, encoding="utf-8")
    else:
        content = json.loads(tuned_file.read_text(encoding="utf-8"))
        change(content)
        path.write_text(json.dumps(content), encoding="utf-8")
    out = tmp_path / "out"
    log = sorted(data_set.glob("*.csv"))[0]
    for command in (("estimate", log), ("train", data_set), ("benchmark", "real", "--data", data_set)):
        target = out / "a.json" if command[0] == "train" else out
        ran = crosscomb(*command, "--tuned", path, "-o", target)
        assert (ran.code, ran.out) == (2, "")
        assert len(ran.err.splitlines()) == 1
        assert words in ran.err
        assert str(path) in ran.err
        assert not out.exists()


def test_the_command_writes_noise_report_and_record(crosscomb, data_set, tmp_path):
    path = tmp_path / "mine.json"
    words = (
        "tune",
        data_set,
        "--filters",
        "kinematic_kf,dynamic_ekf",
        "--evaluations",
        6,
        "--folds",
        2,
        "--jobs",
        1,
    )
    ran = crosscomb(*words, "-o", path)
    assert (ran.code, ran.err) == (0, "")
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == ["mine.json", "mine.run.json", "mine.tuning.csv", "mine.tuning.md", "mine.tuning.png"]
    assert "dynamic_ekf" in ran.out
    tuned = load_tuned(path, list(CATALOGUE))
    assert set(tuned.record["scores"]) == {"kinematic_kf", "dynamic_ekf"}
    for entry_ in tuned.filters:
        assert tuned.record["scores"][entry_.name]["accepted"]
    assert len(tuned.record["data"]) == len(list(data_set.glob("*.csv")))
    log = sorted(data_set.glob("*.csv"))[0]
    if tuned.filters:
        assert crosscomb("estimate", log, "--tuned", path, "-o", tmp_path / "out").code == 0


def test_logs_without_ground_truth_are_tuned_by_likelihood(
    crosscomb, data_set, simulated, car, write_log, write_vehicle, tmp_path
):
    folder = tmp_path / "logs"
    folder.mkdir()
    write_vehicle(folder, car)
    for log in simulated[:2]:
        write_log(log.frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]), folder / f"{log.name}.csv")
    ran = crosscomb(
        "tune", folder, "--filters", "dynamic_ekf", "--evaluations", 5, "--jobs", 1, "-o", tmp_path / "t.json"
    )
    assert (ran.code, ran.err) == (0, "")
    assert "likelihood" in ran.out
    assert load_tuned(tmp_path / "t.json", list(CATALOGUE)).by == "likelihood"
    out = tmp_path / "no.json"
    ran = crosscomb("tune", folder, "--filters", "lint_ekf", "--jobs", 1, "-o", out)
    assert ran.code == 2
    assert "ground truth" in ran.err
    ran = crosscomb("tune", folder, "--filters", "dynamic_ekf", "--by", "error", "-o", out)
    assert ran.code == 2
    assert not out.exists()


@pytest.mark.parametrize(
    "words",
    [
        ("--by", "luck"),
        ("--filters", "magic"),
        ("--filters", "network"),
        ("--filters", "imm,imm"),
        ("-o", "a.toml"),
    ],
)
def test_wrong_use_gives_one_line(crosscomb, data_set, words):
    ran = crosscomb("tune", data_set, *words)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.startswith("error: ")
    assert ran.err.splitlines()[1:] == [] or "warning" in ran.err

"""Health of filters: who diverges is left out, named and begins anew; who is merely less accurate stays."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crosscomb.filters import columns as at
from crosscomb.filters.single_track.ekf import DynamicEKF
from crosscomb.models.vehicle import load_vehicle
from crosscomb.run import drive as running
from crosscomb.run.estimate import LogEstimate, Run, estimate_log, next_estimate, start_run
from crosscomb.selection.artefact import SHIPPED, Artefact, load_artefact
from crosscomb.selection.health import (
    ALONE_TIME,
    HEALTHY,
    PATIENCE,
    QUARANTINE,
    SETTLE_TIME,
    WORDS,
    next_health,
    start_health,
)
from crosscomb.signals import Signals
from crosscomb.training.simulation.simulate import simulate_log
from crosscomb.training.suites.fault_runs import diverging, part
from crosscomb.training.suites.faults import DIVERGING

CAR = load_vehicle("generic_compact")
DT = 0.01
N = 1000


@pytest.fixture(scope="module")
def log() -> Signals:
    """Bends and slides."""
    return simulate_log(CAR, "road_slide", 3, surface="wet", duration=16.0)


def driving(ay: float = 1.0, vx: float = 20.0) -> np.ndarray:
    """Samples of a steady turn ``(N, 17)`` in which beta stays what it is."""
    samples = np.zeros((N, at.SAMPLE_WIDTH))
    samples[:, at.VX], samples[:, at.AY] = vx, ay
    samples[:, at.YAW_RATE] = ay / vx + 1e-4 * np.cos(np.arange(N))
    return samples


def judged(
    beta: np.ndarray, samples: np.ndarray, beta_std: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """What is told of the filters, beta and beta_std, codes, time alone, and samples after which one began anew."""
    beta = np.array(beta, dtype=np.float64)
    std = np.full(beta.shape, 0.01) if beta_std is None else beta_std.copy()
    nis, codes, alone = np.ones(beta.shape), np.zeros(beta.shape, dtype=np.int64), np.zeros(N)
    state, begin, begins = start_health(beta.shape[1]), 0, []
    while begin < N:
        rows = slice(begin, N)
        begin += next_health(
            state, samples[rows], beta[rows], std[rows], nis[rows], codes[rows], alone[rows], DT
        )
        if state.restart.any():
            begins.append(begin - 1)
    return beta, std, codes, alone, np.array(begins)


def wandering(filters: int = 3) -> np.ndarray:
    """What sound filters say ``(N, filters)``, a degree apart."""
    return 0.02 * np.sin(0.02 * np.arange(N))[:, None] + 0.01 * np.arange(filters)


def first(codes: np.ndarray) -> int:
    """First sample at which any filter is unhealthy."""
    return int(np.flatnonzero(codes.any(axis=1))[0])


def test_what_sound_filters_say_is_not_touched():
    beta = wandering()
    told, std, codes, alone, begins = judged(beta, driving())
    np.testing.assert_array_equal(told, beta)
    assert np.all(std == 0.01)
    assert not codes.any()
    assert not alone.any()
    assert not begins.size


def test_less_accurate_is_not_unhealthy():
    """In a slide a filter may be 7 deg from the others: it may be the one that sees it."""
    beta = wandering()
    beta[200:, 0] += np.radians(7.0)
    assert not judged(beta, driving(ay=6.0))[2].any()
    assert not judged(beta, driving(ay=1.0), np.full((N, 3), np.radians(7.0)))[2][:, 1:].any()


def test_alone_in_gentle_driving_is_astray():
    beta = wandering()
    beta[200:, 0] += np.radians(6.0)
    told, _, codes, _, _ = judged(beta, driving())
    assert WORDS[codes[first(codes)][0]] == "astray"
    assert first(codes) == pytest.approx(200 + ALONE_TIME / DT, abs=20)
    assert not codes[:, 1:].any()
    assert np.abs(told[500:, 0] - beta[500:, 1:].mean(axis=1)).max() < np.radians(0.1)


def test_the_further_away_the_sooner_it_is_told():
    near, far = wandering(), wandering()
    near[200:, 0] += 0.001 * np.minimum(np.arange(N - 200), 100.0)  # to 6 deg
    far[200:, 0] += 0.005 * np.minimum(np.arange(N - 200), 100.0)  # to 29 deg
    assert first(judged(far, driving())[2]) < first(judged(near, driving())[2]) - 50


def test_an_offset_that_lasts_is_astray_however_the_car_is_driven():
    """Biases last, slides do not."""
    beta, brief = wandering(), wandering()
    away = np.radians(12.0)
    beta[100:, 0] += away * np.minimum(np.arange(N - 100) / 100.0, 1.0)
    brief[100:300, 0] += away * np.sin(np.pi * np.arange(200) / 200.0)
    codes = judged(beta, driving(ay=7.0))[2]
    assert WORDS[codes[first(codes), 0]] == "astray"
    assert not judged(brief, driving(ay=7.0))[2].any()


def test_a_jump_is_told_at_once():
    beta = wandering()
    beta[300:320, 2] += 0.5
    told, _, codes, _, _ = judged(beta, driving())
    assert first(codes) == 300
    assert WORDS[codes[300, 2]] == "jumped"
    assert np.abs(told[:, 2] - wandering()[:, 2]).max() < 0.03


def test_two_that_disagree_are_not_judged_by_each_other():
    beta = wandering(2)
    beta[200:, 0] += np.radians(30.0) * np.minimum(np.arange(N - 200) / 50.0, 1.0)
    assert not judged(beta, driving())[2].any()


@pytest.mark.parametrize(
    ("word", "spoil"),
    [
        ("not finite", lambda beta, std: beta.__setitem__((slice(300, 400), 1), np.nan)),
        ("not finite", lambda beta, std: std.__setitem__((slice(300, 400), 1), np.inf)),
        ("diverged", lambda beta, std: std.__setitem__((slice(300, 400), 1), np.radians(20.0))),
        ("diverged", lambda beta, std: beta.__setitem__((slice(300, 400), 1), np.radians(80.0))),
        ("frozen", lambda beta, std: beta.__setitem__((slice(300, 400), 1), beta[300, 1])),
    ],
)
def test_what_is_wrong_is_named_and_replaced_without_a_bump(word, spoil):
    beta, std = wandering(), np.full((N, 3), 0.01)
    spoil(beta, std)
    told, told_std, codes, _, _ = judged(beta, driving(), std)
    assert WORDS[codes[first(codes), 1]] == word
    assert 300 <= first(codes) <= 352
    assert np.isfinite(told).all()
    assert np.isfinite(told_std).all()
    assert np.abs(np.diff(told, axis=0)).max() < 0.006
    assert not codes[:, [0, 2]].any()
    # Healthy again once it has settled, or stood its quarantine.
    end = np.flatnonzero(codes[:, 1])[-1]
    assert 400 + SETTLE_TIME / DT - 3 <= end <= 400 + (SETTLE_TIME + QUARANTINE) / DT
    np.testing.assert_allclose(told[-100:], beta[-100:], atol=1e-5)


def test_new_begins_come_late_and_ever_later():
    beta = wandering()
    beta[:, 0] = np.radians(80.0)
    *_, begins = judged(beta, driving())
    gaps = np.diff(begins) * DT
    assert begins[0] * DT == pytest.approx(PATIENCE, abs=0.05)
    assert gaps == pytest.approx([PATIENCE, 2.0, 4.0], abs=0.1)
    assert len(begins) < 5


def test_one_that_is_not_finite_begins_anew_at_once():
    beta = wandering()
    beta[300, 0] = np.nan
    assert judged(beta, driving())[4].tolist() == [300]


def test_missing_signals_excuse_doubt():
    """Who has no signals doubts, and is given time to find back."""
    samples, std = driving(), np.full((N, 3), 0.01)
    samples[200:500, [at.AY, at.YAW_RATE]] = np.nan
    std[240:600, 0] = np.radians(30.0)
    assert not judged(wandering(), samples, std)[2].any()


def test_without_a_healthy_filter_the_answer_is_reckoned_and_doubted_more_and_more():
    samples = driving(ay=2.0)
    samples[:, at.YAW_RATE] -= 0.05  # beta changes by 0.05 rad/s
    beta = np.tile(0.0005 * np.arange(N)[:, None], 3)
    truth = beta[:, 0].copy()
    beta[400:700] = np.nan
    told, std, codes, alone, _ = judged(beta, samples)
    assert (codes[400:700] != HEALTHY).all()
    assert np.abs(told - truth[:, None]).max() < 0.01
    growth = np.diff(std[410:700, 0])
    assert (growth > 0.0).all()
    assert std[699, 0] > np.radians(4.0)
    assert alone[399] == 0.0
    assert alone[699] == pytest.approx(3.0, abs=0.02)


def corrupt(run: Run, name: str, change: Callable[[Any], None]) -> None:
    """Change the state of a filter of a run under way."""
    assert run.stream.stretch is not None
    change(run.stream.stretch.drive.started[run.stream.plan.names.index(name)].state)


def lose(state: Any) -> None:
    """Put NaN into a state, from which no filter finds back."""
    state.mean[:] = np.nan


def corrupted(
    log: Signals, artefact: Artefact, name: str, change: Callable[[Any], None], when: float
) -> LogEstimate:
    """Answers from the moment on in which a filter's state was changed."""
    run = start_run(CAR, artefact)
    next_estimate(run, part(log, log.t < when))
    corrupt(run, name, change)
    return next_estimate(run, part(log, log.t >= when))


@pytest.mark.parametrize("artefact", SHIPPED)
@pytest.mark.parametrize("name", ["kinematic_kf", "dynamic_ekf"])
def test_a_filter_with_a_broken_state_comes_back(log, artefact, name):
    chosen = load_artefact(artefact)
    sound = estimate_log(log, CAR, chosen)
    found = corrupted(log, chosen, name, lose, 8.0)
    late = sound.signals.t >= 8.0
    assert found.reason[0] == f"filter {name} not finite"
    assert "degraded" in found.status[0]
    assert all(np.isfinite(beta).all() for beta in found.filters.values())
    assert np.isfinite(found.beta).all()
    assert name not in found.active[:100]
    assert found.status[-1] == sound.status[-1]
    assert np.degrees(np.abs(found.beta - sound.beta[late])).max() < 3.0
    assert np.degrees(np.abs(found.filters[name] - sound.filters[name][late])[300:]).max() < 2.0


def test_all_filters_lost_at_once_leave_dead_reckoning(log):
    sound = estimate_log(log, CAR, load_artefact())
    run = start_run(CAR, load_artefact())
    next_estimate(run, part(log, log.t < 8.0))
    for name in ("kinematic_kf", "dynamic_ekf"):
        corrupt(run, name, lose)
    corrupt(run, "random_walk_pf", lambda state: state.x.__setitem__(slice(None), np.nan))
    found = next_estimate(run, part(log, log.t >= 8.0))
    assert np.isfinite(found.beta).all()
    assert found.reason[0].count("filter ") == 3
    assert np.degrees(np.abs(np.diff(found.beta))).max() < 1.0
    assert found.beta_std[90] > found.beta_std[30] > sound.beta_std[log.t < 8.0][-1]
    assert "degraded" not in found.status[-1]


@pytest.mark.parametrize("artefact", SHIPPED)
@pytest.mark.parametrize("name", DIVERGING)
def test_a_filter_that_runs_away_does_not_reach_the_answer(log, artefact, name):
    chosen = load_artefact(artefact)
    ill = diverging(chosen, name)
    assert ill is not None
    sound, found = estimate_log(log, CAR, chosen), estimate_log(log, CAR, ill)
    named = np.array([f"filter {name}" in text for text in found.reason])
    late = log.t > 3.0
    apart = np.degrees(np.abs(found.beta - sound.beta))
    flagged = np.array([status != "ok" for status in found.status])
    assert apart[late & ~flagged].max(initial=0.0) < 1.5
    assert not (named & (found.active == name)).any()
    if name != "dynamic_ekf":  # that one only believes its ay too much
        assert named[late].mean() > 0.5


@pytest.mark.parametrize("sizes", [[1], [7, 1, 300]])
@pytest.mark.parametrize("artefact", SHIPPED)
def test_answers_do_not_depend_on_how_a_log_is_cut_where_filters_begin_anew(log, artefact, sizes):
    ill = diverging(load_artefact(artefact), "kinematic_kf")
    assert ill is not None
    log = part(log, log.t < 6.0)
    whole, run = estimate_log(log, CAR, ill, extras=True), start_run(CAR, ill, extras=True)
    parts, begin = [], 0
    while begin < len(log):
        end = begin + sizes[len(parts) % len(sizes)]
        parts.append(next_estimate(run, part(log, slice(begin, end))))
        begin = end
    assert any("restarted" in reason for reason in whole.reason)
    for name in ("beta", "beta_std", "active", "status", "reason"):
        joined = np.concatenate([getattr(one, name) for one in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name), err_msg=name)
    for name, values in (whole.filters | whole.extras).items():
        joined = np.concatenate([(one.filters | one.extras)[name] for one in parts])
        np.testing.assert_array_equal(joined, values, err_msg=name)


def test_pieces_after_a_new_begin_change_nothing(log, monkeypatch):
    ill = diverging(load_artefact(), "random_walk_pf")
    assert ill is not None
    whole = estimate_log(log, CAR, ill)
    monkeypatch.setattr("crosscomb.run.health.PIECE", 37)
    np.testing.assert_array_equal(estimate_log(log, CAR, ill).beta, whole.beta)


def test_a_filter_begins_anew_where_it_is_told_to(log):
    drive = running.start_drive(CAR, [DynamicEKF(CAR)], 100.0, load_artefact().window)
    points = log.rows()
    running.next_seen(drive, points[:800])
    running.begin_anew(drive, 0, -0.2)
    seen = running.next_seen(drive, points[800:810])
    assert seen.beta[0, 0] == pytest.approx(-0.2)
    running.begin_anew(drive, 0, np.nan)
    assert running.next_seen(drive, points[810:820]).beta[0, 0] > -0.1


def test_a_corrected_answer_is_doubted_by_how_far_the_filters_are(log):
    found = estimate_log(log, CAR, load_artefact("hybrid"))
    apart = np.abs(np.column_stack(list(found.filters.values())) - found.beta[:, None]).max(axis=1)
    trusted = (log.column("vx") > 3.0) & ~np.array(["extrapolating" in text for text in found.status])
    assert (found.beta_std >= 0.5 * apart - 1e-9)[trusted].mean() > 0.99
    assert found.beta_std.min() > 0.0

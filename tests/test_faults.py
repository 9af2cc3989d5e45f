"""The campaign of faults: what each fault does to a log, what each criterion lets pass, and the command."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from crosscomb.models.vehicle import load_vehicle
from crosscomb.report.faults import worst_lines
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import load_artefact
from crosscomb.signals import Signals
from crosscomb.training.suites import fault_campaign, fault_runs, faults
from crosscomb.training.suites.fault_criteria import CRITERIA, NOT_JUDGED, PASSED, judge
from crosscomb.training.suites.fault_trials import Answers, Trial, answers_of, holds
from crosscomb.training.suites.faults import signal_faults

ONSET = 12.0
STAMPS = {
    "jitter 20 %",
    "gap of 3 s",
    "repeated stamp",
    "stamp backwards",
    "cut last row",
    "repeated last row",
}


@pytest.fixture(scope="module")
def log() -> Signals:
    """A made-up slalom of 30 s at 100 Hz with some noise."""
    t = 0.01 * np.arange(3000)
    rng = np.random.default_rng(0)
    wave = np.sin(2.0 * t)
    columns = {"vx": 20.0 + np.cos(t), "ax": -np.sin(t), "ay": 5.0 * wave, "yaw_rate": 0.25 * wave}
    columns |= {"steer": 0.03 * wave, "vfl": 20.0 + np.cos(t), "vrr": 20.0 + np.cos(t)}
    noisy = {name: values + rng.normal(0.0, 0.01, len(t)) for name, values in columns.items()}
    return Signals("slalom", pd.DataFrame({"t": t, **noisy, "beta_ref": 0.01 * wave}))


def test_every_kind_of_fault_has_a_criterion(log):
    kinds = {fault.kind for fault in signal_faults(log)}
    kinds |= {*faults.VEHICLE_FAULTS, "filter diverges", *(scene[0] for scene in fault_campaign.SCENES)}
    assert kinds == set(CRITERIA)


def test_channels_that_a_log_lacks_have_no_fault(log):
    bare = replace(log, frame=log.frame.drop(columns=["vfl", "vrr"]))
    assert not {fault.channel for fault in signal_faults(bare)} & {"vfl", "vrr"}


def test_faults_change_their_channel_from_their_onset_to_their_return_only(log):
    for fault in signal_faults(log):
        if fault.kind in STAMPS:
            continue
        faulty = fault.change(log, ONSET)
        for name in log.frame.columns:
            same = (faulty.column(name) == log.column(name)) | np.isnan(log.column(name))
            changed = log.t[~same]
            if name != fault.channel:
                assert not changed.size, (fault.kind, name)
            else:
                assert changed.size, (fault.kind, name)
                assert changed.min() >= ONSET, (fault.kind, name)
                assert changed.max() <= ONSET + fault.lasts + 0.01, (fault.kind, name)


def test_sizes_of_faults(log):
    after = log.t >= ONSET

    def changed(kind: str, channel: str) -> np.ndarray:
        (fault,) = (f for f in signal_faults(log) if (f.kind, f.channel) == (kind, channel))
        return fault.change(log, ONSET).column(channel)

    ay = log.column("ay")
    assert np.sum(np.isnan(changed("dropout 0.1 s", "ay"))) == 10
    assert np.all(changed("stuck", "ay")[after] == ay[~after][-1])
    assert np.allclose((changed("bias", "yaw_rate") - log.column("yaw_rate"))[after], np.radians(2.0))
    assert np.sum(changed("ten spikes", "ax") - log.column("ax") > 99.0) == 10
    assert changed("absurd value", "ax")[1200] == 1e154
    drift = changed("slow drift", "vx") - log.column("vx")
    assert drift[1200] == 0.0
    assert drift[-1] == pytest.approx(3.0 * 17.99 / 20.0)
    assert np.all(changed("sign flip", "steer")[after] == -log.column("steer")[after])
    assert np.all(changed("100 ms late", "ay")[after] == ay[1190:-10])
    assert np.all(np.isinf(changed("infinity for 1 s", "vx")[1200:1300]))
    noise = (changed("noise x 10", "ay") - ay)[1200:1300]
    assert np.std(noise) == pytest.approx(0.1, rel=0.3)


def test_noise_is_told_from_motion(log):
    assert faults.noise_of(log.column("ay")) == pytest.approx(0.01, rel=0.1)
    assert faults.noise_of(np.full(9, np.nan)) == 0.0


def test_faults_of_stamps(log):
    changes = {fault.kind: fault.change(log, ONSET) for fault in signal_faults(log) if fault.kind in STAMPS}
    jitter = changes["jitter 20 %"].t - log.t
    assert np.all(jitter[:1200] == 0.0)
    assert 0.001 < np.abs(jitter).max() <= 0.002
    assert np.all(np.diff(changes["jitter 20 %"].t) > 0.0)
    assert len(changes["gap of 3 s"]) == len(log) - 300
    assert np.diff(changes["repeated stamp"].t).min() == 0.0
    assert np.diff(changes["stamp backwards"].t).min() == pytest.approx(-0.01)
    assert np.isnan(changes["cut last row"].column("ay")[-1])
    assert np.all(np.diff(changes["repeated last row"].t)[-1:] == 0.0)


def trial(lasts: float = np.inf, n: int = 1500, **columns: np.ndarray) -> Trial:
    """A trial in which nothing happens, 100 Hz, but for the columns given."""
    t = 0.01 * np.arange(n)
    words = np.full(n, "a"), np.full(n, "ok", dtype=object)
    sound = Answers(0.02 * np.sin(t), np.full(n, 0.01), *words, np.full(n, True))
    faulty = sound._replace(**{name: values for name, values in columns.items() if name in Answers._fields})
    others = {name: values for name, values in columns.items() if name not in Answers._fields}
    return replace(
        Trial(t, sound, faulty, sound.beta.copy(), np.full(n, 20.0), np.full(n, 4.0), lasts), **others
    )


def status(*spans: tuple[int, int], word: str = "degraded", n: int = 1500) -> np.ndarray:
    """A status that holds a word in spans of rows."""
    texts = np.full(n, "ok", dtype=object)
    for begin, end in spans:
        texts[begin:end] = word
    return texts


def off(degrees: float, begin: int, end: int, n: int = 1500) -> np.ndarray:
    """The sound beta, so many degrees off in a span of rows."""
    beta = 0.02 * np.sin(0.01 * np.arange(n))
    beta[begin:end] += np.radians(degrees)
    return beta


FLAGGED = status((5, 1500))
GROWN = np.full(1500, 0.02)
BACKWARDS = np.where(np.arange(1500) > 500, -2.0, 5.0)
SPUN = np.where(np.arange(1500) > 700, 2.0, 0.0)

CASES = [
    ("dropout 0.1 s", trial(0.1, beta=off(0.4, 0, 99)), trial(0.1, beta=off(0.6, 0, 9))),
    ("dropout 2 s", trial(2.0, status=status((3, 200)), beta=off(9.0, 3, 390)), trial(2.0, status=status((30, 99)))),
    ("dropout for good", trial(status=FLAGGED, beta_std=GROWN), trial(status=FLAGGED)),
    ("dropout for good", trial(status=FLAGGED, beta_std=GROWN), trial(status=status((50, 1500)), beta_std=GROWN)),
    ("stuck", trial(status=status((90, 1500))), trial(status=status((110, 1500)))),
    ("one spike", trial(0.0, beta=off(0.3, 0, 9)), trial(0.0, beta=off(0.4, 0, 9))),
    ("one spike", trial(0.0, status=status((0, 9))), trial(0.0, status=status((0, 300)))),
    ("ten spikes", trial(1.8, status=status((0, 300)), beta=off(5.0, 0, 300)), trial(1.8)),
    ("NaN for 1 s", trial(1.0, status=status((0, 100))), trial(1.0, status=status((2, 100)))),
    ("bias", trial(status=status((400, 1500)), beta=off(5.0, 0, 1500)), trial(beta=off(5.0, 0, 1500))),
    ("bias", trial(beta=off(1.0, 0, 1500)), trial(status=status((700, 1500)), beta=off(5.0, 0, 1500))),
    ("slow drift", trial(status=status((900, 1500)), beta=off(5.0, 0, 1500)), trial(beta=off(5.0, 1100, 1500))),
    ("noise x 10", trial(1.0, beta=off(1.4, 0, 99)), trial(1.0, beta=off(1.6, 0, 99))),
    ("noise x 10", trial(1.0), trial(1.0, active=np.array(["a", "b"] * 750))),
    ("sign flip", trial(status=status((190, 1500))), trial(status=status((190, 900)))),
    ("jitter 20 %", trial(beta=off(0.1, 0, 99)), trial(beta=off(0.3, 0, 99))),
    ("repeated stamp", trial(dropped=1, notes=("one row dropped",)), trial(dropped=1)),
    ("gap of 3 s", trial(3.0, status=status((0, 50))), trial(3.0, status=status((20, 50)))),
    ("bank 5 deg", trial(status=status((250, 1500)), beta=off(3.0, 0, 1500)), trial(beta=off(3.0, 0, 1500))),
    ("filter diverges", trial(status=status((290, 1500)), beta=off(9.0, 0, 1500)), trial(beta=off(9.0, 900, 950))),
    ("standstill", trial(vx=np.zeros(1500), status=status((0, 1500), word="low_speed")), trial(vx=np.zeros(1500))),
    ("reversing", trial(vx=BACKWARDS, status=status((540, 1500), word="low_speed+reverse")), trial(vx=BACKWARDS)),
    ("spin", trial(truth=SPUN, status=status((715, 1500), word="invalid")), trial(truth=SPUN, status=FLAGGED)),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "good", "bad"), CASES, ids=[case[0] for case in CASES])
def test_criteria(kind, good, bad):
    assert judge(kind, good) == PASSED
    assert judge(kind, bad) not in (PASSED, NOT_JUDGED)


@pytest.mark.parametrize("kind", CRITERIA)
def test_an_answer_that_is_not_finite_never_passes(kind):
    assert "not finite" in judge(kind, trial(finite=np.arange(1500) != 9))


def test_a_filter_that_is_not_finite_is_seen(log):
    estimate = estimate_log(log, load_vehicle("generic_compact"), load_artefact(), ["dynamic_ekf"])
    assert answers_of(estimate).finite.all()
    estimate.filters["dynamic_ekf"][7] = np.nan
    assert np.flatnonzero(~answers_of(estimate).finite).tolist() == [7]


def test_a_flag_that_moves_a_little_is_not_left():
    sound = trial(0.0, status=status((400, 700)))
    one = replace(sound, sound=sound.faulty, faulty=sound.faulty._replace(status=status((392, 706))))
    assert judge("one spike", one) == PASSED
    late = replace(one, faulty=one.faulty._replace(status=status((380, 700))))
    assert "a flag is left" in judge("one spike", late)


def test_calm_driving_does_not_count():
    calm = np.full(1500, 0.5)
    assert judge("sign flip", trial(ay=calm)) == NOT_JUDGED
    assert judge("bias", trial(ay=calm, beta=off(5.0, 0, 1500))) == NOT_JUDGED


def test_words_that_the_sound_log_has_too_are_no_flag():
    one = trial(status=FLAGGED)
    assert one.flagged.sum() == 1495
    assert not replace(one, sound=one.faulty).flagged.any()
    assert holds(np.array(["low_speed+invalid", "ok"]), "invalid").tolist() == [True, False]


def test_a_filter_can_be_made_to_diverge():
    artefact = load_artefact()
    for name in faults.DIVERGING:
        changed = fault_runs.diverging(artefact, name)
        assert changed is not None
        assert [a.name for a, b in zip(artefact.filters, changed.filters, strict=True) if a != b] == [name]
    assert fault_runs.diverging(artefact, "luenberger") is None


def test_vehicle_faults_change_the_file():
    car = load_vehicle("generic_compact")
    assert all(change(car) != car for change in faults.VEHICLE_FAULTS.values())


def test_the_command_tells_how_often_the_answer_stands(crosscomb, data_set, tmp_path, monkeypatch):
    monkeypatch.setattr(fault_campaign, "MANOEUVRES", {"lap": "dry"})
    monkeypatch.setattr(fault_campaign, "SCENES", ())
    monkeypatch.setattr(fault_campaign, "DURATION", 14.0)
    kept = tmp_path / "reliability.md"
    words = ("--seeds", 1, "--jobs", 1, "--worst", 2, "-o", kept, "--filters", "dynamic_ekf")
    data = tmp_path / "data"
    shutil.copytree(data_set, data)
    for path in sorted(data.glob("*.csv"))[2:]:
        path.unlink()
    ran = crosscomb("benchmark", "faults", *words, "--data", data, "--drift", data)
    assert (ran.code, ran.err) == (0, "")
    text = kept.read_text(encoding="utf-8")
    assert text.startswith("# Reliability")
    assert "--filters dynamic_ekf --data <folder" in text
    for word in ("all faults", "sign flip", "simulated, with faults", "real, without", "truth inside 1.96"):
        assert word in text
        assert word in " ".join(ran.out.split())


def test_the_command_takes_some_kinds_of_faults(crosscomb, monkeypatch):
    monkeypatch.setattr(fault_campaign, "MANOEUVRES", {"lap": "dry"})
    monkeypatch.setattr(fault_campaign, "DURATION", 14.0)
    words = ("benchmark", "faults", "--seeds", 1, "--jobs", 1, "--filters", "dynamic_ekf", "--kinds")
    ran = crosscomb(*words, "stuck,mass +20 %,standstill")
    assert ran.code == 0
    for kind in ("stuck", "mass +20 %", "standstill"):
        assert kind in ran.out
    assert "spike" not in ran.out
    ran = crosscomb(*words, "gremlins")
    assert (ran.code, "gremlins" in ran.err, "sign flip" in ran.err) == (2, True, True)


def test_the_worst_runs_are_named_first():
    def run(wrong: float, passed: bool = False) -> SimpleNamespace:
        figures = SimpleNamespace(wrong=wrong)
        return SimpleNamespace(
            judged=True,
            passed=passed,
            figures=figures,
            log="a",
            kind="stuck",
            channel="ay",
            failure="not flagged",
        )

    lines = worst_lines(SimpleNamespace(outcomes=[run(0.5), run(9.0, True), run(2.0), run(1.0)]), 2)
    assert lines == [f"a: stuck on ay: not flagged ({wrong} s over 3 deg while ok)" for wrong in (2.0, 1.0)]

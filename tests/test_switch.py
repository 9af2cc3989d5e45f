"""The switch: decisions become switches calmly, without a bump, and never to a lost filter."""

import numpy as np
import pytest

from crosscomb.selection.switch import SwitchSettings, make_switch_state, switch_times
from crosscomb.selection.switch import switch as run_switch

DT = 0.01
N = 3000
AT_ONCE = SwitchSettings(dwell=0.0, confirm=0.0, transition=0.0, slew=1e9)


def switch(beta, beta_std, decision, settings, dt, first):
    """Run a whole drive."""
    state = make_switch_state(beta.shape[1], first, switch_times(settings, dt))
    return run_switch(beta, beta_std, decision, settings, dt, state)


def wandering(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three smooth estimates ``(N, 3)`` some degrees apart, their spread, and nervous decisions ``(N,)``."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(N)
    beta = np.stack(
        [0.1 * np.sin(f * t + p) + 0.05 * p for f, p in ((0.5, 0.0), (0.7, 1.0), (0.3, 2.0))], axis=1
    )
    runs = np.repeat(rng.integers(0, 3, N), rng.integers(1, 60, N))[:N]
    return beta, 0.01 + 0.005 * rng.random((N, 3)), runs


def runs_of(values: np.ndarray) -> np.ndarray:
    """Lengths of the stretches of equal values."""
    edges = np.flatnonzero(np.diff(values)) + 1
    return np.diff(np.concatenate([[0], edges, [len(values)]]))


@pytest.mark.parametrize("chosen", [0, 1, 2])
def test_a_constant_decision_is_that_filter(chosen):
    beta, beta_std, _ = wandering()
    out, out_std, active = switch(beta, beta_std, np.full(N, chosen), SwitchSettings(), DT, chosen)
    np.testing.assert_array_equal(out, beta[:, chosen])
    np.testing.assert_allclose(out_std, beta_std[:, chosen], rtol=1e-15)
    assert set(active) == {chosen}


def test_without_delays_every_decision_is_followed_at_once():
    beta, beta_std, decision = wandering()
    out, _, active = switch(beta, beta_std, decision, AT_ONCE, DT, 0)
    np.testing.assert_array_equal(active, decision)
    np.testing.assert_array_equal(out, beta[np.arange(N), decision])


@pytest.mark.parametrize("dwell", [0.1, 0.5])
def test_a_filter_stays_for_the_dwell_time(dwell):
    beta, beta_std, decision = wandering()
    _, _, active = switch(beta, beta_std, decision, SwitchSettings(dwell=dwell, confirm=0.0), DT, 0)
    assert len(runs_of(active)) > 10
    assert runs_of(active)[1:-1].min() * DT >= dwell
    assert runs_of(decision).min() * DT < dwell


def test_a_decision_is_followed_when_it_has_stood_long_enough():
    beta, beta_std, _ = wandering()
    settings = SwitchSettings(dwell=0.0, confirm=0.05)
    decision = np.zeros(N, dtype=int)
    decision[100:104] = 1  # 40 ms: too short
    decision[200:300] = 2
    _, _, active = switch(beta, beta_std, decision, settings, DT, 0)
    changes = np.flatnonzero(np.diff(active)) + 1
    np.testing.assert_array_equal(changes, [204, 304])  # the fifth sample makes 50 ms
    assert set(active) == {0, 2}


def test_a_decision_must_stand_without_a_break():
    beta, beta_std, _ = wandering()
    decision = np.zeros(N, dtype=int)
    decision[100:200] = np.resize([1, 1, 1, 0], 100)
    _, _, active = switch(beta, beta_std, decision, SwitchSettings(dwell=0.0, confirm=0.05), DT, 0)
    assert set(active) == {0}


def test_a_transition_has_no_bump_and_ends():
    beta = np.tile([0.0, 0.1], (N, 1))
    beta_std = np.full((N, 2), 0.01)
    decision = (np.arange(N) >= 1000).astype(int)
    settings = SwitchSettings(transition=0.1, slew=1e9)
    out, out_std, active = switch(beta, beta_std, decision, settings, DT, 0)
    at = int(np.flatnonzero(active)[0])
    step = np.diff(out)
    assert np.abs(step).max() <= 0.1 * (1.0 - np.exp(-DT / 0.1)) + 1e-12
    assert (step >= 0.0).all()
    assert out[at + 30] == pytest.approx(0.1, abs=0.1 * np.exp(-3.0))
    assert out[at + 200] == pytest.approx(0.1, abs=1e-9)
    # While two estimates disagree, the answer says so.
    assert out_std[at] > 0.08
    assert out_std[at + 200] == pytest.approx(0.01, rel=1e-6)


def test_nervous_decisions_make_no_bump_either():
    beta, beta_std, decision = wandering()
    settings = SwitchSettings(dwell=0.0, confirm=0.0, transition=0.1, slew=1e9)
    out, _, active = switch(beta, beta_std, decision, settings, DT, 0)
    assert np.count_nonzero(np.diff(active)) > 50
    now = np.arange(1, N)
    own = beta[now, active[1:]] - beta[now - 1, active[1:]]  # what the active filter itself did
    hard = np.abs(np.diff(beta[np.arange(N), active])).max()
    caused = np.abs(np.diff(out) - own).max()
    spread = np.ptp(beta, axis=1).max()
    assert hard > 0.1
    assert caused <= (1.0 - np.exp(-DT / 0.1)) * spread + 1e-12
    assert caused < 0.2 * hard


def test_seconds_mean_the_same_at_every_rate():
    beta, beta_std, _ = wandering()
    decision = np.repeat(np.arange(N // 50) % 3, 50)
    slow = switch(beta, beta_std, decision, SwitchSettings(dwell=0.3), DT, 0)
    twice = [np.repeat(x, 2, axis=0) for x in (beta, beta_std, decision)]
    fast = switch(*twice, SwitchSettings(dwell=0.3), DT / 2, 0)
    at_slow, at_fast = (DT * np.flatnonzero(np.diff(slow[2])), DT / 2 * np.flatnonzero(np.diff(fast[2])))
    np.testing.assert_allclose(at_slow, at_fast, atol=1.5 * DT)
    assert np.abs(slow[0] - fast[0][::2]).mean() < 0.002


@pytest.mark.parametrize("settings", [SwitchSettings(), AT_ONCE, SwitchSettings(dwell=60.0)])
@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_lost_filter_is_never_selected(settings, lost):
    beta, beta_std, decision = wandering()
    rng = np.random.default_rng(1)
    for column in range(3):
        for start in rng.integers(0, N, 40):
            others = np.delete(np.arange(3), column)
            span = slice(start, start + int(rng.integers(1, 80)))
            if np.isfinite(beta[span, others]).any(axis=1).all():
                target = beta if rng.random() < 0.5 else beta_std
                target[span, column] = lost
    whole = np.isfinite(beta) & np.isfinite(beta_std)
    beta[~whole.any(axis=1)] = beta_std[~whole.any(axis=1)] = 0.0
    whole = np.isfinite(beta) & np.isfinite(beta_std)
    assert (~whole).mean() > 0.2
    out, out_std, active = switch(beta, beta_std, decision, settings, DT, 0)
    assert np.isfinite(out).all()
    assert np.isfinite(out_std).all()
    assert whole[np.arange(N), active].all()


def test_leaving_a_lost_filter_makes_no_bump():
    beta, beta_std = np.tile([0.0, 0.1], (N, 1)), np.full((N, 2), 0.01)
    beta[1000:, 0] = np.nan
    out, _, active = switch(beta, beta_std, np.zeros(N, dtype=int), SwitchSettings(), DT, 0)
    assert active[999] == 0
    assert active[1000] == 1
    assert np.abs(np.diff(out)).max() <= 0.1 * (1.0 - np.exp(-DT / 0.1)) + 1e-12
    assert out[-1] == pytest.approx(0.1)


def test_it_recovers_when_all_filters_were_lost():
    beta, beta_std, decision = wandering()
    beta[500:510] = np.nan
    out, _, _ = switch(beta, beta_std, decision, SwitchSettings(), DT, 0)
    assert np.isfinite(np.delete(out, np.s_[500:510])).all()


@pytest.mark.parametrize("k", [0, 499, 2000])
def test_later_samples_change_nothing(k):
    beta, beta_std, decision = wandering()
    before = switch(beta, beta_std, decision, SwitchSettings(), DT, 0)
    beta[k + 1 :], beta_std[k + 1 :], decision[k + 1 :] = np.nan, 9.0, 2 - decision[k + 1 :]
    after = switch(beta, beta_std, decision, SwitchSettings(), DT, 0)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one[: k + 1], other[: k + 1])


@pytest.mark.parametrize("sizes", [(1,), (7, 1, 300)])
def test_pieces_make_the_same_drive(sizes):
    beta, beta_std, decision = wandering()
    beta[700:705, 1] = np.nan
    whole = switch(beta, beta_std, decision, SwitchSettings(), DT, 0)
    state = make_switch_state(3, 0, switch_times(SwitchSettings(), DT))
    parts, at = [], 0
    while at < N:
        cut = slice(at, at + sizes[len(parts) % len(sizes)])
        parts.append(run_switch(beta[cut], beta_std[cut], decision[cut], SwitchSettings(), DT, state))
        at = cut.stop
    for one, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(one, np.concatenate(pieces))


def barred_until(beta: np.ndarray, settings: SwitchSettings) -> int:
    """Sample at which filter 1 is active first, when it is wanted from sample 100 on."""
    beta_std, decision = np.full((N, 2), 0.01), (np.arange(N) >= 100).astype(int)
    _, _, active = switch(beta, beta_std, decision, settings, DT, 0)
    return int(np.flatnonzero(active)[0])


def test_a_filter_that_was_lost_jumped_or_stood_still_must_settle_first():
    settings = SwitchSettings(dwell=0.0, confirm=0.0, settle=0.5, stale=0.3)
    sound = np.stack([0.05 * np.sin(DT * np.arange(N)), 0.05 * np.cos(DT * np.arange(N))], axis=1)
    assert barred_until(sound, settings) == 100
    lost, jumped, still = sound.copy(), sound.copy(), sound.copy()
    lost[90:96, 1] = np.nan
    assert barred_until(lost, settings) == 96 + 50
    jumped[95:, 1] += 0.3  # 17 deg in 10 ms: it was started anew
    assert barred_until(jumped, settings) == 96 + 50
    still[50:200, 1] = still[50, 1]
    assert barred_until(still, settings) == 200 + 50


def test_an_active_filter_that_stands_still_gives_way():
    beta = np.stack([0.05 * np.sin(DT * np.arange(N)), 0.05 * np.cos(DT * np.arange(N))], axis=1)
    beta[1000:1500, 0] = beta[1000, 0]
    _, _, active = switch(beta, np.full((N, 2), 0.01), np.zeros(N, dtype=int), SwitchSettings(), DT, 0)
    assert set(active[:1040]) == set(active[1600:]) == {0}
    assert set(active[1060:1500]) == {1}


def test_a_large_step_does_not_show_as_a_jump():
    beta, beta_std = np.tile([0.0, 0.3], (N, 1)), np.full((N, 2), 0.01)  # 17 deg apart
    out, _, active = switch(beta, beta_std, (np.arange(N) >= 1000).astype(int), SwitchSettings(), DT, 0)
    assert set(active) == {0, 1}
    assert np.degrees(np.abs(np.diff(out)).max()) < 0.3
    assert out[1200] == pytest.approx(0.3, abs=1e-3)


def test_what_is_left_of_a_step_never_points_beyond_what_a_filter_may_say():
    """From a filter that has run off to one that swings away: their step fades on top of the swing."""
    most, t = np.radians(80.0), DT * np.arange(N)
    beta = np.stack([np.full(N, most), 0.3 * (1.0 - np.cos(np.maximum(t - 1.0, 0.0)))], axis=1)
    settings = SwitchSettings(dwell=0.0, confirm=0.0, transition=50.0)
    out, out_std, active = switch(beta, np.full((N, 2), 0.01), np.where(t < 1.0, 0, 1), settings, DT, 0)
    assert active[200] == 1
    assert np.abs(out).max() == most
    assert np.isfinite(out_std).all()

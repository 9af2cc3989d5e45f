"""What passes: a criterion for each kind of fault, on the answers to a faulty log beside those to the sound one."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from crosscomb.signals import MIN_SPEED
from crosscomb.training.suites.fault_trials import FLAGS, WRONG, Trial, holds

SAME_SAMPLE = 0.016
"""Rows of this time [s] are of the same sample: the filters' own are 10 ms apart, and a row may fall between them."""

LITTLE = 0.1
"""Flags begin and end this close [s] where particle filters only draw otherwise."""

LASTING = 0.95
"""Share of the excited rows that a flag which lasts as long as its fault is up in."""

NOT_JUDGED = "not judged"
"""The log does not hold what the criterion asks about."""

PASSED = ""

Judge = Callable[[Trial], str]
"""Gives why a trial fails, `PASSED` or `NOT_JUDGED`."""


def judge(kind: str, trial: Trial) -> str:
    """Judge a trial: what holds for any fault first, then what is asked of its kind."""
    if not trial.faulty.finite.all():
        return "an answer is not finite"
    return CRITERIA[kind](trial)


def close(trial: Trial, most: float, since: float = 0.0) -> str:
    """Stay within so many deg of the sound run, from a time [s] on."""
    late = trial.t >= since
    apart = trial.apart[late]
    if not apart.size or apart.max() <= most:
        return PASSED
    return f"{apart.max():.2f} deg off at {trial.t[late][np.argmax(apart)]:.2f} s"


def flagged_in(trial: Trial, rows: int) -> str:
    """Be flagged within so many samples."""
    if trial.flagged[:rows].any():
        return PASSED
    return f"no flag in {rows} samples; {_first(trial)}"


def _first(trial: Trial) -> str:
    rows = np.flatnonzero(trial.flagged)
    return f"the first after {trial.t[rows[0]]:.2f} s" if rows.size else "none at all"


def unflagged(trial: Trial, since: float) -> str:
    """Have no flag left from a time [s] on; one that begins or ends a little otherwise is not left."""
    left = trial.newly(*FLAGS, within=LITTLE) & (trial.t >= since)
    return f"a flag is left at {trial.t[left].max():.2f} s" if left.any() else PASSED


def all_of(*failures: str) -> str:
    """Join reasons for failing."""
    return "; ".join(failure for failure in failures if failure)


def brief_dropout(trial: Trial) -> str:
    """Within 0.5 deg of the sound run."""
    return close(trial, 0.5)


def long_dropout(trial: Trial) -> str:
    """Flagged within 10 samples; within 0.5 deg of the sound run from 2 s after the return on."""
    return all_of(flagged_in(trial, 10), close(trial, 0.5, trial.lasts + 2.0))


def lasting_dropout(trial: Trial) -> str:
    """Degraded or invalid within 0.2 s, and beta_std larger than in the sound run over the second half."""
    told = trial.newly("degraded", "invalid") & (trial.t <= 0.2)
    later = trial.t > 0.5 * trial.t[-1]
    grown = trial.faulty.beta_std[later].mean() / max(trial.sound.beta_std[later].mean(), 1e-9)
    return all_of(
        PASSED if told.any() else "neither degraded nor invalid in 0.2 s",
        PASSED if grown > 1.0 else f"beta_std is {grown:.2f} of that of the sound run",
    )


def stuck(trial: Trial) -> str:
    """Flagged within 100 samples."""
    return flagged_in(trial, 100)


def one_spike(trial: Trial) -> str:
    """Within 0.35 deg of the sound run, and no flag from 2 s on."""
    return all_of(close(trial, 0.35), unflagged(trial, 2.0))


def ten_spikes(trial: Trial) -> str:
    """Flagged within 10 samples; 2 s after the last within 0.35 deg of the sound run, and no flag."""
    back = trial.lasts + 2.0
    return all_of(flagged_in(trial, 10), close(trial, 0.35, back), unflagged(trial, back))


def no_number(trial: Trial) -> str:
    """Flagged on the same sample."""
    return flagged_in(trial, max(int(np.searchsorted(trial.t, SAME_SAMPLE)), 1))


def told_or_inside(trial: Trial, seconds: float) -> str:
    """Be flagged within so much excited driving [s], or have the error inside 3 beta_std until the flag.

    Rows in which the sound run itself lies outside do not count. Without ground truth the sound run is the truth.
    """
    _, clock = trial.excited_time()
    due = int(np.searchsorted(clock, seconds, side="right"))
    flagged = trial.flagged
    if flagged[:due].any():
        return PASSED
    counted = trial.vx > MIN_SPEED
    truth = np.where(np.isfinite(trial.truth), trial.truth, trial.sound.beta)
    outside = counted & ~flagged & (np.abs(trial.faulty.beta - truth) > 3.0 * trial.faulty.beta_std)
    outside &= np.abs(trial.sound.beta - truth) <= 3.0 * trial.sound.beta_std
    if not outside.any():
        return PASSED
    if due == len(clock):
        return NOT_JUDGED
    worst = np.degrees(np.abs(trial.faulty.beta - truth)[outside].max())
    return f"no flag in {seconds:g} s of excited driving, {worst:.1f} deg wrong; {_first(trial)}"


def steady_error(trial: Trial) -> str:
    """Flagged within 5 s of excited driving, or the error inside 3 beta_std."""
    return told_or_inside(trial, 5.0)


def slow_error(trial: Trial) -> str:
    """Flagged within 10 s of excited driving, or the error inside 3 beta_std."""
    return told_or_inside(trial, 10.0)


def noisy(trial: Trial) -> str:
    """Within 1.5 deg of the sound run, and at most 2 switches in any second."""
    switched = np.append(False, trial.faulty.active[1:] != trial.faulty.active[:-1])
    times = trial.t[switched & (trial.t <= trial.lasts + 1.0)]
    most = max((int(np.sum((times >= t) & (times < t + 1.0))) for t in times), default=0)
    return all_of(close(trial, 1.5), f"{most} switches in a second" if most > 2 else PASSED)


def wrong_sign(trial: Trial) -> str:
    """Flagged after 2 s of excited driving, and in 95 % of the excited rows from there on."""
    excited, clock = trial.excited_time()
    due = excited & (clock > 2.0)
    if not due.any():
        return NOT_JUDGED
    share = float(np.mean(trial.flagged[due]))
    return PASSED if share >= LASTING else f"flagged in {share:.0%} of the excited rows; {_first(trial)}"


def jittering(trial: Trial) -> str:
    """Within 0.2 deg of the sound run."""
    return close(trial, 0.2)


def dropped_row(trial: Trial) -> str:
    """One row dropped, and counted in a note."""
    return all_of(
        PASSED if trial.dropped == 1 else f"{trial.dropped} rows dropped",
        PASSED if trial.notes else "no note",
    )


def gap(trial: Trial) -> str:
    """Flagged within 10 samples."""
    return flagged_in(trial, 10)


def banked(trial: Trial) -> str:
    """Within 1.5 deg of the sound run, or flagged in 3 s."""
    return PASSED if trial.flagged[trial.t <= 3.0].any() else close(trial, 1.5)


def diverged(trial: Trial) -> str:
    """Within 1.5 deg of the sound run, or flagged, at all rows from 3 s on."""
    apart = np.where((trial.t > 3.0) & ~trial.flagged, trial.apart, 0.0)
    return f"{apart.max():.1f} deg off without a flag" if apart.max() > 1.5 else PASSED


def standing(trial: Trial) -> str:
    """Low speed at all rows of a standing car."""
    still = np.abs(trial.vx) < 1.0
    if not still.any():
        return NOT_JUDGED
    missed = still & ~holds(trial.faulty.status, "low_speed")
    return f"no low_speed in {np.mean(missed[still]):.0%} of the rows at rest" if missed.any() else PASSED


def reversing(trial: Trial, words: tuple[str, ...] = ("reverse",), after: float = 0.5) -> str:
    """Reverse in 95 % of the rows after 0.5 s of it."""
    forward = np.maximum.accumulate(np.where(trial.vx > -0.5, trial.t, trial.t[0]))
    due = trial.t - forward > after
    if not due.any():
        return NOT_JUDGED
    told = np.any([holds(trial.faulty.status, word) for word in words], axis=0)
    share = float(np.mean(told[due]))
    return PASSED if share >= LASTING else f"told in {share:.0%} of the rows"


def unsigned_reversing(trial: Trial) -> str:
    """Reverse or invalid after 3 s of it."""
    return reversing(trial, ("reverse", "invalid"), 3.0)


def spinning(trial: Trial) -> str:
    """Right (within 3 deg or 3 beta_std) or invalid within 0.2 s, in a car that is past 45 deg."""
    spun = trial.counted & (np.abs(trial.truth) > math.radians(45.0))
    if not spun.any():
        return NOT_JUDGED
    error = np.abs(trial.faulty.beta - trial.truth)
    right = error <= np.maximum(3.0 * trial.faulty.beta_std, WRONG)
    wrong = spun & ~right & ~holds(trial.faulty.status, "invalid")
    since = np.maximum.accumulate(np.where(wrong, trial.t[0], trial.t))
    longest = float(np.max(np.where(wrong, trial.t - since, 0.0)))
    return f"wrong for {longest:.2f} s and not invalid" if longest > 0.2 else PASSED


CRITERIA: dict[str, Judge] = {
    "dropout 0.1 s": brief_dropout,
    "dropout 2 s": long_dropout,
    "dropout for good": lasting_dropout,
    "stuck": stuck,
    "one spike": one_spike,
    "absurd value": one_spike,
    "ten spikes": ten_spikes,
    "NaN for 1 s": no_number,
    "infinity for 1 s": no_number,
    "bias": steady_error,
    "slow drift": slow_error,
    "scale 1.2": steady_error,
    "100 ms late": steady_error,
    "noise x 10": noisy,
    "sign flip": wrong_sign,
    "jitter 20 %": jittering,
    "gap of 3 s": gap,
    "repeated stamp": dropped_row,
    "stamp backwards": dropped_row,
    "repeated last row": dropped_row,
    "cut last row": brief_dropout,
    "bank 5 deg": banked,
    "mass +20 %": steady_error,
    "mass -20 %": steady_error,
    "stiffness halved": steady_error,
    "friction halved": steady_error,
    "filter diverges": diverged,
    "standstill": standing,
    "reversing": reversing,
    "unsigned reversing": unsigned_reversing,
    "spin": spinning,
}
"""The criterion of each kind of fault, in the order of the table."""

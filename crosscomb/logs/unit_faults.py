"""Which slips of unit or sign put a log's channels at odds, told from ratios that should be about 1.

A wrong unit puts every tie of its channel out by a known factor. The simplest set of faults that puts all
ties right is taken; where several sets do, all are named, because the log cannot decide between them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from crosscomb.logs.gaps import Finding
from crosscomb.signals import UNITS, WHEEL_SPEEDS

MOST_SLIPS = 3
"""More slips than this explain anything and therefore nothing."""


@dataclass(frozen=True)
class Fault:
    """One way for a channel to be wrong; its values times ``factor`` are right."""

    channel: str
    factor: float
    looks: str
    mend: str
    sure: bool = True


@dataclass(frozen=True)
class Tie:
    """A ratio of channels that is about 1 when all is right."""

    text: str
    powers: dict[str, int]
    ratio: float
    possible: tuple[float, float]  # a ratio outside is plainly wrong
    likely: tuple[float, float]  # where a set of faults must bring it back to
    left: float = np.inf  # rms of the side of the first channel in `powers`
    right: float = np.inf  # rms of the other side
    least: float = 0.0  # what is smaller in SI units is noise and offsets
    signed: bool = False  # whether the sign of the ratio is to be believed

    def mended(self, faults: tuple[Fault, ...]) -> Tie:
        ratio, left = self.ratio, self.left
        for fault in faults:
            ratio *= fault.factor ** self.powers.get(fault.channel, 0)
            if fault.channel == next(iter(self.powers)):
                left *= abs(fault.factor)
        return replace(self, ratio=ratio if self.signed else abs(ratio), left=left)

    def is_possible(self) -> bool:
        return self.possible[0] <= self.ratio <= self.possible[1]

    def is_likely(self) -> bool:
        return self.likely[0] <= self.ratio <= self.likely[1] and self.left >= self.least

    def is_loud(self) -> bool:
        return max(self.left, self.right) >= self.least


def unit_fault(channel: str, unit: str, factor: float) -> Fault:
    """A channel in a foreign unit that is ``factor`` in SI; ``wheels`` stands for the four wheel speeds."""
    wheels = channel == "wheels"
    name = "vfl" if wheels else channel
    mend = f'[channels.{name}] unit = "{unit}"' + (", the same for vfr, vrl and vrr" if wheels else "")
    looks = f"looks like {unit}, not {UNITS[name]}"
    return Fault(channel, factor, looks, mend)


def sign_fault(channel: str, sure: bool = True) -> Fault:
    """A channel that counts the other way round."""
    return Fault(channel, -1.0, "looks reversed", f"[channels.{channel}] sign = -1", sure)


def explain(ties: list[Tie], slips: list[tuple[Fault, ...]]) -> list[tuple[Fault, ...]]:
    """The simplest sets of faults that put most ties right and none wrong; an empty set where all is right.

    Parameters
    ----------
    ties : list of Tie
        What the log can judge.
    slips : list of tuple of Fault
        Single faults, and groups that usually go together: dearer than one fault, cheaper than two.
    """
    best: list[tuple[Fault, ...]] = [()]
    least = _cost((), ties)
    for count in range(1, MOST_SLIPS + 1):
        for chosen in itertools.combinations(slips, count):
            price = sum(1.0 if len(slip) == 1 else 1.5 for slip in chosen)
            faults = tuple(dict.fromkeys(itertools.chain.from_iterable(chosen)))
            if price > least or len(faults) < sum(map(len, chosen)):
                continue
            cost = price + _cost(faults, ties)
            if cost < least:
                best, least = [], cost
            if cost == least:
                best.append(faults)
    return best


def _cost(faults: tuple[Fault, ...], ties: list[Tie]) -> float:
    """A price for each tie that the faults leave wrong, which is more than that of `MOST_SLIPS` slips."""
    wrong = 0
    for tie in ties:
        mended = tie.mended(faults)
        if tie.is_possible():
            if not mended.is_possible():
                return np.inf
        elif mended.ratio == tie.ratio:
            wrong += tie.is_loud()
        else:
            wrong += not mended.is_likely()
    return (2.0 * MOST_SLIPS) * wrong


def findings_of(sets: list[tuple[Fault, ...]], ties: list[Tie]) -> list[Finding]:
    """One line for each certain fault, one for the alternatives, one for each tie left unexplained."""
    certain = [fault for fault in sets[0] if all(fault in faults for faults in sets)]
    findings = [_finding([(fault,)], sets[0], ties) for fault in certain]
    if len(sets) > 1:
        rest = [tuple(fault for fault in faults if fault not in certain) for faults in sets]
        findings.append(_finding(rest, sets[0], ties))
    for tie in ties:
        if not tie.is_possible() and tie.is_loud() and not tie.mended(sets[0]).is_likely():
            text = tie.text.format(f"{tie.ratio:.2g}")
            message = f"{text}, which no usual slip of unit or sign explains: check these channels"
            severity: Literal["error", "warning"] = "error" if tie.least == 0.0 else "warning"
            findings.append(Finding(severity, next(iter(tie.powers)), message))
    return findings


def _finding(sets: list[tuple[Fault, ...]], all_faults: tuple[Fault, ...], ties: list[Tie]) -> Finding:
    """One line on one set of faults, or on several between which the log cannot decide."""
    channels = {fault.channel for faults in sets for fault in faults}
    evidence = [
        tie.text.format(f"{tie.ratio:.2g}")
        for tie in ties
        if channels & set(tie.powers) and not tie.is_possible() and tie.mended(all_faults).is_likely()
    ]
    if not evidence:
        evidence = ["the other channels of its kind are so, and it goes with them"]
    looks = ", or ".join(
        " and ".join(f"{', '.join(_columns(fault))} {fault.looks}" for fault in faults) for faults in sets
    )
    mend = ", or ".join(" and ".join(fault.mend for fault in faults) for faults in sets)
    severity: Literal["error", "warning"] = "error" if all(fault.sure for fault in sets[0]) else "warning"
    message = f"{looks}: {'; '.join(evidence[:2])}: write in a channel map (`channel_map`): {mend}"
    return Finding(severity, _columns(sets[0][0])[0], message)


def _columns(fault: Fault) -> tuple[str, ...]:
    return WHEEL_SPEEDS if fault.channel in ("wheels", "sides") else (fault.channel,)

"""Find channels that are plainly in the wrong unit or of the wrong sign, before a filter believes them.

Channels are tied to each other by physics: ay to vx * yaw_rate, the steering angle to wheelbase * yaw_rate / vx,
vx to the wheels. A wrong unit puts every tie of its channel out by a known factor. The smallest set of faults
that puts all ties right is reported; where several sets do, all are named. A tie counts only where the log
excites it and it holds closely, so quiet driving and drifting raise nothing.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from crosscomb.coverage import Finding, check_coverage
from crosscomb.models.vehicle import Vehicle
from crosscomb.resample import resample
from crosscomb.signals import GRAVITY, UNITS, WHEEL_SPEEDS, Signals

RATE = 20.0
"""Channels are compared at this rate [Hz], after a moving average over `SMOOTHING` samples."""
SMOOTHING = 9

LIMITS = {"vx": 120.0, "vx_ref": 120.0, "yaw_rate": 10.0, "steer": 1.5, "steer_wheel": 35.0}
"""In SI units no car is beyond these for more than 2 % of a log. Nor is beta_ref beyond pi, even in a spin."""

MOST_SLIPS = 3
"""More slips than this explain anything and therefore nothing."""

_DEGREE = np.pi / 180.0
_WIDE = ((-0.3, 6.0), (0.2, 4.0))  # for ties that only judge degrees and sign


@dataclass(frozen=True)
class _Fault:
    """One way for a channel to be wrong; its values times ``factor`` are right."""

    channel: str
    factor: float
    looks: str
    mend: str
    sure: bool = True


@dataclass(frozen=True)
class _Tie:
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

    def mended(self, faults: tuple[_Fault, ...]) -> _Tie:
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


def check_units(signals: Signals, vehicle: Vehicle) -> list[Finding]:
    """Check units, signs and coverage of a log against physics and its own channels.

    Parameters
    ----------
    signals : Signals
        The log as read; columns that `crosscomb.prepare.complete` adds would only confirm themselves.
    vehicle : Vehicle
        Its wheelbase, track and steering ratio are used; those of a similar car will do.

    Returns
    -------
    list of Finding
        Errors first.
    """
    slow = _check_time_unit(signals)
    if slow:
        return slow
    table = _smoothed(signals)
    ties = [*_limit_ties(signals, LIMITS), *(_channel_ties(signals, table, vehicle) if table else [])]
    sets = _explain(ties, _possible_faults(signals, ties, vehicle))
    reference_ties = _limit_ties(signals, {"beta_ref": 3.2})
    if table and len(sets) == 1:
        reference_ties += _reference_ties(_mended(table, sets[0]), vehicle)
    reference_sets = _explain(reference_ties, _reference_faults())
    return [*_errors(sets, ties), *_errors(reference_sets, reference_ties), *check_coverage(signals)]


def _check_time_unit(signals: Signals) -> list[Finding]:
    step = float(np.median(np.diff(signals.t)))
    if step < 0.5:
        return []
    unit = "ms" if step < 1e3 else "us" if step < 1e6 else "ns"
    message = (
        f"t looks like {unit}, not s: the rows are {step:g} s apart, and a log so slow is of no use: "
        f'write in a channel map (--map): [channels.t] unit = "{unit}"'
    )
    return [Finding("error", "t", message)]


def _smoothed(signals: Signals) -> dict[str, np.ndarray]:
    """Low-passed channels on a regular grid, with the rates of vx and of vy = vx * beta_ref."""
    parts = []
    for segment in resample(signals, RATE):
        if len(segment.signals) < 2 * SMOOTHING:
            continue
        part = {name: _moving_average(segment.signals.column(name)) for name in UNITS if name != "t"}
        part["wheels"] = np.mean([part[wheel] for wheel in WHEEL_SPEEDS], axis=0)
        part["speed"] = part["vx"] if signals.has("vx") else part["wheels"]
        part["speed_rate"] = np.gradient(part["speed"]) * RATE
        part["vy_rate"] = np.gradient(part["speed"] * part["beta_ref"]) * RATE
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def _moving_average(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    box = np.ones(SMOOTHING)
    total = np.convolve(np.where(known, values, 0.0), box, "same")
    count = np.convolve(known, box, "same")
    return np.where(count > SMOOTHING // 2, total / np.maximum(count, 1.0), np.nan)


def _limit_ties(signals: Signals, limits: dict[str, float]) -> list[_Tie]:
    ties = []
    for name, limit in limits.items():
        values = np.abs(signals.column(name))
        if signals.has(name):
            reach = float(np.nanquantile(values, 0.98))
            text = f"{name} reaches {reach:.3g} {UNITS[name]}"
            ties.append(_Tie(text, {name: 1}, reach / limit, (0.0, 1.0), (0.0, 1.0)))
    return ties


def _channel_ties(signals: Signals, table: dict[str, np.ndarray], vehicle: Vehicle) -> list[_Tie]:
    """The ties between channels that this log can judge."""
    speed = "vx" if signals.has("vx") else "wheels"
    steer, ratio = ("steer", 1.0) if signals.has("steer") else ("steer_wheel", vehicle.steering_ratio)
    of_hand = "" if steer == "steer" else "steering_ratio * "
    table = {name: values[np.abs(table["speed"]) > 2.0] for name, values in table.items()}
    v, yaw_rate = table["speed"], table["yaw_rate"]
    ties = [
        _tie("ay is {} of vx * yaw_rate", {"ay": 1, speed: -1, "yaw_rate": -1}, table["ay"], v * yaw_rate, 0.8, 0.85, 0.7),
        # Understeer takes up to twice the angle of a slow turn, and sliding front wheels much more.
        _tie(
            f"{steer} is {{}} of {of_hand}wheelbase * yaw_rate / vx",
            {steer: 1, speed: 1, "yaw_rate": -1},
            *(table[steer] / ratio, vehicle.wheelbase * yaw_rate / v, 0.75, 0.9, 0.008, (0.5, 8.0), (0.6, 2.2)),
        ),
        _tie("ax is {} of the slope of vx", {"ax": 1, speed: -1}, table["ax"], table["speed_rate"], 0.85, 0.85, 0.3),
        _tie("vx_ref is {} of vx", {"vx_ref": 1, speed: -1}, table["vx_ref"], v, 0.9, 2.0, 2.0),
        _tie("vx is {} of the wheel speeds", {"vx": 1, "wheels": -1}, table["vx"], table["wheels"], 0.9, 2.0, 2.0),
        _tie(
            "vrr - vrl is {} of track * yaw_rate",
            {"wheels": 1, "sides": 1, "yaw_rate": -1},
            *(table["vrr"] - table["vrl"], vehicle.track_rear * yaw_rate, 0.85, 0.9, 0.1),
        ),
        _tie(
            "steer_wheel is {} of steering_ratio * steer",
            {"steer_wheel": 1, "steer": -1},
            *(table["steer_wheel"] / vehicle.steering_ratio, table["steer"], 0.9, 0.95, 0.003, (0.3, 3.0)),
        ),
    ]
    return [tie for tie in ties if tie is not None]


def _mended(table: dict[str, np.ndarray], faults: tuple[_Fault, ...]) -> dict[str, np.ndarray]:
    factors = {"ay": 1.0, "yaw_rate": 1.0, "vx": 1.0, "wheels": 1.0}
    for fault in faults:
        factors[fault.channel] = factors.get(fault.channel, 1.0) * fault.factor
    factors["speed"] = factors["vy_rate"] = factors["vx"] if np.isfinite(table["vx"]).any() else factors["wheels"]
    return {name: values * factors.get(name, 1.0) for name, values in table.items()}


def _reference_ties(table: dict[str, np.ndarray], vehicle: Vehicle) -> list[_Tie]:
    """What beta_ref must agree with: drifting or not, vy changes only as fast as ay leaves over for it."""
    moving = np.abs(table["speed"]) > 3.0
    table = {name: values[moving] for name, values in table.items()}
    v, yaw_rate, vy_rate, beta = table["speed"], table["yaw_rate"], table["vy_rate"], table["beta_ref"]
    left_over = table["ay"] - v * yaw_rate
    known = np.isfinite(vy_rate) & np.isfinite(left_over)
    if known.sum() < 2.0 * RATE:
        return []
    bound = 5.0 * (float(np.sqrt(np.mean(left_over[known] ** 2))) + 0.2)
    rms = float(np.sqrt(np.mean(vy_rate[known] ** 2)))
    text = "with beta_ref the rate of vy is {} of the most that ay and yaw_rate allow"
    slow = (np.abs(v) < 9.0) & (np.abs(v * yaw_rate) < 3.0)
    drag = vehicle.cg_to_rear_axle * yaw_rate / v  # slip angle of a rear axle that does not slide
    ties = [
        _Tie(text, {"beta_ref": 1}, rms / bound, (0.0, 1.0), (0.0, 1.0)),
        _tie("the rate of vy is {} of ay - vx * yaw_rate", {"beta_ref": 1}, vy_rate, left_over, 0.9, 0.9, 0.5, *_WIDE),
        _tie(
            "in slow turns beta_ref is {} of cg_to_rear_axle * yaw_rate / vx",
            {"beta_ref": 1},
            *(beta[slow], drag[slow], 0.9, 0.9, 0.02, *_WIDE),
        ),
    ]
    return [tie for tie in ties if tie is not None]


def _tie(
    text: str,
    powers: dict[str, int],
    left: np.ndarray,
    right: np.ndarray,
    enough: float,
    enough_for_sign: float,
    least: float,
    possible: tuple[float, float] = (0.45, 2.2),
    likely: tuple[float, float] = (0.6, 1.7),
) -> _Tie | None:
    """Regress left on right, both through zero; the correlations that are `enough` say what may be concluded.

    A slip of unit or sign is the same in gentle and in violent rows; a ratio that differs comes from sliding.
    """
    known = np.isfinite(left) & np.isfinite(right)
    x, y = right[known], left[known]
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    if known.sum() < 2.0 * RATE or xx == 0.0 or yy == 0.0:
        return None
    correlation = xy / np.sqrt(xx * yy)
    if abs(correlation) < enough:
        return None
    gentle = np.abs(x) < 0.5 * np.quantile(np.abs(x), 0.98)
    gentle_ratio = float(x[gentle] @ y[gentle]) / max(float(x[gentle] @ x[gentle]), 1e-12)
    if not 0.75 <= gentle_ratio / (xy / xx) <= 1.33:
        return None
    signed = abs(correlation) >= enough_for_sign
    ratio = xy / xx if signed else abs(xy) / xx
    sizes = (float(np.sqrt(yy / known.sum())), float(np.sqrt(xx / known.sum())))
    return _Tie(text, powers, ratio, possible, likely, *sizes, least, signed)


def _unit_fault(channel: str, unit: str, factor: float) -> _Fault:
    wheels = channel == "wheels"
    name = "vfl" if wheels else channel
    mend = f'[channels.{name}] unit = "{unit}"' + (", the same for vfr, vrl and vrr" if wheels else "")
    looks = f"looks like {unit}, not {UNITS[name]}"
    return _Fault(channel, factor, looks, mend)


def _sign_fault(channel: str) -> _Fault:
    return _Fault(channel, -1.0, "looks reversed", f"[channels.{channel}] sign = -1")


def _possible_faults(signals: Signals, ties: list[_Tie], vehicle: Vehicle) -> list[tuple[_Fault, ...]]:
    """Single slips, and whole kinds of channels in one foreign unit, of the channels that the ties can judge."""
    speeds = [_unit_fault(channel, "km/h", 1.0 / 3.6) for channel in ("vx", "wheels", "vx_ref")]
    accelerations = [_unit_fault(channel, "g", GRAVITY) for channel in ("ay", "ax")]
    angles = [_unit_fault(channel, "deg", _DEGREE) for channel in ("steer", "steer_wheel")]
    angles.append(_unit_fault("yaw_rate", "deg/s", _DEGREE))
    signs = [_sign_fault(channel) for channel in ("ay", "ax", "yaw_rate", "steer", "steer_wheel")]
    if np.nanmedian(signals.column("vx" if signals.has("vx") else "vfl")) < 0.0:
        signs.append(_sign_fault("vx"))
    hand = _Fault(
        "steer",
        1.0 / vehicle.steering_ratio,
        "looks like the angle of the hand wheel, not of the road wheel",
        '[channels.steer_wheel] column = "steer"',
    )
    swapped = _Fault(
        "sides",
        -1.0,
        "look swapped, left and right",
        '[channels.vrl] column = "vrr" and [channels.vrr] column = "vrl", the same for vfl and vfr',
    )
    judged = {channel for tie in ties for channel in tie.powers}
    kinds = [tuple(fault for fault in kind if fault.channel in judged) for kind in (speeds, accelerations, angles)]
    singles = [(fault,) for fault in (*speeds, *accelerations, *angles, *signs, hand, swapped)]
    return [
        *(single for single in singles if single[0].channel in judged),
        *(kind for kind in kinds if len(kind) > 1),
    ]


def _reference_faults() -> list[tuple[_Fault, ...]]:
    return [(_unit_fault("beta_ref", "deg", _DEGREE),), (replace(_sign_fault("beta_ref"), sure=False),)]


def _explain(ties: list[_Tie], slips: list[tuple[_Fault, ...]]) -> list[tuple[_Fault, ...]]:
    """The simplest sets of faults that put most ties right and none wrong; one empty set where all is right."""
    best: list[tuple[_Fault, ...]] = [()]
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


def _cost(faults: tuple[_Fault, ...], ties: list[_Tie]) -> float:
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


def _errors(sets: list[tuple[_Fault, ...]], ties: list[_Tie]) -> list[Finding]:
    certain = [fault for fault in sets[0] if all(fault in faults for faults in sets)]
    findings = [_finding([(fault,)], sets[0], ties) for fault in certain]
    if len(sets) > 1:
        rest = [tuple(fault for fault in faults if fault not in certain) for faults in sets]
        findings.append(_finding(rest, sets[0], ties))
    for tie in ties:
        if not tie.is_possible() and tie.is_loud() and not tie.mended(sets[0]).is_likely():
            text = tie.text.format(f"{tie.ratio:.2g}")
            message = f"{text}, which no usual slip of unit or sign explains: check these channels"
            findings.append(Finding("error" if tie.least == 0.0 else "warning", next(iter(tie.powers)), message))
    return findings


def _finding(sets: list[tuple[_Fault, ...]], all_faults: tuple[_Fault, ...], ties: list[_Tie]) -> Finding:
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
    message = f"{looks}: {'; '.join(evidence[:2])}: write in a channel map (--map): {mend}"
    return Finding(severity, _columns(sets[0][0])[0], message)


def _columns(fault: _Fault) -> tuple[str, ...]:
    return WHEEL_SPEEDS if fault.channel in ("wheels", "sides") else (fault.channel,)

"""Find channels that are plainly in the wrong unit or of the wrong sign, before a filter believes them.

Channels are tied to each other by physics: ay to vx * yaw_rate, the steering angle to the wheelbase and the
curvature, vx to the wheels. A tie counts only where the log excites it and where it holds closely, so that
quiet driving, drifting and spinning raise nothing. What the ties prove is worked out in `crosscomb.logs.unit_faults`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from crosscomb.logs.gaps import Finding, Gaps
from crosscomb.logs.grid import to_grid
from crosscomb.logs.unit_faults import Fault, Tie, explain, findings_of, sign_fault, unit_fault
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import GRAVITY, UNITS, WHEEL_SPEEDS, Signals

RATE = 20.0
"""Channels are compared at this rate [Hz], after a moving average over `SMOOTHING` samples."""
SMOOTHING = 9

LIMITS = {
    **{"vx": 120.0, "vx_ref": 120.0, "yaw_rate": 10.0, "steer": 1.5, "steer_wheel": 35.0},
    **{"ax": 100.0, "ay": 100.0},
}
"""In SI units no car is beyond these for more than 2 % of a log."""
BETA_LIMIT = 3.2
"""Even in a spin [rad]."""

FRICTION_SLACK = 1.1
"""Lateral acceleration may be this much above what the vehicle file's friction allows before that is said."""

_FAR = 1e30  # larger values count as this: products of four and their sums stay finite, and what is absurd stays so
_DEGREE = np.pi / 180.0
_WIDE = (0.15, 6.0)  # for ties that are too loose to judge more than degrees and sign


_TABLE = (
    *("vx", "ax", "ay", "yaw_rate", "steer", "steer_wheel", *WHEEL_SPEEDS, "beta_ref", "vx_ref"),
    *("wheels", "speed", "speed_rate", "vy_rate"),
)
MOST = 1 << 15
"""So many numbers of each kind are looked at; of a longer log every second, fourth, eighth ... one."""


def check_units(signals: Signals, vehicle: Vehicle) -> list[Finding]:
    """Check units, signs and gaps of a log against physics and its own channels.

    Parameters
    ----------
    signals : Signals
        The log as read; columns that `crosscomb.logs.prepare.complete` adds would only confirm themselves.
    vehicle : Vehicle
        Its wheelbase, track and steering ratio are used; those of a similar car will do.

    Returns
    -------
    list of Finding
        Errors first. A log with an error should not be used before it is mended.
    """
    look = Look()
    look.take(signals)
    return look.findings(vehicle)


@dataclass
class Thinned:
    """At most `MOST` rows of many, evenly spread: every one, or every second, fourth, eighth ... one."""

    stride: int = 1
    count: int = 0  # rows that came
    kept: list[np.ndarray] = field(default_factory=list)

    def take(self, rows: np.ndarray) -> None:
        """Take the next rows ``(n, ...)``."""
        self.kept.append(rows[-self.count % self.stride :: self.stride].copy())
        self.count += len(rows)
        while -(-self.count // self.stride) > MOST:
            self.kept, self.stride = [self.rows()[::2].copy()], 2 * self.stride

    def rows(self) -> np.ndarray:
        """Those that were kept."""
        return np.concatenate(self.kept)


@dataclass
class Look:
    """What the checks of a log need, gathered piece by piece in memory that does not grow with the log."""

    gaps: Gaps = field(default_factory=Gaps)
    steps: Thinned = field(default_factory=Thinned)  # of t [s]
    values: dict[str, Thinned] = field(default_factory=dict)  # measurements of each channel
    smoothed: Thinned = field(default_factory=Thinned)  # rows of the `_TABLE`

    def take(self, signals: Signals) -> None:
        """Look at the next rows."""
        self.steps.take(np.diff(signals.t, prepend=self.gaps.t)[0 if self.gaps.rows else 1 :])
        self.gaps.take(signals)
        for name in signals.frame.columns.intersection([*LIMITS, "beta_ref", "vfl"]):
            values = signals.column(name)
            self.values.setdefault(name, Thinned()).take(values[np.isfinite(values)])
        for part in _smoothed(signals):
            self.smoothed.take(part)

    def has(self, name: str) -> bool:
        """Tell whether a channel holds at least one measurement."""
        return bool(self.gaps.measured.get(name))

    def findings(self, vehicle: Vehicle) -> list[Finding]:
        """As of `check_units`, on the rows so far."""
        slow = _check_time_unit(float(np.median(self.steps.rows())))
        if slow:
            return slow
        table = dict(zip(_TABLE, self.smoothed.rows().T, strict=True)) if self.smoothed.count else {}
        ties = _limit_ties(self, LIMITS)
        if table:
            ties += _channel_ties(self, table, vehicle)
        sets = explain(ties, _possible_faults(self, ties, vehicle))
        reference_ties = _limit_ties(self, {"beta_ref": BETA_LIMIT})
        if table and len(sets) == 1:
            reference_ties += _reference_ties(_mended(table, sets[0]), vehicle)
        in_degrees, reversed_ = unit_fault("beta_ref", "deg", _DEGREE), sign_fault("beta_ref", sure=False)
        reference_sets = explain(reference_ties, [(in_degrees,), (reversed_,)])
        findings = [*findings_of(sets, ties), *findings_of(reference_sets, reference_ties)]
        if table and not findings:
            findings = _friction_bound(table, vehicle)
        return sorted([*findings, *self.gaps.findings()], key=lambda finding: finding.severity)


def _check_time_unit(step: float) -> list[Finding]:
    if step < 0.5:
        return []
    unit = "ms" if step < 1e3 else "us" if step < 1e6 else "ns"
    message = (
        f"t looks like {unit}, not s: the rows are {step:g} s apart, and a log so slow is of no use: "
        f'write in a channel map (`channel_map`): [channels.t] unit = "{unit}"'
    )
    return [Finding("error", "t", message)]


def _smoothed(signals: Signals) -> Iterator[np.ndarray]:
    """Low-passed channels on a regular grid ``(n, _TABLE)``, with the rates of vx and of vy = vx * beta_ref.

    A long log may be cut anywhere: at the cuts a few samples are smoothed less.
    """
    known = signals.frame.columns.intersection(["t", *_TABLE])
    for segment in to_grid(replace(signals, frame=signals.frame[known]), RATE):
        n = len(segment.signals)
        if n < 2 * SMOOTHING:
            continue
        part = {name: np.full(n, np.nan) for name in _TABLE}
        part |= {name: _moving_average(segment.signals.column(name)) for name in known if name != "t"}
        part["wheels"] = _wheel_speed(part)
        part["speed"] = part["vx"] if signals.has("vx") else part["wheels"]
        part["speed_rate"] = np.gradient(part["speed"]) * RATE
        part["vy_rate"] = np.gradient(part["speed"] * part["beta_ref"]) * RATE
        yield np.column_stack([part[name] for name in _TABLE])


def _moving_average(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    box = np.ones(SMOOTHING)
    total = np.convolve(np.where(known, np.clip(values, -_FAR, _FAR), 0.0), box, "same")
    count = np.convolve(known, box, "same")
    return np.where(count > SMOOTHING // 2, total / np.maximum(count, 1.0), np.nan)


def _wheel_speed(part: dict[str, np.ndarray]) -> np.ndarray:
    """Speed of the wheel that is nearest to vx, as others may spin or lock; the mean where there is no vx."""
    wheels = np.stack([part[wheel] for wheel in WHEEL_SPEEDS])
    if not np.isfinite(part["vx"]).any():
        return wheels.mean(axis=0)
    distance = np.abs(np.log(np.maximum(np.abs(wheels), 0.1) / np.maximum(np.abs(part["vx"]), 0.1)))
    nearest = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=0)
    return np.take_along_axis(wheels, nearest[None], axis=0)[0]


def _limit_ties(look: Look, limits: dict[str, float]) -> list[Tie]:
    ties = []
    for name, limit in limits.items():
        if look.has(name):
            reach = float(np.quantile(np.abs(look.values[name].rows()), 0.98))
            text = f"{name} reaches {reach:.3g} {UNITS[name]}"
            ties.append(Tie(text, {name: 1}, reach / limit, possible=(0.0, 1.0), likely=(0.0, 1.0)))
    return ties


def _friction_bound(table: dict[str, np.ndarray], vehicle: Vehicle) -> list[Finding]:
    """Hold the log against |ay| = |yaw_rate vx| <= friction g (Atheupe 2023, eq. 30).

    Both sides count: in a spin the yaw rate, on a bank ay is large without force from the road.
    """
    force = np.fmin(np.abs(table["ay"]), np.abs(table["speed"] * table["yaw_rate"]))
    known = np.isfinite(force)
    reach = float(np.quantile(force[known], 0.99)) if known.any() else 0.0
    if reach <= FRICTION_SLACK * vehicle.friction * GRAVITY:
        return []
    message = (
        f"the road gives {reach:.3g} m/s^2 across the car, the vehicle file's friction of {vehicle.friction:g} allows "
        f"{vehicle.friction * GRAVITY:.3g}: write friction = {reach / GRAVITY:.2f} or more there"
    )
    return [Finding("warning", "ay", message)]


def _channel_ties(look: Look, table: dict[str, np.ndarray], vehicle: Vehicle) -> list[Tie]:
    """The ties between channels that this log can judge."""
    speed = "vx" if look.has("vx") else "wheels"
    steer, of_hand, ratio = "steer", "", 1.0
    if not look.has("steer"):
        steer, of_hand, ratio = "steer_wheel", "steering_ratio * ", vehicle.steering_ratio
    table = {name: values[np.abs(table["speed"]) > 2.0] for name, values in table.items()}
    v, v_rate, yaw_rate = table["speed"], table["speed_rate"], table["yaw_rate"]
    steer_tie = _tie(
        f"{steer} is {{}} of {of_hand}wheelbase * yaw_rate / vx",
        {steer: 1, speed: 1, "yaw_rate": -1},
        (table[steer] / ratio, vehicle.wheelbase * yaw_rate / v),
        correlation=(0.75, 0.9),
        least=0.008,
        possible=(
            0.5,
            8.0,
        ),  # understeer takes up to twice the angle of a slow turn, sliding front wheels more
        likely=(0.6, 2.2),
    )
    ay_tie = _tie(
        "ay is {} of vx * yaw_rate",
        {"ay": 1, speed: -1, "yaw_rate": -1},
        (table["ay"], v * yaw_rate),
        correlation=(0.8, 0.85),
        least=0.7,
        violence=yaw_rate,
    )
    ax_tie = _tie(
        "ax is {} of the slope of vx",
        {"ax": 1, speed: -1},
        (table["ax"], v_rate),
        correlation=(0.85, 0.85),
        least=0.3,
        violence=v_rate,
    )
    reference_tie = _tie(
        "vx_ref is {} of vx",
        {"vx_ref": 1, speed: -1},
        (table["vx_ref"], v),
        correlation=(0.95, 2.0),
        least=2.0,
        violence=v,
    )
    wheel_tie = _tie(
        "vx is {} of the wheel speeds",
        {"vx": 1, "wheels": -1},
        (table["vx"], table["wheels"]),
        correlation=(0.95, 2.0),
        least=2.0,
        violence=v,
    )
    # Near the limit the unloaded inner wheel spins, and is the faster one.
    calm = np.abs(v * yaw_rate) < 4.0
    side_tie = _tie(
        "vrr - vrl is {} of track * yaw_rate",
        {"wheels": 1, "sides": 1, "yaw_rate": -1},
        ((table["vrr"] - table["vrl"])[calm], vehicle.track_rear * yaw_rate[calm]),
        correlation=(0.9, 0.93),
        least=0.1,
        possible=_WIDE,
        likely=(0.6, 2.5),
    )
    hand_tie = _tie(
        "steer_wheel is {} of steering_ratio * steer",
        {"steer_wheel": 1, "steer": -1},
        (table["steer_wheel"] / vehicle.steering_ratio, table["steer"]),
        correlation=(0.9, 0.95),
        least=0.003,
        possible=(0.3, 3.0),
    )
    if steer_tie is None:
        ay_tie = None  # a car that does not follow its steering may spin, and then vy changes fast
    ties = [steer_tie, ay_tie, ax_tie, reference_tie, wheel_tie, side_tie, hand_tie]
    return [tie for tie in ties if tie is not None]


def _mended(table: dict[str, np.ndarray], faults: tuple[Fault, ...]) -> dict[str, np.ndarray]:
    factors = dict.fromkeys(("ay", "yaw_rate", "vx", "wheels"), 1.0)
    for fault in faults:
        factors[fault.channel] = factors.get(fault.channel, 1.0) * fault.factor
    source = "vx" if np.isfinite(table["vx"]).any() else "wheels"
    factors["speed"] = factors["vy_rate"] = factors[source]
    return {name: values * factors.get(name, 1.0) for name, values in table.items()}


def _reference_ties(table: dict[str, np.ndarray], vehicle: Vehicle) -> list[Tie]:
    """What beta_ref must agree with: drifting or not, vy changes only as fast as ay leaves over for it."""
    moving = table["speed"] > 3.0  # forward only: in reverse beta jumps between 180 and -180 deg
    table = {name: values[moving] for name, values in table.items()}
    v, yaw_rate, vy_rate = table["speed"], table["yaw_rate"], table["vy_rate"]
    left_over = table["ay"] - v * yaw_rate
    known = np.isfinite(vy_rate) & np.isfinite(left_over)
    if known.sum() < 2.0 * RATE:
        return []
    # Eight times, because ay holds offsets, roll and the lever arm of its sensor; degrees make it 57 times.
    most = 8.0 * (float(np.sqrt(np.mean(left_over[known] ** 2))) + 0.2)
    rms = float(np.sqrt(np.mean(vy_rate[known] ** 2)))
    text = "with beta_ref the rate of vy is {} of the most that ay and yaw_rate allow"
    size_tie = Tie(text, {"beta_ref": 1}, rms / most, possible=(0.0, 1.0), likely=(0.0, 1.0))
    rate_tie = _tie(
        "the rate of vy is {} of ay - vx * yaw_rate",
        {"beta_ref": 1},
        (vy_rate, left_over),
        correlation=(0.9, 0.9),
        least=0.5,
        possible=_WIDE,
        likely=_WIDE,
    )
    slow = (np.abs(v) < 9.0) & (np.abs(v * yaw_rate) < 3.0)
    turn_tie = _tie(
        "in slow turns beta_ref is {} of cg_to_rear_axle * yaw_rate / vx",
        {"beta_ref": 1},
        (table["beta_ref"][slow], (vehicle.cg_to_rear_axle * yaw_rate / v)[slow]),
        correlation=(0.9, 0.9),
        least=0.02,
        possible=_WIDE,
        likely=_WIDE,
    )
    return [tie for tie in (size_tie, rate_tie, turn_tie) if tie is not None]


def _tie(
    text: str,
    powers: dict[str, int],
    sides: tuple[np.ndarray, np.ndarray],
    *,
    correlation: tuple[float, float],
    least: float,
    possible: tuple[float, float] = (0.45, 2.2),
    likely: tuple[float, float] = (0.6, 1.7),
    violence: np.ndarray | None = None,
) -> Tie | None:
    """Regress the left side on the right one through zero; None where the log cannot judge.

    `correlation` is what it takes to judge the size, and the sign. A slip is the same in gentle and violent
    rows: where the ratio differs with the `violence`, the car slides, and nothing is judged.
    """
    known = np.isfinite(sides[0]) & np.isfinite(sides[1])
    y, x = sides[0][known], sides[1][known]
    xx, xy, yy = _product(x, x), _product(x, y), _product(y, y)
    if known.sum() < 2.0 * RATE or xx == 0.0 or yy == 0.0:
        return None
    found = abs(xy) / np.sqrt(xx * yy)
    if found < correlation[0]:
        return None
    if violence is not None:
        force = np.abs(violence[known])
        gentle = force < 0.4 * np.quantile(force, 0.98)
        gentle_xx, gentle_xy = _product(x[gentle], x[gentle]), _product(x[gentle], y[gentle])
        if gentle_xx > 0.01 * xx and not 0.75 <= (gentle_xy / gentle_xx) / (xy / xx) <= 1.33:
            return None
    signed = bool(found >= correlation[1])
    return Tie(
        text,
        powers,
        ratio=xy / xx if signed else abs(xy) / xx,
        possible=possible,
        likely=likely,
        left=float(np.sqrt(yy / known.sum())),
        right=float(np.sqrt(xx / known.sum())),
        least=least,
        signed=signed,
    )


def _product(x: np.ndarray, y: np.ndarray) -> float:
    """Scalar product; the BLAS would wake threads for it that cost more than they give."""
    return float(np.sum(x * y))


def _possible_faults(look: Look, ties: list[Tie], vehicle: Vehicle) -> list[tuple[Fault, ...]]:
    """Single slips, and whole kinds of channels in one foreign unit, of the channels that the ties judge."""
    speeds = [unit_fault(channel, "km/h", 1.0 / 3.6) for channel in ("vx", "wheels", "vx_ref")]
    accelerations = [unit_fault(channel, "g", GRAVITY) for channel in ("ay", "ax")]
    angles = [unit_fault(channel, "deg", _DEGREE) for channel in ("steer", "steer_wheel")]
    angles.append(unit_fault("yaw_rate", "deg/s", _DEGREE))
    signs = [sign_fault(channel) for channel in ("ay", "ax", "yaw_rate", "steer", "steer_wheel")]
    if np.median(look.values["vx" if look.has("vx") else "vfl"].rows()) < 0.0:
        signs.append(sign_fault("vx"))
    hand = Fault(
        "steer",
        1.0 / vehicle.steering_ratio,
        "looks like the angle of the hand wheel, not of the road wheel",
        '[channels.steer_wheel] column = "steer"',
    )
    swapped = Fault(
        "sides",
        -1.0,
        "look swapped, left and right",
        '[channels.vrl] column = "vrr" and [channels.vrr] column = "vrl", the same for vfl and vfr',
    )
    judged = {channel for tie in ties for channel in tie.powers}
    singles = [(fault,) for fault in (*speeds, *accelerations, *angles, *signs, hand, swapped)]
    kinds = [[fault for fault in kind if fault.channel in judged] for kind in (speeds, accelerations, angles)]
    return [
        *(single for single in singles if single[0].channel in judged),
        *(tuple(kind) for kind in kinds if len(kind) > 1),
    ]

"""Live: one sample in, one estimate out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from crosscomb.errors import UsageError
from crosscomb.logs.prepare import next_rows
from crosscomb.logs.watch import reason
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.answers import Plan, advance
from crosscomb.run.estimate import LogEstimate, next_estimate, start_run
from crosscomb.run.handling import STATES, Handling
from crosscomb.run.health import with_health
from crosscomb.run.motion import Motion, PointVelocity, point_velocity
from crosscomb.run.status import TEXTS
from crosscomb.run.tuned import Tuned
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import COLUMN, UNITS, Signals
from crosscomb.stamps import Stamps

_T = COLUMN["t"]


class StreamEstimate(NamedTuple):
    """Answer at one sample.

    Attributes
    ----------
    t : float [s]
    beta, beta_std : float [rad]
    active : str
        Name of the filter that is active.
    status : str
        ``ok``, or words joined by ``+``.
    filters : dict of str to float [rad]
        beta of each filter.
    vy : float [m/s]
        Of the centre of gravity.
    motion : Motion
        Of floats.
    handling : Handling
        Of floats and the word.
    reason : str
        Which channels and filters are bad and how, as in `LogEstimate`; empty where none is. ``time repeats`` or
        ``time goes backwards`` where the sample was dropped and this is the answer before it once more.
    """

    t: float
    beta: float
    beta_std: float
    active: str
    status: str
    filters: dict[str, float]
    vy: float
    motion: Motion
    handling: Handling
    reason: str

    def at(self, x: float, y: float = 0.0) -> PointVelocity:
        """Velocity of the point x [m] ahead and y [m] to the left of the centre of gravity."""
        return PointVelocity(*point_velocity(self.beta, self.beta_std, *self.motion, float(x), float(y)))


@dataclass
class StreamingEstimator:
    """Sideslip angle live: one sample in, one estimate out.

    The answers are those of `crosscomb.run.estimate.estimate_log` for the log of the same samples, bit for bit, also
    when they come in chunks. A sample is a mapping from column names (`crosscomb.signals.UNITS`) to SI values; what
    is left out, None or NaN is "no measurement". t is needed and increases: a sample that is not later than all before
    it is dropped, as a row of a log is, and told of. After more than a second without a sample everything begins anew.

    Parameters
    ----------
    vehicle : Vehicle
    artefact : Artefact
    filters : sequence of str, optional
        Estimators to run instead of the artefact's, see `estimate_log`.
    tuned : Tuned, optional
        Noise that takes the place of the filters' own.

    Examples
    --------
    >>> from crosscomb import StreamingEstimator, load_artefact, load_vehicle
    >>> live = StreamingEstimator(load_vehicle("generic_compact"), load_artefact())
    >>> live.step({"t": 0.0, "vx": 20.0, "ax": 0.0, "ay": 0.0, "yaw_rate": 0.0, "steer": 0.0}).status
    'ok'
    """

    vehicle: Vehicle
    artefact: Artefact
    filters: Sequence[str] | None = None
    tuned: Tuned | None = None

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything that came so far: the next sample is the first one of a new log."""
        self._run = start_run(self.vehicle, self.artefact, self.filters, self.tuned)
        self._stamps = Stamps(live=True)

    def step(self, sample: Mapping[str, float] | pd.Series) -> StreamEstimate:
        """Take one sample.

        One that repeats a time or goes back a little is dropped: the answer before it comes again, with the reason.

        Raises
        ------
        UsageError
            An unknown column, a value that is no number, t missing or more than a second back, or a repeated t whose
            sample holds what the one before lacks.
        """
        rows = sample_row(sample)[None, :]
        stream = self._run.stream
        if self._later(rows)[0]:
            newest = advance(stream, rows, next_rows(self._run.completion, rows))
            return _estimate_of(stream.plan, newest, stream.t)
        return _estimate_of(stream.plan, stream.newest, stream.t)._replace(reason=self._stamps.word)

    def take(self, chunk: Signals | pd.DataFrame) -> LogEstimate:
        """Take a chunk of a log: rows that follow on those before.

        Rows that repeat a time or go back a little are dropped as in `step`, and counted in the notes of the signals.

        Raises
        ------
        UsageError
            As in `step`.
        """
        if isinstance(chunk, Signals):
            signals = chunk
        else:
            _require_known(chunk.columns)
            columns = [name for name in UNITS if name in chunk]
            try:
                frame = chunk[columns].astype(np.float64).reset_index(drop=True)
            except (TypeError, ValueError) as error:
                raise UsageError(
                    f"chunk: holds something that is no number ({error}): pass SI values"
                ) from None
            signals = Signals("chunk", frame.replace([np.inf, -np.inf], np.nan))
        if not len(signals):
            raise UsageError("chunk: has no rows: pass at least one")
        later = self._later(signals.rows())
        if not later.all():
            notes = *signals.notes, *self._stamps.counted()
            signals = replace(signals, frame=signals.frame[later].reset_index(drop=True), notes=notes)
        return next_estimate(self._run, signals)

    def _later(self, rows: np.ndarray) -> np.ndarray:
        """Tell which of the next rows ``(n, columns)`` are later than all before them; a refusal changes nothing."""
        stamps = replace(self._stamps, dropped=0, fault="")
        later = stamps.later(rows, _T, "sample", stamps.rows + 1 + np.arange(len(rows)))
        self._stamps = stamps
        return later


def _estimate_of(plan: Plan, answer: np.ndarray, t: float) -> StreamEstimate:
    """Put names to the answer ``(1,)`` at a sample."""
    told = dict(zip(plan.record.names or (), answer[0].tolist(), strict=True))
    beta, beta_std, motion = told["beta"], told["beta_std"], Motion(*(told[name] for name in Motion._fields))
    slips = told["slip_front"], told["slip_rear"], told["understeer"]
    channels = np.array([reason(told["faults"])], dtype=object)
    return StreamEstimate(
        t,
        beta,
        beta_std,
        plan.names[told["active"]],
        TEXTS[told["status"]],
        dict(zip(plan.names, told["filters"].tolist(), strict=True)),
        point_velocity(beta, beta_std, *motion, 0.0, 0.0)[1],
        motion,
        Handling(*slips, STATES[told["state"]]),
        with_health(channels, plan.watched, answer["health"])[0],
    )


def _require_known(names: Any) -> None:
    for name in names:
        if name not in UNITS:
            raise UsageError(f"sample, column {name}: unknown: take of {', '.join(UNITS)}, in SI units")


def sample_row(sample: Mapping[str, Any] | pd.Series) -> np.ndarray:
    """One sample as a row ``(columns,)`` of `Signals.rows`; infinite values are no measurements.

    Raises
    ------
    UsageError
        An unknown column, a value that is no number, or no t.
    """
    if not isinstance(sample, Mapping | pd.Series):
        raise UsageError(f"sample: is a {type(sample).__name__}: pass column names with values, as a dict")
    _require_known(sample.keys())
    row = np.full(len(UNITS), np.nan)
    for name, value in dict(sample).items():
        try:
            number = math.nan if value is None else float(value)
        except (TypeError, ValueError):
            raise UsageError(
                f"sample, column {name}: {value!r} is no number: pass it in {UNITS[name]}"
            ) from None
        row[COLUMN[name]] = number if math.isfinite(number) else math.nan
    return row

"""One log end to end: filters in parallel, selector, switch, and the answer at each row of the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from crosscomb.logs.grid import MAX_GAP
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import Vehicle
from crosscomb.run.answers import Plan, Stream, advance, make_plan
from crosscomb.run.handling import STATES, Handling
from crosscomb.run.motion import Motion, PointVelocity, velocity_at
from crosscomb.run.status import TEXTS
from crosscomb.run.tuned import Tuned
from crosscomb.selection.artefact import Artefact
from crosscomb.signals import MIN_SPEED, Signals


@dataclass(frozen=True)
class LogEstimate:
    """Answer at each row of a log.

    Attributes
    ----------
    signals : Signals
        The log, completed.
    beta, beta_std : (n,) [rad]
    active : (n,) str
        Name of the filter that is active.
    status : (n,) str
        ``ok``, or words joined by ``+``.
    filters : dict of str to (n,) [rad]
        beta of each filter.
    motion : Motion
        Speed and curvature, from which `at` makes the velocity of any point of the car.
    handling : Handling
        Slip angles of both axles and whether the car understeers or oversteers.
    extras : dict of str to (n,)
        What the filters tell beside beta, by ``<filter> <quantity> [unit]``; empty where nobody asked.
    """

    signals: Signals
    beta: np.ndarray
    beta_std: np.ndarray
    active: np.ndarray
    status: np.ndarray
    filters: dict[str, np.ndarray]
    motion: Motion
    handling: Handling
    extras: dict[str, np.ndarray]

    def table(self) -> pd.DataFrame:
        """Columns of the estimate file: t, beta, beta_std, active, status and beta of each filter."""
        columns = {"t": self.signals.t, "beta": self.beta, "beta_std": self.beta_std}
        filters = {f"beta_{name}": beta for name, beta in self.filters.items()}
        return pd.DataFrame({**columns, "active": self.active, "status": self.status, **filters})

    def at(self, x: float, y: float = 0.0) -> PointVelocity:
        """Velocity of the point x [m] ahead and y [m] to the left of the centre of gravity, at each row."""
        return velocity_at(self.beta, self.beta_std, self.motion, x, y)

    def point_table(self, x: float, y: float = 0.0) -> pd.DataFrame:
        """Columns of the file of a point: t, vx, vy, beta and beta_std."""
        return pd.DataFrame({"t": self.signals.t, **self.at(x, y)._asdict()})

    def handling_table(self) -> pd.DataFrame:
        """Columns of the handling file: t, slip_front, slip_rear, understeer and state."""
        return pd.DataFrame({"t": self.signals.t, **self.handling._asdict()})

    def extras_table(self) -> pd.DataFrame:
        """Columns of the file of what the filters tell beside beta: t and each of `extras`."""
        return pd.DataFrame({"t": self.signals.t, **self.extras})

    def handling_shares(self) -> dict[str, float]:
        """Share of the time above `MIN_SPEED` in each state of handling; all 0 where the car never was that fast."""
        steps = np.minimum(np.diff(self.signals.t, append=self.signals.t[-1]), MAX_GAP)
        steps[self.motion.vx <= MIN_SPEED] = 0.0
        total = max(float(steps.sum()), 1e-9)
        return {state: float(steps[self.handling.state == state].sum()) / total for state in STATES}


def estimate_log(
    signals: Signals,
    vehicle: Vehicle,
    artefact: Artefact,
    filters: Sequence[str] | None = None,
    tuned: Tuned | None = None,
    extras: bool = False,
) -> LogEstimate:
    """Estimate the sideslip angle at each row of a log.

    A row holds the newest estimate at or before its time; none is made from later samples.

    Parameters
    ----------
    signals : Signals
        As read from a file.
    vehicle : Vehicle
    artefact : Artefact
    filters : sequence of str, optional
        Estimators to run instead of the artefact's. With all of the artefact's among them its switch works as ever,
        and the others stand beside it; else the first named one is the answer, and nothing is switched.
    tuned : Tuned, optional
        Noise that takes the place of the filters' own.
    extras : bool
        Also give what the estimators tell beside beta: innovations, forces, yaw moment, friction in use, tyre
        parameters, shares.

    Raises
    ------
    UsageError
        Extras are wanted, and none of the estimators tells more than beta.
    """
    signals = complete(signals, vehicle)
    plan = make_plan(vehicle, artefact, filters, tuned, extras)
    if not plan.switched:
        needed = ", ".join(artefact.filter_names)
        note = f"{plan.names[0]} is the answer: the selector needs all of {needed}"
        signals = replace(signals, notes=(*signals.notes, note))
    return to_estimate(plan, signals, advance(Stream(plan), signals.rows()))


def to_estimate(plan: Plan, signals: Signals, answers: np.ndarray) -> LogEstimate:
    """Put names to the answers at the rows of a completed log."""
    told = {name: answers[name].T.copy() for name in plan.record.names or ()}
    slips = told["slip_front"], told["slip_rear"], told["understeer"]
    return LogEstimate(
        signals,
        told["beta"],
        told["beta_std"],
        np.array(plan.names)[told["active"]],
        TEXTS[told["status"]],
        dict(zip(plan.names, told["filters"], strict=True)),
        Motion(*(told[name] for name in Motion._fields)),
        Handling(*slips, np.array(STATES, dtype=object)[told["state"]]),
        dict(zip(plan.extras, told["extras"], strict=True)),
    )

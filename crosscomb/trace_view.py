"""Picture of what filters find beside beta: how adapted tyre parameters or forces move over a log."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from crosscomb.filters.base import make_inputs
from crosscomb.report import COLOURS, save_figure
from crosscomb.resample import resample
from crosscomb.signals import MIN_SPEED, Signals
from crosscomb.stream import Plan


class Traces(NamedTuple):
    """Further answers of filters at the working rate; a row of NaN parts the segments of a log."""

    t: np.ndarray  # (n,) [s] from the first row of the log
    values: dict[str, dict[str, np.ndarray]]  # filter to name and unit to (n,)


def traces(plan: Plan, signals: Signals) -> Traces:
    """Run the filters that have further answers once more and keep these.

    Parameters
    ----------
    plan : Plan
        Of the estimate.
    signals : Signals
        Completed by `crosscomb.prepare.complete`.
    """
    speaking = {name: one for name, one in zip(plan.names, plan.filters, strict=True) if one.extras}
    times, found = [], []
    for segment in resample(signals, plan.artefact.rate) if speaking else ():
        inputs = make_inputs(segment.signals, plan.vehicle, 1.0 / plan.artefact.rate)
        times.append([*(segment.signals.t - signals.t[0]), np.nan])
        found.append([one.run(inputs).extra for one in speaking.values()])
    values = {
        name: {key: np.concatenate([[*part[i][key], np.nan] for part in found]) for key in one.extras}
        for i, (name, one) in enumerate(speaking.items())
    }
    return Traces(np.concatenate(times) if times else np.zeros(0), values)


def trace_figure(plan: Plan, signals: Signals, title: str) -> Figure | None:
    """Draw each further answer over the log, beside the value of the vehicle file where that has one.

    Parameters
    ----------
    plan : Plan
    signals : Signals
        Completed.
    title : str

    Returns
    -------
    Figure or None
        Nothing where no filter has further answers.
    """
    found = traces(plan, signals)
    keys = list(dict.fromkeys(key for each in found.values.values() for key in each))
    if not keys:
        return None
    colours = dict(zip(found.values, COLOURS * len(found.values), strict=False))
    figure = Figure(figsize=(12, 1.9 * len(keys) + 2.0), layout="constrained")
    *axes, inputs = figure.subplots(len(keys) + 1, 1, sharex=True)
    for axis, key in zip(axes, keys, strict=True):
        name, _, unit = key.partition(" ")
        for filter_name, each in found.values.items():
            if key in each:
                axis.plot(found.t, each[key], color=colours[filter_name], lw=1.2, label=filter_name)
        if (known := getattr(plan.vehicle, name, None)) is not None:
            axis.axhline(known, color="0.4", lw=0.9, ls="--", label="vehicle file")
        axis.set_title(f"{name.replace('_', ' ')} {unit}", fontsize=9, loc="left")
    figure.suptitle(title)
    t = signals.t - signals.t[0]
    for column, scale, word in (("ay", 1.0, "ay [m/s²]"), ("vx", 0.1, "vx [10 m/s]")):
        inputs.plot(t, scale * signals.column(column), lw=0.8, label=word)
    inputs.set_xlabel("t [s]")
    slow = ~(signals.column("vx") > MIN_SPEED)
    for axis in (*axes, inputs):
        axis.fill_between(
            t, 0, 1, where=slow, transform=axis.get_xaxis_transform(), color="0.9", lw=0, step="post"
        )
        axis.grid(alpha=0.3)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    return figure


def plot_traces(plan: Plan, signals: Signals, path: Path, title: str) -> None:
    """Write the picture as PNG; nothing where no filter has further answers."""
    figure = trace_figure(plan, signals, title)
    if figure is not None:
        save_figure(figure, path)

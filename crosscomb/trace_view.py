"""Picture of what filters find beside beta: how adapted tyre parameters or forces move over a log."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from crosscomb.estimate import LogEstimate
from crosscomb.models.vehicle import Vehicle
from crosscomb.report import COLOURS, save_figure
from crosscomb.signals import MIN_SPEED


def trace_figure(estimate: LogEstimate, vehicle: Vehicle, title: str) -> Figure:
    """Draw each further answer of the filters over the log, beside the value of the vehicle file where it has one.

    Parameters
    ----------
    estimate : LogEstimate
        Of at least one filter with further answers.
    vehicle : Vehicle
    title : str
    """
    t = estimate.signals.t - estimate.signals.t[0]
    keys = list(dict.fromkeys(key for extra in estimate.extras.values() for key in extra))
    colours = dict(zip(estimate.extras, COLOURS * len(estimate.extras), strict=False))
    figure = Figure(figsize=(12, 1.9 * len(keys) + 2.0), layout="constrained")
    *axes, inputs = figure.subplots(len(keys) + 1, 1, sharex=True)
    for axis, key in zip(axes, keys, strict=True):
        name, _, unit = key.partition(" ")
        for filter_name, extra in estimate.extras.items():
            if key in extra:
                axis.plot(t, extra[key], color=colours[filter_name], lw=1.2, label=filter_name)
        if (known := getattr(vehicle, name, None)) is not None:
            axis.axhline(known, color="0.4", lw=0.9, ls="--", label="vehicle file")
        axis.set_title(f"{name.replace('_', ' ')} {unit}", fontsize=9, loc="left")
    figure.suptitle(title)
    for column, scale, word in (("ay", 1.0, "ay [m/s²]"), ("vx", 0.1, "vx [10 m/s]")):
        inputs.plot(t, scale * estimate.signals.column(column), lw=0.8, label=word)
    inputs.set_xlabel("t [s]")
    slow = ~(estimate.signals.column("vx") > MIN_SPEED)
    for axis in (*axes, inputs):
        axis.fill_between(
            t, 0, 1, where=slow, transform=axis.get_xaxis_transform(), color="0.9", lw=0, step="post"
        )
        axis.grid(alpha=0.3)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    return figure


def plot_traces(estimate: LogEstimate, vehicle: Vehicle, path: Path, title: str) -> None:
    """Write the picture as PNG; nothing where no filter has further answers."""
    if estimate.extras:
        save_figure(trace_figure(estimate, vehicle, title), path)

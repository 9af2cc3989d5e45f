"""What `identify` writes, with pictures: the motion before and after, and the tyre curves of both axles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crosscomb.files import run_record, write_json, write_text
from crosscomb.logs.channel_map import ChannelMap
from crosscomb.models.magic_formula import magic_formula
from crosscomb.models.tyres import rational_tyre
from crosscomb.report.pictures import save_figure
from crosscomb.training.identification.files import fitted_map, fitted_text, map_text, rms, table_csv
from crosscomb.training.identification.handling import shown_motion
from crosscomb.training.identification.identify import Identification
from crosscomb.training.identification.parameters import Fit
from crosscomb.training.identification.trace import settled
from crosscomb.training.identification.tyres import AxleCurve

MOST_LOGS = 10
SHOWN_SECONDS = 30.0
BEFORE, AFTER, MEASURED = "#d55e00", "#0072b2", "black"
"""Told apart by colour-blind eyes (Okabe and Ito)."""


def beside_vehicle(path: Path) -> list[Path]:
    """Files that `write_identification` writes beside a vehicle file: channel map, table, two pictures, record."""
    return [path.with_suffix(end) for end in (".map.toml", ".csv", ".motion.png", ".tyres.png", ".run.json")]


def write_identification(
    result: Identification,
    path: Path,
    base: ChannelMap | None,
    settings: dict[str, Any],
    inputs: Sequence[Path],
) -> None:
    """Write the vehicle file that was found and what belongs beside it.

    Parameters
    ----------
    result : Identification
    path : Path
        Of the vehicle file.
    base : ChannelMap, optional
        That the logs were read with.
    settings : dict
        Of the run, for its record.
    inputs : sequence of Path
        Files that it read, for its record.
    """
    map_file, table_file, motion_file, tyre_file, record_file = beside_vehicle(path)
    write_text(path, fitted_text(result))
    write_text(map_file, map_text(fitted_map(result, base)))
    write_text(table_file, table_csv(result))
    save_figure(motion_figure(result), motion_file)
    save_figure(tyre_figure(result), tyre_file)
    write_json(record_file, run_record("identify", settings, inputs))


def motion_figure(result: Identification) -> Figure:
    """Yaw rate and ay as measured, and as the car before and after shows them, in the liveliest seconds of logs."""
    traces = result.problem.traces[:MOST_LOGS]
    figure = Figure(figsize=(13, 3.0 * len(traces) + 0.5), layout="constrained")
    axes = figure.subplots(len(traces), 2, squeeze=False)
    for i, trace in enumerate(traces):
        rows = _liveliest(trace.t, np.where(trace.normal, np.abs(trace.ay), 0.0))
        for j, (measured, name) in enumerate(((trace.yaw_rate, "yaw rate [rad/s]"), (trace.ay, "ay [m/s²]"))):
            axis = axes[i, j]
            axis.plot(trace.t[rows], measured[rows], color=MEASURED, lw=1.6, label="measured")
            for fit, colour, word in ((result.first, BEFORE, "before"), (result.fit, AFTER, "after")):
                shown = _shown(result, fit, i, j)
                error = rms((shown - measured)[rows][settled(trace.normal)[rows]])
                axis.plot(trace.t[rows], shown[rows], color=colour, lw=1.0, label=f"{word}: rms {error:.3g}")
            reach = 1.3 * float(np.abs(measured[rows]).max())
            axis.set_ylim(-reach, reach)
            axis.set_title(f"{trace.name}: {name}", fontsize=9)
            axis.legend(fontsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("t [s]")
    count = len(result.problem.traces)
    some = f" (the first {MOST_LOGS} of {count} logs)" if count > MOST_LOGS else ""
    figure.suptitle(
        f"{result.vehicle.name}: the model, driven by steering and speed, against the sensors{some}"
    )
    return figure


def _shown(result: Identification, fit: Fit, i: int, output: int) -> np.ndarray:
    return shown_motion(result.problem, fit, i)[output]


def _liveliest(t: np.ndarray, strength: np.ndarray) -> slice:
    """The stretch of `SHOWN_SECONDS` with the strongest cornering."""
    width = min(int(SHOWN_SECONDS / (t[1] - t[0])), len(t))
    sums = np.concatenate([[0.0], np.cumsum(strength)])
    begin = int(np.argmax(sums[width:] - sums[: len(sums) - width]))
    return slice(begin, begin + width)


def tyre_figure(result: Identification) -> Figure:
    """Force over load against slip angle of both axles, with the laws fitted to them."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    if result.tyres is None:
        axes[0].text(
            0.5, 0.5, "too little cornering for a tyre curve", ha="center", transform=axes[0].transAxes
        )
        return figure
    stiffness = (result.vehicle.cornering_stiffness_front, result.vehicle.cornering_stiffness_rear)
    for axis, (name, curve), slope in zip(axes, result.tyres.items(), stiffness, strict=True):
        _draw_axle(axis, curve, slope, result)
        axis.set_title(f"{name} axle")
        axis.set_xlabel("slip angle [deg]")
    axes[0].set_ylabel("lateral force over load")
    figure.suptitle(f"{result.vehicle.name}: tyre curves")
    return figure


def _draw_axle(axis: Axes, curve: AxleCurve, slope: float, result: Identification) -> None:
    slip = np.linspace(0.0, curve.slip[-1], 60)
    degrees = np.degrees(slip)
    axis.errorbar(
        np.degrees(curve.slip),
        curve.force,
        1.96 * curve.error,
        fmt="o",
        ms=3,
        color=MEASURED,
        label="measured",
    )
    linear = np.minimum(slip * slope / curve.load, 1.2 * max(curve.force.max(), 0.1))
    axis.plot(degrees, linear, color=AFTER, ls="--", lw=1.0, label="cornering stiffness")
    if curve.rational:
        c1, c2 = curve.rational["c1"][0], curve.rational["c2"][0]
        force = [rational_tyre(s, c1, c2, result.vehicle.friction, 1.0)[0] / curve.load for s in slip]
        axis.plot(degrees, force, color=BEFORE, label="rational")
    if curve.magic:
        b, c, d = (curve.magic[key][0] for key in "BCD")
        force = [magic_formula(s, b, c, d, result.vehicle.tyre.curvature)[0] for s in slip]
        axis.plot(degrees, force, color="#009e73", label="Magic Formula")
    axis.legend(fontsize=8)

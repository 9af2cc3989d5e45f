"""Pictures that people read: estimates, what estimators tell beside beta, confusion matrices."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text

from crosscomb.errors import printable
from crosscomb.files import write_file
from crosscomb.report.markdown import row_shares
from crosscomb.run.estimate import LogEstimate
from crosscomb.run.handling import STATES
from crosscomb.signals import MIN_SPEED

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colour of each filter, told apart by colour-blind eyes (Okabe and Ito)."""


STATE_COLOURS = dict(zip(STATES, ("0.88", COLOURS[0], COLOURS[4], COLOURS[1], "white"), strict=True))
"""Colour of each state of handling."""


def estimate_figure(estimate: LogEstimate, title: str) -> Figure:
    """Draw beta with its band and the reference, the active filter, the handling, and the signals it was chosen by.

    Parameters
    ----------
    estimate : LogEstimate
    title : str
    """
    t = estimate.signals.t - estimate.signals.t[0]
    names = list(estimate.filters)
    moving = estimate.signals.column("vx") > MIN_SPEED
    figure = Figure(figsize=(12, 7.4), layout="constrained")
    main, strip, balance, inputs = figure.subplots(4, 1, sharex=True, height_ratios=(5, 0.6, 0.6, 2.2))
    beta, band = np.degrees(estimate.beta), np.degrees(1.96 * estimate.beta_std)
    for colour, name in zip(COLOURS, names, strict=False):
        main.plot(t, np.degrees(estimate.filters[name]), color=colour, lw=0.7, alpha=0.55, label=name)
    main.fill_between(t, beta - band, beta + band, color="0.75", alpha=0.6, lw=0, label="± 1.96 beta_std")
    main.plot(t, beta, color="black", lw=1.4, label="crosscomb")
    reference = np.where(moving, np.degrees(estimate.signals.beta_ref), np.nan)
    shown = [beta[moving]] if moving.any() else [beta]
    if np.isfinite(reference).any():
        main.plot(t, reference, color="#e6007e", lw=1.2, ls="--", label="reference")
        shown.append(reference[np.isfinite(reference)])
    _limits(main, np.concatenate(shown))
    main.axhline(0.0, color="0.5", lw=0.5)
    main.set_ylabel("beta [deg]")
    main.set_title(title)
    main.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    for colour, name in zip(COLOURS, names, strict=False):
        strip.fill_between(t, 0, 1, where=estimate.active == name, color=colour, lw=0, step="post")
    strip.fill_between(t, 0, 1, where=~moving, color="white", alpha=0.75, lw=0, step="post")
    for state, colour in STATE_COLOURS.items():
        here = estimate.handling.state == state
        balance.fill_between(t, 0, 1, where=here, color=colour, lw=0, step="post")
    for axis, label in ((strip, "active"), (balance, "handling")):
        axis.set_yticks([])
        axis.set_ylim(0.0, 1.0)
        axis.set_ylabel(label, rotation=0, ha="right", va="center")
    shown_states = [Patch(fc=STATE_COLOURS[state], ec="0.6", label=state) for state in STATES]
    balance.legend(handles=shown_states, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, ncols=2,
                   frameon=False, columnspacing=1.0, handlelength=1.0)  # fmt: skip
    inputs.plot(t, estimate.signals.column("ay"), color="0.25", lw=0.7, label="ay [m/s²]")
    inputs.plot(t, np.degrees(estimate.signals.column("yaw_rate")) / 10.0, color=COLOURS[4], lw=0.9,
                label="yaw rate [10 deg/s]")  # fmt: skip
    inputs.plot(t, estimate.signals.column("vx") / 10.0, color=COLOURS[5], lw=0.9, label="vx [10 m/s]")
    inputs.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    inputs.set_xlabel("t [s]")
    for axis in (main, inputs):
        axis.grid(alpha=0.3)
    return figure


def _limits(axis: Axes, values: np.ndarray) -> None:
    """Scale to what is estimated, not to a single filter that runs off."""
    low, high = float(values.min()), float(values.max())
    margin = max(1.0, 0.25 * (high - low))
    axis.set_ylim(low - margin, high + margin)


def extras_figure(table: pd.DataFrame, title: str) -> Figure:
    """Draw what estimators tell beside beta, each quantity over time, that of all estimators in one picture.

    Parameters
    ----------
    table : pandas.DataFrame
        As of `crosscomb.run.estimate.LogEstimate.extras_table`.
    title : str
    """
    told = [str(column).partition(" ") for column in table.columns.drop(["t", "reason"])]
    quantities = list(dict.fromkeys(quantity for _, _, quantity in told))
    figure = Figure(figsize=(12, 1.2 + 1.9 * len(quantities)), layout="constrained")
    axes = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for axis, quantity in zip(axes, quantities, strict=True):
        for name in (name for name, _, other in told if other == quantity):
            axis.plot(table["t"] - table["t"].iloc[0], table[f"{name} {quantity}"], lw=0.9, label=name)
        axis.set_ylabel(quantity.replace(" [", "\n["), fontsize=8)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
        axis.grid(alpha=0.3)
    axes[0].set_title(title)
    axes[-1].set_xlabel("t [s]")
    return figure


def confusion_figure(confusion: np.ndarray, names: Sequence[str]) -> Figure:
    """Draw a confusion matrix with counts and row shares.

    Parameters
    ----------
    confusion : (filters, filters) int
        Windows by best filter (rows) and selected filter (columns).
    names : sequence of str
    """
    shares = row_shares(confusion)
    figure = Figure(figsize=(6.2, 5.2), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(shares, vmin=0.0, vmax=1.0, cmap="Blues")
    for i in range(len(names)):
        for j in range(len(names)):
            axis.text(j, i, f"{confusion[i, j]}\n{100 * shares[i, j]:.0f} %", ha="center", va="center",
                      color="white" if shares[i, j] > 0.5 else "black")  # fmt: skip
    axis.set_xticks(range(len(names)), names, rotation=20, ha="right")
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel("selected")
    axis.set_ylabel("best in the window")
    axis.set_title("Windows of recordings not seen in fitting")
    figure.colorbar(image, label="share of the row")
    return figure


def as_png(figure: Figure) -> bytes:
    """Picture as PNG, the same bytes each time; names in it are shown as they are, not as formulas."""
    buffer = io.BytesIO()
    for text in figure.findobj(Text):
        text.set_parse_math(False)
        text.set_text(printable(text.get_text(), "\n"))
    figure.savefig(buffer, dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture as PNG, whole or not at all."""
    content = as_png(figure)
    write_file(path, lambda temporary: temporary.write_bytes(content))

"""The commands `filters`, `estimate` and `check`: what can be run, logs estimated, a log looked at."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crosscomb.cli.options import (
    FiltersOption,
    MapOption,
    PointOption,
    SelectorFileOption,
    TunedOption,
    VehicleOption,
    filter_names,
    place,
)
from crosscomb.logs.formats.table import endings

if TYPE_CHECKING:
    from crosscomb.logs.intake import OpenedLog
    from crosscomb.report.estimates import Sources
    from crosscomb.run.tuned import Tuned
    from crosscomb.selection.artefact import Artefact


def filters() -> None:
    """List the estimators that can be put into the switch."""
    from crosscomb.filters.catalogue import CATALOGUE
    from crosscomb.report.terminal import show

    rows = [[name, entry.summary, entry.source] for name, entry in CATALOGUE.items()]
    show("Estimators", ["name", "what it is", "source"], rows, left=3)


def estimate(
    logs: Annotated[list[Path], typer.Argument(help=f"Logs ({endings()}).")],
    selector_file: SelectorFileOption = None,
    vehicle: VehicleOption = None,
    channel_map: MapOption = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the estimates.")] = Path(
        "estimates"
    ),
    plot: Annotated[
        bool, typer.Option("--plot", help="Also draw beta, its band and the active filter.")
    ] = False,
    filters: FiltersOption = None,
    tuned: TunedOption = None,
    point: PointOption = None,
    handling: Annotated[
        bool, typer.Option("--handling", help="Also write slip angles, understeer and oversteer.")
    ] = False,
    extras: Annotated[
        bool,
        typer.Option(
            "--extras", help="Also write what estimators tell beside beta: innovations, forces, shares."
        ),
    ] = False,
) -> None:
    """Estimate the sideslip angle of logs; with ground truth in them, also score it."""
    _spare_scipy()
    from crosscomb.files import refuse_overwriting
    from crosscomb.logs.channel_map import load_map
    from crosscomb.logs.intake import log_names, open_logs
    from crosscomb.report import terminal
    from crosscomb.report.estimates import Sources, estimate_files
    from crosscomb.run.drive import name_filters
    from crosscomb.run.tuned import load_tuned
    from crosscomb.selection.artefact import load_artefact

    artefact, spot = load_artefact(selector_file), place(point)
    names = filter_names(filters)
    name_filters(names, artefact)
    given = load_tuned(tuned, names or artefact.filter_names)
    signs = load_map(channel_map)
    refuse_overwriting(logs, estimate_files(output, log_names(logs)))
    with terminal.progress("reading", len(logs)) as advance:
        opened = open_logs(logs, artefact.vehicle, vehicle, signs, advance)
    for warning in (warning for log in opened for warning in log.warnings):
        terminal.warn(warning)
    sources = Sources(selector_file, channel_map, tuned)
    answer(opened, artefact, output, sources, names, given, extras, point=spot, handling=handling, plot=plot)


def _spare_scipy() -> None:
    """Let numba start without scipy.linalg, a tenth of the time of a short log: no kernel needs a BLAS.

    Only where nobody has loaded either yet, as in a process of ours: numba keeps to what it found.
    """
    if "numba" not in sys.modules and "scipy.linalg" not in sys.modules:
        sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
        try:
            import_module("numba.np.arraymath")
        finally:
            del sys.modules["scipy.linalg"]


def answer(
    opened: list[OpenedLog],
    artefact: Artefact,
    output: Path,
    sources: Sources,
    names: list[str] | None = None,
    given: Tuned | None = None,
    extras: bool = False,
    **wanted: Any,
) -> None:
    """Estimate opened logs, write and show; for what else may be `wanted` see `write_estimate`."""
    from crosscomb.report import terminal
    from crosscomb.report.estimates import Summary, write_estimate
    from crosscomb.run.estimate import start_run

    summary = Summary()
    with terminal.progress("estimating", len(opened)) as advance:
        for log in opened:
            run = start_run(log.vehicle, artefact, names or None, given, extras)
            tally = write_estimate(run, log, output, sources, **wanted)
            summary.add(log.file.name, tally, [*log.file.notes, *run.notes()])
            advance()
    terminal.show_summary(summary)
    terminal.say(f"{output}: {len(opened)} estimates written")


def check(
    log: Annotated[Path, typer.Argument(help=f"Log ({endings()}).")],
    vehicle: VehicleOption = None,
    channel_map: MapOption = None,
) -> None:
    """Say what is in a log, what is missing and what looks wrong; exit code 2 if it would be refused."""
    from crosscomb.logs.channel_map import load_map
    from crosscomb.logs.intake import choose_vehicle, require_road_wheel_angle
    from crosscomb.logs.plausibility import check_units
    from crosscomb.logs.read import read_log
    from crosscomb.report import terminal
    from crosscomb.selection.artefact import load_artefact

    signals = read_log(log, load_map(channel_map))
    car, origin, warning = choose_vehicle(log, vehicle, load_artefact().vehicle)
    terminal.show_signals(signals)
    terminal.say(f"vehicle: {car.name} ({origin})")
    findings = check_units(signals, car)
    for note in signals.notes:
        terminal.say(f"note: {note}")
    if warning:
        terminal.warn(warning)
    for finding in findings:
        terminal.say(f"{finding.severity}: column {finding.column}: {finding.message}")
    if warning:  # the generic car stands in
        require_road_wheel_angle(signals.source, signals.has("steer"))
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(2)
    terminal.say("nothing plainly wrong" if findings else "nothing wrong found")

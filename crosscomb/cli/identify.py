"""The command `identify`: find a car's parameters and its sensors' errors in logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crosscomb.errors import UsageError


def identify(
    data_dir: Annotated[
        Path, typer.Argument(help="Folder with logs of one car, with or without ground truth.")
    ],
    vehicle: Annotated[
        str,
        typer.Option("--vehicle", help="Vehicle file (TOML) to begin with, or the name of a shipped one."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Vehicle file to write.")] = Path(
        "fitted.toml"
    ),
    channel_map: Annotated[
        Path | None, typer.Option("--map", help="Channel map (TOML) that the logs are read with.")
    ] = None,
    without_truth: Annotated[
        bool, typer.Option("--without-truth", help="Leave ground truth in the logs aside.")
    ] = False,
) -> None:
    """Find a car's parameters and its sensors' errors in logs, each with an interval or a word why not."""
    from crosscomb.files import existing_files, locked, refuse_overwriting, writing_together
    from crosscomb.logs.channel_map import load_map
    from crosscomb.logs.read import read_log
    from crosscomb.models.vehicle import load_vehicle
    from crosscomb.report import terminal
    from crosscomb.report.identification import beside_vehicle, write_identification
    from crosscomb.training.identification.files import motion_rows, table_rows
    from crosscomb.training.identification.identify import identify as find
    from crosscomb.training.recordings import find_places

    if output.suffix != ".toml":
        raise UsageError(f"{output}: a vehicle file is a TOML file: let its name end in .toml")
    before = load_vehicle(vehicle)
    base = load_map(channel_map)
    places = find_places(data_dir)
    # A sub-folder with a vehicle file of its own holds another car.
    own = [
        (place, logs) for place, logs in places if place == data_dir or not (place / "vehicle.toml").exists()
    ]
    for place, _ in places:
        if place not in [kept for kept, _ in own]:
            terminal.warn(f"{place.name}: skipped, it has a vehicle file of its own")
    paths = [path for _, logs in own for path in logs]
    if not paths:
        raise UsageError(f"{data_dir}: its sub-folders hold other cars: name one of them")
    beside = beside_vehicle(output)
    inputs = [*paths, *existing_files(vehicle, channel_map)]
    refuse_overwriting(inputs, [output, *beside])
    with terminal.progress("reading", len(paths)) as advance:
        logs = []
        for path in paths:
            logs.append(read_log(path, base))
            advance()
    result = find(logs, before, not without_truth)
    for name in result.left_out:
        terminal.warn(f"{name}: left aside, the car slides too much in it for its handling to show")
    settings = {"vehicle": before.model_dump(), "map": channel_map, "without_truth": without_truth}
    with locked(output.parent), writing_together(output.parent) as folder:
        write_identification(result, folder / output.name, base, settings, inputs)
    terminal.show(
        f"{before.name}: {len(result.problem.traces)} of {len(logs)} logs with driving",
        ["parameter", "unit", "before", "after", "from (95 %)", "to", "word"],
        table_rows(result),
        left=2,
    )
    terminal.show(
        "What the model leaves, below the limit (rms)",
        ["log", "yaw rate before", "after [rad/s]", "ay before", "after [m/s^2]"],
        motion_rows(result),
    )
    terminal.say(f"written: {output}, {', '.join(path.name for path in beside)}")
    terminal.say(f"use both: crosscomb estimate LOG --vehicle {output} --map {beside[0]}")

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
    from crosscomb.files import refuse_overwriting, run_record, write_json, write_text
    from crosscomb.logs.channel_map import load_map
    from crosscomb.logs.read import read_log
    from crosscomb.models.vehicle import load_vehicle
    from crosscomb.report import terminal
    from crosscomb.report.identification import write_pictures
    from crosscomb.training.identification.files import (
        fitted_map,
        fitted_text,
        map_text,
        motion_rows,
        table_csv,
        table_rows,
    )
    from crosscomb.training.identification.identify import identify as find
    from crosscomb.training.recordings import find_places

    if output.suffix != ".toml":
        raise UsageError(f"{output}: a vehicle file is a TOML file: let its name end in .toml")
    before = load_vehicle(vehicle)
    base = load_map(channel_map) if channel_map else None
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
    beside = [
        output.with_suffix(end) for end in (".map.toml", ".csv", ".motion.png", ".tyres.png", ".run.json")
    ]
    inputs = [*paths, *(Path(given) for given in (vehicle, channel_map) if given and Path(given).is_file())]
    refuse_overwriting(inputs, [output, *beside])
    with terminal.progress("reading", len(paths)) as advance:
        logs = []
        for path in paths:
            logs.append(read_log(path, base))
            advance()
    result = find(logs, before, not without_truth)
    for name in result.left_out:
        terminal.warn(f"{name}: left aside, the car slides too much in it for its handling to show")
    map_file, table_file, motion_file, tyre_file, record_file = beside
    write_text(output, fitted_text(result))
    write_text(map_file, map_text(fitted_map(result, base)))
    write_text(table_file, table_csv(result))
    write_pictures(result, motion_file, tyre_file)
    settings = {"vehicle": before.model_dump(), "map": channel_map, "without_truth": without_truth}
    write_json(record_file, run_record("identify", settings, inputs))
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
    terminal.say(f"use both: crosscomb estimate LOG --vehicle {output} --map {map_file}")

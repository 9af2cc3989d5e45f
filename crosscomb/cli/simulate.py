"""The commands `vehicle` and `simulate`: a car, and logs of it from the simulation plant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crosscomb.cli.options import JobsOption, SeedOption, VehicleOption
from crosscomb.errors import UsageError

if TYPE_CHECKING:
    from crosscomb.models.vehicle import Vehicle


def vehicle(
    name: Annotated[str, typer.Argument(help="Name of the car.")],
    mass: Annotated[float, typer.Option(help="Mass with driver [kg].")],
    wheelbase: Annotated[float, typer.Option(help="[m]")],
    front_share: Annotated[float, typer.Option(help="Share of the weight on the front axle, 0 to 1.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Vehicle file to write.")] = Path(
        "vehicle.toml"
    ),
    steering_ratio: Annotated[float | None, typer.Option(help="Hand wheel to road wheel.")] = None,
    track: Annotated[float | None, typer.Option(help="[m]")] = None,
    cg_height: Annotated[float | None, typer.Option(help="Height of the centre of gravity [m].")] = None,
    wheel_radius: Annotated[float | None, typer.Option(help="[m]")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write a vehicle file from mass, wheelbase and weight share, with stated estimates for the rest."""
    from crosscomb.files import write_text
    from crosscomb.models.vehicle_estimates import vehicle_from_basics
    from crosscomb.report.terminal import say

    if output.exists() and not force:
        raise UsageError(f"{output}: exists already: choose another name or use --force")
    _, text = vehicle_from_basics(
        name, mass, wheelbase, front_share,
        steering_ratio=steering_ratio, track=track, cg_height=cg_height, wheel_radius=wheel_radius,
    )  # fmt: skip
    write_text(output, text)
    say(f"{output}: written; the estimated lines say how they were estimated: replace what you know better")


def simulate(
    out_dir: Annotated[Path, typer.Argument(help="Folder for the logs.")],
    vehicle: VehicleOption = None,
    seed: SeedOption = 0,
    logs: Annotated[int, typer.Option("--logs", min=1, max=100_000, help="Number of logs.")] = 40,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier simulated logs.")] = False,
    jobs: JobsOption = 2,
    preset: Annotated[
        str, typer.Option("--preset", help="full, quick (short logs) or paper (its manoeuvres, on snow).")
    ] = "full",
) -> None:
    """Write labelled logs from the simulation plant."""
    from crosscomb.files import existing_files, refuse_overwriting
    from crosscomb.models.vehicle import load_vehicle

    car = load_vehicle(vehicle or "generic_compact")
    inputs = existing_files(vehicle)
    refuse_overwriting(inputs, [out_dir / "vehicle.toml"])
    make_logs(car, out_dir, seed, logs, force, jobs, preset, inputs)


def make_logs(
    car: Vehicle,
    out_dir: Path,
    seed: int,
    logs: int,
    force: bool,
    jobs: int,
    preset: str,
    inputs: Sequence[Path] = (),
) -> list[Path]:
    """Simulate, with progress and a record of the run, which read `inputs`; gives the logs."""
    from crosscomb.files import run_record, write_json
    from crosscomb.report import terminal
    from crosscomb.training.simulation.simulate import simulate_data_set

    with terminal.progress("simulating", logs) as advance:
        paths = simulate_data_set(
            car, out_dir, seed, logs, force=force, jobs=jobs, progress=advance, preset=preset
        )
    settings = {"vehicle": car.model_dump(), "seed": seed, "logs": logs, "preset": preset}
    write_json(out_dir / "simulate.run.json", run_record("simulate", settings, inputs))
    terminal.say(f"{out_dir}: {len(paths)} logs of {car.name}, what is in them stands in dataset.json")
    return paths

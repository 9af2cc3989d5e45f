"""Options that several commands share, and what is read from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crosscomb.errors import UsageError

VehicleOption = Annotated[
    str | None, typer.Option("--vehicle", help="Vehicle file (TOML), or the name of a shipped one.")
]
MapOption = Annotated[
    Path | None, typer.Option("--map", help="Channel map (TOML) for foreign names and units.")
]
SelectorFileOption = Annotated[
    Path | None,
    typer.Option(
        "--selector-file",
        help="Artefact of `crosscomb train`, or `hybrid`: the shipped correction. Default: the shipped tree.",
    ),
]
FiltersOption = Annotated[
    str | None, typer.Option("--filters", help="Estimators by name, a,b,c, or all; see `crosscomb filters`.")
]
TunedOption = Annotated[
    Path | None, typer.Option("--tuned", help="Noise settings from `crosscomb tune`, for the filters in it.")
]
PointOption = Annotated[
    str | None,
    typer.Option(
        "--point",
        help="X or X,Y: also write vx, vy and beta of this point, ahead and left of the centre of gravity [m].",
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, help="The same seed gives the same result bit for bit.")
]
JobsOption = Annotated[int, typer.Option("--jobs", min=1, help="Processes; does not change the result.")]


def filter_names(filters: str | None) -> list[str]:
    """Take the names in a --filters option apart; `all` is the whole catalogue."""
    if filters is None:
        return []
    if filters.strip() == "all":
        from crosscomb.filters.catalogue import CATALOGUE

        return list(CATALOGUE)
    names = [name.strip() for name in filters.split(",") if name.strip()]
    if not names:
        raise UsageError("--filters: names no estimator: `crosscomb filters` lists them")
    return names


FARTHEST = 50.0
"""Coordinates of a point beyond this [m] are no longer those of a road vehicle."""


def place(point: str | None) -> tuple[float, float] | None:
    """Read the coordinates in a --point option; the lateral one may be left out."""
    if point is None:
        return None
    try:
        numbers = [float(number) for number in point.split(",")]
        x, y = [*numbers, 0.0] if len(numbers) == 1 else numbers
    except ValueError:
        raise UsageError(f"--point {point}: give X or X,Y in metres, such as 1.2 or -1.4,0.5") from None
    if not max(abs(x), abs(y)) <= FARTHEST:
        raise UsageError(f"--point {point}: lies outside the car: give metres from the centre of gravity")
    return x, y

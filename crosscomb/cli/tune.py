"""The command `crosscomb tune`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crosscomb.cli.options import (
    FiltersOption,
    JobsOption,
    MapOption,
    SeedOption,
    VehicleOption,
    filter_names,
)
from crosscomb.errors import UsageError

if TYPE_CHECKING:
    from crosscomb.training.recordings import Recording


def tune(
    data_dir: Annotated[Path, typer.Argument(help="Logs; sub-folders hold one vehicle each.")],
    vehicle: VehicleOption = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Noise settings to write.")] = Path(
        "tuned.json"
    ),
    filters: FiltersOption = None,
    by: Annotated[
        str | None,
        typer.Option("--by", help="error or likelihood; default: error where there is ground truth."),
    ] = None,
    evaluations: Annotated[
        int, typer.Option("--evaluations", min=5, max=1000, help="Of each of the two rounds of a search.")
    ] = 50,
    folds: Annotated[int, typer.Option("--folds", min=2, max=50, help="Grouped folds, by recording.")] = 3,
    seed: SeedOption = 0,
    rate: Annotated[float, typer.Option("--rate", min=10.0, max=1000.0, help="Working rate [Hz].")] = 100.0,
    channel_map: MapOption = None,
    jobs: JobsOption = 2,
) -> None:
    """Find noise settings from logs, and keep those that also help on logs they were not tuned on."""
    from crosscomb.files import (
        existing_files,
        file_hash,
        locked,
        refuse_overwriting,
        run_record,
        write_json,
        writing_together,
    )
    from crosscomb.filters.catalogue import DEFAULT_FILTERS
    from crosscomb.logs.channel_map import load_map
    from crosscomb.report import terminal
    from crosscomb.report.tuning import beside_tuned, show_tuning, to_tuned, write_tuning
    from crosscomb.run.tuned import save_tuned
    from crosscomb.training.recordings import files_of, find_places, read_recordings
    from crosscomb.training.selectors.train import default_filters
    from crosscomb.training.tuning import tune as search

    if output.suffix != ".json":
        raise UsageError(f"{output}: tuned noise is a JSON file: let its name end in .json")
    if by not in (None, "error", "likelihood"):
        raise UsageError(f"--by {by}: unknown: take error or likelihood")
    names = filter_names(filters) or list(DEFAULT_FILTERS)
    for name in names:
        search.require_tunable(name, by or "error")
        if names.count(name) > 1:
            raise UsageError(f"--filters {name}: named twice: name it once")
    signs = load_map(channel_map)
    with terminal.progress("reading", sum(len(logs) for _, logs in find_places(data_dir))) as advance:
        recordings, notes = read_recordings(data_dir, vehicle, signs, advance, unscored=True)
    by, recordings, skipped = _choose(by, recordings)
    for note in [*notes, *skipped]:
        terminal.warn(note)
    if len(recordings) < 2:
        kind = "recordings with ground truth (--by likelihood needs none)" if by == "error" else "recordings"
        raise UsageError(f"{data_dir}: {len(recordings)} {kind}, tuning needs two or more: add logs")
    inputs = [*existing_files(vehicle, channel_map), *files_of(recordings, vehicle)]
    record_file = output.with_suffix(".run.json")
    refuse_overwriting(inputs, [output, record_file, *beside_tuned(output)])
    steps = search.searches(len(names), len(recordings), folds)
    with locked(output.parent), terminal.progress(f"tuning by {by}", steps) as advance:
        tuning = search.tune(
            recordings, default_filters(recordings[0].vehicle, names), rate,
            by=by, evaluations=evaluations, folds=folds, seed=seed, jobs=jobs, progress=advance,
        )  # fmt: skip
    settings = {
        "by": by, "filters": names, "evaluations": evaluations, "folds": folds, "seed": seed, "rate": rate,
        "vehicle": vehicle,
    }  # fmt: skip
    record = {**settings, "data": {recording.name: file_hash(recording.path) for recording in recordings}}
    with locked(output.parent), writing_together(output.parent) as folder:
        save_tuned(to_tuned(tuning, record), folder / output.name)
        paths = write_tuning(tuning, folder / output.name)
        write_json(folder / record_file.name, run_record("tune", settings, inputs))
    show_tuning(tuning)
    terminal.say(f"written: {output}, {', '.join(path.name for path in paths)}")


def _choose(by: str | None, recordings: list[Recording]) -> tuple[str, list[Recording], list[str]]:
    """What to tune by, the recordings that serve for it, and a line for each of the others."""
    scored = [recording for recording in recordings if recording.signals.has_reference]
    if by == "likelihood" or (by is None and not scored):
        return "likelihood", recordings, []
    rest = [recording for recording in recordings if not recording.signals.has_reference]
    return "error", scored, [f"{r.name}: skipped, it has no ground truth above walking speed" for r in rest]

"""The command `train`: a selector from logs with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crosscomb.cli.options import (
    FiltersOption,
    JobsOption,
    MapOption,
    SeedOption,
    TunedOption,
    VehicleOption,
    filter_names,
)
from crosscomb.errors import UsageError

if TYPE_CHECKING:
    from crosscomb.run.tuned import Tuned
    from crosscomb.training.recordings import Recording
    from crosscomb.training.selectors.train import Training


def train(
    data_dir: Annotated[
        Path, typer.Argument(help="Logs with ground truth; sub-folders hold one vehicle each.")
    ],
    vehicle: VehicleOption = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Artefact to write.")] = Path(
        "selector.json"
    ),
    selector: Annotated[
        str,
        typer.Option(
            "--selector",
            help="tree, paper, tree_all, boosted, soft, hybrid; or all: compare them and write the tree.",
        ),
    ] = "tree",
    folds: Annotated[int, typer.Option("--folds", min=2, max=50, help="Grouped folds, by recording.")] = 5,
    seed: SeedOption = 0,
    rate: Annotated[float, typer.Option("--rate", min=10.0, max=1000.0, help="Working rate [Hz].")] = 100.0,
    channel_map: MapOption = None,
    jobs: JobsOption = 2,
    filters: FiltersOption = None,
    tuned: TunedOption = None,
    tune_budget: Annotated[
        int, typer.Option("--tune-budget", min=0, max=1000, help="Evaluations to tune noise with; 0: none.")
    ] = 12,
) -> None:
    """Train a selector, cross-validate it, and write the artefact and its report."""
    from crosscomb.files import existing_files, locked, refuse_overwriting
    from crosscomb.filters.catalogue import DEFAULT_FILTERS
    from crosscomb.logs.channel_map import load_map
    from crosscomb.report import terminal
    from crosscomb.report.training import comparison_file, training_files
    from crosscomb.run.tuned import load_tuned
    from crosscomb.training.recordings import files_of, find_places, read_recordings, require_enough
    from crosscomb.training.selectors.fit import SELECTORS
    from crosscomb.training.selectors.train import require_filters

    if selector not in (*SELECTORS, "all"):
        raise UsageError(f"--selector {selector}: unknown: take one of {', '.join(SELECTORS)}, all")
    everything, selector = selector == "all", "tree" if selector == "all" else selector
    if output.suffix != ".json":
        raise UsageError(f"{output}: an artefact is a JSON file: let its name end in .json")
    names = filter_names(filters) or list(DEFAULT_FILTERS)
    require_filters(names)
    given = load_tuned(tuned, names)
    signs = load_map(channel_map)
    with terminal.progress("reading", sum(len(logs) for _, logs in find_places(data_dir))) as advance:
        recordings, notes = read_recordings(data_dir, vehicle, signs, advance, jobs=jobs, hold=False)
    for note in notes:
        terminal.warn(note)
    require_enough(recordings, data_dir)
    inputs = [*existing_files(vehicle, channel_map, tuned), *files_of(recordings, vehicle)]
    refuse_overwriting(inputs, [*training_files(output), comparison_file(output)])
    settings = {
        "selector": selector, "folds": folds, "seed": seed, "rate": rate, "vehicle": vehicle, "filters": names,
        "tuned": str(tuned) if tuned else None, "tune_budget": tune_budget,
    }  # fmt: skip
    with locked(output.parent):
        learn(recordings, output, settings, jobs, given, notes, inputs, everything)


def learn(
    recordings: list[Recording],
    output: Path,
    settings: dict[str, Any],
    jobs: int,
    given: Tuned | None = None,
    notes: Sequence[str] = (),
    inputs: Sequence[Path] = (),
    everything: bool = False,
) -> Training:
    """Train, write and show; `settings` are those of the record, `notes` and `inputs` say what was read.

    With `everything` the selectors are compared too. All files appear together at the end.
    """
    from crosscomb.files import writing_together
    from crosscomb.report import terminal
    from crosscomb.report.training import write_artefact
    from crosscomb.training.selectors.train import steps, train
    from crosscomb.training.tuning.first import say_tuned

    selector, folds, seed, rate = (settings[key] for key in ("selector", "folds", "seed", "rate"))
    names, budget = settings["filters"], settings["tune_budget"]
    with terminal.progress("training", steps(recordings, folds)) as advance:
        training = train(recordings, selector, folds, seed, rate, jobs, advance, names, given, budget)
    with writing_together(output.parent) as folder:
        paths = write_artefact(training, folder / output.name, notes, settings, inputs)
        for line in say_tuned(training.artefact.filters, budget):
            terminal.say(line)
        terminal.show_training(training)
        if everything:
            paths.append(compare_all(recordings, folder / output.name, settings, jobs))
    terminal.say(f"written: {output}, {', '.join(path.name for path in paths)}")
    return training


def compare_all(recordings: list[Recording], output: Path, settings: dict[str, Any], jobs: int) -> Path:
    """Compare the selectors, write and show; gives the file."""
    from crosscomb.report import terminal
    from crosscomb.report.training import comparison_file, write_comparison
    from crosscomb.training.selectors.compare import compare, comparison_steps

    folds, seed, rate = (settings[key] for key in ("folds", "seed", "rate"))
    with terminal.progress("comparing", comparison_steps(recordings, folds, seed)) as advance:
        comparison = compare(recordings, folds, seed, rate, jobs, advance, settings["filters"])
    write_comparison(comparison, output)
    terminal.show_comparison(comparison)
    return comparison_file(output)

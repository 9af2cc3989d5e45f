"""The commands. Each imports what it needs only when it runs: `--help` starts at once."""

from __future__ import annotations

import atexit
import gc
import sys
from pathlib import Path
from typing import Annotated

import typer

from crosscomb import __version__
from crosscomb.cli import identify as cli_identify
from crosscomb.cli.options import (
    FiltersOption,
    JobsOption,
    MapOption,
    PointOption,
    SeedOption,
    SelectorFileOption,
    TunedOption,
    VehicleOption,
)
from crosscomb.cli.options import existing_files as _existing
from crosscomb.cli.options import filter_names as _names
from crosscomb.cli.options import place as _place
from crosscomb.cli.tune import tune
from crosscomb.errors import UsageError

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Virtual sensor for the vehicle sideslip angle.",
)


def main() -> None:
    """Run the command line: errors of use become one line and exit code 2."""
    # A run's 250,000 objects are its imports and live to the end: searching them for rubbish cost a tenth of it.
    gc.set_threshold(500_000)
    atexit.register(gc.freeze)
    try:
        code = app(standalone_mode=False)
    except UsageError as error:
        # One line, whatever a file or column is called.
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        # typer brings its own copy of click in some versions: its errors are known by what they can do
        if not hasattr(error, "format_message"):
            raise
        print(f"error: {error.format_message()} (see --help)", file=sys.stderr)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(__version__)
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)


@app.command()
def filters() -> None:
    """List the estimators that can be put into the switch."""
    from crosscomb.filters.catalogue import CATALOGUE
    from crosscomb.report.terminal import show

    rows = [[name, entry.summary, entry.source] for name, entry in CATALOGUE.items()]
    show("Estimators", ["name", "what it is", "source"], rows, left=3)


@app.command()
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


@app.command()
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
    from crosscomb.files import refuse_overwriting, run_record, write_json
    from crosscomb.models.vehicle import load_vehicle
    from crosscomb.report import terminal
    from crosscomb.training.simulation.simulate import simulate_data_set

    car = load_vehicle(vehicle or "generic_compact")
    inputs = _existing(vehicle)
    refuse_overwriting(inputs, [out_dir / "vehicle.toml"])
    with terminal.progress("simulating", logs) as advance:
        paths = simulate_data_set(
            car, out_dir, seed, logs, force=force, jobs=jobs, progress=advance, preset=preset
        )
    settings = {"vehicle": car.model_dump(), "seed": seed, "logs": logs, "preset": preset}
    write_json(out_dir / "simulate.run.json", run_record("simulate", settings, inputs))
    terminal.say(f"{out_dir}: {len(paths)} logs of {car.name}, what is in them stands in dataset.json")


app.command()(tune)


@app.command()
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
    from crosscomb.files import refuse_overwriting, run_record, write_json, write_text
    from crosscomb.filters.catalogue import DEFAULT_FILTERS
    from crosscomb.logs.channel_map import load_map
    from crosscomb.report import terminal
    from crosscomb.report.page import beside_artefact, row_shares, write_training
    from crosscomb.run.tuned import load_tuned, require_used
    from crosscomb.selection.artefact import save_artefact
    from crosscomb.training.recordings import find_places, read_recordings, require_enough
    from crosscomb.training.selectors.fit import SELECTORS
    from crosscomb.training.selectors.train import require_filters, steps
    from crosscomb.training.selectors.train import train as run_training
    from crosscomb.training.tuning.first import say_tuned

    if selector not in (*SELECTORS, "all"):
        raise UsageError(f"--selector {selector}: unknown: take one of {', '.join(SELECTORS)}, all")
    everything, selector = selector == "all", "tree" if selector == "all" else selector
    if output.suffix != ".json":
        raise UsageError(f"{output}: an artefact is a JSON file: let its name end in .json")
    names = _names(filters) or list(DEFAULT_FILTERS)
    require_filters(names)
    given = load_tuned(tuned) if tuned else None
    require_used(given, names, tuned)
    signs = load_map(channel_map) if channel_map else None
    with terminal.progress("reading", sum(len(logs) for _, logs in find_places(data_dir))) as advance:
        recordings, notes = read_recordings(data_dir, vehicle, signs, advance)
    for note in notes:
        terminal.warn(note)
    require_enough(recordings, data_dir)
    cars = [] if vehicle else sorted({r.path.with_name("vehicle.toml") for r in recordings})
    inputs = [*_existing(vehicle, channel_map, tuned), *cars, *(r.path for r in recordings)]
    record_file = output.with_suffix(".run.json")
    refuse_overwriting(
        inputs, [output, record_file, *beside_artefact(output), output.with_name("comparison.json")]
    )
    with terminal.progress("training", steps(recordings, folds)) as advance:
        training = run_training(
            recordings, selector, folds, seed, rate, jobs, advance, names, given, tune_budget
        )
    save_artefact(training.artefact, output)
    paths = write_training(training, output, notes)
    settings = {
        "selector": selector, "folds": folds, "seed": seed, "rate": rate, "vehicle": vehicle, "filters": names,
        "tuned": str(tuned) if tuned else None, "tune_budget": tune_budget,
    }  # fmt: skip
    write_json(record_file, run_record("train", settings, inputs))

    for line in say_tuned(training.artefact.filters, tune_budget):
        terminal.say(line)
    for part, evaluation in training.evaluations.items():
        count = len(evaluation.table)
        terminal.show_scores(f"{part}: {count} recordings", evaluation.rmse, evaluation.largest)
        terminal.say(
            f"{part}: switch / best single filter ({evaluation.best_single}) = {evaluation.ratio:.3f}\n"
        )
    terminal.show_confusion(training.folds.confusion, row_shares(training.folds.confusion), names)
    terminal.say(f"written: {output}, {', '.join(path.name for path in paths)}")
    if everything:
        from crosscomb.training.selectors.compare import compare, comparison_steps

        with terminal.progress("comparing", comparison_steps(recordings, folds, seed)) as advance:
            comparison = compare(recordings, folds, seed, rate, jobs, advance, names)
        write_text(output.with_name("comparison.json"), comparison.to_json())
        terminal.show_comparison(comparison)
        terminal.say(f"written: {output.with_name('comparison.json')}")


app.command()(cli_identify.identify)


@app.command()
def estimate(
    logs: Annotated[list[Path], typer.Argument(help="Logs (.csv or .csv.gz).")],
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
    from crosscomb.files import run_record, write_json
    from crosscomb.logs.channel_map import load_map
    from crosscomb.report import terminal
    from crosscomb.run.drive import name_filters
    from crosscomb.run.estimate import estimate_log, open_logs, write_estimate, write_table
    from crosscomb.run.tuned import load_tuned, require_used
    from crosscomb.selection.artefact import load_artefact
    from crosscomb.training.metrics import score_log

    artefact, spot = load_artefact(selector_file), _place(point)
    names = _names(filters)
    name_filters(names, artefact)
    given = load_tuned(tuned) if tuned else None
    require_used(given, names or artefact.filter_names, tuned)
    signs = load_map(channel_map) if channel_map else None
    with terminal.progress("reading", len(logs)) as advance:
        opened = open_logs(logs, artefact, vehicle, signs, output, advance)
    for warning in (warning for log in opened for warning in log.warnings):
        terminal.warn(warning)
    scores, shares, notes = {}, {}, []
    with terminal.progress("estimating", len(opened)) as advance:
        for log in opened:
            result = estimate_log(log.signals, log.vehicle, artefact, names or None, given, extras)
            name = log.signals.name
            if extras:
                write_table(result.extras_table(), output / f"{name}.extras.csv")
            write_estimate(result, output / f"{name}.estimate.csv")
            if spot is not None:
                write_table(result.point_table(*spot), output / f"{name}.point.csv")
            if handling:
                write_table(result.handling_table(), output / f"{name}.handling.csv")
            shares[name] = result.handling_shares()
            settings = {
                "artefact": str(selector_file or "shipped"), "vehicle": log.vehicle.model_dump(),
                "vehicle_from": log.origin, "filters": list(result.filters), "notes": list(result.signals.notes),
                "tuned": str(tuned) if tuned else None, "point": spot,
            }  # fmt: skip
            inputs = [log.path, *_existing(selector_file, channel_map, tuned, log.origin)]
            write_json(output / f"{name}.run.json", run_record("estimate", settings, inputs))
            if plot:
                from crosscomb.report.page import plot_estimate, plot_extras

                plot_estimate(result, output / f"{name}.estimate.png", f"{name}, {log.vehicle.name}")
                if extras:
                    plot_extras(
                        result.extras_table(), output / f"{name}.extras.png", f"{name}, {log.vehicle.name}"
                    )
            notes += [f"{name}: {note}" for note in result.signals.notes]
            if result.signals.has_reference:
                scores[name] = score_log(result)
            else:
                notes.append(f"{name}: no ground truth, not scored")
            advance()
    for note in notes:
        terminal.say(note)
    if scores:
        terminal.show_log_scores(scores)
    for name, share in shares.items():
        terminal.say(f"{name}: {terminal.shares_text(share)} of the time above walking speed")
    terminal.say(f"{output}: {len(opened)} estimates written")


@app.command()
def check(
    log: Annotated[Path, typer.Argument(help="Log (.csv or .csv.gz).")],
    vehicle: VehicleOption = None,
    channel_map: MapOption = None,
) -> None:
    """Say what is in a log, what is missing and what looks wrong; exit code 2 if it would be refused."""
    from crosscomb.logs.channel_map import load_map
    from crosscomb.logs.plausibility import check_units
    from crosscomb.logs.read import read_log
    from crosscomb.report import terminal
    from crosscomb.run.estimate import choose_vehicle, require_road_wheel_angle
    from crosscomb.selection.artefact import load_artefact

    signals = read_log(log, load_map(channel_map) if channel_map else None)
    car, origin, warning = choose_vehicle(log, vehicle, load_artefact())
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
        require_road_wheel_angle(signals)
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(2)
    terminal.say("nothing plainly wrong" if findings else "nothing wrong found")


@app.command()
def benchmark(
    suite: Annotated[str, typer.Argument(help="real, simulated, papers or speed.")] = "simulated",
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of real logs, for the suite real.")
    ] = None,
    selector_file: SelectorFileOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Markdown file to keep the tables in.")
    ] = None,
    jobs: JobsOption = 2,
    filters: FiltersOption = None,
    tuned: TunedOption = None,
) -> None:
    """Print accuracy and speed of all estimators."""
    from crosscomb.report import terminal
    from crosscomb.report.markdown import write_benchmark, write_papers, write_speeds
    from crosscomb.run.drive import name_filters
    from crosscomb.run.tuned import load_tuned, require_used, with_tuned
    from crosscomb.selection.artefact import load_artefact
    from crosscomb.training.recordings import find_places
    from crosscomb.training.suites import benchmark as suites

    if suite == "speed":
        from crosscomb.training.suites.speed import measure_all, pairs_of

        pairs = pairs_of(_names(filters))
        with terminal.progress("timing", len(pairs)) as advance:
            speeds_of_pairs = measure_all(pairs, advance)
        terminal.show_speeds(speeds_of_pairs)
        if output is not None:
            write_speeds(output, speeds_of_pairs)
        return
    artefact = load_artefact(selector_file)
    if suite == "papers":
        from crosscomb.training.suites.papers import PAPERS, PaperTable

        with terminal.progress("rebuilding tables", len(PAPERS)) as advance:
            tables: dict[str, PaperTable] = {}
            for paper, rebuild in PAPERS.items():
                tables |= {f"{paper}, {title}": table for title, table in rebuild().items()}
                advance()
        for name, table in tables.items():
            terminal.show_table(name, table.table)
            terminal.say(table.verdict + "\n")
        if output is not None:
            write_papers(output, tables)
        return
    beside = name_filters([name for name in _names(filters) if name not in artefact.filter_names], artefact)
    if tuned is not None:
        given = load_tuned(tuned)
        require_used(given, [*artefact.filter_names, *(entry.name for entry in beside)], tuned)
        beside = with_tuned(beside, given)
        artefact = artefact.model_copy(update={"filters": with_tuned(artefact.filters, given)})
    if suite == "real":
        if data is None:
            raise UsageError("benchmark real: needs the folder of the logs: give --data")
        with terminal.progress("filtering", 2 * sum(len(logs) for _, logs in find_places(data))) as advance:
            result = suites.benchmark_real(data, artefact, jobs, advance, beside)
    elif suite == "simulated":
        with terminal.progress("filtering", suites.SIMULATED_LOGS) as advance:
            result = suites.benchmark_simulated(artefact, jobs, advance, beside)
    else:
        raise UsageError(f"benchmark {suite}: unknown suite: take real, simulated, papers or speed")
    for note in result.notes:
        terminal.warn(note)
    terminal.show_benchmark(result)
    speeds = suites.filter_speeds(artefact, beside)
    terminal.show("Speed", ["filter", "us per sample"], [[name, f"{us:.2f}"] for name, us in speeds.items()])
    if output is not None:
        write_benchmark(output, suite, result, speeds, selector_file)
        terminal.say(f"{output}: section {suite} written")


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for everything the demo makes.")
    ] = Path("crosscomb-demo"),
) -> None:
    """Simulate, train and estimate on a small set, in under a minute."""
    from crosscomb.report import terminal

    logs, unseen, selector = output / "logs", output / "unseen", output / "selector.json"
    simulate(logs, vehicle=None, seed=1, logs=30, force=True, jobs=2, preset="quick")
    train(logs, output=selector, jobs=2, tune_budget=0)  # noise tuned on logs this short would be no better
    simulate(unseen, vehicle=None, seed=2, logs=3, force=True, jobs=2, preset="quick")
    fresh = sorted(unseen.glob("*.csv.gz"))
    estimate(fresh, selector_file=selector, output=output / "estimates", plot=True)
    terminal.say(
        f"look at {output / 'estimates'} (pictures) and {output / 'report.html'} (how well it was trained)"
    )

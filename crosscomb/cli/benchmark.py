"""The command `benchmark`: tables of accuracy and speed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crosscomb.cli.options import FiltersOption, JobsOption, SelectorFileOption, TunedOption, filter_names
from crosscomb.errors import UsageError

if TYPE_CHECKING:
    from crosscomb.training.suites.fault_runs import Setup


def benchmark(
    suite: Annotated[str, typer.Argument(help="real, simulated, faults, papers or speed.")] = "simulated",
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of real logs, for the suites real and faults.")
    ] = None,
    selector_file: SelectorFileOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Markdown file to keep the tables in.")
    ] = None,
    jobs: JobsOption = 2,
    filters: FiltersOption = None,
    tuned: TunedOption = None,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=100, help="Faults: simulated logs of each manoeuvre.")
    ] = 5,
    drift: Annotated[
        Path | None, typer.Option("--drift", help="Faults: folder of real drifts, run without any fault.")
    ] = None,
    kinds: Annotated[
        str | None, typer.Option("--kinds", help="Faults: only these rows of the table, a,b,c.")
    ] = None,
    worst: Annotated[int, typer.Option("--worst", min=0, help="Faults: name so many of the worst runs.")] = 0,
) -> None:
    """Print accuracy and speed of all estimators, or what faults do to the answer."""
    if suite == "speed":
        _speed(filter_names(filters), output)
        return
    from crosscomb.report import terminal
    from crosscomb.report.markdown import write_benchmark
    from crosscomb.run.drive import name_filters
    from crosscomb.run.tuned import load_tuned, with_tuned
    from crosscomb.selection.artefact import load_artefact
    from crosscomb.training.recordings import find_places
    from crosscomb.training.suites import benchmark as suites
    from crosscomb.training.suites.fault_runs import Setup

    artefact = load_artefact(selector_file)
    if suite == "papers":
        _papers(output)
        return
    if suite == "faults":
        setup = Setup(artefact, tuple(filter_names(filters)), _kinds(kinds))
        _faults(setup, selector_file, data, drift, seeds, jobs, worst, output)
        return
    beside = name_filters(
        [name for name in filter_names(filters) if name not in artefact.filter_names], artefact
    )
    given = load_tuned(tuned, [*artefact.filter_names, *(entry.name for entry in beside)])
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
        raise UsageError(f"benchmark {suite}: unknown suite: take real, simulated, faults, papers or speed")
    for note in result.notes:
        terminal.warn(note)
    terminal.show_benchmark(result)
    speeds = suites.filter_speeds(artefact, beside)
    terminal.show("Speed", ["filter", "us per sample"], [[name, f"{us:.2f}"] for name, us in speeds.items()])
    if output is not None:
        write_benchmark(output, suite, result, speeds, selector_file)
        terminal.say(f"{output}: section {suite} written")


def _speed(names: list[str], output: Path | None) -> None:
    """Time kernels beside their twins."""
    from crosscomb.report import terminal
    from crosscomb.report.markdown import write_speeds
    from crosscomb.training.suites.speed import measure_all, pairs_of

    pairs = pairs_of(names)
    with terminal.progress("timing", len(pairs)) as advance:
        speeds = measure_all(pairs, advance)
    terminal.show_speeds(speeds)
    if output is not None:
        write_speeds(output, speeds)


def _kinds(given: str | None) -> tuple[str, ...]:
    """Take the kinds of faults in a --kinds option apart; all where there is none."""
    from crosscomb.training.suites.fault_criteria import CRITERIA

    if given is None:
        return tuple(CRITERIA)
    kinds = tuple(kind.strip() for kind in given.split(","))
    for kind in kinds:
        if kind not in CRITERIA:
            raise UsageError(f"--kinds {kind}: no such fault: take of {', '.join(CRITERIA)}")
    return kinds


def _faults(
    setup: Setup,
    selector_file: Path | None,
    data: Path | None,
    drift: Path | None,
    seeds: int,
    jobs: int,
    worst: int,
    output: Path | None,
) -> None:
    """Put every fault into every log."""
    from crosscomb.report import terminal
    from crosscomb.report.faults import show_campaign, write_campaign
    from crosscomb.training.recordings import find_places
    from crosscomb.training.suites.fault_campaign import SEEDS, jobs_of, run_campaign
    from crosscomb.training.suites.fault_criteria import CRITERIA

    folders = [folder for folder in (data, drift) if folder is not None]
    logs = sum(len(logs) for folder in folders for _, logs in find_places(folder))
    with terminal.progress("breaking logs", len(jobs_of(seeds, setup.kinds)) + logs) as advance:
        campaign = run_campaign(setup, data, drift, seeds, jobs, advance)
    show_campaign(campaign, worst)
    if output is None:
        return
    words = [f"--selector-file {selector_file.name}"] if selector_file else []
    words += [f"--filters {','.join(setup.filters)}"] if setup.filters else []
    words += ["--data <folder of the real logs>"] if data else []
    words += ["--drift <folder of the real drifts>"] if drift else []
    words += [f"--seeds {seeds}"] if seeds != SEEDS else []
    words += [f'--kinds "{",".join(setup.kinds)}"'] if setup.kinds != tuple(CRITERIA) else []
    name = "-".join([selector_file.stem if selector_file else "tree", *setup.filters])
    write_campaign(
        output, campaign, name, " ".join(["crosscomb benchmark faults", *words, f"-o docs/{output.name}"])
    )
    terminal.say(f"{output}: section {name} written")


def _papers(output: Path | None) -> None:
    """Rebuild the papers' tables."""
    from crosscomb.report import terminal
    from crosscomb.report.markdown import write_papers
    from crosscomb.training.suites.papers import PAPERS, PaperTable

    tables: dict[str, PaperTable] = {}
    with terminal.progress("rebuilding tables", len(PAPERS)) as advance:
        for paper, rebuild in PAPERS.items():
            tables |= {f"{paper}, {title}": table for title, table in rebuild().items()}
            advance()
    for name, table in tables.items():
        terminal.show_table(name, table.table)
        terminal.say(table.verdict + "\n")
    if output is not None:
        write_papers(output, tables)

"""The command line. Each command imports what it needs only when it runs: `--help` starts at once."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from typing import Annotated

import typer

from crosscomb import __version__
from crosscomb.cli.benchmark import benchmark
from crosscomb.cli.demo import demo
from crosscomb.cli.estimate import check, estimate, filters
from crosscomb.cli.identify import identify
from crosscomb.cli.simulate import simulate, vehicle
from crosscomb.cli.stop import clean_up, stoppable, stopped_by
from crosscomb.cli.train import train
from crosscomb.cli.tune import tune
from crosscomb.errors import UsageError, printable

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Virtual sensor for the vehicle sideslip angle.",
)


def main() -> None:
    """Run the command line: errors of use become one line and exit code 2, signals one line and their own code."""
    try:
        with stoppable():
            _run()
    except BaseException:
        number = stopped_by()
        if not number:
            raise
        clean_up(number)
        sys.exit(128 + number)


def _run() -> None:
    # A run that is stopped leaves it to loky's tracker to clear up, which would warn of that on the terminal.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")
    # A run's 250,000 objects are its imports and live to the end: searching them for rubbish cost a tenth of it.
    gc.set_threshold(500_000)
    atexit.register(gc.freeze)
    try:
        code = app(standalone_mode=False)
    except UsageError as error:
        from crosscomb.report.terminal import as_flags

        _say_error(as_flags(str(error)))
        sys.exit(2)
    except OSError as error:
        _say_error(f"{error.filename or 'output'}: {error.strerror or error}")
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        # typer brings its own copy of click in some versions: its errors are known by what they can do
        if not hasattr(error, "format_message"):
            raise
        _say_error(f"{error.format_message()} (see --help)")
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)


def _say_error(text: str) -> None:
    """Print one line, whatever a file or column is called."""
    print(f"error: {printable(' '.join(text.split()))}", file=sys.stderr)


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


for command in (filters, vehicle, simulate, tune, train, identify, estimate, check, benchmark, demo):
    app.command()(command)

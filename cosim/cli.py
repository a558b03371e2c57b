"""The command line. Exit status: 0 done, 2 the input is wrong (told in one line), 1 the program failed."""

import os
import sys
import warnings

import typer
from rich.table import Table
from rich.text import Text

from ..sins.text import printable, shortened
from .bound_command import bound
from .campaign_command import campaign, report
from .command_line import InputError, ScenarioArgument, loaded
from .fly_command import fly
from .lmi_command import lmi
from .localize_command import localize
from .maneuver_command import maneuver
from .replay_command import replay
from .run_command import run
from .terminal import error_console, out_console

MOST_LETTERS = 5000
"""Of a line that tells a mistake: as a path may have, and some."""


def main() -> None:
    """Entry point: turns mistakes in the input into one line each and status 2."""
    try:
        _main()
    except KeyboardInterrupt:  # during the imports
        error_console.print("stopped")
        sys.exit(1)


def _main() -> None:
    # All cores are at work on runs of their own: more threads in each would wait. numpy reads it at import.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    warnings.showwarning = lambda message, *_, **__: error_console.print(f"warning: {message}")
    try:
        status = app(standalone_mode=False)
        if status == 130:  # what typer makes of Ctrl-C
            raise KeyboardInterrupt
    except typer.TyperException as error:
        status = _refuse(_told(error))
    except (typer.Abort, KeyboardInterrupt):
        error_console.print("stopped")
        status = 1
    except (ValueError, RuntimeError) as error:
        status = _status(error)
        if status is None:
            raise
    sys.exit(status or 0)


def _told(error: typer.TyperException) -> str:
    """What typer refuses, in a line."""
    from pydantic import ValidationError

    from .mistakes import told_option

    parameter = getattr(error, "param", None)
    if parameter is not None and isinstance(error.__cause__, ValidationError):
        return told_option(parameter.opts[0], error.__cause__)
    return getattr(error, "format_message", error.__str__)()


def _status(error: Exception) -> int | None:
    """What the program ends with after an error that its user is told; None: it is the program's own."""
    # Imported here: with them come scipy and numba, and most ends of a program need neither.
    from ..aircraft.envelope import FlightError
    from .scenario import ScenarioError

    if not isinstance(error, InputError | ScenarioError | FlightError):
        return None
    _refuse(str(error))
    at_fault = isinstance(error, FlightError) and error.phase == "preparation"
    return 1 if at_fault else 2  # 1: JSBSim or its models are at fault, not the plan.


def _refuse(message: str) -> int:
    for line in message.split("\n"):
        told = shortened(printable(line), MOST_LETTERS)
        error_console.print(f"fleetalign: {told}", soft_wrap=True)
    return 2


def check(scenario: ScenarioArgument) -> None:
    """Check a scenario without flying it."""
    from ..aircraft.airframe import load_airframe
    from ..aircraft.envelope import Envelope, FlightError
    from .papers.scenario import validated
    from .scenario import ScenarioError, is_paper, read_scenario

    read = name, content, _ = read_scenario(scenario)
    if is_paper(content):
        out_console.print(f"{name}: {validated(scenario, content).title}: good", soft_wrap=True)
        return
    _, settings = loaded(scenario, read=read)
    try:
        Envelope(settings.flight, load_airframe(settings.flight.airframe))
    except FlightError as error:
        raise ScenarioError(f"{printable(scenario)}: {error}") from error
    out_console.print(f"{name}: {settings.title}: good", soft_wrap=True)


def list_() -> None:
    """List bundled scenarios, airframes and filters."""
    from ..aircraft.airframe import airframe_names
    from ..align.methods import METHODS
    from .scenario import read_scenario, scenario_names

    table = Table("kind", "name", "what")
    for name in scenario_names():
        table.add_row("scenario", name, Text(read_scenario(name)[1]["title"]))
    for name in airframe_names():
        table.add_row("airframe", name, "")
    for name, method in METHODS.items():
        table.add_row("filter", name, method.about)
    out_console.print(table)


app = typer.Typer(
    help="Fly, err, fix, align, record: in-flight alignment of a strapdown INS on late fleet fixes.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (run, fly, localize, bound, replay, lmi, maneuver, campaign, report, check):
    app.command()(command)
app.command("list")(list_)


if __name__ == "__main__":
    main()

"""What the commands share: arguments and options, and the steps that each of them begins with."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .terminal import progress_bar

if TYPE_CHECKING:
    from ..aircraft.flight import Flight
    from .scenario import ReadScenario, Scenario

ScenarioArgument = Annotated[str, typer.Argument(help="A bundled scenario (see `list`) or a TOML file.")]
NoCache = Annotated[bool, typer.Option("--no-cache", help="Fly anew, and keep nothing.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]
OutFolder = Annotated[Path | None, typer.Option(help="Folder for the results.")]


class InputError(ValueError):
    """An option that cannot be used; one line."""


def loaded(
    scenario: str,
    runs: int | None = None,
    seed: int | None = None,
    filters: list[str] | None = None,
    read: "ReadScenario | None" = None,
) -> "tuple[str, Scenario]":
    """The scenario with the options of the command line in the place of its own. Raises `ScenarioError`."""
    from .scenario import load_scenario, replaced

    name, settings = load_scenario(scenario, read)
    changes = {"runs": runs, "seed": seed, "alignment.filters": filters or None}
    changes = {field: value for field, value in changes.items() if value is not None}
    return name, replaced(settings, changes, origin="option")


def flown(settings: "Scenario", no_cache: bool, silent: bool) -> "Flight":
    """The scenario's flight, from the cache if it is there. Raises `FlightError`."""
    from ..aircraft.cache import cached_flight

    with progress_bar(f"flying {settings.flight.airframe}", silent) as progress:
        flight, _ = cached_flight(settings.flight, use_cache=not no_cache, progress=progress)
    return flight


def output_folder(folder: Path) -> Path:
    """The folder, made if need be. Raises `InputError` where nothing can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink(missing_ok=True)  # another process may have tried the same
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
    return folder


def command_as_typed() -> str:
    """The command that runs, as a line for a shell."""
    return shlex.join(["fleetalign", *sys.argv[1:]])

"""The command line. Exit status: 0 done, 2 the input is wrong (told in one line), 1 the program failed."""

import json
import os
import shlex
import subprocess
import sys
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from .terminal import deferred_interrupt, error_console, out_console, progress_bar, results_table

if TYPE_CHECKING:
    from ..aircraft.flight import Flight
    from ..network.fixes import Fixes
    from .run import Run
    from .scenario import Scenario

app = typer.Typer(
    help="Fly, err, fix, align, record: in-flight alignment of a strapdown INS on late fleet fixes.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ScenarioArgument = Annotated[str, typer.Argument(help="A bundled scenario (see `list`) or a TOML file.")]
NoCache = Annotated[bool, typer.Option("--no-cache", help="Fly anew, and keep nothing.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]


class InputError(ValueError):
    """An option that cannot be used; one line."""


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

    from ..aircraft.envelope import FlightError
    from .scenario import ScenarioError

    warnings.showwarning = lambda message, *_, **__: error_console.print(f"warning: {message}")
    try:
        status = app(standalone_mode=False)
        if status == 130:  # what typer makes of Ctrl-C
            raise KeyboardInterrupt
    except typer.TyperException as error:
        status = _refuse(getattr(error, "format_message", error.__str__)())
    except (typer.Abort, KeyboardInterrupt):
        error_console.print("stopped")
        status = 1
    except (InputError, ScenarioError, FlightError) as error:
        status = _refuse(str(error))
        if isinstance(error, FlightError) and error.phase == "preparation":
            status = 1  # JSBSim or its models are at fault, not the plan.
    sys.exit(status or 0)


def _refuse(message: str) -> int:
    for line in message.splitlines():
        error_console.print(f"fleetalign: {line}", soft_wrap=True)
    return 2


@app.command()
def run(
    scenario: ScenarioArgument = "gao2009",
    runs: Annotated[int | None, typer.Option(help="Number of runs; the scenario's by default.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all runs; the scenario's by default.")] = None,
    filter_: Annotated[
        list[str] | None, typer.Option("--filter", help="Filter to run; may be given again.")
    ] = None,
    variants: Annotated[
        bool, typer.Option("--variants", help="Run the scenario's variants as well, for one table.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Open the recording in the Rerun viewer.")] = False,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario, align on it many times, and write summary, estimates, recording and report."""
    from ..aircraft.cache import is_cached
    from .network_score import NetworkScorer
    from .outputs import estimates_writer, manifest, summarize, write_json
    from .recording import write_recording
    from .report import write_report
    from .run import (
        BOUND_DRAWS,
        alignment_window,
        bound_of,
        compiling_ahead,
        no_bound_because,
        simulate_all,
    )
    from .scenario import ScenarioError
    from .score import Scorer, standard_deviations
    from .variants import run_variants

    name, settings = _load(scenario, runs, seed, filter_)
    if variants and not settings.variants:
        raise InputError(f"--variants: {scenario} has none")
    folder = _output_folder(out or Path(f"fleetalign-{name}"))
    silent = quiet or as_json
    flown_before = is_cached(settings.flight) and not no_cache
    with nullcontext() if flown_before else compiling_ahead():
        flight = _flown(settings, no_cache, silent)
    try:
        window = alignment_window(settings, flight)
    except ScenarioError as error:
        raise ScenarioError(f"{scenario}: {error}") from error
    scorer, network = Scorer(window, settings.alignment.filters), NetworkScorer()
    first: Run | None = None
    fixes: list[Fixes] = []
    done = 0
    with (
        deferred_interrupt() as interrupted,
        progress_bar("aligning", silent) as progress,
        estimates_writer(folder / "estimates.parquet", window, settings.imu.vibration_mps) as estimates,
    ):
        for done_run in simulate_all(settings, flight, settings.runs, settings.seed, progress):
            first = first or done_run
            scorer.add(done_run)
            if done_run.network is not None:
                network.add(done_run.network)
            if len(fixes) < BOUND_DRAWS:
                fixes.append(done_run.fixes)
            estimates.add(done_run)
            done += 1
            if interrupted():
                error_console.print(f"stopped after {done} of {settings.runs} runs; these are kept")
                break
    assert first is not None
    bound = bound_of(settings, window, fixes)
    bound_sd = standard_deviations(window, bound, settings.imu.vibration_mps)
    scores = scorer.scores()
    network_score = network.score() if network.runs else None
    summary = summarize(name, settings, settings.seed, flight, scores, bound_sd, network_score)
    if variants and done == settings.runs:
        with progress_bar("variants", silent) as progress:
            summary["variants"] = run_variants(settings, flight, progress)
    write_json(folder / "summary.json", summary)
    command = shlex.join(["fleetalign", *sys.argv[1:]])
    about = manifest(name, settings, settings.seed, done, command)
    write_json(folder / "manifest.json", about)
    with progress_bar("recording and report", silent) as progress:
        write_recording(
            folder / "recording.rrd",
            settings.title,
            flight,
            window,
            first,
            bound,
            settings.imu.vibration_mps,
        )
        progress(1, 2)
        write_report(
            folder / "report.html",
            settings,
            flight,
            window,
            scores,
            bound_sd,
            summary,
            about,
            (first.network, network_score) if first.network is not None and network_score else None,
        )
        progress(2, 2)
    if as_json:
        typer.echo(json.dumps(summary, indent=2, allow_nan=False))
    elif not quiet:
        out_console.print(results_table(settings, summary))
        reason = no_bound_because(settings)
        if reason:
            out_console.print(f"no bound: {reason}")
        for filter_name, score in scores.items():
            for run_id, reason in score.failures.items():
                out_console.print(f"failed {filter_name}, run {run_id}: {reason}", style="red")
        for line in settings.paper.remarks if settings.paper else ():
            out_console.print(f"- {line}")
        out_console.print(f"report     {folder / 'report.html'}", soft_wrap=True)
        out_console.print(f"recording  {folder / 'recording.rrd'}", soft_wrap=True)
    if view:
        subprocess.Popen(
            [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(folder / "recording.rrd")]
        )
    if done < settings.runs:
        raise typer.Exit(1)


@app.command()
def fly(
    scenario: ScenarioArgument = "gao2009",
    out: Annotated[Path | None, typer.Option(help="Folder for `flight.parquet`.")] = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario in JSBSim and tell how it went."""
    from .outputs import write_flight

    _, settings = _load(scenario)
    folder = _output_folder(out) if out else None
    flight = _flown(settings, no_cache, quiet or as_json)
    if folder:
        write_flight(folder / "flight.parquet", flight)
    if as_json:
        typer.echo(json.dumps(flight.summary, indent=2))
    elif not quiet:
        table = Table("phase", "from, s", "to, s", "altitude, m", "speed, m/s", title=Text(settings.title))
        for phase in flight.phases:
            lla, v_n, _ = flight.at([phase.start_s, phase.end_s])
            speeds = [float((v**2).sum() ** 0.5) for v in v_n]
            table.add_row(
                phase.name,
                f"{phase.start_s:.2f}",
                f"{phase.end_s:.2f}",
                f"{lla[0, 2]:.1f} to {lla[1, 2]:.1f}",
                f"{speeds[0]:.1f} to {speeds[1]:.1f}",
            )
        out_console.print(table)
        for key, value in flight.summary.items():
            shown = value if isinstance(value, str) else f"{value:.2f}"
            out_console.print(f"{key:24} {shown}")


@app.command()
def localize(
    scenario: ScenarioArgument = "gao2009",
    nodes: Annotated[
        int | None,
        typer.Option(max=2_000_000, help="Number of nodes; above 200 the study of scale, without a flight."),
    ] = None,
    draws: Annotated[int, typer.Option(help="Draws of the network.")] = 200,
    seed: Annotated[int | None, typer.Option(help="Seed of all draws; the scenario's by default.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.")] = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Run a scenario's network alone: coverage, accuracy, delay and load, and the paper's figures."""
    from .localize_command import MOST_NODES, study_fleet, study_scale, with_network
    from .outputs import write_json

    if draws < 1:
        raise InputError(f"--draws {draws}: at least 1")
    name, settings = _load(scenario, seed=seed)
    large = nodes is not None and nodes > MOST_NODES
    settings = settings if large else with_network(settings, scenario, nodes)
    folder, silent = _output_folder(out or Path(f"fleetalign-localize-{name}")), quiet or as_json
    if nodes is not None and large:
        with progress_bar(f"locating {nodes} nodes", silent) as progress:
            told = study_scale(nodes, settings.seed, progress)
    else:
        flight = _flown(settings, no_cache, silent)
        command = shlex.join(["fleetalign", *sys.argv[1:]])
        with progress_bar("localizing", silent) as progress:
            told = study_fleet(name, settings, flight, draws, folder / "localize.html", command, progress)
    write_json(folder / "localize.json", told.summary)
    if as_json:
        typer.echo(json.dumps(told.summary, indent=2, allow_nan=False))
    elif not quiet:
        for part in told.parts:
            out_console.print(part)
        for path in sorted(folder.glob("localize.*")):
            out_console.print(str(path), soft_wrap=True)


@app.command()
def check(scenario: ScenarioArgument) -> None:
    """Check a scenario without flying it."""
    from ..aircraft.airframe import load_airframe
    from ..aircraft.envelope import Envelope

    name, settings = _load(scenario)
    Envelope(settings.flight, load_airframe(settings.flight.airframe))
    out_console.print(f"{name}: {settings.title}: good", soft_wrap=True)


@app.command("list")
def list_() -> None:
    """List bundled scenarios, airframes and filters."""
    from ..aircraft.airframe import airframe_names
    from ..align.filters import FILTERS
    from .scenario import load_scenario, scenario_names

    table = Table("kind", "name", "what")
    for name in scenario_names():
        table.add_row("scenario", name, Text(load_scenario(name)[1].title))
    for name in airframe_names():
        table.add_row("airframe", name, "")
    for name, delay in FILTERS.items():
        table.add_row("filter", name, f"delay {delay.name.lower()}")
    out_console.print(table)


def _load(
    scenario: str, runs: int | None = None, seed: int | None = None, filters: list[str] | None = None
) -> "tuple[str, Scenario]":
    """The scenario with the options of the command line in the place of its own."""
    from .scenario import load_scenario, replaced

    name, settings = load_scenario(scenario)
    changes = {"runs": runs, "seed": seed, "alignment.filters": filters or None}
    changes = {field: value for field, value in changes.items() if value is not None}
    return name, replaced(settings, changes, origin="option")


def _flown(settings: "Scenario", no_cache: bool, silent: bool) -> "Flight":
    from ..aircraft.cache import cached_flight

    with progress_bar(f"flying {settings.flight.airframe}", silent) as progress:
        flight, _ = cached_flight(settings.flight, use_cache=not no_cache, progress=progress)
    return flight


def _output_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
    return folder


if __name__ == "__main__":
    main()

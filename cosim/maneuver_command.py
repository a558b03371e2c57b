"""The command `maneuver`. What is heavy is imported when it runs, so that the help is quick."""

import json
import time
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from ..sins.settings import Settings
from .command_line import (
    AsJson,
    InputError,
    NoCache,
    OutFolder,
    Quiet,
    ScenarioArgument,
    command_as_typed,
    flown,
    loaded,
    output_folder,
)
from .terminal import out_console, progress_bar

Chosen = TypeVar("Chosen", bound=Settings)


def maneuver(
    scenario: ScenarioArgument = "stated_fixes",
    velocity_sd_mps: Annotated[
        float | None, typer.Option(help="Noise of the fixes; the scenario's by default, 0.03 for a network.")
    ] = None,
    position_sd_m: Annotated[
        float | None, typer.Option(help="The same of position; 10 for a network.")
    ] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Of the fixes; the scenario's by default.")] = None,
    duration_s: Annotated[float | None, typer.Option(help="Of the manoeuvre; 40 by default.")] = None,
    max_bank_deg: Annotated[float | None, typer.Option(help="60 by default.")] = None,
    max_load_factor: Annotated[float | None, typer.Option(help="In g; 3 by default.")] = None,
    max_roll_rate_deg_s: Annotated[float | None, typer.Option(help="30 by default.")] = None,
    max_roll_acceleration_deg_s2: Annotated[float | None, typer.Option(help="30 by default.")] = None,
    max_heading_excursion_deg: Annotated[
        float | None, typer.Option(help="From the course at the start, at any time; 180 by default.")
    ] = None,
    course_tolerance_deg: Annotated[
        float | None, typer.Option(help="From that course at the end; 180 by default, 1 to be back on it.")
    ] = None,
    whole_turns: Annotated[
        bool, typer.Option("--whole-turns", help="A course regained after a full circle is regained.")
    ] = False,
    heading_weight: Annotated[
        float | None, typer.Option(help="Of the heading's variance beside those of level; 1 by default.")
    ] = None,
    random_starts: Annotated[int | None, typer.Option(help="Besides eight others; 4 by default.")] = None,
    max_iterations: Annotated[int | None, typer.Option(help="From each start; 150 by default.")] = None,
    runs: Annotated[int | None, typer.Option(help="Number of runs; the scenario's by default.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all runs; the scenario's by default.")] = None,
    out: OutFolder = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find the bank profile with the least bound on misalignment, fly it, and align on it beside the S."""
    from ..align.maneuver import ManeuverError, ManeuverSearch, best_maneuver
    from ..align.maneuver_limits import ManeuverLimits
    from .maneuver import ManeuverStudy, align_on, grid_of, task_of, with_profile, with_stated_fixes
    from .maneuver_report import maneuver_table, summarize, told_lines, write_maneuver
    from .outputs import write_json
    from .recording import write_recording
    from .scenario_file import write_scenario

    limits = _chosen(
        ManeuverLimits,
        duration_s=duration_s,
        max_bank_deg=max_bank_deg,
        max_load_factor_g=max_load_factor,
        max_roll_rate_deg_s=max_roll_rate_deg_s,
        max_roll_acceleration_deg_s2=max_roll_acceleration_deg_s2,
        max_heading_excursion_deg=max_heading_excursion_deg,
        course_tolerance_deg=course_tolerance_deg,
        whole_turns=whole_turns or None,
    )
    search = _chosen(
        ManeuverSearch,
        heading_weight=heading_weight,
        random_starts=random_starts,
        max_iterations=max_iterations,
    )
    name, settings = loaded(scenario, runs, seed)
    noise = {"rate_hz": rate_hz, "position_sd_m": position_sd_m, "velocity_sd_mps": velocity_sd_mps}
    settings = with_stated_fixes(settings, scenario, limits, noise)
    task, silent = task_of(settings), quiet or as_json
    folder = output_folder(out or Path(f"fleetalign-maneuver-{name}"))
    started = time.perf_counter()
    with progress_bar("searching", silent) as progress:
        try:
            found = best_maneuver(task, limits, search, progress)
        except ManeuverError as error:
            raise InputError(f"{scenario}: {error}") from error
    seconds = time.perf_counter() - started
    with progress_bar("grid of S families", silent) as progress:
        grid = grid_of(task, limits, search, progress=progress)
    results = []
    for told, flying in (("the S", settings), ("best manoeuvre", with_profile(settings, found.profile))):
        flight = flown(flying, no_cache, silent)
        with progress_bar(f"aligning, {told}", silent) as progress:
            results.append(align_on(flying, flight, progress))
    s, best = results
    study = ManeuverStudy(task, limits, search, found, seconds, grid, s, best)
    summary = summarize(name, study)
    write_json(folder / "maneuver.json", summary)
    write_scenario(best.scenario, folder / "maneuver.toml")
    with progress_bar("recording and report", silent) as progress:
        vibration_mps = settings.imu.vibration_mps
        title = best.scenario.title
        write_recording(
            folder / "maneuver.rrd", title, best.flight, best.window, best.first, best.bound, vibration_mps
        )
        progress(1, 2)
        write_maneuver(folder / "maneuver.html", settings.title, study, summary, command_as_typed())
        progress(2, 2)
    if as_json:
        typer.echo(json.dumps(summary, indent=2, allow_nan=False))
    elif not quiet:
        out_console.print(maneuver_table(settings.title, summary))
        for line in told_lines(summary):
            out_console.print(f"- {line}", soft_wrap=True)
        for path in sorted(folder.glob("maneuver.*")):
            out_console.print(str(path), soft_wrap=True)


def _chosen(model: type[Chosen], **options: Any) -> Chosen:
    """The model with the options that were given. Raises `InputError`, one line for each mistake."""
    from pydantic import ValidationError

    from .mistakes import told_mistakes

    given = {name: value for name, value in options.items() if value is not None}
    try:
        return model(**given)
    except ValidationError as error:
        raise InputError(told_mistakes("option", error, model)) from error

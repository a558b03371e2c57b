"""What the commands do with a companion paper's scenario."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from ...network.localization.problem import LocalizationError
from ..command_line import InputError, command_as_typed, output_folder
from ..outputs import surroundings, write_json, write_parquet
from ..scenario import ScenarioError
from ..terminal import out_console, progress_bar
from .report import summarize, terminal_parts, write_report
from .scenario import ON_THE_RUN, run_experiment, validated


@dataclass(frozen=True)
class Asked:
    """What a command line asks of an experiment."""

    command: str
    """`run` or `localize`."""
    scenario: str
    """As typed."""
    content: dict[str, Any]
    draws: int | None
    seed: int | None
    out: Path | None
    quiet: bool
    as_json: bool
    idle: dict[str, bool]
    """Options that no experiment has, and whether they are given."""


def study_paper(name: str, asked: Asked) -> Path:
    """Run the experiment and leave its files. Returns their folder.

    Raises `ScenarioError`, `InputError`.
    """
    for option, given in asked.idle.items():
        if given:
            raise InputError(f"{option}: not for {asked.scenario}, the experiment of a paper")
    changes = {"draws": asked.draws, "seed": asked.seed}
    changes = {field: value for field, value in changes.items() if value is not None}
    scenario = validated(asked.scenario, asked.content)
    try:
        scenario = validated("option", {**asked.content, **changes})
    except ScenarioError as error:
        draws = "--runs" if asked.command == "run" else "--draws"
        typed = str(error).replace("option: draws", draws).replace("option: seed", "--seed")
        raise InputError(typed) from error
    command = "run" if isinstance(scenario.experiment, ON_THE_RUN) else "localize"
    if command != asked.command:
        raise InputError(f"{asked.scenario}: run it by: fleetalign {command} {asked.scenario}")
    summary_file, page = (
        ("summary.json", "report.html") if command == "run" else ("localize.json", "localize.html")
    )
    default = f"fleetalign-{name}" if command == "run" else f"fleetalign-localize-{name}"
    folder, silent = output_folder(asked.out or Path(default)), asked.quiet or asked.as_json
    with progress_bar(name, silent) as progress:
        try:
            results = run_experiment(scenario, progress)
        except LocalizationError as error:
            raise ScenarioError(f"{asked.scenario}: {error}") from error
    summary, typed = summarize(name, scenario, results), command_as_typed()
    write_json(folder / summary_file, summary)
    write_report(folder / page, scenario, results, typed)
    if command == "run":
        about = {"scenario": name, "seed": scenario.seed, "runs": scenario.draws, **surroundings(typed)}
        write_json(folder / "manifest.json", about | {"content": scenario.model_dump(mode="json")})
    if results.estimates:
        write_parquet(folder / "estimates.parquet", results.estimates)
    if results.write_recording:
        results.write_recording(folder / "recording.rrd")
    if asked.as_json:
        typer.echo(json.dumps(summary, indent=2, allow_nan=False))
    elif not asked.quiet:
        for part in terminal_parts(scenario, results):
            out_console.print(part)
        out_console.print(f"report     {folder / page}", soft_wrap=True)
        if results.write_recording:
            out_console.print(f"recording  {folder / 'recording.rrd'}", soft_wrap=True)
    return folder

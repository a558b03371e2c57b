"""The command `bound`. What is heavy is imported when it runs, so that the help is quick."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

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

MOST_DRAWS = 10_000
TIMES_SHOWN = 6
"""Columns of the table on the terminal."""


def bound(
    scenario: ScenarioArgument = "gao2009",
    draws: Annotated[
        int, typer.Option(help="Draws of the fixes to average over, where losses or delays differ.")
    ] = 20,
    seed: Annotated[int | None, typer.Option(help="Seed of all draws; the scenario's by default.")] = None,
    out: OutFolder = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """The Cramer-Rao bound of every state along the flown truth, with stamps known and delays unknown."""
    import numpy as np

    from .bound import bounds_of, no_bound_because
    from .bound_report import STATES, states_of, summarize_bounds, write_bound_report, write_bounds
    from .outputs import write_json
    from .run import alignment_window, fixes_of
    from .scenario import ScenarioError

    if not 1 <= draws <= MOST_DRAWS:
        raise InputError(f"--draws {draws}: allowed is [1, {MOST_DRAWS}]")
    name, settings = loaded(scenario, seed=seed)
    reason = no_bound_because(settings)
    if reason:
        raise ScenarioError(f"{scenario}: no bound: {reason}")
    folder, silent = output_folder(out or Path(f"fleetalign-bound-{name}")), quiet or as_json
    flight = flown(settings, no_cache, silent)
    try:
        window = alignment_window(settings, flight)
    except ScenarioError as error:
        raise ScenarioError(f"{scenario}: {error}") from error
    fixes = []
    with progress_bar("drawing fixes", silent) as progress:
        for run_id in range(draws):
            fixes.append(fixes_of(settings, flight, run_id, settings.seed)[0])
            progress(run_id + 1, draws)
    bounds = bounds_of(settings, window, fixes)
    summary = summarize_bounds(name, settings, draws, window, bounds)
    write_json(folder / "bound.json", summary)
    write_bounds(folder / "bound.parquet", window, bounds)
    write_bound_report(folder / "bound.html", settings, window, bounds, summary, command_as_typed())
    if as_json:
        typer.echo(json.dumps(summary, indent=2, allow_nan=False))
    elif not quiet:
        end = float(window.time[-1] - window.time[0])
        times = end * np.arange(1, TIMES_SHOWN + 1) / TIMES_SHOWN
        for key, estimate in bounds.items():
            title = Text(f"bound, {key.replace('_', ' ')}")
            table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, padding=0)
            table.add_column("after", no_wrap=True)
            rows = np.searchsorted(estimate.time - window.time[0], times - 0.05)
            for time in times:
                table.add_column(f"{time:.0f} s", justify="right", no_wrap=True)
            for label, values in zip(STATES.values(), states_of(window, estimate)[rows].T, strict=True):
                if np.isfinite(values).any():
                    table.add_row(label, *(f"{value:.3g}" for value in values))
            out_console.print(table)
        out_console.print(str(folder / "bound.html"), soft_wrap=True)

"""The command `localize`. What is heavy is imported when it runs, so that the help is quick."""

import json
from pathlib import Path
from typing import Annotated

import typer

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

LARGEST = 2_000_000
"""Number of nodes."""
MOST_DRAWS = 100_000


def localize(
    scenario: ScenarioArgument = "gao2009",
    nodes: Annotated[
        int | None,
        typer.Option(
            min=2, max=LARGEST, help="Number of nodes; above 200 the study of scale, without a flight."
        ),
    ] = None,
    draws: Annotated[
        int | None, typer.Option(help="Draws of the network; 200, or a paper's scenario's own, by default.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all draws; the scenario's by default.")] = None,
    out: OutFolder = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Run a scenario's network alone: coverage, accuracy, delay and load, and the paper's figures.

    Scenarios of companion papers run the experiment of their paper.
    """
    from .localize_studies import MOST_NODES, Told, study_fleet, study_ground, study_scale, with_network
    from .outputs import write_json
    from .papers.command import Asked, study_paper
    from .scenario import is_paper, read_scenario

    read = name, content, _ = read_scenario(scenario)
    if is_paper(content):
        idle = {"--nodes": nodes is not None, "--no-cache": no_cache}
        study_paper(name, Asked("localize", scenario, content, draws, seed, out, quiet, as_json, idle))
        return
    draws = 200 if draws is None else draws
    if not 1 <= draws <= MOST_DRAWS:
        raise InputError(f"--draws {draws}: allowed is [1, {MOST_DRAWS}]")
    name, settings = loaded(scenario, seed=seed, read=read)
    large = nodes is not None and nodes > MOST_NODES
    grounded = settings.ground is not None and not large
    # A scenario of nodes on the ground need not have a network besides.
    networked = not grounded or settings.fixes.kind == "network"
    if not networked and nodes is not None:
        raise InputError(f"--nodes {nodes}: {scenario} has no network; those on the ground are ground.nodes")
    settings = with_network(settings, scenario, nodes) if networked and not large else settings
    folder, silent = output_folder(out or Path(f"fleetalign-localize-{name}")), quiet or as_json
    if nodes is not None and large:
        with progress_bar(f"locating {nodes} nodes", silent) as progress:
            told = study_scale(nodes, settings.seed, progress)
    else:
        flight = flown(settings, no_cache, silent)
        command = command_as_typed()
        told = Told({"scenario": name, "seed": settings.seed}, [])
        if networked:
            with progress_bar("localizing", silent) as progress:
                page = folder / "localize.html"
                told = study_fleet(name, settings, flight, draws, page, command, progress)
        if grounded:
            with progress_bar("locating nodes on the ground", silent) as progress:
                page = folder / "ground.html"
                ground = study_ground(name, settings, flight, draws, page, command, progress)
            told = Told({**told.summary, "ground": ground.summary}, [*told.parts, *ground.parts])
    write_json(folder / "localize.json", told.summary)
    if as_json:
        typer.echo(json.dumps(told.summary, indent=2, allow_nan=False))
    elif not quiet:
        for part in told.parts:
            out_console.print(part)
        for path in sorted([*folder.glob("localize.*"), *folder.glob("ground.html")]):
            out_console.print(str(path), soft_wrap=True)

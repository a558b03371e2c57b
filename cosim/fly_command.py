"""The command `fly`. What is heavy is imported when it runs, so that the help is quick."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from .command_line import AsJson, NoCache, Quiet, ScenarioArgument, flown, loaded, output_folder
from .terminal import out_console

if TYPE_CHECKING:
    from ..aircraft.mission import FlightPlan


def fly(
    scenario: ScenarioArgument = "gao2009",
    out: Annotated[Path | None, typer.Option(help="Folder for `flight.parquet`.")] = None,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario in JSBSim and tell how it went."""
    from .outputs import write_flight

    _, settings = loaded(scenario)
    folder = output_folder(out) if out else None
    flight = flown(settings, no_cache, quiet or as_json)
    if folder:
        write_flight(folder / "flight.parquet", flight)
    if as_json:
        plan = settings.flight.model_dump(mode="json")
        befallen = {"failures": plan["failures"], "gusts": plan["air"]["gusts"]}
        typer.echo(json.dumps(flight.summary | befallen, indent=2))
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
        for line in _befallen(settings.flight, float(flight.time[-1])):
            out_console.print(line)


def _befallen(plan: "FlightPlan", end_s: float) -> list[str]:
    """A line for each failure and gust until the flight ends, by the clock."""
    told = [(failure.time_s, "failure", failure.told) for failure in plan.failures]
    for gust in plan.air.gusts:
        speeds = f"{gust.north_mps:g}, {gust.east_mps:g}, {gust.down_mps:g} m/s north, east, down"
        told.append((gust.start_s, "gust", f"{speeds}, for {2 * gust.rise_s + gust.hold_s:g} s"))
    return [f"{kind:24} at {time_s:.2f} s: {what}" for time_s, kind, what in sorted(told) if time_s < end_s]

"""The command `lmi`. What is heavy is imported when it runs, so that the help is quick."""

import json
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from .command_line import AsJson, InputError, Quiet
from .terminal import error_console, out_console, progress_bar

if TYPE_CHECKING:
    from ..align.lmi.design import Design

KINDS = ("l2linf", "hinf", "h2", "theorem2", "feedback")
ROWS = {
    "mean-square spectral radius": "spectral_radius",
    "peak gain, disturbance fixed": "peak_deterministic",
    "peak gain, disturbance adapted": "peak_adapted",
    "energy gain, disturbance fixed": "energy_deterministic",
    "energy gain, disturbance adapted": "energy_adapted",
    "RMS under white noise": "white_rms",
    "RMS simulated, 200 steps from rest": "simulated_rms",
    "its standard error": "simulated_sd",
    "RMS expected there": "expected_rms",
}
"""What the table calls the fields of `align.lmi.analysis.Analysis`."""


def lmi(
    plant: Annotated[
        str, typer.Argument(help="A TOML file, or a bundled plant: gao_level, two_state, two_vertices.")
    ] = "two_state",
    kind: Annotated[
        str | None,
        typer.Option(help="l2linf, hinf, h2, theorem2 or feedback; by default what the file says."),
    ] = None,
    order: Annotated[
        int | None, typer.Option(help="Number of the filter's states, with theorem2; all by default.")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Design a robust filter by a matrix inequality for a plant whose outputs come late at random."""
    from ..align.lmi.design import DesignError, Kind, design, encoded
    from .plants import load_plant

    if kind is not None and kind not in KINDS:
        raise InputError(f"--kind {kind}: allowed are {', '.join(KINDS)}")
    title, suggested, vertices = load_plant(plant)
    suggested = "theorem2" if len(vertices) > 1 or order is not None else suggested
    wanted = Kind(kind or suggested)
    try:
        # Mistakes show up in here as well: where nobody watches, nothing comes before their line.
        with progress_bar("solving and analysing", quiet or as_json or not error_console.is_terminal):
            found = design(vertices, wanted, order)
    except (DesignError, ValueError) as error:
        raise InputError(f"{plant}: {error}") from error
    if as_json:
        typer.echo(json.dumps({"title": title, **encoded(found)}, indent=2, allow_nan=False))
    elif not quiet:
        _show(title, found)


def _show(title: str, found: "Design") -> None:
    out_console.print(f"{title}: {found.kind.value} filter of order {found.filter.order}", soft_wrap=True)
    out_console.print(f"gamma {found.gamma:.6g}: {found.outcome.value} ({found.solver}: {found.status})")
    table = Table("analysis of the closed loop", box=SIMPLE_HEAD, pad_edge=False)
    several = len(found.analyses) > 1
    for number in range(1, len(found.analyses) + 1):
        name = f"vertex {number}" if number < len(found.analyses) else "centre"
        table.add_column(name if several else "", justify="right")
    for told, field in ROWS.items():
        values = [getattr(each, field) for each in found.analyses]
        if None not in values:
            table.add_row(Text(told), *[f"{value:.6g}" for value in values])
    out_console.print(table)
    for name, matrix in vars(found.filter).items():
        rows = ["  ".join(f"{value:12.5g}" for value in row) for row in matrix]
        out_console.print("\n".join([name, *rows]), soft_wrap=True)

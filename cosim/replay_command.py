"""The command `replay`. What is heavy is imported when it runs, so that the help is quick."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from .command_line import AsJson, OutFolder, Quiet, command_as_typed, output_folder
from .terminal import out_console, progress_bar

if TYPE_CHECKING:
    from .replay import Replay


def replay(
    imu: Annotated[Path, typer.Option(help="Recorded increments or rates, CSV or Parquet.")],
    fixes: Annotated[Path, typer.Option(help="Recorded fixes, CSV or Parquet.")],
    initial: Annotated[
        str | None,
        typer.Option(
            help="Attitude at the start: roll,pitch,heading or roll,pitch,heading,level_sd,heading_sd, deg."
        ),
    ] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="TOML file: columns, units, axes, error budget.")
    ] = None,
    filter_: Annotated[
        list[str] | None, typer.Option("--filter", help="Filter to run; may be given again.")
    ] = None,
    out: OutFolder = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Run the filters on a recording: innovations, sigmas and biases, without a truth."""
    from .outputs import write_json
    from .replay import replay as run_replay
    from .replay_map import load_map
    from .replay_outputs import replay_manifest, summarize_replay, write_replay_estimates
    from .replay_recording import write_replay_recording
    from .replay_report import repairs, write_replay_report

    settings = load_map(map_, initial, filter_)
    silent = quiet or as_json
    with progress_bar("replaying", silent) as progress:
        done = run_replay(imu, fixes, settings, progress)
    folder = output_folder(out or Path(f"fleetalign-replay-{imu.stem}"))
    summary, about = summarize_replay(done), replay_manifest(done, command_as_typed())
    with progress_bar("recording and report", silent) as progress:
        write_json(folder / "summary.json", summary)
        write_json(folder / "manifest.json", about)
        write_replay_estimates(folder / "estimates.parquet", done)
        progress(1, 3)
        write_replay_recording(folder / "recording.rrd", done)
        progress(2, 3)
        write_replay_report(folder / "report.html", done, summary, about)
    if as_json:
        typer.echo(json.dumps(summary, indent=2, allow_nan=False))
    elif not quiet:
        out_console.print(_table(done, summary))
        out_console.print(repairs(summary))
        for line in doubts(summary):
            out_console.print(line, style="red")
        for kind in ("report.html", "recording.rrd"):
            out_console.print(str(folder / kind), soft_wrap=True)


def doubts(summary: dict[str, Any]) -> list[str]:
    """What speaks against the filters' estimates, a line each."""
    lines = []
    for name, row in summary["filters"].items():
        fixes = row["fixes"]
        refused, all_fixes = fixes["gated"], sum(fixes.values())
        if refused > 0.5 * all_fixes:
            lines.append(f"{name}: refused {refused} of {all_fixes} fixes: wrong units, axes or error budget")
        elif row["nis"] is not None and not row["nis_band95"][0] <= row["nis"] <= row["nis_band95"][1]:
            lines.append(f"{name}: NIS outside its band: noise of the fixes is not as stated, or not white")
    return lines


def _table(done: "Replay", summary: dict[str, Any]) -> Table:
    """How each filter ended."""
    title = Text(f"{done.settings.title}: {summary['duration_s']:.1f} s")
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 0, 0, 1))
    for column in ("", "updates\n", "NIS\nof 6", "95 %\nband", "roll\ndeg", "pitch\ndeg", "heading\ndeg"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for name, row in summary["filters"].items():
        if row["outcome"] != "aligned" or not row["updates"]:
            table.add_row(name, str(row["updates"]), row["outcome"])
            continue
        angles = [row["final"][f"{angle}_deg"] for angle in ("roll", "pitch", "heading")]
        told = [f"{a['value']:.2f}" + ("" if a["sd"] is None else f" ± {a['sd']:.2f}") for a in angles]
        # A constant gain has no covariance to be judged by.
        judged = ("", "")
        if row["nis"] is not None:
            low, high = row["nis_band95"]
            judged = (f"{row['nis']:.2f}", f"{low:.2f}-{high:.2f}")
        table.add_row(name, str(row["updates"]), *judged, *told)
    return table

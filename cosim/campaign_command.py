"""The commands `campaign` and `report`. What is heavy is imported when they run."""

import json
import signal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .command_line import AsJson, InputError, OutFolder, Quiet, command_as_typed, output_folder
from .terminal import error_console, out_console, progress_bar

if TYPE_CHECKING:
    from .campaign.summary import CampaignSummary


def campaign(
    file: Annotated[Path, typer.Argument(help="A campaign's TOML file.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on: do only what is missing.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Processes by Dask on this machine.")
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None,
    out: OutFolder = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Do many runs over axes of a scenario's settings; what is done is kept, whatever happens."""
    from .campaign.cluster import check_cluster, on_cluster
    from .campaign.engine import locally, run_campaign
    from .campaign.ledger import Ledger
    from .campaign.plan import load_campaign
    from .campaign.report import write_report

    if scheduler is not None and workers is not None:
        raise InputError("--workers: not beside --scheduler, whose workers are its own")
    silent = quiet or as_json
    with progress_bar("checking points", silent, "points") as progress:
        plan = load_campaign(file, progress)
    dask = scheduler is not None or workers is not None
    if dask:
        check_cluster(scheduler)
    folder = output_folder(out or Path(f"fleetalign-campaign-{file.stem}"))
    done_by = partial(on_cluster, scheduler=scheduler, workers=workers) if dask else locally
    total = plan.settings.runs * len(plan.coordinates)
    ledger: Ledger | None = None
    # What a batch system sends ends the workers, too, as Ctrl-C does.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with Ledger(folder, plan, resume) as ledger:
            with progress_bar("campaign", silent, "runs") as progress:
                run_campaign(plan, ledger, done_by, progress)
            summary = write_report(folder, command_as_typed())
    except (OSError, KeyboardInterrupt) as error:
        kept = sum(shard.runs for shard in ledger.done) if ledger else 0
        why = f"{folder}: {error.strerror or error}" if isinstance(error, OSError) else "stopped"
        error_console.print(f"{why}; {kept} of {total} runs are kept, go on with --resume", soft_wrap=True)
        raise typer.Exit(1) from error
    finally:
        signal.signal(signal.SIGTERM, before)
    _tell(folder, summary, quiet, as_json)


def report(
    folder: Annotated[Path, typer.Argument(help="A campaign's folder.")],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Write the report of a campaign's folder anew, of whatever is done."""
    from .campaign.report import write_report

    try:
        summary = write_report(folder, command_as_typed())
    except OSError as error:
        error_console.print(f"{folder}: {error.strerror or error}: no report", soft_wrap=True)
        raise typer.Exit(1) from error
    _tell(folder, summary, quiet, as_json)


def _tell(folder: Path, summary: "CampaignSummary", quiet: bool, as_json: bool) -> None:
    from .campaign.report import campaign_table, told_worst

    if as_json:
        typer.echo(json.dumps(summary.content, indent=2, allow_nan=False))
    elif not quiet:
        out_console.print(campaign_table(summary, out_console))
        for line in told_worst(folder, summary.worst):
            out_console.print(line, soft_wrap=True)
        out_console.print(f"report     {folder / 'report.html'}", soft_wrap=True)

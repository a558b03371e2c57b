"""The command `run`. What is heavy is imported when it runs, so that the help is quick."""

import json
import subprocess
import sys
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from .terminal import deferred_interrupt, error_console, out_console, progress_bar, results_table

if TYPE_CHECKING:
    from ..network.fixes import Fixes
    from .run import Run


def run(
    scenario: ScenarioArgument = "gao2009",
    runs: Annotated[int | None, typer.Option(help="Number of runs; the scenario's by default.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all runs; the scenario's by default.")] = None,
    filter_: Annotated[
        list[str] | None, typer.Option("--filter", help="Filter to run; may be given again.")
    ] = None,
    run_id: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Do this run alone, as it is among the others.")
    ] = None,
    variants: Annotated[
        bool, typer.Option("--variants", help="Run the scenario's variants as well, for one table.")
    ] = False,
    out: OutFolder = None,
    view: Annotated[bool, typer.Option("--view", help="Open the recording in the Rerun viewer.")] = False,
    no_cache: NoCache = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario, align on it many times, and write summary, estimates, recording and report.

    Scenarios of companion papers run the experiment of their paper.
    """
    from ..aircraft.cache import is_cached
    from ..align.bound import Knowledge
    from .bound import BOUND_DRAWS, bounds_of, no_bound_because
    from .clean_twin import has_faults
    from .fault_report import told_faults
    from .fault_score import FaultScorer
    from .network_score import NetworkScorer
    from .outages import told_outages
    from .outputs import estimates_writer, manifest, summarize, write_json
    from .recording import write_recording
    from .report import write_report
    from .run import alignment_window, compiling_ahead, outage_times, simulate_all
    from .scenario import ScenarioError, is_paper, read_scenario
    from .score import Scorer, standard_deviations
    from .variants import AS_STATED, run_variants

    read = name, content, _ = read_scenario(scenario)
    if is_paper(content):
        from .papers.command import Asked, study_paper

        idle = {"--filter": bool(filter_), "--variants": variants, "--no-cache": no_cache}
        idle["--run-id"] = run_id is not None
        folder = study_paper(name, Asked("run", scenario, content, runs, seed, out, quiet, as_json, idle))
        if view:
            _view(folder / "recording.rrd")
        return
    if run_id is not None and (runs is not None or variants):
        raise InputError("--run-id: not beside --runs or --variants")
    _, settings = loaded(scenario, 1 if run_id is not None else runs, seed, filter_, read)
    if variants and not settings.variants:
        raise InputError(f"--variants: {scenario} has none")
    folder = output_folder(out or Path(f"fleetalign-{name}"))
    silent = quiet or as_json
    flown_before = is_cached(settings.flight) and not no_cache
    with nullcontext() if flown_before else compiling_ahead(settings):
        flight = flown(settings, no_cache, silent)
    try:
        window = alignment_window(settings, flight)
    except ScenarioError as error:
        raise ScenarioError(f"{scenario}: {error}") from error
    scorer, network = Scorer(window, settings.alignment.filters), NetworkScorer()
    judged = FaultScorer(settings, window) if has_faults(settings) else None
    first: Run | None = None
    fixes: list[Fixes] = []
    done = 0
    with (
        deferred_interrupt() as interrupted,
        progress_bar("aligning", silent) as progress,
        estimates_writer(folder / "estimates.parquet", window, settings.imu.vibration_mps) as estimates,
    ):
        for done_run in simulate_all(
            settings, flight, settings.runs, settings.seed, progress, first=run_id or 0
        ):
            first = first or done_run
            scorer.add(done_run)
            if judged:
                judged.add(done_run)
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
    bounds = bounds_of(settings, window, fixes)
    bound_sd = {
        key: standard_deviations(window, bound, settings.imu.vibration_mps) for key, bound in bounds.items()
    }
    scores = scorer.scores()
    network_score = network.score() if network.runs else None
    summary = summarize(name, settings, settings.seed, flight, scores, bound_sd, network_score)
    if judged:
        # Nothing without them was run: what they cost shows where a variant or the scenario has none.
        summary["faults"] = {AS_STATED: {"against": None, **judged.rows(scores, None)}}
    if variants and done == settings.runs:
        with progress_bar("variants", silent) as progress:
            found = run_variants(settings, flight, scores, progress)
            faults = summary.get("faults", {}) | found.pop("faults", {})
            summary |= found | ({"faults": faults} if faults else {})
    write_json(folder / "summary.json", summary)
    command = command_as_typed()
    about = manifest(name, settings, settings.seed, done, command)
    write_json(folder / "manifest.json", about)
    with progress_bar("recording and report", silent) as progress:
        write_recording(
            folder / "recording.rrd",
            settings.title,
            flight,
            window,
            first,
            bounds[Knowledge.STAMPED],
            settings.imu.vibration_mps,
            outage_times(settings, window),
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
            for reason, count in Counter(score.failures.values()).items():
                told = f"failed {filter_name}: {count} of {score.runs} runs {reason}"
                out_console.print(told, style="red")
        for line in told_outages(summary):
            out_console.print(line)
        for line in told_faults(summary) if "faults" in summary else ():
            out_console.print(line, soft_wrap=True)
        for line in settings.paper.remarks if settings.paper else ():
            out_console.print(f"- {line}")
        out_console.print(f"report     {folder / 'report.html'}", soft_wrap=True)
        out_console.print(f"recording  {folder / 'recording.rrd'}", soft_wrap=True)
    if view:
        _view(folder / "recording.rrd")
    if done < settings.runs:
        raise typer.Exit(1)


def _view(recording: Path) -> None:
    subprocess.Popen([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(recording)])

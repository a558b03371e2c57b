"""Campaigns against what their workers could do without them: hand-out, shards, ledger, memory, Dask."""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import psutil
from fleetalign.aircraft.cache import cached_flight
from fleetalign.align import problem
from fleetalign.align.filters import FILTERS
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.settings import DelayModel
from fleetalign.cosim.campaign import engine
from fleetalign.cosim.campaign.cluster import on_cluster
from fleetalign.cosim.campaign.ledger import Ledger
from fleetalign.cosim.campaign.plan import Campaign, CampaignFile, Shard
from fleetalign.cosim.campaign.shard import encoded, shard_rows
from fleetalign.cosim.run import alignment_window, simulate
from fleetalign.cosim.scenario import Scenario

from .harness import Harness, Row
from .material import SEED, Material

KERNEL_TARGET, LEDGER_TARGET, MEMORY_TARGET, DASK_TARGET = 0.90, 0.02, 1.10, 0.85
_SHARD_RUNS = 25
_PREPARED = 8
"""Runs whose posed problems a process holds ready to time the compiled loops alone."""


def rows(harness: Harness, material: Material) -> list[Row]:
    """Rates of a campaign, of its runs alone and of the compiled loops alone; ledger, memory, Dask."""
    size, cores = harness.size, os.cpu_count() or 1
    scenario = material.scenario
    share = max(size.campaign_runs // 10, cores)
    # The machine's pace drifts: what is compared with the campaign is timed before and after it.
    before = _rates(scenario, share, cores)
    whole = _timed(_campaign(scenario, size.campaign_runs), engine.locally)
    after = _rates(scenario, share, cores)
    kernel, runs = ((a + b) / 2 for a, b in zip(before, after, strict=True))
    encoding = _encoding_seconds(scenario) * size.campaign_runs
    ledger = (whole.ledger_s + encoding) / (cores * whole.seconds)
    first, last = whole.memory_mb(0.0, 0.1), whole.memory_mb(0.9, 1.0)

    some = _campaign(scenario, size.dask_runs)
    dasks = {"pool": engine.locally, "dask": partial(on_cluster, workers=cores)}
    times = harness.times(
        "pool and Dask",
        {name: partial(_timed, some, done_by) for name, done_by in dasks.items()},
        rounds=2,
        clock=time.perf_counter,
        warm_up=False,
    )
    dask = times["pool"].best / times["dask"].best
    filters = len(scenario.alignment.filters)
    return [
        Row(
            f"Campaign of {size.campaign_runs:,} runs, {filters} filters, against its loops",
            f"{whole.rate:.1f} runs/s",
            f"compiled loops alone: {kernel:.1f} runs/s",
            f"{whole.rate / kernel:.2f}",
            f"{KERNEL_TARGET:.2f} or more",
            whole.rate / kernel >= KERNEL_TARGET,
            f"`run_campaign` on {cores} processes, their start included, with sensors, fixes, scores and"
            " shards, against the compiled filter loops on records that stand ready, in as many processes.",
        ),
        Row(
            f"Campaign of {size.campaign_runs:,} runs, {filters} filters, against its runs",
            f"{whole.rate:.1f} runs/s",
            f"runs and rows alone: {runs:.1f} runs/s",
            f"{whole.rate / runs:.2f}",
            f"{KERNEL_TARGET:.2f} or more",
            whole.rate / runs >= KERNEL_TARGET,
            "The same, against `shard_rows` in as many processes, which nobody hands out, gathers or keeps.",
        ),
        Row(
            "Ledger of that campaign",
            f"{1e3 * (whole.ledger_s + encoding):.0f} ms",
            f"{cores * whole.seconds:.0f} s of all cores",
            f"{100 * ledger:.2f} %",
            f"under {100 * LEDGER_TARGET:.0f} %",
            ledger < LEDGER_TARGET,
            "Parquet of all shards, and their way to the disk, with `fsync`.",
        ),
        Row(
            "Memory of that campaign",
            f"{last:.0f} MB at most in the last tenth of its runs",
            f"{first:.0f} MB in the first",
            f"{last / first:.2f}",
            f"{MEMORY_TARGET:.2f} or less",
            last / first <= MEMORY_TARGET,
            "Resident, of the main process and its workers together.",
        ),
        Row(
            f"Dask, {cores} workers, {size.dask_runs:,} runs",
            f"{size.dask_runs / times['dask'].best:.1f} runs/s",
            f"plain pool: {size.dask_runs / times['pool'].best:.1f} runs/s",
            f"{dask:.2f}",
            f"{DASK_TARGET:.2f} or more",
            dask >= DASK_TARGET,
            "Wall time with the start of the workers, in shards of"
            f" {min(_SHARD_RUNS, size.dask_runs)}; the start weighs less in a longer campaign.",
        ),
    ]


@dataclass
class _Whole:
    """What a campaign took."""

    runs: int
    seconds: float = 0.0
    ledger_s: float = 0.0
    memory: list[tuple[float, float]] = field(default_factory=list)
    """Share that was done, and resident memory then, MB."""

    @property
    def rate(self) -> float:
        """Runs a second."""
        return self.runs / self.seconds

    def memory_mb(self, low: float, high: float) -> float:
        """The most while the share done was between the two; the whole's, where nothing was seen then."""
        seen = [mb for share, mb in self.memory if low < share <= high]
        return max(seen or [mb for _, mb in self.memory])


def _campaign(scenario: Scenario, runs: int) -> Campaign:
    settings = CampaignFile(
        title="benchmark", scenario="stated_fixes", runs=runs, seed=SEED, shard_runs=min(_SHARD_RUNS, runs)
    )
    return Campaign(settings, scenario, ({},))


def _timed(
    campaign: Campaign, done_by: Callable[[Campaign, list[Shard]], Iterator[tuple[Shard, bytes]]]
) -> _Whole:
    whole = _Whole(campaign.settings.runs)
    with (
        tempfile.TemporaryDirectory() as folder,
        Ledger(Path(folder), campaign, resume=False) as ledger,
    ):
        keep = ledger.add

        def add(shard: Shard, content: bytes) -> None:
            since = time.perf_counter()
            keep(shard, content)
            whole.ledger_s += time.perf_counter() - since

        ledger.add = add
        whole.seconds = -time.perf_counter()
        engine.run_campaign(
            campaign,
            ledger,
            done_by,
            lambda done, total: whole.memory.append((done / total, _resident_mb())),
        )
        whole.seconds += time.perf_counter()
    return whole


def _resident_mb() -> float:
    own = psutil.Process()
    return sum(process.memory_info().rss for process in (own, *own.children(recursive=True))) / 1e6


def _rates(scenario: Scenario, runs: int, cores: int) -> list[float]:
    """Runs a second of so many processes side by side, without their start: loops alone, runs alone."""
    each = max(runs // cores, 1)
    with ProcessPoolExecutor(cores, mp_context=multiprocessing.get_context("spawn")) as pool:
        return [
            sum(each / seconds for seconds in pool.map(partial(of, runs=each), [scenario] * cores))
            for of in (_kernel_seconds, _run_seconds)
        ]


def _run_seconds(scenario: Scenario, runs: int) -> float:
    shard_rows(scenario, Shard(0, 0, 1))
    since = time.perf_counter()
    shard_rows(scenario, Shard(0, 0, runs))
    return time.perf_counter() - since


def _kernel_seconds(scenario: Scenario, runs: int) -> float:
    """Of the compiled loops of all filters over so many runs."""
    flight, _ = cached_flight(scenario.flight)
    window = alignment_window(scenario, flight)
    settings, gravity = scenario.alignment.settings, scenario.alignment.gravity_model(window.gravity)
    posed = []
    for run in (simulate(scenario, flight, i, SEED) for i in range(min(runs, _PREPARED))):
        measured = run.imu.time, run.imu.dtheta_b, run.imu.dv_b, run.q_nb_coarse, run.fixes
        given = AlignmentInput.checked(*measured, settings, scenario.imu, gravity)
        posed.append([problem.pose(given, FILTERS[name]) for name in scenario.alignment.filters])
    horizon = round(settings.horizon_s / window.dt)
    seconds = 0.0
    for i in range(runs):
        for one in posed[i % len(posed)]:
            # A run fills in the outcomes.
            fresh = one._replace(outcome=one.outcome.copy())
            since = time.perf_counter()
            problem.run(fresh, horizon, horizon + 1 if one.delay is DelayModel.STAMPED else 1)
            seconds += time.perf_counter() - since
    return seconds


def _encoding_seconds(scenario: Scenario) -> float:
    """Of one run's rows, in its shard."""
    found = shard_rows(scenario, Shard(0, 0, 2))
    many = [dict(row) for row in found for _ in range(_SHARD_RUNS)]
    encoded(many)
    since = time.process_time()
    encoded(many)
    return (time.process_time() - since) / (2 * _SHARD_RUNS)

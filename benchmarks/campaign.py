"""Campaigns against what their workers could do without them: hand-out, shards, ledger, memory, Dask."""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Self

import psutil
from fleetalign.aircraft.cache import cached_flight
from fleetalign.align import problem
from fleetalign.align.filters import FILTERS
from fleetalign.cosim.campaign import engine
from fleetalign.cosim.campaign.cluster import on_cluster
from fleetalign.cosim.campaign.ledger import Ledger
from fleetalign.cosim.campaign.plan import Campaign, CampaignFile, Shard
from fleetalign.cosim.campaign.shard import TOGETHER, encoded, shard_rows
from fleetalign.cosim.run import measured
from fleetalign.cosim.scenario import Scenario

from .harness import Harness, Row
from .material import SEED, Material

KERNEL_TARGET, LEDGER_TARGET, MEMORY_TARGET, DASK_TARGET = 0.90, 0.02, 1.10, 0.85
PAUSES = 20
"""Of a campaign, in which its parts are timed alone: the machine's pace drifts."""
_SHARD_RUNS = 25


def rows(harness: Harness, material: Material) -> list[Row]:
    """Rates of a campaign, of its runs alone and of the compiled loops alone; ledger, memory, Dask."""
    size, cores = harness.size, os.cpu_count() or 1
    scenario = material.scenario
    with _Alone(scenario, cores, size.campaign_runs // (2 * PAUSES)) as alone:
        whole = _timed(_campaign(scenario, size.campaign_runs), engine.locally, alone)
    kernel, runs = alone.rates
    encoding = _encoding_seconds(scenario) * size.campaign_runs
    ledger = (whole.ledger_s + encoding) / (cores * whole.seconds)
    first, last = whole.memory_mb(0.0, 0.1), whole.memory_mb(0.9, 1.0)

    some = _campaign(scenario, size.dask_runs)
    dasks = {"pool": engine.locally, "dask": partial(on_cluster, workers=cores)}
    firsts: dict[str, list[float]] = {name: [] for name in dasks}
    times = harness.times(
        "pool and Dask",
        {
            name: partial(lambda name: firsts[name].append(_timed(some, dasks[name]).first_s), name)
            for name in dasks
        },
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
            " shards, against the compiled filter loops on records that stand ready, in as many processes,"
            f" timed in {PAUSES} pauses of the campaign, since a machine's pace drifts.",
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
            f"Parquet of all shards, {whole.shard_kb:.0f} kB each, and their way to the disk, with `fsync`.",
        ),
        Row(
            "Memory of that campaign",
            f"{last:.0f} MB at most in the last tenth of its runs",
            f"{first:.0f} MB in the first",
            f"{last / first:.2f}",
            f"{MEMORY_TARGET:.2f} or less",
            last / first <= MEMORY_TARGET,
            f"Resident, of the main process and its {cores} workers together.",
        ),
        Row(
            f"Dask, {cores} workers, {size.dask_runs:,} runs",
            f"{size.dask_runs / times['dask'].best:.1f} runs/s",
            f"plain pool: {size.dask_runs / times['pool'].best:.1f} runs/s",
            f"{dask:.2f}",
            f"{DASK_TARGET:.2f} or more",
            dask >= DASK_TARGET,
            f"Wall time with the start of the workers, in shards of {min(_SHARD_RUNS, size.dask_runs)}. The"
            f" first is there after {min(firsts['dask']):.1f} s, with the pool after"
            f" {min(firsts['pool']):.1f} s, which weighs less in a longer campaign.",
        ),
    ]


@dataclass
class _Whole:
    """What a campaign took."""

    runs: int
    seconds: float = 0.0
    first_s: float = 0.0
    """Until the first shard was there."""
    shard_kb: float = 0.0
    """Of the first shard."""
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
    campaign: Campaign,
    done_by: Callable[[Campaign, list[Shard]], Iterator[tuple[Shard, bytes]]],
    alone: "_Alone | None" = None,
) -> _Whole:
    """Do a campaign in a folder that is taken away again; in its pauses ``alone`` is timed."""
    whole, paused_s, pauses = _Whole(campaign.settings.runs), 0.0, 0
    with (
        tempfile.TemporaryDirectory() as folder,
        Ledger(Path(folder), campaign, resume=False) as ledger,
    ):
        keep = ledger.add

        def add(shard: Shard, content: bytes) -> None:
            now = time.perf_counter()
            if not ledger.done:
                whole.first_s, whole.shard_kb = now - begun, len(content) / 1e3
            keep(shard, content)
            whole.ledger_s += time.perf_counter() - now

        def progress(done: float, total: float) -> None:
            nonlocal paused_s, pauses
            workers = _workers(alone)
            memory = sum(process.memory_info().rss for process in (psutil.Process(), *workers))
            whole.memory.append((done / total, memory / 1e6))
            if alone and done / total > (pauses + 0.5) / PAUSES:
                since = time.perf_counter()
                with _stopped(workers):
                    alone.sample()
                pauses += 1
                paused_s += time.perf_counter() - since

        ledger.add = add
        begun = time.perf_counter()
        engine.run_campaign(campaign, ledger, done_by, progress)
        whole.seconds = time.perf_counter() - begun - paused_s
    return whole


def _workers(alone: "_Alone | None") -> list[psutil.Process]:
    """The processes that do a campaign."""
    others = alone.processes if alone else ()
    return [one for one in psutil.Process().children(recursive=True) if one.pid not in others]


@contextmanager
def _stopped(processes: list[psutil.Process]) -> Iterator[None]:
    for process in processes:
        process.suspend()
    try:
        yield
    finally:
        for process in processes:
            process.resume()


class _Alone:
    """What a campaign is compared with, in as many processes: compiled loops, and runs with their rows."""

    def __init__(self, scenario: Scenario, cores: int, runs: int) -> None:
        self._each = max(runs // cores, 1)
        self._asked = [scenario] * cores
        self._pool = ProcessPoolExecutor(cores, mp_context=multiprocessing.get_context("spawn"))
        self._seen: list[list[float]] = []

    def __enter__(self) -> Self:
        # Compiled code is loaded, and records are made, before anything is timed.
        self._rates(1)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    @property
    def processes(self) -> Collection[int]:
        """Their numbers."""
        return self._pool._processes.keys()  # pyright: ignore[reportPrivateUsage]

    def sample(self) -> None:
        """Time a few."""
        self._seen.append(self._rates(self._each))

    @property
    def rates(self) -> tuple[float, float]:
        """Runs a second, over all samples: of the loops alone, and of runs with their rows."""
        loops, runs = (
            len(self._seen) / sum(1 / rate for rate in seen) for seen in zip(*self._seen, strict=True)
        )
        return loops, runs

    def _rates(self, each: int) -> list[float]:
        return [
            sum(each / seconds for seconds in self._pool.map(partial(of, runs=each), self._asked))
            for of in (_kernel_seconds, _run_seconds)
        ]


def _run_seconds(scenario: Scenario, runs: int) -> float:
    shard_rows(scenario, Shard(0, 0, 1))
    since = time.perf_counter()
    shard_rows(scenario, Shard(0, 0, runs))
    return time.perf_counter() - since


def _kernel_seconds(scenario: Scenario, runs: int) -> float:
    """Of the compiled loops of all filters over so many runs."""
    seconds = 0.0
    for first in range(0, runs, TOGETHER):
        for of_filter in _posed(scenario.model_dump_json()):
            # A run fills in the outcomes.
            fresh = [one._replace(outcome=one.outcome.copy()) for one in of_filter[: runs - first]]
            since = time.perf_counter()
            problem.run_all(fresh)
            seconds += time.perf_counter() - since
    return seconds


@cache
def _posed(scenario: str) -> list[list[problem.Problem]]:
    """The problems of `TOGETHER` runs, a list of each filter."""
    stated = Scenario.model_validate_json(scenario)
    flight, _ = cached_flight(stated.flight)
    given = [measured(stated, flight, i, SEED)[1] for i in range(TOGETHER)]
    return [[problem.pose(one, FILTERS[name]) for one in given] for name in stated.alignment.filters]


def _encoding_seconds(scenario: Scenario) -> float:
    """Of one run's rows, in its shard."""
    found = shard_rows(scenario, Shard(0, 0, 2))
    many = [dict(row) for row in found for _ in range(_SHARD_RUNS)]
    encoded(many)
    since = time.process_time()
    encoded(many)
    return (time.process_time() - since) / (2 * _SHARD_RUNS)

"""Campaigns against what their workers could do without them: hand-out, shards, ledger, memory, Dask."""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import repeat
from pathlib import Path
from statistics import fmean, harmonic_mean
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
DASK_ROUNDS = 2
_LOOKS = 100
"""At how much memory there is, over a campaign."""
_SHARD_RUNS = 25


def rows(harness: Harness, material: Material) -> list[Row]:
    """Rates of a campaign, of its runs alone and of the compiled loops alone; ledger, memory, Dask."""
    size, cores = harness.size, os.cpu_count() or 1
    scenario = material.scenario
    ways = {"pool": engine.locally, "dask": partial(on_cluster, workers=cores)}
    some: dict[str, list[_Whole]] = {name: [] for name in ways}
    with _Alone(scenario, cores) as alone:
        asked = _campaign(scenario, size.campaign_runs)
        whole = _timed(asked, engine.locally, alone, (_kernel_seconds, _run_seconds))
        for _ in range(min(DASK_ROUNDS, size.rounds)):
            for name, done_by in ways.items():
                asked = _campaign(scenario, size.dask_runs)
                some[name].append(_timed(asked, done_by, alone, (_run_seconds,)))
    kernel, runs = whole.alone
    encoding = _encoding_seconds(scenario) * size.campaign_runs
    ledger = (whole.ledger_s + encoding) / (cores * whole.seconds)
    first, last = whole.memory_mb(0.0, 0.1), whole.memory_mb(0.9, 1.0)
    shares = {name: fmean(one.rate / one.alone[0] for one in done) for name, done in some.items()}
    rates = {name: fmean(one.rate for one in done) for name, done in some.items()}
    firsts = {name: min(one.first_s for one in done) for name, done in some.items()}
    dask = shares["dask"] / shares["pool"]
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
            f"{shares['dask']:.2f} of its bare runs ({rates['dask']:.1f} runs/s)",
            f"plain pool: {shares['pool']:.2f} of its bare runs ({rates['pool']:.1f} runs/s)",
            f"{dask:.2f}",
            f"{DASK_TARGET:.2f} or more",
            dask >= DASK_TARGET,
            "The ratio is that of two shares, so that drift from one campaign to the next cancels: each"
            " campaign's rate, start and end of its workers included, by that of `shard_rows` alone in as"
            f" many processes in {PAUSES} pauses of it. Means of {len(some['dask'])} rounds, shards of"
            f" {min(_SHARD_RUNS, size.dask_runs)}. The first shard is there after {firsts['dask']:.1f} s,"
            f" with the pool after {firsts['pool']:.1f} s, which weighs less in a longer campaign.",
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
    samples: list[list[float]] = field(default_factory=list)
    """Of each pause: runs a second of each part alone."""

    @property
    def rate(self) -> float:
        """Runs a second."""
        return self.runs / self.seconds

    @property
    def alone(self) -> list[float]:
        """Runs a second of each part alone, over all pauses."""
        return [harmonic_mean(rates) for rates in zip(*self.samples, strict=True)]

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
    alone: "_Alone",
    parts: "Sequence[_Part]",
) -> _Whole:
    """Do a campaign in a folder that is taken away again; in its pauses parts of it are timed ``alone``."""
    whole, paused_s = _Whole(campaign.settings.runs), 0.0
    each = campaign.settings.runs // (2 * PAUSES)
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
            nonlocal paused_s
            if done / total < len(whole.memory) / _LOOKS:  # each takes time of the campaign
                return
            workers = _workers(alone)
            memory = sum(process.memory_info().rss for process in (psutil.Process(), *workers))
            whole.memory.append((done / total, memory / 1e6))
            if done / total > (len(whole.samples) + 0.5) / PAUSES:
                since = time.perf_counter()
                with _stopped(workers):
                    whole.samples.append(alone.rates(parts, each))
                paused_s += time.perf_counter() - since

        ledger.add = add
        begun = time.perf_counter()
        engine.run_campaign(campaign, ledger, done_by, progress)
        whole.seconds = time.perf_counter() - begun - paused_s
    return whole


def _workers(alone: "_Alone") -> list[psutil.Process]:
    """The processes that do a campaign: the pool's, or Dask's, whose scheduler and nannies are here."""
    return [one for one in psutil.Process().children(recursive=True) if one.pid not in alone.processes]


@contextmanager
def _stopped(processes: list[psutil.Process]) -> Iterator[None]:
    for process in processes:
        process.suspend()
    try:
        yield
    finally:
        for process in processes:
            process.resume()


_Part = Callable[[Scenario, int], float]
"""Seconds that so many runs take."""


class _Alone:
    """As many processes as a campaign has, for parts of it without what a campaign adds."""

    def __init__(self, scenario: Scenario, cores: int) -> None:
        self._asked = [scenario] * cores
        self._pool = ProcessPoolExecutor(cores, mp_context=multiprocessing.get_context("spawn"))

    def __enter__(self) -> Self:
        # Compiled code is loaded, and records are made, before anything is timed.
        self.rates((_kernel_seconds, _run_seconds), 1)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    @property
    def processes(self) -> Collection[int]:
        """Their numbers."""
        return self._pool._processes.keys()  # pyright: ignore[reportPrivateUsage]

    def rates(self, parts: Sequence[_Part], runs: int) -> list[float]:
        """Runs a second of each part, of so many runs by all processes together."""
        each = max(runs // len(self._asked), 1)
        return [
            sum(each / seconds for seconds in self._pool.map(of, self._asked, repeat(each))) for of in parts
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

"""Hands out shards to workers, and keeps what they bring: processes of this machine, or `cluster`.

A worker may die: what was in work is done again, each shard alone, and one at which its worker dies again is
done run by run, so that a poison run costs itself alone.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ..scenario import Scenario
from .ledger import Ledger
from .plan import Campaign, Shard
from .shard import done_shard, encoded, failed_rows

Progress = Callable[[float, float], None]
Completed = Callable[[Campaign, list[Shard]], Iterator[tuple[Shard, bytes]]]
"""Does shards of a campaign, and yields the content of each as it is done."""
DIED = "the worker died"
_WATCH_S = 0.5
"""Interval at which a worker looks whether the main process lives."""


def run_campaign(
    campaign: Campaign, ledger: Ledger, done_by: Completed, progress: Progress | None = None
) -> None:
    """Do what is missing in the ledger. Raises OSError where a shard cannot be kept; what is kept stays.

    ``done_by`` : `locally`, or `cluster.on_cluster` with its arguments.
    """
    missing = [shard for shard in campaign.shards if shard not in ledger.done]
    done = sum(shard.runs for shard in ledger.done)
    total = done + sum(shard.runs for shard in missing)
    if progress:
        progress(done, total)
    for shard, content in done_by(campaign, missing):
        ledger.add(shard, content)
        done += shard.runs
        if progress:
            progress(done, total)


def locally(
    campaign: Campaign, shards: list[Shard], workers: int | None = None
) -> Iterator[tuple[Shard, bytes]]:
    """Each shard's content, in the order in which they are done, by processes of this machine."""
    workers = workers or os.cpu_count() or 1
    waiting, suspects = list(reversed(shards)), list[Shard]()
    while waiting or suspects:
        for shard in suspects:
            yield shard, _alone(campaign, shard)
        suspects = []
        pool = _pool(workers)
        pending: dict[Future[bytes], Shard] = {}
        try:
            while (waiting or pending) and not suspects:
                # Few at a time: what is in work is lost with a worker, and memory does not grow with runs.
                try:
                    while waiting and len(pending) < 2 * workers:
                        shard = waiting[-1]
                        pending[pool.submit(done_shard, campaign.scenario(shard.point), shard)] = shard
                        waiting.pop()
                except BrokenProcessPool:
                    # A worker died while a result was kept; with nothing in work nobody is to blame for it.
                    if not pending:
                        break
                finished, _ = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    shard = pending.pop(future)
                    try:
                        content = future.result()
                    except BrokenProcessPool:
                        suspects.append(shard)
                        continue
                    yield shard, content
        finally:
            _stop(pool)
        # One worker's death fails all that is in work: who is to blame shows when each is done alone.
        suspects += pending.values() if suspects else ()


def _alone(campaign: Campaign, shard: Shard) -> bytes:
    """A shard that was in work when a worker died, in a process of its own; if that dies too, run by run."""
    scenario = campaign.scenario(shard.point)
    content = _attempt(scenario, shard)
    if content is not None:
        return content
    rows: list[dict[str, Any]] = []
    for run_id in range(shard.first_run, shard.first_run + shard.runs):
        content = _attempt(scenario, Shard(shard.point, run_id, 1))
        rows += failed_rows(scenario, shard.point, run_id, DIED) if content is None else rows_of(content)
    return encoded(rows)


def _attempt(scenario: Scenario, shard: Shard) -> bytes | None:
    """The content of a shard by one worker that does nothing else; None if it dies."""
    pool = _pool(1)
    try:
        return pool.submit(done_shard, scenario, shard).result()
    except BrokenProcessPool:
        return None
    finally:
        _stop(pool)


def rows_of(content: bytes) -> list[dict[str, Any]]:
    """Rows of `shard.SCHEMA` that a shard holds."""
    return pq.read_table(pa.BufferReader(content)).to_pylist()


def _pool(workers: int) -> ProcessPoolExecutor:
    # Spawned, not forked: this process may have threads, and a fork of those deadlocks.
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=spawn, initializer=_quiet, initargs=(os.getpid(),))


def _quiet(parent: int) -> None:
    """In a worker: one thread, since there is a worker for each core; Ctrl-C is for the main process, and
    with that process, whose number is ``parent``, the worker ends."""
    import numba

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_outlive_nobody, args=(parent,), daemon=True).start()
    numba.set_num_threads(1)


def _outlive_nobody(parent: int) -> None:
    """End this process when its parent has, even by a kill that lets it tell nobody."""
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os._exit(1)


def _stop(pool: Executor) -> None:
    """End the workers at once; what they were at is not kept."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with suppress(OSError):
            process.kill()
        process.join()

"""Shards by the workers of a Dask cluster: `distributed` hands a dead worker's tasks out again by itself."""

import logging
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import closing
from typing import Any

from ..command_line import InputError
from ..scenario import Scenario
from .plan import Campaign, Shard, versions
from .shard import done_shard, encoded, failed_rows

LOCALHOST = "127.0.0.1"
IN_WORK = 3
"""Shards for each thread of a worker: one in work, and what it takes next while its result travels."""


def check_cluster(scheduler: str | None) -> None:
    """Raise `InputError` where `distributed` is not installed, the scheduler does not answer, or one of its
    workers would give other bits than this process."""
    _distributed()
    if scheduler is None:
        return
    with closing(_client(scheduler)) as client:
        for worker, found in client.run(versions, on_error="return").items():
            if not isinstance(found, dict):
                raise InputError(f"worker {worker}: no such fleetalign: {found}")
            _check_versions(worker, found, versions())


def _check_versions(worker: str, found: dict[str, str], wanted: dict[str, str]) -> None:
    for name, version in wanted.items():
        if found.get(name) != version:
            raise InputError(f"worker {worker} has {name} {found.get(name)}, and not {version} as here")


def on_cluster(
    campaign: Campaign, shards: list[Shard], scheduler: str | None = None, workers: int | None = None
) -> Iterator[tuple[Shard, bytes]]:
    """Each shard's content, in the order in which they are done.

    Parameters
    ----------
    scheduler : address of one that runs, e.g. ``"tcp://10.0.0.5:8786"``; its workers need this fleetalign.
    workers : without a scheduler, so many processes of this machine, bound to `LOCALHOST`.

    Raises `InputError` where `distributed` is not installed, the scheduler does not answer or a worker that
    joined after `check_cluster` would give other bits, and ConnectionError where the scheduler is lost.
    """
    Client, LocalCluster = _distributed()
    if scheduler is None:
        # Ctrl-C is for the main process: its children inherit that they are to ignore it.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host=LOCALHOST,
                # Of its pages, which it serves whether or not anybody asks: on any free port, and here alone.
                dashboard_address=f"{LOCALHOST}:0",
                scheduler_port=0,
                silence_logs=logging.ERROR,  # warnings tell what the engine tells, and how workers end
            )
        finally:
            signal.signal(signal.SIGINT, before)
        with cluster, closing(Client(cluster)) as client:
            yield from _completed(client, campaign, shards)
        return
    with closing(_client(scheduler)) as client:
        yield from _completed(client, campaign, shards)


def _distributed() -> tuple[Any, Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError("--scheduler, --workers: need the extra: pip install fleetalign[cluster]") from error
    return Client, LocalCluster


def _client(scheduler: str) -> Any:
    try:
        return _distributed()[0](scheduler, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: does not answer: {error}") from error


def _completed(client: Any, campaign: Campaign, shards: list[Shard]) -> Iterator[tuple[Shard, bytes]]:
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    waiting, by_key, suspects = list(reversed(shards)), dict[str, Shard](), list[Shard]()
    wanted = versions()
    flying = as_completed([])

    def hand_out() -> None:
        threads = max(sum(client.nthreads().values()), 1)
        while waiting and len(by_key) < IN_WORK * threads:
            shard = waiting.pop()
            task = _submitted(client, wanted, campaign.scenario(shard.point), shard)
            by_key[task.key] = shard
            flying.add(task)

    try:
        hand_out()
        for task in flying:
            shard = by_key.pop(task.key)
            try:
                content = task.result()
            except KilledWorker:
                # Several workers died of it, or of another that was beside it each time.
                suspects.append(shard)
            else:
                yield shard, content
            task.release()
            hand_out()
        # Run by run and with nothing beside it, the poison one alone is lost.
        for shard in suspects:
            yield shard, _run_by_run(client, wanted, campaign, shard)
    except (CancelledError, OSError) as error:  # of what keeps a shard nothing comes here
        raise ConnectionError("the scheduler is lost") from error


def _submitted(client: Any, wanted: dict[str, str], scenario: Scenario, shard: Shard) -> Any:
    return client.submit(_as_wanted, wanted, done_shard, scenario, shard, pure=False)


def _as_wanted(
    wanted: dict[str, str], done: Callable[[Scenario, Shard], bytes], scenario: Scenario, shard: Shard
) -> bytes:
    """On a worker, which may have joined after the check. What a plugin's `setup` raises there is logged, and
    the worker goes on: so it is here that such a one is told apart. Without fleetalign it cannot read the
    task, and ends. Raises `InputError`."""
    from distributed import get_worker

    _check_versions(get_worker().address, versions(), wanted)
    return done(scenario, shard)


def _run_by_run(client: Any, wanted: dict[str, str], campaign: Campaign, shard: Shard) -> bytes:
    from distributed.scheduler import KilledWorker

    from .engine import DIED, rows_of

    scenario, rows = campaign.scenario(shard.point), list[dict[str, Any]]()
    for run_id in range(shard.first_run, shard.first_run + shard.runs):
        task = _submitted(client, wanted, scenario, Shard(shard.point, run_id, 1))
        try:
            rows += rows_of(task.result())
        except KilledWorker:
            rows += failed_rows(scenario, shard.point, run_id, DIED)
    return encoded(rows)

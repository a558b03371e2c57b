"""Many alignment runs on all cores, and what the second core is worth."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from fleetalign.cosim.run import simulate_all
from fleetalign.cosim.score import Scorer

from .harness import Harness, Row
from .material import SEED, Material

TARGET_S = 60.0


def rows(harness: Harness, material: Material) -> list[Row]:
    """Wall time of all runs, scores included, and the ratio of all cores to one."""
    size, cores = harness.size, os.cpu_count() or 1
    busy = -time.process_time()
    whole = harness.times(
        "runs",
        {"ours": lambda: _score(material, size.runs)},
        rounds=1,
        clock=time.perf_counter,
        warm_up=False,
    )
    busy += time.process_time()
    seconds = whole["ours"].best
    filters = ", ".join(f"`{name}`" for name in material.scenario.alignment.filters)
    found = [
        Row(
            f"{size.runs:,} runs of the alignment, {cores} cores",
            f"{seconds:.1f} s",
            f"processor time {busy:.1f} s",
            f"{busy / seconds:.2f} cores busy",
            "under 60 s",
            seconds < TARGET_S,
            f"`cosim.run.simulate_all` and the scores: {material.scenario.alignment.duration_s:.0f} s each,"
            f" with its own sensor errors and fixes, for {filters}. Other work on the machine takes its"
            " share of the cores.",
        )
    ]
    if not hasattr(os, "sched_setaffinity"):
        return found
    chunk = size.scaling_runs
    times = harness.times(
        "runs by cores",
        {"all": lambda: _score(material, chunk), "one": lambda: _score_on_one_core(material, chunk)},
        rounds=5,
        clock=time.perf_counter,
    )
    return [
        *found,
        Row(
            f"Runs on {cores} cores against one",
            f"{chunk / times['all'].best:.0f} runs/s (median {chunk / times['all'].median:.0f})",
            f"one core: {chunk / times['one'].best:.0f} runs/s (median {chunk / times['one'].median:.0f})",
            f"{times['one'].best / times['all'].best:.2f} times",
            note=f"{chunk} runs at a time, in wall time, so that other work on the machine counts against it;"
            " for one core all threads are confined to it.",
        ),
    ]


def _score(material: Material, runs: int) -> None:
    scorer = Scorer(material.window, material.scenario.alignment.filters)
    for run in simulate_all(material.scenario, material.window, runs, SEED):
        scorer.add(run)
    scorer.scores()


def _score_on_one_core(material: Material, runs: int) -> None:
    with _one_core():
        _score(material, runs)


@contextmanager
def _one_core() -> Iterator[None]:
    """Confine this thread, and those that it starts, to one core."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)

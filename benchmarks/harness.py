"""Timing and its table: interleaved repetitions, rows, the machine, Markdown."""

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.progress import Progress

PACKAGES = ("fleetalign", "numpy", "scipy", "numba", "jsbsim", "gtsam", "filterpy", "sidereon", "distributed")


@dataclass(frozen=True)
class Size:
    """How much work a benchmark does."""

    rounds: int = 7
    """Interleaved repetitions."""
    samples: int = 1_000_000
    """IMU samples to mechanise."""
    oracle_samples: int = 4_000
    """IMU samples that a readable numpy step mechanises: it is slow."""
    runs: int = 1_000
    """Alignment runs."""
    scaling_runs: int = 100
    """Alignment runs of each repetition that compares numbers of cores."""
    campaign_runs: int = 10_000
    """Alignment runs of a campaign."""
    dask_runs: int = 2_000
    """Alignment runs of the campaigns that compare Dask with a pool."""
    coarse_runs: int = 200
    """Alignment runs from any heading."""
    nodes: int = 1_000_000
    """Nodes of the largest network to locate."""
    network_s: float = 560.0
    """Time of the fleet's network, at most."""
    changes: Mapping[str, object] = field(default_factory=dict)
    """What differs from the bundled scenario."""


FULL = Size()
QUICK = Size(
    rounds=1,
    samples=20_000,
    oracle_samples=200,
    runs=8,
    scaling_runs=4,
    campaign_runs=8,
    dask_runs=4,
    coarse_runs=2,
    nodes=5_000,
    network_s=5.0,
    changes={
        "flight.altitude_m": 200.0,
        "flight.fdm_rate_hz": 100,
        "flight.s_start_s": 100.0,
        "flight.s_maneuver.duration_s": 5.0,
        "flight.tail_s": 0.0,
        "alignment.duration_s": 2.0,
    },
)
"""Whether everything runs; its figures mean little."""


@dataclass(frozen=True)
class Row:
    """One line of the table. ``reached`` is None where there is no target."""

    what: str
    ours: str
    reference: str
    ratio: str
    target: str = ""
    reached: bool | None = None
    note: str = ""

    @property
    def cells(self) -> tuple[str, ...]:
        """The row's text, cell by cell."""
        reached = "" if self.reached is None else ("yes" if self.reached else "**no**")
        return self.what, self.ours, self.reference, self.ratio, self.target, reached


@dataclass(frozen=True)
class Timing:
    """Seconds of repetitions of the same work."""

    seconds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The least: what other work on the machine disturbed least."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """The median: what a user of a machine as busy as this one sees."""
        return statistics.median(self.seconds)

    def rate(self, samples: int) -> str:
        """Samples per second, best and median."""
        return f"{quantity(samples / self.best)}/s (median {quantity(samples / self.median)})"


class Harness:
    """Runs and times subjects with a progress bar."""

    def __init__(self, size: Size, progress: Progress) -> None:
        self.size = size
        self._progress = progress

    def times(
        self,
        title: str,
        subjects: Mapping[str, Callable[[], object]],
        rounds: int | None = None,
        repeats: Mapping[str, int] | None = None,
        clock: Callable[[], float] = time.thread_time,
        warm_up: bool = True,
    ) -> dict[str, Timing]:
        """Time the subjects in turn, round after round, so that a busy spell meets all of them.

        ``rounds`` may be fewer than the size's. A subject in ``repeats`` is called, and timed, so often in
        each round. ``clock`` is the processor time of this thread unless told otherwise. ``warm_up``: each
        subject runs once before, untimed, which compiles it and fills caches.
        """
        rounds = min(rounds or self.size.rounds, self.size.rounds)
        seconds: dict[str, list[float]] = {name: [] for name in subjects}
        task = self._progress.add_task(title, total=(rounds + warm_up) * len(subjects))
        if warm_up:
            for subject in subjects.values():
                subject()
                self._progress.advance(task)
        for _ in range(rounds):
            for name, subject in subjects.items():
                for _ in range((repeats or {}).get(name, 1)):
                    start = clock()
                    subject()
                    seconds[name].append(clock() - start)
                self._progress.advance(task)
        return {name: Timing(tuple(s)) for name, s in seconds.items()}


def quantity(x: float) -> str:
    """Three digits with a unit prefix."""
    for scale, prefix in ((1e6, "M"), (1e3, "k")):
        # What rounds to 1000 of one prefix is 1 of the next.
        if x >= 0.9995 * scale:
            return f"{x / scale:.3g} {prefix}"
    return f"{x:.3g}"


def package_version(name: str) -> str | None:
    """Version of an installed distribution, None for one that is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def load() -> str:
    """Mean number of runnable processes over the last minute, for the record."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def machine() -> dict[str, str]:
    """Processor, cores, system, Python and packages."""
    facts = {"Processor": _processor(), "Cores": str(os.cpu_count())}
    facts["System"] = f"{platform.system()} {platform.machine()}"
    facts["Python"] = f"{platform.python_implementation()} {platform.python_version()}"
    return facts | {name: package_version(name) or "not installed" for name in PACKAGES}


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def markdown(rows: list[Row], loads: tuple[str, str], command: str) -> str:
    """The whole document."""
    header = ("What", "fleetalign", "Reference", "Ratio", "Target", "Reached")
    lines = [
        "# Benchmarks",
        "",
        f"Made by `{command}`. What is compared takes turns in one process.",
        "A figure is that of the best repetition (in brackets of the median), a ratio that of two bests.",
        "On one core, time is the processor time of the thread; on several it is wall time.",
        f"Mean load of the machine (runnable processes over a minute): {loads[0]} before, {loads[1]} after.",
        "",
        _table_line(header),
        _table_line(("---",) * len(header)),
        *(_table_line(row.cells) for row in rows),
        "",
        "## What is compared",
        "",
        *(f"- {row.what}: {row.note}" for row in rows if row.note),
        "",
        "## Machine",
        "",
        *(f"- {name}: {fact}" for name, fact in machine().items()),
    ]
    return "\n".join(lines) + "\n"


def _table_line(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"

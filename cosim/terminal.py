"""The terminal: consoles, progress, Ctrl-C, and the table of results."""

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from .scenario import Scenario

# Titles and paths are the user's words: no markup in them.
out_console = Console(markup=False, highlight=False)
error_console = Console(stderr=True, markup=False, highlight=False)

_DIGITS = {"roll_arcsec": 1, "pitch_arcsec": 1, "heading_arcmin": 2, "v_east_mps": 3, "v_north_mps": 3}
_SOON_S, _OFTEN_S, _SELDOM_S = 2.0, 60.0, 600.0
"""Seconds to the first line of progress, and the least and most between two."""


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields what tells whether Ctrl-C was pressed, so that a run ends whole.

    Pressed again, it ends the program at once.
    """
    pressed: list[int] = []

    def note(number: int, _: object) -> None:
        pressed.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


class _Pace:
    """How fast work goes, over all the time since it was first told of: what was done by then is another
    command's.

    It comes in lumps, as shards of several workers do that end together, and what is seen of a lump of late
    is no rate.
    """

    def __init__(self) -> None:
        self._from: tuple[float, float] | None = None
        self._at = self._done = self._total = 0.0

    def note(self, done: float, total: float) -> None:
        """Take down how much is done, and of how much."""
        self._at, self._done, self._total = monotonic(), done, total
        self._from = self._from or (self._at, done)

    @property
    def elapsed_s(self) -> float:
        """From the first note to the last."""
        return self._at - self._from[0] if self._from else 0.0

    @property
    def rate(self) -> float | None:
        """How much is done a second; None as long as nothing was."""
        done = self._done - self._from[1] if self._from else 0.0
        return done / self.elapsed_s if done > 0 and self.elapsed_s > 0 else None

    @property
    def told_left(self) -> str:
        """The time that the rest takes, in hours, minutes and seconds; unknown where that is over already."""
        left_s = (self._total - self._done) / self.rate - (monotonic() - self._at) if self.rate else -1.0
        return f"{timedelta(seconds=math.ceil(left_s))}" if left_s >= 0 else "-:--:--"

    def told_rate(self, unit: str | None) -> str:
        """The rate with its unit, if both are known."""
        return f"{self.rate:.3g} {unit}/s" if unit and self.rate else ""


class _Words(ProgressColumn):
    """What a function tells at each look."""

    def __init__(self, words: Callable[[], str]) -> None:
        super().__init__()
        self._words = words

    def render(self, task: Task) -> Text:
        """The text of a bar."""
        return Text(self._words())


@contextmanager
def progress_bar(
    what: str, silent: bool, unit: str | None = None
) -> Iterator[Callable[[float, float], None]]:
    """A progress bar on the terminal's error stream; call what it yields with (done, total).

    ``unit`` is that of the two: with it their numbers are shown, and how many are done a second. Where that
    is no terminal, a line now and then takes the bar's place, if the work lasts.
    """
    pace = _Pace()
    if silent or not error_console.is_terminal:
        lines = _Lines(what, unit, pace)
        yield (lambda done, total: None) if silent else lines.note
        return
    columns: list[ProgressColumn] = [TextColumn("{task.description:22}"), BarColumn()]
    if unit:
        columns += [MofNCompleteColumn(), _Words(lambda: pace.told_rate(unit))]
    columns += [TimeElapsedColumn(), _Words(lambda: pace.told_left)]
    with Progress(*columns, console=error_console, transient=True) as bar:
        task = bar.add_task(what, total=None)

        def note(done: float, total: float) -> None:
            pace.note(done, total)
            bar.update(task, completed=done, total=total)

        yield note


class _Lines:
    """Progress where nobody watches, as in a batch job's file: the first line after two seconds, then one at
    each tenth of the work, but no more than one a minute and no fewer than one in ten."""

    def __init__(self, what: str, unit: str | None, pace: _Pace) -> None:
        self._what, self._unit, self._pace = what, unit, pace
        self._last: tuple[float, float] | None = None

    def note(self, done: float, total: float) -> None:
        """Take down how much is done, and tell it if that is due."""
        self._pace.note(done, total)
        at_s = self._pace.elapsed_s
        if self._last:
            since_s, more = at_s - self._last[0], done - self._last[1]
            due = since_s >= _SELDOM_S or (since_s >= _OFTEN_S and more >= total / 10)
        else:
            due = at_s >= _SOON_S
        if due and self._pace.rate and done < total:
            self._last = at_s, done
            parts = [f"{done / total:.0%}"]
            if self._unit:
                parts = [f"{done:.0f} of {total:.0f} {self._unit}", self._pace.told_rate(self._unit)]
            told = ", ".join([*parts, f"{self._pace.told_left} left"])
            error_console.print(f"{self._what}: {told}", soft_wrap=True)


def results_table(settings: "Scenario", summary: dict[str, Any]) -> Table:
    """The table of alignment errors, the paper's and the bound's beside ours."""
    table = Table(
        title=Text(
            f"{settings.title}\nRMS over {summary['runs']} runs after {settings.alignment.duration_s:g} s"
        ),
        caption=Text(f"paper: {settings.paper.source}") if settings.paper else None,
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=0,
    )
    table.add_column("", no_wrap=True)
    columns = {"roll": "arcsec", "pitch": "arcsec", "heading": "arcmin", "vE": "m/s", "vN": "m/s"}
    for heading, unit in {**columns, "NEES": "of 3", "NIS": "of 6", "failed": "runs"}.items():
        table.add_column(f"{heading}\n{unit}", justify="right", no_wrap=True)
    for name, row in summary["filters"].items():
        consistency = [_number(row["nees"], 2), _number(row["nis"], 2), str(row["failed_runs"])]
        table.add_row(name, *_five(row), *consistency)
    for key, bound in summary["bound"].items():
        table.add_row(f"bound, {key.replace('_', ' ')}", *_five(bound), style="dim")
    if settings.paper:
        for name in ("ekf", "l2linf"):
            # As printed there: rounded, 30.15 would become 30.1.
            printed = [f"{summary['paper'][name][column]:g}" for column in _DIGITS]
            table.add_row(f"paper, {name}", *printed, style="cyan")
    return table


def _five(row: dict[str, Any]) -> list[str]:
    return [_number(row[column], digits) for column, digits in _DIGITS.items()]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"

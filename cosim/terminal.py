"""The terminal: consoles, progress, Ctrl-C, and the table of results."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from .scenario import Scenario

# Titles and paths are the user's words: no markup in them.
out_console = Console(markup=False, highlight=False)
error_console = Console(stderr=True, markup=False, highlight=False)

_DIGITS = {"roll_arcsec": 1, "pitch_arcsec": 1, "heading_arcmin": 2, "v_east_mps": 3, "v_north_mps": 3}


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


class _Rate(ProgressColumn):
    """How many of a unit are done a second, of late."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """The text of a bar."""
        return Text("" if not task.speed else f"{task.speed:.3g} {self._unit}/s")


@contextmanager
def progress_bar(
    what: str, silent: bool, unit: str | None = None
) -> Iterator[Callable[[float, float], None]]:
    """A progress bar on the terminal's error stream; call what it yields with (done, total).

    ``unit`` is that of the two: with it their numbers are shown, and how many are done a second. Where that
    is no terminal there is none: in a file it would be blank lines.
    """
    silent = silent or not error_console.is_terminal
    columns: list[ProgressColumn] = [TextColumn("{task.description:22}"), BarColumn()]
    if unit:
        columns += [MofNCompleteColumn(), _Rate(unit)]
    times = TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, *times, console=error_console, disable=silent, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


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

"""`python -m benchmarks`: time everything and write the table."""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from . import campaign, coarse, filters, flight, localization, mechanization, network, peers, runs
from .harness import FULL, QUICK, Harness, Row, load, markdown
from .material import prepare

SUBJECTS = (mechanization, filters, flight, runs, campaign, coarse, network, localization, peers)


def main(arguments: list[str]) -> int:
    """Run the benchmarks; 0 if every target is reached, else 1."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="little work, to see whether everything runs")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks.md"), help="Markdown file to write")
    names = {subject.__name__.rsplit(".", 1)[1]: subject for subject in SUBJECTS}
    parser.add_argument("--only", choices=names, nargs="+", default=list(names), help="subjects to time")
    options = parser.parse_args(arguments)

    console, before = Console(stderr=True), load()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    rows: list[Row] = []
    with Progress(*columns, console=console) as progress:
        preparing = progress.add_task("preparing", total=1)
        harness = Harness(QUICK if options.quick else FULL, progress)
        material = prepare(harness.size)
        progress.advance(preparing)
        for name in options.only:
            rows += names[name].rows(harness, material)
    if options.quick:
        # Little work says nothing of speed.
        rows = [replace(row, reached=None) for row in rows]
    command = shlex.join(["python", "-m", "benchmarks", *arguments])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(markdown(rows, (before, load()), command), "utf-8")
    for row in rows:
        print("  ".join(cell for cell in row.cells if cell))
    console.print(f"written to {options.out}", highlight=False, soft_wrap=True)
    return int(any(row.reached is False for row in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""What `campaign` and `report` leave: `summary.json`, `report.html`, and the scenario of each named point."""

import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..clean_twin import has_faults
from ..outputs import write_json
from ..pages import number, write_page
from ..scenario import Scenario, replaced
from ..scenario_file import write_scenario
from .figures import draw_campaign, joined, short
from .incidents import GREATEST
from .ledger import POINTS, kept_base
from .summary import CampaignSummary, summarize

_LINES = 40
"""Of the terminal's table."""
_BEFELL = {
    "gated": ("fixes refused by the gate", 1),
    "late": ("fixes too late", 1),
    "unauthentic": ("fixes not authentic", 1),
    "outliers_used": ("outliers believed", 2),
    "dead_reckoning_s": ("dead reckoning, s", 2),
    "largest_jump_sd": ("largest jump, sd", 1),
    "held_imu_samples": ("IMU samples held", 1),
    "quarantined": ("nodes left out", 2),
    "honest_quarantined": ("honest ones of them", 2),
}
"""Headings and digits for `incidents.NAMES`."""
_WITHOUT_FLIGHT = "FlightError", "ScenarioError"
"""Errors of a flight that ends early, and of one that does not hold the alignment."""
NO_FLIGHT = "no flight to align on, so a replay would record nothing"


def write_report(folder: Path, command: str) -> CampaignSummary:
    """Write summary, page and scenarios of the worst runs' points. Raises `ScenarioError`, OSError."""
    summary = summarize(folder)
    plan = summary.plan
    total = plan["settings"]["runs"] * len(plan["coordinates"])
    # All filters of a point have the same runs, and the next point may have other filters.
    done = sum({score.point: score.runs for score in summary.scores}.values())
    base = kept_base(folder, plan)
    changes: dict[str, Any] = {"variants": {}, "seed": plan["settings"]["seed"]}
    if plan["settings"]["filters"]:
        changes["alignment.filters"] = plan["settings"]["filters"]

    def at(point: int) -> Scenario:
        return replaced(base, changes | plan["coordinates"][point], f"{folder}: point {point}")

    named = {row["point"]: at(row["point"]) for row in summary.worst}
    ends = [at(point) for point in (0, -1)] if plan["coordinates"] else []
    write_json(folder / "summary.json", summary.content)
    write_page(
        folder / "report.html",
        "campaign.html.j2",
        draw_campaign(summary),
        plan=plan,
        scores=summary.scores,
        worst=[row | {"command": replay_command(folder, row)} for row in summary.worst],
        befell=_befell(summary) if any(map(_may_fail, (*ends, *named.values()))) else {},
        missing=total - done,
        total=total,
        replayed=base.fixes.kind == "replay",
        folder=folder,
        command=command,
        shown=short,
        joined=joined,
        no_flight=NO_FLIGHT,
    )
    (folder / POINTS).mkdir(exist_ok=True)
    for point, scenario in named.items():
        write_scenario(scenario, folder / POINTS / f"{point:06d}.toml")
    return summary


def replay_command(folder: Path, row: dict[str, Any]) -> str | None:
    """The command that makes a recording of one of `CampaignSummary.worst` in a folder of its own; None where
    nothing would be recorded."""
    if (row["failure"] or "").split(":")[0] in _WITHOUT_FLIGHT:
        return None
    scenario = folder / POINTS / f"{row['point']:06d}.toml"
    out = folder / "replays" / f"p{row['point']:06d}_r{row['run']:07d}"
    return shlex.join(["fleetalign", "run", str(scenario), "--run-id", str(row["run"]), "--out", str(out)])


def told_worst(folder: Path, worst: Iterable[dict[str, Any]]) -> list[str]:
    """A line for the first of each filter: how bad, and the command that replays it, if one can."""
    lines = []
    for name, row in {row["filter"]: row for row in reversed(list(worst))}.items():
        why = row["failure"] or f"NEES {row['nees']:.1f} of 3"
        lines.append(f"worst      {name}, {why}: {replay_command(folder, row) or NO_FLIGHT}")
    return lines[::-1]


def _may_fail(scenario: Scenario) -> bool:
    return scenario.fixes.kind == "network" or has_faults(scenario)


def _befell(summary: CampaignSummary) -> dict[str, tuple[str, int]]:
    """Headings and digits of what befell any of the runs."""
    return {
        name: (heading + (", at most" if name in GREATEST else ", a run"), digits)
        for name, (heading, digits) in _BEFELL.items()
        if any(score.befell[name] > 0 for score in summary.scores)
    }


def shortest(axes: Sequence[str]) -> list[str]:
    """So few last parts of each dotted name as tell it from all others and begin with no number."""

    def told(name: str) -> str:
        parts = name.split(".")
        ends = [
            ".".join(parts[first:]) for first in range(len(parts) - 1, 0, -1) if not parts[first].isdigit()
        ]
        return next((end for end in ends if sum(f".{axis}".endswith(f".{end}") for axis in axes) == 1), name)

    return list(map(told, axes))


def campaign_table(summary: CampaignSummary, console: Console) -> Table:
    """RMS, NEES and failures by point and filter, with as many axes as the console is wide enough for."""
    axes, wide = list(summary.plan["settings"]["axes"]), console.options.update(width=10_000)
    for count in range(len(axes), 0, -1):
        table = _table(summary, count)
        if console.measure(table, options=wide).maximum <= console.width:
            return table
    return _table(summary, 0)


def _table(summary: CampaignSummary, count: int) -> Table:
    """With the first few axes."""
    table = Table(title=Text(summary.plan["title"]), box=SIMPLE_HEAD, pad_edge=False, padding=0)
    axes = list(summary.plan["settings"]["axes"])
    names = shortest(axes)
    for heading in ("point", *(name.replace("_", "_\n") for name in names[:count])):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("filter", no_wrap=True)
    for heading in ("level\narcsec", "heading\narcmin", "velocity\nm/s", "NEES\nof 3", "failed"):
        table.add_column(heading, justify="right", no_wrap=True)
    for score in summary.scores[:_LINES]:
        at = summary.plan["coordinates"][score.point]
        place = str(score.point), *(short(at[name]) for name in axes[:count])
        figures = [number(score.rms[g][0], d) for g, d in (("level", 1), ("heading", 2), ("velocity", 3))]
        failed = f"{score.failed}/{score.runs}"
        table.add_row(*place, score.filter, *figures, number(score.nees, 2), failed)
    left_out = [f"{len(summary.scores) - _LINES} more lines"] if len(summary.scores) > _LINES else []
    left_out += names[count:]
    table.caption = Text(f"in the report: {', '.join(left_out)}") if left_out else None
    return table

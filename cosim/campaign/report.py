"""What `campaign` and `report` leave: `summary.json`, `report.html`, and the scenario of each named point."""

from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ..outputs import write_json
from ..pages import number, write_page
from ..scenario import Scenario, replaced
from ..scenario_file import write_scenario
from .figures import draw_campaign
from .ledger import POINTS, kept_base
from .summary import CampaignSummary, summarize

_LINES = 40
"""Of the terminal's table."""


def write_report(folder: Path, command: str) -> CampaignSummary:
    """Write summary, page and scenarios of the worst runs' points. Raises `ScenarioError`, OSError."""
    summary = summarize(folder)
    plan = summary.plan
    total = plan["settings"]["runs"] * len(plan["coordinates"])
    one = summary.scores[0].filter if summary.scores else ""
    done = sum(score.runs for score in summary.scores if score.filter == one)
    base, named = kept_base(folder, plan), dict[int, Scenario]()
    for point in {row["point"] for row in summary.worst}:
        changes: dict[str, Any] = {"variants": {}, "seed": plan["settings"]["seed"]}
        if plan["settings"]["filters"]:
            changes["alignment.filters"] = plan["settings"]["filters"]
        named[point] = replaced(base, changes | plan["coordinates"][point], f"{folder}: point {point}")
    write_json(folder / "summary.json", summary.content)
    write_page(
        folder / "report.html",
        "campaign.html.j2",
        draw_campaign(summary),
        plan=plan,
        scores=summary.scores,
        worst=summary.worst,
        missing=total - done,
        total=total,
        folder=folder,
        command=command,
        shown=_shown,
    )
    (folder / POINTS).mkdir(exist_ok=True)
    for point, scenario in named.items():
        write_scenario(scenario, folder / POINTS / f"{point:06d}.toml")
    return summary


def campaign_table(summary: CampaignSummary) -> Table:
    """RMS, NEES and failures by point and filter."""
    table = Table(title=Text(summary.plan["title"]), box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    axes = list(summary.plan["settings"]["axes"])
    for name in axes:
        table.add_column(name.rsplit(".", 1)[-1], justify="right")
    table.add_column("filter", no_wrap=True)
    for heading in ("level\narcsec", "heading\narcmin", "velocity\nm/s", "NEES\nof 3", "failed"):
        table.add_column(heading, justify="right", no_wrap=True)
    for score in summary.scores[:_LINES]:
        at = summary.plan["coordinates"][score.point]
        figures = [number(score.rms[g][0], d) for g, d in (("level", 1), ("heading", 2), ("velocity", 3))]
        failed = f"{score.failed}/{score.runs}"
        table.add_row(
            *(_shown(at[name]) for name in axes), score.filter, *figures, number(score.nees, 2), failed
        )
    if len(summary.scores) > _LINES:
        table.caption = f"{len(summary.scores) - _LINES} more lines in the report"
    return table


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)

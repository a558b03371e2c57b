"""What an experiment leaves: a summary as JSON, a page, and its tables on the terminal."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table as TerminalTable
from rich.text import Text

from ..network_score import plain
from ..pages import number, write_page
from .figures import draw_figures
from .results import Form, Metric, Results, Table, Value, Verdict
from .scenario import PaperScenario

_SHORT = {
    Form.PUBLISHED: "pub.",
    Form.MENDED: "mend",
    Form.BASELINE: "base",
    Form.OURS: "ours",
    Form.BOUND: "",
}
_LARGE = 1e6
"""From which on a figure has an exponent."""
_VERDICT_STYLES = {
    Verdict.REPRODUCED: "green",
    Verdict.PARTLY: "yellow",
    Verdict.NOT: "red",
    Verdict.UNDECIDED: "yellow",
}


def summarize(name: str, scenario: PaperScenario, results: Results) -> dict[str, Any]:
    """Content of the JSON summary. Values are ``[value, low, high]``, null where nothing can be said."""
    return plain(
        {
            "scenario": name,
            "seed": scenario.seed,
            "draws": scenario.draws,
            "experiment": scenario.experiment.model_dump(mode="json"),
            "tables": {table.name: _table(table) for table in results.tables},
            "claims": [asdict(claim) for claim in results.claims],
            "notes": list(results.notes),
        }
    )


def _table(table: Table) -> dict[str, Any]:
    return {
        "title": table.title,
        "metrics": {m.key: m.about for m in table.metrics},
        "methods": [
            {"method": row.method, "form": row.form, "about": row.about}
            | {key: [v.value, v.low, v.high] for key, v in row.values.items()}
            for row in table.rows
        ],
    }


def write_report(path: Path, scenario: PaperScenario, results: Results, command: str) -> None:
    """Write the page, whole or not at all. Raises OSError."""
    write_page(
        path,
        "paper.html.j2",
        draw_figures(results.figures),
        scenario=scenario,
        results=results,
        command=command,
        cell=_cell,
        interval=_interval,
        bound=Form.BOUND,
        ours=Form.OURS,
        parameters=scenario.experiment.model_dump_json(indent=2),
    )


def terminal_parts(scenario: PaperScenario, results: Results) -> list[RenderableType]:
    """Tables, claims and notes."""
    parts: list[RenderableType] = [Text(f"{scenario.title}; {scenario.draws} draws, seed {scenario.seed}")]
    for table in results.tables:
        shown = TerminalTable(title=Text(table.title), box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        metrics = [metric for metric in table.metrics if metric.brief]
        cells = [[_cell(row.values.get(m.key), m) for m in metrics] for row in table.rows]
        shown.add_column("", min_width=18)
        shown.add_column("", no_wrap=True, min_width=4)
        for metric, column in zip(metrics, zip(*cells, strict=True), strict=True):
            shown.add_column(
                metric.heading, justify="right", min_width=max(map(len, column)), overflow="fold"
            )
        for row, numbers in zip(table.rows, cells, strict=True):
            style = "dim" if row.form is Form.BOUND else None
            shown.add_row(row.method, _SHORT[row.form], *numbers, style=style)
        parts.append(shown)
    parts.append(
        Text("pub.: as published; mend: as mended; base: plain baseline. 95 % intervals: report and JSON.")
    )
    for claim in results.claims:
        parts.append(
            Text.assemble(
                (f"- {str(claim.verdict).capitalize()}", _VERDICT_STYLES[claim.verdict]),
                f" ({claim.where}): {claim.statement} {claim.measured} {claim.why}",
            )
        )
    parts += [Text(f"- {note}") for note in results.notes]
    return parts


def _cell(value: Value | None, metric: Metric) -> str:
    return "" if value is None else _number(value.value, metric)


def _interval(value: Value | None, metric: Metric) -> str:
    if value is None or not (np.isfinite(value.low) and np.isfinite(value.high)):
        return ""
    return f"{_number(value.low, metric)} to {_number(value.high, metric)}"


def _number(value: float, metric: Metric) -> str:
    return f"{value:.1e}" if _LARGE <= abs(value) < np.inf else number(value, metric.digits)

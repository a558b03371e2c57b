"""What an experiment leaves: a summary as JSON, a page, and its tables on the terminal."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table as TerminalTable
from rich.text import Text

from ..network_score import plain
from ..pages import number, write_page
from .figures import draw_figures
from .results import Form, Metric, Results, Table, Value, Verdict
from .scenario import PaperScenario

_VERDICT_STYLES = {Verdict.REPRODUCED: "green", Verdict.PARTLY: "yellow", Verdict.NOT: "red"}


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
        shown.add_column("")
        for metric in table.metrics:
            shown.add_column(metric.heading, justify="right")
        for row in table.rows:
            cells = [_with_interval(row.values.get(m.key), m) for m in table.metrics]
            name = f"{row.method} ({row.form})" if row.form is not Form.BOUND else row.method
            shown.add_row(name, *cells, style="dim" if row.form is Form.BOUND else None)
        parts.append(shown)
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
    return "" if value is None else number(value.value, metric.digits)


def _interval(value: Value | None, metric: Metric) -> str:
    known = value is not None and number(value.low, 0)[-1].isdigit()
    return (
        f"{number(value.low, metric.digits)} to {number(value.high, metric.digits)}"
        if value and known
        else ""
    )


def _with_interval(value: Value | None, metric: Metric) -> str:
    interval = _interval(value, metric)
    return f"{_cell(value, metric)}\n{interval}" if interval else _cell(value, metric)

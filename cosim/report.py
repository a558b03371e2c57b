"""The report of a scenario's runs: one HTML file that needs nothing else."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..aircraft.flight import Flight
from ..align.bound import Knowledge
from ..align.estimate import Array, FixOutcome
from ..network.fleet_network import FleetNetwork
from ..network.record import NetworkRecord
from .fault_report import fault_rows
from .figures import BOUND_NAMES, draw_all
from .network_figures import draw_network
from .network_report import level, network_tables, variant_rows
from .network_score import NetworkScore
from .outages import told_outages
from .pages import number, write_page
from .palette import filter_color
from .resampling import LEAST_RUNS
from .run import outage_times
from .scenario import Scenario
from .scenery import told
from .score import COLUMNS, FilterScore
from .toml import to_toml

_DIGITS = dict(zip(COLUMNS, (1, 1, 2, 3, 3), strict=True))
_HEADINGS = ("Roll, arcsec", "Pitch, arcsec", "Heading, arcmin", "v east, m/s", "v north, m/s")


def write_report(
    path: str | Path,
    scenario: Scenario,
    flight: Flight,
    window: Flight,
    scores: Mapping[str, FilterScore],
    bounds: Mapping[str, Array],
    summary: dict[str, Any],
    manifest: dict[str, Any],
    network: tuple[NetworkRecord, NetworkScore] | None = None,
) -> None:
    """Write the report, whole or not at all.

    Parameters
    ----------
    flight : the whole of it. window : the part in which the runs aligned.
    bounds : by name, each (m, 5), as `score.standard_deviations` gives them.
    summary, manifest : content of `summary.json` and of `manifest.json`.
    network : record of one run and score of all, where the fixes came from a network.

    Raises OSError.
    """
    replayed = scenario.fixes.kind == "replay"
    if isinstance(scenario.fixes, FleetNetwork):
        delays = network[1].own_delay if network is not None else np.empty(0)
        delay_mean_s = float(np.mean(delays)) if len(delays) else np.nan
    else:
        delay_mean_s = scenario.fixes.delay_mean_s
    figures = draw_all(
        flight, window, scores, bounds, delay_mean_s, not replayed, outage_times(scenario, window)
    )
    if network is not None:
        figures |= draw_network(*network)
    write_page(
        path,
        "report.html.j2",
        figures,
        scenario=scenario,
        summary=summary,
        manifest=manifest,
        headline=_headline(summary, window),
        replayed=replayed,
        least_runs=LEAST_RUNS,
        columns=list(zip(COLUMNS, _HEADINGS, _DIGITS.values(), strict=True)),
        rows=[_row(name, row) for name, row in summary["filters"].items()],
        bounds=[(BOUND_NAMES[Knowledge(key)], row) for key, row in summary["bound"].items()],
        comparison=_comparison(summary),
        outcomes=outcome_table({name: score.fix_outcomes for name, score in scores.items()}),
        network=network_tables(summary["network"]) if network is not None else None,
        variants=variant_rows(summary),
        outages=told_outages(summary),
        faults=fault_rows(summary),
        failures={name: score.failures for name, score in scores.items() if score.failures},
        duration_s=float(window.time[-1] - window.time[0]),
        scenario_text=to_toml(scenario.model_dump(mode="json")),
    )


def _headline(summary: dict[str, Any], window: Flight) -> str:
    """The result in a few sentences."""
    floor = summary["bound"]["stamped"]
    rows = {name: row for name, row in summary["filters"].items() if np.isfinite(level(row))}
    runs = f"RMS over {summary['runs']} runs" if summary["runs"] > 1 else "errors of one run"
    start = f"After {window.time[-1] - window.time[0]:g} s, {runs}"
    if not rows:
        return f"{start}: no filter came to an end."
    reaching = [name for name, row in rows.items() if level(_lower_ends(row)) <= level(floor)]
    told_rows = []
    if reaching:
        levels = " and ".join(f"{name} ({level(rows[name]):.1f} arcsec)" for name in reaching)
        verb = "reach" if len(reaching) > 1 else "reaches"
        told_rows.append(
            f"{levels} {verb} the bound in level ({level(floor):.1f} arcsec) within sampling error"
        )
    told_rows += [
        f"{name} is level to {level(row):.1f} arcsec"
        + (f", {level(row) / level(floor):.1f} times the bound" if np.isfinite(level(floor)) else "")
        for name, row in rows.items()
        if name not in reaching
    ]
    headings = [row["heading_arcmin"] for row in rows.values()]
    span = " to ".join(dict.fromkeys(f"{h:.2f}" for h in (min(headings), max(headings))))
    heading_floor = number(floor["heading_arcmin"], 2)
    failed = sum(row["failed_runs"] for row in summary["filters"].values())
    return (
        f"{start}: {'; '.join(told_rows)}. Heading {span} arcmin, bound {heading_floor}."
        f" {failed or 'No'} failed run{'s' if failed > 1 else ''}."
    )


def _lower_ends(row: Mapping[str, Any]) -> dict[str, float | None]:
    """The lower ends of a filter's confidence intervals, if it has any."""
    return {column: row["ci95"][column][0] if row["ci95"] else None for column in COLUMNS}


def _row(name: str, row: dict[str, Any]) -> dict[str, Any]:
    """A filter's line of the headline table, and of the table over the last half."""

    def judged(kind: str) -> dict[str, Any]:
        value, band = row[kind], row[f"{kind}_band95"]
        outside = value is not None and band is not None and not band[0] <= value <= band[1]
        return {"value": value, "band": band, "outside": outside}

    intervals = row["ci95"] or dict.fromkeys(COLUMNS)

    return {
        "name": name,
        "color": filter_color(name),
        "values": [(column, row[column], intervals[column], _DIGITS[column]) for column in COLUMNS],
        "over_bound": row["over_bound"],
        "nees": judged("nees"),
        "nees_outside": row["nees_outside"],
        "nis": judged("nis"),
        "failed": row["failed_runs"],
        "level_s": row["level_below_60_arcsec_s"],
        "heading_s": row["heading_below_5_arcmin_s"],
        "window": [(column, row["window"][column], _DIGITS[column]) for column in COLUMNS],
    }


def _comparison(summary: dict[str, Any]) -> list[tuple[str, list[tuple[float | None, int]]]]:
    """The paper's table and ours, line by line, with what the second filter gains over the first in each."""
    if "paper" not in summary:
        return []
    paper, ours = summary["paper"], summary["filters"]
    lines = []
    for name in paper:
        lines.append((f"paper, {name}", [(paper[name][c], max(_DIGITS[c], 2)) for c in COLUMNS]))
        if name in ours:
            lines.append((f"here, {name}", [(ours[name][c], _DIGITS[c]) for c in COLUMNS]))
    for whose, table in (("paper", paper), ("here", ours)):
        if "ekf" in table and "l2linf" in table:
            gains = [(_ratio(table["l2linf"][c], table["ekf"][c]), 2) for c in COLUMNS]
            lines.append((f"{whose}, l2linf / ekf", gains))
    return lines


def outcome_table(outcomes: Mapping[str, Mapping[FixOutcome, int]]) -> dict[str, Any]:
    """What became of the fixes: the outcomes that occur, and for each filter their counts and shares."""
    kinds = [o for o in FixOutcome if any(numbers[o] for numbers in outcomes.values())]
    counts = {}
    for name, numbers in outcomes.items():
        total = max(sum(numbers.values()), 1)
        counts[name] = [(numbers[o], 100 * numbers[o] / total) for o in kinds]
    return {"kinds": [told(o.name) for o in kinds], "counts": counts}


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference

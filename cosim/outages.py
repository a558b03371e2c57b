"""What filters make of outages of the fixes: errors at the end of each."""

from typing import Any

import numpy as np

from .papers import statistics
from .papers.results import Value
from .scenario import Scenario
from .score import FilterScore


def outage_rows(scenario: Scenario, score: FilterScore) -> list[dict[str, Any]]:
    """For each outage of a scenario what the summary says of a filter: RMS over the runs at its last epoch.

    Velocity is horizontal. Runs without an error there do not count.
    """
    rows = []
    for outage in scenario.outages:
        row = max(int(np.searchsorted(score.time, outage.end_s - 1e-6)) - 1, 0)
        squares = {
            "position_m": np.sum(score.position_errors[:, row] ** 2, axis=1),
            "velocity_mps": np.sum(score.errors[:, row, 3:5] ** 2, axis=1),
        }
        rows.append(
            {"start_s": outage.start_s, "duration_s": outage.duration_s}
            | {name: figures_of(statistics.rms(values)) for name, values in squares.items()}
            | {"position_nees": figures_of(statistics.mean(score.position_nees[:, row]))}
        )
    return rows


def figures_of(value: Value) -> list[float | None]:
    """The figure and the ends of its interval."""
    return [float(v) if np.isfinite(v) else None for v in (value.value, value.low, value.high)]


def told_outages(summary: dict[str, Any]) -> list[str]:
    """A line for each filter and outage, from `summary.json`."""
    lines = []
    blocks = {"": summary, **{f"{name}: ": part for name, part in summary.get("variants", {}).items()}}
    for label, block in blocks.items():
        for name, row in block["filters"].items():
            for outage in row.get("outages", []):
                end_s = outage["start_s"] + outage["duration_s"]
                lines.append(
                    f"{label}{name}, end of outage {outage['start_s']:g} to {end_s:g} s:"
                    f" {_told(outage['position_m'], 1)} m, {_told(outage['velocity_mps'], 3)} m/s,"
                    f" NEES of position {_told(outage['position_nees'], 1)} of 3"
                )
    return lines


def _told(value: list[float | None], digits: int) -> str:
    middle, low, high = (None if v is None else f"{v:.{digits}f}" for v in value)
    return "-" if middle is None else middle if low is None else f"{middle} ({low} to {high})"

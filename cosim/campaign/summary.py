"""What a campaign's rows say of each point and filter."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...align.consistency import mean_band
from ..network_score import plain
from ..resampling import LEAST_RUNS, resampled_means, tails
from ..scenario import ScenarioError
from ..score import COLUMNS, GROUPS
from .incidents import GREATEST, NAMES
from .ledger import read_plan, read_points

WORST = 10
"""Runs that are named for each filter."""


@dataclass(frozen=True)
class PointScore:
    """One filter at one point."""

    point: int
    filter: str
    runs: int
    failed: int
    reasons: dict[str, int]
    """How often each reason of a failure was met."""
    rms: dict[str, tuple[float, float, float]]
    """By `score.GROUPS`: RMS over runs at the end with its 95 % interval, arcsec, arcmin, m/s; or NaN. Runs
    that replay the same fixes have no interval."""
    nees: float
    nees_band: tuple[float, float] | None
    """None where no run has a NEES, and for runs that replay the same fixes."""
    befell: dict[str, float]
    """By `incidents.NAMES`: the mean over the runs that have a value, the greatest of `incidents.GREATEST`;
    NaN where none has."""
    time_s: list[float]
    level_rms_arcsec: list[float]
    heading_rms_arcmin: list[float]


@dataclass(frozen=True)
class CampaignSummary:
    """All points of a campaign that have rows."""

    plan: dict[str, Any]
    scores: list[PointScore]
    worst: list[dict[str, Any]]
    """Of each filter the failed runs, then those with the greatest NEES at the end: furthest out in their own
    covariance."""

    @property
    def content(self) -> dict[str, Any]:
        """What `campaign` leaves as `summary.json`."""
        points = [{"point": s.point, "at": self.plan["coordinates"][s.point]} | vars(s) for s in self.scores]
        return plain({"title": self.plan["title"], "points": points, "worst": self.worst})


def summarize(folder: Path) -> CampaignSummary:
    """Read a campaign's folder, point by point. Raises `ScenarioError` where none is kept."""
    plan, scores, worst = read_plan(folder), list[PointScore](), dict[str, list[dict[str, Any]]]()
    # No axis can lead from one kind to another: they have other fields.
    independent = plan["base"].get("fixes", {}).get("kind") != "replay"
    for point, table in read_points(folder):
        if point >= len(plan["coordinates"]):
            raise ScenarioError(f"{folder}: shards of point {point}; the plan has {len(plan['coordinates'])}")
        rows = table.to_pylist()
        for name in dict.fromkeys(row["filter"] for row in rows):
            mine = [row for row in rows if row["filter"] == name]
            scores.append(_score(point, name, mine, independent))
            named = worst.setdefault(name, [])
            named += [_named(row) for row in mine if row["failure"] or row["nees"] is not None]
            named.sort(key=_order)
            del named[WORST:]
    return CampaignSummary(plan, scores, [row for rows in worst.values() for row in rows])


def _score(point: int, name: str, rows: list[dict[str, Any]], independent: bool) -> PointScore:
    errors = np.array([[np.nan if row[c] is None else row[c] for c in COLUMNS] for row in rows], float)
    errors = errors[np.isfinite(errors).all(axis=1)]
    nees = np.array([row["nees"] for row in rows if row["nees"] is not None], float)
    failures = [row["failure"] for row in rows if row["failure"]]
    histories = [row for row in rows if row["history_time_s"]]
    time = histories[0]["history_time_s"] if histories else []
    return PointScore(
        point=point,
        filter=name,
        runs=len(rows),
        failed=len(failures),
        reasons={reason: failures.count(reason) for reason in dict.fromkeys(failures)},
        rms={group: _rms(errors[:, columns], independent) for group, columns in GROUPS.items()},
        nees=float(nees.mean()) if len(nees) else np.nan,
        nees_band=mean_band(3, len(nees)) if independent and len(nees) else None,
        befell={key: _befell(key, rows) for key in NAMES},
        time_s=list(time),
        level_rms_arcsec=_history(histories, "level_history_arcsec"),
        heading_rms_arcmin=_history(histories, "heading_history_arcmin"),
    )


def _befell(key: str, rows: list[dict[str, Any]]) -> float:
    values = [row[key] for row in rows if row[key] is not None]
    if not values:
        return np.nan
    return float(max(values) if key in GREATEST else np.mean(values))


def _rms(errors: np.ndarray, independent: bool) -> tuple[float, float, float]:
    if not len(errors):
        return np.nan, np.nan, np.nan
    squares = np.mean(errors**2, axis=1)[:, None]
    if len(squares) < LEAST_RUNS or not independent:
        return float(np.sqrt(squares.mean())), np.nan, np.nan
    low, high = np.sqrt(np.quantile(resampled_means(squares)[:, 0], tails(0.95)))
    return float(np.sqrt(squares.mean())), float(low), float(high)


def _history(rows: list[dict[str, Any]], key: str) -> list[float]:
    if not rows:
        return []
    values = np.array([row[key] for row in rows], float)
    known = np.isfinite(values)
    squares = np.where(known, values, 0.0) ** 2
    count = known.sum(axis=0)
    return np.where(count > 0, np.sqrt(squares.sum(axis=0) / np.maximum(count, 1)), np.nan).tolist()


def _order(row: dict[str, Any]) -> tuple[bool, float, int, int]:
    far = np.inf if row["nees"] is None else row["nees"]
    return row["failure"] is None, -far, row["point"], row["run"]


def _named(row: dict[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in ("filter", "point", "run", "failure", "nees", *COLUMNS)}

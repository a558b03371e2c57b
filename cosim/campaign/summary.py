"""What a campaign's rows say of each point and filter."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from ...align.consistency import mean_band
from ...align.estimate import Array
from ..network_score import plain
from ..resampling import LEAST_RUNS, resampled_means, tails
from ..scenario import ScenarioError
from ..score import COLUMNS, GROUPS
from .incidents import GREATEST, NAMES
from .ledger import read_plan, read_points

WORST = 10
"""Runs that are named for each filter."""
_NAMED = ["filter", "point", "run", "failure", "nees", *COLUMNS]
_HISTORIES = "level_history_arcsec", "heading_history_arcmin"


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
    """Read a campaign's folder, shard by shard. Raises `ScenarioError` where none is kept."""
    plan, scores, worst = read_plan(folder), list[PointScore](), dict[str, list[dict[str, Any]]]()
    # No axis can lead from one kind to another: they have other fields.
    independent = plan["base"].get("fixes", {}).get("kind") != "replay"
    for point, shards in groupby(read_points(folder), key=itemgetter(0)):
        if point >= len(plan["coordinates"]):
            raise ScenarioError(f"{folder}: shards of point {point}; the plan has {len(plan['coordinates'])}")
        tallies: dict[str, _Tally] = {}
        for _, table in shards:
            names = np.array(table["filter"].to_pylist())
            for name in dict.fromkeys(names.tolist()):
                mine = table.take(np.flatnonzero(names == name))
                tallies.setdefault(name, _Tally(point, name)).add(mine)
                named = worst.setdefault(name, [])
                rows = mine.select(_NAMED).to_pylist()
                named += [row for row in rows if row["failure"] or row["nees"] is not None]
                named.sort(key=_order)
                del named[WORST:]
        scores += [tally.score(independent) for tally in tallies.values()]
    return CampaignSummary(plan, scores, [row for rows in worst.values() for row in rows])


class _Tally:
    """One filter at one point, as its shards go by: sums, and of a run four numbers that are resampled."""

    def __init__(self, point: int, name: str) -> None:
        self._point, self._name = point, name
        self._runs = 0
        self._reasons: dict[str, int] = {}
        # Arrays of the standard library grow in place, and have next to nothing beside their numbers.
        self._squares = {group: array("d") for group in GROUPS}
        self._nees = array("d")
        self._befell = np.zeros(len(NAMES)), np.zeros(len(NAMES)), np.full(len(NAMES), np.nan)
        self._time_s: list[float] = []
        self._histories: dict[str, tuple[Array, Array]] = {}

    def add(self, table: Any) -> None:
        """Rows of `shard.SCHEMA`, of this filter alone."""
        self._runs += len(table)
        for reason in filter(None, table["failure"].to_pylist()):
            self._reasons[reason] = self._reasons.get(reason, 0) + 1
        errors = _numbers(table, COLUMNS).T
        errors = errors[np.isfinite(errors).all(axis=1)]
        for group, columns in GROUPS.items():
            self._squares[group].frombytes(np.mean(errors[:, columns] ** 2, axis=1).tobytes())
        nees = _numbers(table, ["nees"])[0]
        self._nees.frombytes(nees[~np.isnan(nees)].tobytes())
        befell = _numbers(table, NAMES)
        total, count, greatest = self._befell
        self._befell = (
            total + np.nansum(befell, axis=1),
            count + np.count_nonzero(~np.isnan(befell), axis=1),
            np.fmax(greatest, np.fmax.reduce(befell, axis=1)),
        )
        times = _lists(table, "history_time_s")
        if times.size:
            self._time_s = self._time_s or times[0].tolist()
            for key in _HISTORIES:
                self._add_history(key, _lists(table, key))

    def _add_history(self, key: str, values: Array) -> None:
        if not values.size:
            return
        nothing = np.zeros(len(self._time_s))
        squares, count = self._histories.get(key, (nothing, nothing))
        if values.shape[1] != len(nothing):
            raise ScenarioError(f"shards of point {self._point}: histories of several lengths")
        known = np.isfinite(values)
        # One after the other, as all at once would be summed.
        squares = np.vstack([squares, np.where(known, values, 0.0) ** 2]).sum(axis=0)
        self._histories[key] = squares, count + known.sum(axis=0)

    def score(self, independent: bool) -> PointScore:
        """What the runs so far come to."""
        total, count, greatest = self._befell
        means = np.divide(total, count, out=np.full(len(NAMES), np.nan), where=count > 0)
        befell = np.where([key in GREATEST for key in NAMES], greatest, means)
        nees = np.array(self._nees)
        return PointScore(
            point=self._point,
            filter=self._name,
            runs=self._runs,
            failed=sum(self._reasons.values()),
            reasons=self._reasons,
            rms={group: _rms(np.array(squares), independent) for group, squares in self._squares.items()},
            nees=float(nees.mean()) if len(nees) else np.nan,
            nees_band=mean_band(3, len(nees)) if independent and len(nees) else None,
            befell=dict(zip(NAMES, befell.tolist(), strict=True)),
            time_s=self._time_s,
            level_rms_arcsec=self._history("level_history_arcsec"),
            heading_rms_arcmin=self._history("heading_history_arcmin"),
        )

    def _history(self, key: str) -> list[float]:
        if key not in self._histories:
            return []
        squares, count = self._histories[key]
        return np.where(count > 0, np.sqrt(squares / np.maximum(count, 1)), np.nan).tolist()


def _numbers(table: Any, columns: Iterable[str]) -> Array:
    """Columns of a table, (columns, rows), NaN for null."""
    return np.array([table[column].to_numpy() for column in columns], float)


def _lists(table: Any, column: str) -> Array:
    """A column of equally long lists, (rows that have one, their length), NaN for null."""
    lists = table[column].combine_chunks().drop_null()
    flat = lists.flatten().to_numpy(zero_copy_only=False).astype(float)
    return flat.reshape(len(lists), len(flat) // max(len(lists), 1))


def _rms(squares: Array, independent: bool) -> tuple[float, float, float]:
    if not len(squares):
        return np.nan, np.nan, np.nan
    rms = float(np.sqrt(squares.mean()))
    if len(squares) < LEAST_RUNS or not independent:
        return rms, np.nan, np.nan
    low, high = np.sqrt(np.quantile(resampled_means(squares[:, None])[:, 0], tails(0.95)))
    return rms, float(low), float(high)


def _order(row: dict[str, Any]) -> tuple[bool, float, int, int]:
    far = np.inf if row["nees"] is None else row["nees"]
    return row["failure"] is None, -far, row["point"], row["run"]

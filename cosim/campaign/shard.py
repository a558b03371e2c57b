"""Some runs of one point, as rows of a Parquet file: the same bytes wherever they are done."""

import io
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ...aircraft.cache import cached_flight
from ...aircraft.flight import Flight
from ...aircraft.mission import FlightPlan
from ..run import alignment_window, simulate
from ..scenario import Scenario
from ..score import COLUMNS, Scorer
from .incidents import FIELDS, incidents
from .plan import Shard

CURVE_HZ = 1.0
"""Rate of the kept histories of level and heading errors."""
SCHEMA = pa.schema(
    [
        ("point", pa.int32()),
        ("run", pa.int32()),
        ("filter", pa.string()),
        ("failure", pa.string()),
        *((column, pa.float64()) for column in COLUMNS),
        ("nees", pa.float64()),
        ("nis", pa.float64()),
        ("fused", pa.int32()),
        ("fixes", pa.int32()),
        *FIELDS,
        ("history_time_s", pa.list_(pa.float32())),
        ("level_history_arcsec", pa.list_(pa.float32())),
        ("heading_history_arcmin", pa.list_(pa.float32())),
    ]
)
"""Of a shard. ``failure`` is null for a run that aligned; errors are estimate less truth at the end, null
where there is no estimate; what befell it, see `incidents`; the histories, once a second from the start, have
the root of the mean square of roll and pitch, and the size of the heading's error."""


def done_shard(scenario: Scenario, shard: Shard) -> bytes:
    """Do the runs of a shard; a run that raises is a row with its reason for each filter, and no more."""
    return encoded(shard_rows(scenario, shard))


def shard_rows(scenario: Scenario, shard: Shard) -> list[dict[str, Any]]:
    """Rows of `SCHEMA`, by run and then by filter."""
    try:
        flight = _flight(scenario.flight.model_dump_json())
        alignment_window(scenario, flight)
    # No flight, whatever the reason, is no end of a campaign.
    except Exception as error:
        runs = range(shard.first_run, shard.first_run + shard.runs)
        return [row for run in runs for row in failed_rows(scenario, shard.point, run, _told(error))]
    rows: list[dict[str, Any]] = []
    for run_id in range(shard.first_run, shard.first_run + shard.runs):
        try:
            rows += _run_rows(scenario, flight, shard.point, run_id)
        # A campaign outlives whatever one of its runs comes to; the reason is kept with its type.
        except Exception as error:
            rows += failed_rows(scenario, shard.point, run_id, _told(error))
    return rows


def failed_rows(scenario: Scenario, point: int, run_id: int, reason: str) -> list[dict[str, Any]]:
    """Rows of a run that gave nothing."""
    names = scenario.alignment.filters
    return [{"point": point, "run": run_id, "filter": name, "failure": reason} for name in names]


def encoded(rows: list[dict[str, Any]]) -> bytes:
    """Parquet of rows; equal rows have equal bytes."""
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), buffer, compression="zstd")
    return buffer.getvalue()


@lru_cache(maxsize=4)
def _flight(plan: str) -> Flight:
    """Flights that a worker needs again and again."""
    return cached_flight(FlightPlan.model_validate_json(plan))[0]


def _told(error: Exception) -> str:
    first = str(error).splitlines()[0] if str(error) else ""
    return f"{type(error).__name__}: {first}".removesuffix(": ")


def _run_rows(scenario: Scenario, flight: Flight, point: int, run_id: int) -> list[dict[str, Any]]:
    window = alignment_window(scenario, flight)
    run = simulate(scenario, flight, run_id, scenario.seed)
    scorer = Scorer(window, scenario.alignment.filters)
    scorer.add(run)
    rows = []
    for name, score in scorer.scores().items():
        errors = score.errors[0]
        end = errors[-1] if score.failures.get(run_id) not in ("no_fix", "no_coarse") else np.full(5, np.nan)
        whole = np.round(score.time * CURVE_HZ, 6) % 1 == 0
        level = np.sqrt(np.mean(errors[whole, :2] ** 2, axis=1))
        row = {
            "point": point,
            "run": run_id,
            "filter": name,
            "failure": score.failures.get(run_id),
            **{column: _known(value) for column, value in zip(COLUMNS, end, strict=True)},
            "nees": _known(score.nees[0, -1]),
            "nis": _known(score.nis[0]),
            "fused": int(score.fused[0]),
            "fixes": len(run.fixes),
            **incidents(run, run.estimates[name], scenario.alignment.settings.output_rate_hz),
            "history_time_s": score.time[whole].tolist(),
            "level_history_arcsec": level.tolist(),
            "heading_history_arcmin": np.abs(errors[whole, 2]).tolist(),
        }
        rows.append(row)
    return rows


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

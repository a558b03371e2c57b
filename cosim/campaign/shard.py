"""Some runs of one point, as rows of a Parquet file: the same bytes wherever they are done."""

import hashlib
import io
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ...aircraft.cache import cached_flight
from ...aircraft.flight import Flight
from ...aircraft.mission import FlightPlan
from ...align.estimate import Array
from ..run import Run, aligned, alignment_window, measured
from ..scenario import Scenario
from ..score import COLUMNS, Scorer
from .incidents import FIELDS, incidents
from .plan import Shard

CURVE_HZ = 1.0
"""Rate of the kept histories of level and heading errors."""
TOGETHER = 25
"""Runs whose stages are done one after the other: code and tables stay in a processor's caches from run to
run, and memory does not grow with a shard."""
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
_LEAN: Any = {"use_dictionary": ["filter", "failure"], "write_statistics": False}
"""Of Parquet: figures hardly repeat, and few rows are soon read."""
_SEAL = b"sha256\x18\x40"
"""Key of a file's digest in its footer, and what Thrift puts between that and a text of 64 bytes."""


def done_shard(scenario: Scenario, shard: Shard) -> bytes:
    """Do the runs of a shard; a run that raises is a row with its reason for each filter, and no more."""
    return encoded(shard_rows(scenario, shard))


def shard_rows(scenario: Scenario, shard: Shard) -> list[dict[str, Any]]:
    """Rows of `SCHEMA`, by run and then by filter."""
    try:
        flight = _flight(scenario.flight.model_dump_json())
        window = alignment_window(scenario, flight)
    # No flight, whatever the reason, is no end of a campaign.
    except Exception as error:
        runs = range(shard.first_run, shard.first_run + shard.runs)
        return [row for run in runs for row in failed_rows(scenario, shard.point, run, _told(error))]
    ids = range(shard.first_run, shard.first_run + shard.runs)
    return [
        row
        for first in range(0, len(ids), TOGETHER)
        for row in _rows_together(scenario, flight, window, shard.point, ids[first : first + TOGETHER])
    ]


def _rows_together(
    scenario: Scenario, flight: Flight, window: Flight, point: int, ids: range
) -> list[dict[str, Any]]:
    """Rows of a few runs, each stage done for all of them before the next."""
    rows: dict[int, list[dict[str, Any]]] = {}

    def each(stage: Callable[[Any], Any], runs: dict[int, Any]) -> dict[int, Any]:
        done: dict[int, Any] = {}
        for run_id, of_run in runs.items():
            try:
                done[run_id] = stage(of_run)
            # A campaign outlives whatever one of its runs comes to; the reason is kept with its type.
            except Exception as error:
                rows[run_id] = failed_rows(scenario, point, run_id, _told(error))
        return done

    def together(stage: Callable[[list[Any]], list[Any]], runs: dict[int, Any]) -> dict[int, Any]:
        try:
            return dict(zip(runs, stage(list(runs.values())), strict=True))
        # One of them, or histories of several lengths: each alone, and who is to blame shows.
        except Exception:
            return each(lambda one: stage([one])[0], runs)

    made = each(lambda run_id: measured(scenario, flight, run_id, scenario.seed), {i: i for i in ids})
    runs = together(lambda made: aligned(made, scenario, flight), made)
    rows |= together(lambda runs: _rows(scenario, window, point, runs), runs)
    return [row for _, of_run in sorted(rows.items()) for row in of_run]


def failed_rows(scenario: Scenario, point: int, run_id: int, reason: str) -> list[dict[str, Any]]:
    """Rows of a run that gave nothing."""
    names = scenario.alignment.filters
    return [{"point": point, "run": run_id, "filter": name, "failure": reason} for name in names]


def encoded(rows: list[dict[str, Any]]) -> bytes:
    """Parquet of rows, `sealed`; equal rows have equal bytes."""
    return sealed(pa.Table.from_pylist(rows, schema=SCHEMA))


def sealed(table: pa.Table) -> bytes:  # pyright: ignore[reportUnknownParameterType]
    """Parquet of a table, with a digest of the whole file: checksums of pages leave out what says where pages
    are and how they are read."""
    buffer = io.BytesIO()
    with pq.ParquetWriter(buffer, table.schema, compression="zstd", **_LEAN) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({"sha256": "0" * 64})
    content = buffer.getvalue()
    at, digest = _digest(content)
    return content[:at] + digest + content[at + 64 :]


def is_whole(content: bytes) -> bool:
    """Whether this is to the last bit what `sealed` had given."""
    at, digest = _digest(content)
    return content[at : at + 64] == digest


def _digest(content: bytes) -> tuple[int, bytes]:
    """Where the 64 digits of the digest stand, and what they must be: of all but themselves."""
    at = content.rfind(_SEAL) + len(_SEAL)
    return at, hashlib.sha256(content[:at] + content[at + 64 :]).hexdigest().encode()


@lru_cache(maxsize=4)
def _flight(plan: str) -> Flight:
    """Flights that a worker needs again and again."""
    return cached_flight(FlightPlan.model_validate_json(plan))[0]


def _told(error: Exception) -> str:
    first = str(error).splitlines()[0] if str(error) else ""
    return f"{type(error).__name__}: {first}".removesuffix(": ")


def _whole(since: Array) -> NDArray[np.bool_]:
    """Of times, s from the start of the alignment, those whose histories are kept."""
    return np.round(since * CURVE_HZ, 6) % 1 == 0


def _rows(scenario: Scenario, window: Flight, point: int, runs: list[Run]) -> list[list[dict[str, Any]]]:
    """Rows of each run, one of each filter."""
    if not runs:
        return []
    time = next(iter(runs[0].estimates.values())).time
    scorer = Scorer(window, scenario.alignment.filters)
    scorer.add(*runs, rows=np.flatnonzero(np.append(_whole(time[:-1] - window.time[0]), True)))
    rate_hz = scenario.alignment.settings.output_rate_hz
    rows: list[list[dict[str, Any]]] = [[] for _ in runs]
    for name, score in scorer.scores().items():
        whole = _whole(score.time)
        times = score.time[whole].astype(np.float32)
        level = np.sqrt(np.mean(score.errors[:, whole, :2] ** 2, axis=2)).astype(np.float32)
        heading = np.abs(score.errors[:, whole, 2]).astype(np.float32)
        for i, run in enumerate(runs):
            failure = score.failures.get(run.run_id)
            end = score.errors[i, -1] if failure not in ("no_fix", "no_coarse") else np.full(5, np.nan)
            rows[i].append(
                {
                    "point": point,
                    "run": run.run_id,
                    "filter": name,
                    "failure": failure,
                    **{column: _known(value) for column, value in zip(COLUMNS, end.tolist(), strict=True)},
                    "nees": _known(float(score.nees[i, -1])),
                    "nis": _known(float(score.nis[i])),
                    "fused": int(score.fused[i]),
                    "fixes": len(run.fixes),
                    **incidents(run, run.estimates[name], rate_hz),
                    "history_time_s": times,
                    "level_history_arcsec": level[i],
                    "heading_history_arcmin": heading[i],
                }
            )
    return rows


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None

"""The files that a run leaves: `summary.json`, `manifest.json`, `estimates.parquet`, `flight.parquet`."""

import json
import math
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..aircraft.flight import Flight
from ..align.bound import Knowledge
from ..align.consistency import mean_band
from ..align.estimate import Array, Estimate, FixOutcome, NavStatus
from ..sins import attitude
from ..sins.units import DEG, DEG_PER_HOUR, MICRO_G, MILLISECOND
from .files import whole_file
from .network_score import NetworkScore
from .outages import outage_rows
from .resampling import bootstrap_rms_interval, paired_ratios, rms_over
from .run import Run
from .scenario import Scenario
from .score import (
    COLUMNS,
    HEADING_LIMIT_ARCMIN,
    LEVEL_LIMIT_ARCSEC,
    FilterScore,
    errors_against,
    standard_deviations,
)

_PACKAGES = ("fleetalign", "jsbsim", "numba", "numpy", "pyarrow", "rerun-sdk", "scipy")
REFERENCE = "ekf_stamped"
"""The filter that others are compared with, run by run."""
_RUNS_PER_ROW_GROUP = 50


def summarize(
    name: str,
    scenario: Scenario,
    seed: int,
    flight: Flight,
    scores: dict[str, FilterScore],
    bounds: Mapping[str, Array],
    network: NetworkScore | None = None,
) -> dict[str, Any]:
    """Content of `summary.json`; ``bounds``, each (m, 5), as `score.standard_deviations` gives them."""
    summary: dict[str, Any] = {
        "scenario": name,
        "seed": seed,
        "runs": next(iter(scores.values())).runs,
        "flight": flight.summary,
        **summarize_runs(scenario, scores, network, bounds[Knowledge.STAMPED][-1]),
        "bound": {key: _named(bound[-1]) for key, bound in bounds.items()},
    }
    if scenario.paper:
        summary["paper"] = scenario.paper.model_dump(include={"ekf", "l2linf"})
    return summary


def summarize_runs(
    scenario: Scenario, scores: dict[str, FilterScore], network: NetworkScore | None, floor: Array
) -> dict[str, Any]:
    """The blocks ``filters``, ``paired`` and, where there is one, ``network`` of the runs of a scenario or a
    variant; ``floor`` (5,) is the bound with stamps known at the end."""
    independent = scenario.fixes.kind != "replay"
    filters = {name: _summarize_filter(score, independent, floor) for name, score in scores.items()}
    if scenario.outages:
        for name, score in scores.items():
            filters[name]["outages"] = outage_rows(scenario, score)
    others = [name for name in scores if name != REFERENCE and REFERENCE in scores and independent]
    paired = {
        f"{name}/{REFERENCE}": _plain_groups(
            paired_ratios(scores[name].errors[:, -1], scores[REFERENCE].errors[:, -1])
        )
        for name in others
    }
    return {"filters": filters, "paired": paired} | ({} if network is None else {"network": network.summary})


def _summarize_filter(score: FilterScore, independent: bool, floor: Array) -> dict[str, Any]:
    """Runs that are not ``independent``, for they replay the same fixes, have neither interval nor band."""
    surviving, fused = int(np.count_nonzero(np.isfinite(score.errors[:, -1, 0]))), int(score.fused.sum())
    interval = bootstrap_rms_interval(score.errors[:, -1])
    known = independent and np.isfinite(interval).all()
    pairs = zip(COLUMNS, interval.T, strict=True)
    return {
        **_named(score.rms[-1]),
        "ci95": {column: _plain(pair) for column, pair in pairs} if known else None,
        "over_bound": _plain_groups(rms_over(score.errors[:, -1], floor)),
        "window": _named(score.window_rms),
        "level_below_60_arcsec_s": score.time_below(slice(0, 2), LEVEL_LIMIT_ARCSEC),
        "heading_below_5_arcmin_s": score.time_below(slice(2, 3), HEADING_LIMIT_ARCMIN),
        "nees": _plain(score.mean_nees[-1]),
        "nees_band95": mean_band(3, surviving) if independent and surviving else None,
        "nees_outside": _plain(score.nees_outside) if independent else None,
        "nis": _plain(score.mean_nis),
        "nis_band95": mean_band(6, fused) if independent and fused else None,
        "fixes": {outcome.name.lower(): score.fix_outcomes[outcome] for outcome in FixOutcome},
        "restarts": score.restarts,
        "failed_runs": len(score.failures),
        "failures": {str(run_id): reason for run_id, reason in score.failures.items()},
    }


def _plain_groups(ratios: Mapping[str, Array]) -> dict[str, Any]:
    """Ratio, lower and upper end of its 95 % interval, by group."""
    return {name: _plain(ratio) for name, ratio in ratios.items()}


def manifest(name: str, scenario: Scenario, seed: int, runs: int, command: str) -> dict[str, Any]:
    """Content of `manifest.json`: all that is needed to do a run again."""
    return {
        "scenario": name,
        "scenario_sha256": scenario.digest,
        "seed": seed,
        "runs": runs,
        **surroundings(command),
        "content": scenario.model_dump(mode="json"),
    }


def surroundings(command: str) -> dict[str, Any]:
    """What a manifest says of the command, the time, the machine and the packages."""
    return {
        "command": command,
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "versions": {package: metadata.version(package) for package in _PACKAGES},
    }


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", "utf-8")


def write_flight(path: Path, flight: Flight) -> None:
    """Write a flight's truth and ideal increments as Parquet."""
    euler = attitude.to_euler(flight.q_nb) / DEG
    columns = {"time_s": flight.time, "lat_deg": flight.lla[:, 0] / DEG, "lon_deg": flight.lla[:, 1] / DEG}
    columns["height_m"] = flight.lla[:, 2]
    columns |= _columns(("v_north_mps", "v_east_mps", "v_down_mps"), flight.v_n)
    columns |= _columns(("roll_deg", "pitch_deg", "heading_deg"), euler)
    columns |= _columns(("dtheta_x_rad", "dtheta_y_rad", "dtheta_z_rad"), flight.dtheta_b)
    columns |= _columns(("dv_x_mps", "dv_y_mps", "dv_z_mps"), flight.dv_b)
    write_parquet(path, columns)


def write_parquet(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns by name, whole or not at all."""
    with whole_file(path) as partial:
        pq.write_table(pa.table(dict(columns)), partial, compression="zstd")


@contextmanager
def estimates_writer(path: Path, truth: Flight, vibration_mps: float) -> Iterator["EstimatesWriter"]:
    """Yields a writer of one or more runs; the file appears at the end, unless there was an exception."""
    with whole_file(path) as partial:
        writer = EstimatesWriter(partial, truth, vibration_mps)
        try:
            yield writer
            writer.flush()
        finally:
            writer.close()


class EstimatesWriter:
    """Streams the estimates of run after run into one Parquet file."""

    def __init__(self, path: Path, truth: Flight, vibration_mps: float) -> None:
        self._path, self._truth, self._vibration_mps = path, truth, vibration_mps
        self._tables: list[pa.Table] = []
        self._writer: pq.ParquetWriter | None = None

    def add(self, run: Run) -> None:
        """Append all estimates of one run."""
        for name, estimate in run.estimates.items():
            self._tables.append(self._table(run.run_id, name, estimate))
        if len(self._tables) >= _RUNS_PER_ROW_GROUP * len(run.estimates):
            self.flush()

    def _table(self, run_id: int, name: str, estimate: Estimate) -> pa.Table:  # pyright: ignore[reportUnknownParameterType]
        m = len(estimate.time)
        columns: dict[str, Any] = {
            "run": np.full(m, run_id, np.int32),
            "filter": pa.DictionaryArray.from_arrays(np.zeros(m, np.int8), [name]).cast(pa.string()),
            **navigation_columns(estimate),
        }
        columns |= _columns([f"error_{c}" for c in COLUMNS], errors_against(self._truth, estimate))
        columns |= _columns(
            [f"sd_{c}" for c in COLUMNS], standard_deviations(self._truth, estimate, self._vibration_mps)
        )
        return estimates_table(columns | bias_columns(estimate))

    def flush(self) -> None:
        """Write what was added."""
        if self._tables:
            table = pa.concat_tables(self._tables)
            if self._writer is None:
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="zstd")
            self._writer.write_table(table)
            self._tables.clear()

    def close(self) -> None:
        """End the file; what was not flushed is lost."""
        if self._writer is not None:
            self._writer.close()


def navigation_columns(estimate: Estimate) -> dict[str, Any]:
    """Time, status, position, velocity and attitude of `estimates.parquet`, (m,) each."""
    words = np.array([status.name.lower() for status in NavStatus])
    columns = {
        "time_s": estimate.time,
        "status": words[estimate.status],
        "jump_sigmas": estimate.jump,
        "lat_deg": estimate.lla[:, 0] / DEG,
        "lon_deg": estimate.lla[:, 1] / DEG,
        "height_m": estimate.lla[:, 2],
    }
    columns |= _columns(("v_north_mps", "v_east_mps", "v_down_mps"), estimate.v_n)
    return columns | _columns(
        ("roll_deg", "pitch_deg", "heading_deg"), attitude.to_euler(estimate.q_nb) / DEG
    )


def bias_columns(estimate: Estimate) -> dict[str, Any]:
    """Biases and delay of `estimates.parquet`, (m,) each."""
    columns = _columns([f"accel_bias_{a}_ug" for a in "xyz"], estimate.accel_bias / MICRO_G)
    columns |= _columns([f"gyro_bias_{a}_deg_h" for a in "xyz"], estimate.gyro_bias / DEG_PER_HOUR)
    return columns | {"delay_ms": estimate.delay / MILLISECOND}


def estimates_table(columns: dict[str, Any]) -> pa.Table:  # pyright: ignore[reportUnknownParameterType]
    """The columns as a table, NaN as null."""
    # Position and time need all digits; the rest is good to seven.
    exact = ("run", "filter", "status", "time_s", "lat_deg", "lon_deg", "height_m")
    arrays = {
        key: pa.array(value if key in exact else value.astype(np.float32), from_pandas=True)
        for key, value in columns.items()
    }
    return pa.table(arrays)


def _columns(names: Any, values: Array) -> dict[str, Array]:
    return dict(zip(names, values.T, strict=True))


def _plain(value: Any) -> Any:
    """Numbers that JSON can hold: NaN and infinity become null."""
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(v) for v in value]
    return float(value) if math.isfinite(value) else None


def _named(five: Array) -> dict[str, float | None]:
    return {column: _plain(value) for column, value in zip(COLUMNS, five, strict=True)}

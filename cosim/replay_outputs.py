"""The files that a replay leaves: `summary.json`, `manifest.json`, `estimates.parquet`."""

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..align.consistency import mean_band
from ..align.estimate import Array, Estimate, FixOutcome
from ..sins import attitude
from ..sins.error_model import ACCEL, GYRO
from ..sins.units import DEG, DEG_PER_HOUR, MICRO_G, MILLISECOND
from .files import whole_file
from .outputs import bias_columns, estimates_table, navigation_columns, surroundings
from .replay import COMPONENTS, Replay, attitude_sd
from .replay_map import ReplayMap

_SD = (
    *("sd_roll_deg", "sd_pitch_deg", "sd_heading_deg"),
    *(f"sd_{component}" for component in COMPONENTS),
    *(f"sd_accel_bias_{axis}_ug" for axis in "xyz"),
    *(f"sd_gyro_bias_{axis}_deg_h" for axis in "xyz"),
    "sd_delay_ms",
)


def summarize_replay(done: Replay) -> dict[str, Any]:
    """Content of `summary.json` of a replay."""
    settings, imu = done.settings, done.imu
    return _plain(
        {
            "title": settings.title,
            "duration_s": imu.time[-1] - imu.time[0],
            "imu": asdict(imu.base),
            "fixes": asdict(done.fix_base),
            "checks": done.checks,
            "initial": _initial(settings),
            "filters": {name: _summarize_filter(e) for name, e in done.estimates.items()},
        }
    )


def _initial(settings: ReplayMap) -> dict[str, Any] | None:
    """The attitude that the filters started from, in the sense of `sins.attitude`, None if there was none."""
    if settings.euler is None:
        return None
    return {
        **dict(zip(("roll_deg", "pitch_deg", "heading_deg"), settings.euler / DEG, strict=True)),
        **settings.settings.model_dump(include={"level_sd_deg", "heading_sd_deg"}),
        "convention": settings.convention,
    }


def _summarize_filter(estimate: Estimate) -> dict[str, Any]:
    fused, innovation = estimate.fused, estimate.innovation[estimate.fused]
    updates = int(np.count_nonzero(fused))
    return {
        "outcome": estimate.outcome.name.lower(),
        "updates": updates,
        "nis": np.mean(estimate.nis[fused]) if updates else None,
        "nis_band95": mean_band(6, updates) if updates else None,
        "fixes": {outcome.name.lower(): estimate.count(outcome) for outcome in FixOutcome},
        "held_imu_samples": estimate.held_imu_samples,
        "innovations": {
            name: {"mean": np.mean(v), "rms": np.sqrt(np.mean(v**2)), "correlation_of_next": _next(v)}
            for name, v in zip(COMPONENTS, innovation.T, strict=True)
        }
        if updates
        else None,
        "final": {"time_s": estimate.time[-1], **final_state(estimate)},
    }


def _next(values: Array) -> float | None:
    """Correlation of each value with the one after it: zero for a filter that makes the most of its fixes."""
    values = values - np.mean(values)
    power = float(values @ values)
    return float(values[1:] @ values[:-1]) / power if power > 0 else None


def final_state(estimate: Estimate) -> dict[str, dict[str, float]]:
    """Value and standard deviation of attitude, biases and delay at the end, in the reader's units."""
    angles = attitude.to_euler(estimate.q_nb[-1]) / DEG
    rows: dict[str, tuple[float, float]] = {}
    for name, value, sd in zip(("roll", "pitch", "heading"), angles, attitude_sd(estimate)[-1], strict=True):
        rows[f"{name}_deg"] = value, sd / DEG
    for kind, unit, bias, part in (
        ("accel_bias_{}_ug", MICRO_G, estimate.accel_bias, ACCEL),
        ("gyro_bias_{}_deg_h", DEG_PER_HOUR, estimate.gyro_bias, GYRO),
    ):
        for axis, value, sd in zip("xyz", bias[-1] / unit, estimate.sd[-1, part] / unit, strict=True):
            rows[kind.format(axis)] = value, sd
    if estimate.sd[-1, GYRO.stop] > 0:
        rows["delay_ms"] = estimate.delay[-1] / MILLISECOND, estimate.sd[-1, GYRO.stop] / MILLISECOND
    return {name: {"value": value, "sd": sd} for name, (value, sd) in rows.items()}


def _plain(value: Any) -> Any:
    """Numbers that JSON can hold: what is not finite becomes null."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.floating | float):
        return float(value) if np.isfinite(value) else None
    return value


def replay_manifest(done: Replay, command: str) -> dict[str, Any]:
    """Content of `manifest.json`: all that is needed to do a replay again."""
    return {
        **surroundings(command),
        "files_sha256": {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in done.files},
        "content": done.settings.model_dump(mode="json"),
    }


def write_replay_estimates(path: Path, done: Replay) -> None:
    """Write the histories of all filters as Parquet, with their standard deviations."""
    tables = []
    for name, e in done.estimates.items():
        sd = dict(zip(_SD, _deviations(e).T, strict=True))
        columns = {"filter": np.full(len(e.time), name), **navigation_columns(e), **bias_columns(e), **sd}
        tables.append(estimates_table(columns))
    with whole_file(path) as partial:
        pq.write_table(pa.concat_tables(tables), partial, compression="zstd")


def _deviations(estimate: Estimate) -> Array:
    """Standard deviations, (m, 16), in the order and the units of `_SD`."""
    sd = estimate.sd
    parts = (
        attitude_sd(estimate) / DEG,
        sd[:, : len(COMPONENTS)],
        sd[:, ACCEL] / MICRO_G,
        sd[:, GYRO] / DEG_PER_HOUR,
        sd[:, [GYRO.stop]] / MILLISECOND,
    )
    return np.hstack(parts)

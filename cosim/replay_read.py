"""Reads a recording's two files into what the filters take: increments in FRD, fixes in NED, SI units."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..network.fixes import Fixes, read_fixes
from ..network.tables import check_range, read_columns
from .replay_map import (
    ANGLE_UNITS,
    SPEED_UNITS,
    TIME_UNITS,
    TO_FRD,
    TO_NED,
    Array,
    FixColumns,
    Recorded,
    ReplayError,
)
from .replay_time import TimeBase, in_order, of_fixes, uniform

_HEIGHT_M = -1e4, 1e6
_SPEED_MPS = 1e4
_TIME_S = 1e12
_SENSED = 1e12
"""Of an IMU, in whatever unit: what is beyond overflows in sums."""
_DEVIATION = 1e9


@dataclass(frozen=True)
class RecordedImu:
    """Increments over the intervals that end at ``time`` (n,) s: ``dtheta_b`` rad, ``dv_b`` m/s, (n, 3), FRD.

    Rows that were missing or not finite are NaN; row 0 has no interval.
    """

    time: Array
    dtheta_b: Array
    dv_b: Array
    base: TimeBase


def read_imu(file: Path, recorded: Recorded, from_s: float | None) -> RecordedImu:
    """The IMU's file, from ``from_s`` on. Raises `TableError` and `ReplayError`."""
    layout = recorded.imu
    sensors = (*layout.gyro, *layout.accel)
    columns = read_columns(file, (layout.time, *sensors), may_lack=sensors)
    time = columns[layout.time] * TIME_UNITS[layout.time_unit]
    check_range(file, layout.time, time, -_TIME_S, _TIME_S)
    units = np.repeat([layout.gyro_units[layout.gyro_unit], layout.accel_units[layout.accel_unit]], 3)
    for name in sensors:
        _check_finite_range(file, name, columns[name], -_SENSED, _SENSED)
    values = np.column_stack([columns[name] for name in sensors]) * units
    time, values, base = uniform(file, time, values, recorded, from_s)
    if layout.kind == "samples":
        values[1:] = 0.5 * (values[1:] + values[:-1])
    if layout.kind != "increments":
        values *= np.diff(time, prepend=time[0])[:, None]
    values[0] = 0.0
    to_frd = TO_FRD[layout.axes].T
    return RecordedImu(time, values[:, :3] @ to_frd, values[:, 3:] @ to_frd, base)


def read_recorded_fixes(file: Path, recorded: Recorded) -> tuple[Fixes, TimeBase]:
    """The file of fixes, in order of arrival. Raises `TableError` and `ReplayError`."""
    layout = recorded.fixes
    if layout is None:
        fixes, moved, repeated = read_fixes(file), 0, 0
        rows = len(fixes)
    else:
        fixes, moved, repeated = _mapped(file, layout, recorded.backward_limit_s)
        rows = len(fixes) + repeated
    if len(fixes) < 2:
        raise ReplayError(f"{file}: {len(fixes)} fixes; allowed is 2 or more")
    content = np.hstack([fixes.lla, fixes.v_n, fixes.cov.reshape(len(fixes), 36)])
    return fixes, of_fixes(rows, fixes.t_arrival, content, moved, repeated)


def _mapped(file: Path, layout: FixColumns, limit_s: float) -> tuple[Fixes, int, int]:
    position = (layout.latitude, layout.longitude, layout.height)
    deviations = (*(layout.position_sd or ()), *(layout.velocity_sd or ()))
    content = (*position, *layout.velocity, *deviations)
    times = (layout.time, layout.arrival or layout.time)
    numbers = tuple(name for name in (layout.source, layout.sequence) if name)
    columns = read_columns(file, dict.fromkeys((*times, *content, *numbers)), may_lack=content)
    stamp, arrival = (columns[name] * TIME_UNITS[layout.time_unit] for name in times)
    for name, values in zip(times, (stamp, arrival), strict=True):
        check_range(file, name, values, -_TIME_S, _TIME_S)
    for name in numbers:
        check_range(file, name, columns[name], 0.0, 2.0**53)
    # What all rows hold makes a repeat; a file with numbers leaves repeats to the filter.
    everything = np.column_stack([columns[name] for name in (*times, *content)])
    rows, moved, repeated = in_order(file, arrival, everything, limit_s, drop_repeats=not layout.sequence)

    columns = {name: values[rows] for name, values in columns.items()}
    angle, speed, k = ANGLE_UNITS[layout.angle_unit], SPEED_UNITS[layout.velocity_unit], len(rows)
    lla = np.column_stack([columns[name] for name in position]) * [angle, angle, 1.0]
    _check_position(file, layout, lla)
    v_n = np.column_stack([columns[name] for name in layout.velocity]) * speed @ TO_NED[layout.axes].T
    _check_finite_range(file, ", ".join(layout.velocity), v_n, -_SPEED_MPS, _SPEED_MPS)
    for name in deviations:
        _check_finite_range(file, name, columns[name], 0.0, _DEVIATION)
    sd = np.empty((k, 6))
    for part, names, number, unit in (
        (slice(0, 3), layout.position_sd, layout.position_sd_m, 1.0),
        (slice(3, 6), layout.velocity_sd, layout.velocity_sd_mps, speed),
    ):
        stated = (
            np.column_stack([columns[name] for name in names]) * unit if names else np.full((k, 3), number)
        )
        sd[:, part] = stated @ np.abs(TO_NED[layout.axes]).T
    cov = np.zeros((k, 6, 6))
    np.einsum("kii->ki", cov)[:] = sd**2
    source = columns[layout.source] if layout.source else np.zeros(k)
    sequence = columns[layout.sequence] if layout.sequence else np.arange(k)
    fixes = Fixes(
        t_valid=stamp[rows],
        t_stamp=stamp[rows],
        t_arrival=arrival[rows],
        lla=lla,
        v_n=v_n,
        cov=cov,
        source=source.astype(np.int64),
        sequence=sequence.astype(np.int64),
    )
    return fixes, moved, repeated


def _check_position(file: Path, layout: FixColumns, lla: Array) -> None:
    """Raise `ReplayError` for angles and heights beyond the earth's."""
    for name, values, limit in (
        (layout.latitude, lla[:, 0], 0.5 * np.pi),
        (layout.longitude, lla[:, 1], 2 * np.pi),
    ):
        beyond = np.abs(values) > limit
        if beyond.any():
            row, unit = int(np.argmax(beyond)), ANGLE_UNITS[layout.angle_unit]
            other = "; it fits recorded.fixes.angle_unit = deg" if layout.angle_unit == "rad" else ""
            raise ReplayError(
                f"{file}, column {name}, fix {row + 1}: {values[row] / unit:.8g} {layout.angle_unit}: "
                f"allowed is {-limit / unit:.6g} to {limit / unit:.6g} {layout.angle_unit}{other}"
            )
    _check_finite_range(file, layout.height, lla[:, 2], *_HEIGHT_M)


def _check_finite_range(file: Path, column: str, values: Array, low: float, high: float) -> None:
    """Raise `ReplayError` for a value outside; what is not finite is the filter's to leave out."""
    outside = (values < low) | (values > high)
    if outside.any():
        worst = values[outside][0]
        raise ReplayError(f"{file}, column {column}: {worst:.8g} is not allowed ({low:g} to {high:g})")

"""Whether a recording is what its map says, seen by magnitude and by physics.

Gravity tells the unit of the accelerometers, the course the unit and the sense of the gyros, and the way from
fix to fix the units and the axes of the fixes. What moves too little to tell is passed over.
"""

from pathlib import Path

import numpy as np

from ..network.fixes import Fixes
from ..sins import attitude
from ..sins.units import DEG
from .replay_fix_checks import FACTOR, check_displacement
from .replay_map import (
    FORCE_UNITS,
    GAINED_UNITS,
    Array,
    FixColumns,
    ImuColumns,
    Recorded,
    ReplayError,
)
from .replay_read import RecordedImu

SPECIFIC_FORCE_MPS2 = 5.0, 30.0
"""Median that a vehicle on or over the earth has."""
RATE_RAD_S = 1e-6, 10.0
"""Root mean square: far below the earth's rate, and 1.6 turns a second."""
LEAST_SPEED_MPS, LEAST_TURN = 3.0, 10 * DEG
TURN_S, LEAN_S = 2.0, 0.5
"""Lengths of the pieces over which turns are compared."""
MOST_TILT = 60 * DEG
"""What the specific force may lie from the vertical at the start."""


def check_imu(file: Path, imu: RecordedImu, layout: ImuColumns) -> dict[str, float]:
    """Specific force and turning rate. Raises `ReplayError`, one line that names the unit that fits."""
    dt = imu.base.interval_s
    second = max(1, round(1 / dt))
    means = [
        np.linalg.norm(np.nanmean(part, axis=0)) / dt
        for part in np.array_split(imu.dv_b[1:], max(1, len(imu.dv_b) // second))
        if np.isfinite(part).any()
    ]
    force = float(np.median(means)) if means else np.nan
    rate = float(np.sqrt(np.nanmean(np.sum(imu.dtheta_b[1:] ** 2, axis=1)))) / dt
    if not SPECIFIC_FORCE_MPS2[0] <= force <= SPECIFIC_FORCE_MPS2[1]:
        raw = force / layout.accel_units[layout.accel_unit] * (dt if layout.kind == "increments" else 1.0)
        fitting = [
            f"kind = {kind}, accel_unit = {unit}"
            for kind, units, per_s in (("increments", GAINED_UNITS, 1 / dt), ("rates", FORCE_UNITS, 1.0))
            for unit, factor in units.items()
            if 7 <= raw * factor * per_s <= 14
        ]
        stated = f"{layout.kind} in {layout.accel_unit}"
        raise _misfit(
            file, layout.accel, "specific force", force, "m/s^2", stated, SPECIFIC_FORCE_MPS2, fitting
        )
    if not RATE_RAD_S[0] <= rate <= RATE_RAD_S[1]:
        units = layout.gyro_units
        raw = rate / units[layout.gyro_unit]
        fitting = [f"gyro_unit = {unit}" for unit, factor in units.items() if 3e-4 <= raw * factor <= 3]
        stated = f"{layout.kind} in {layout.gyro_unit}"
        raise _misfit(file, layout.gyro, "turning rate", rate, "rad/s", stated, RATE_RAD_S, fitting)
    return {"specific_force_mps2": force, "turning_rate_deg_s": rate / DEG}


def check_together(
    files: tuple[Path, Path], imu: RecordedImu, fixes: Fixes, recorded: Recorded
) -> dict[str, float | None]:
    """Fixes against the IMU's time, gyros and themselves; None for what could not be told.

    Raises `ReplayError`, one line.
    """
    start, end = imu.time[0], imu.time[-1]
    inside = (fixes.t_arrival >= start) & (fixes.t_arrival <= end)
    if np.count_nonzero(inside) < 2:
        raise ReplayError(
            f"{files[1]}: {np.count_nonzero(inside)} fixes between {start:.10g} and {end:.10g} s, the time "
            f"of {files[0]}; allowed is 2 or more; the fixes are from {fixes.t_arrival.min():.10g} to "
            f"{fixes.t_arrival.max():.10g} s"
        )
    source, count = np.unique(fixes.source, return_counts=True)
    busiest = fixes.t_stamp[fixes.source == source[np.argmax(count)]]
    step = float(np.median(np.diff(np.unique(busiest)))) if len(np.unique(busiest)) > 1 else np.inf
    if step < 0.5 * imu.base.interval_s:
        raise ReplayError(
            f"{files[1]}: {step:.3g} s between fixes: allowed is the interval of the IMU or more, "
            f"{imu.base.interval_s:.3g} s; see recorded.fixes.time_unit"
        )
    usable = fixes[inside & np.isfinite(fixes.lla).all(axis=1) & np.isfinite(fixes.v_n).all(axis=1)]
    usable = usable[np.argsort(usable.t_stamp, kind="stable")]
    usable = usable[np.diff(usable.t_stamp, prepend=-np.inf) > 0]
    layout = recorded.fixes or FixColumns(position_sd_m=1.0, velocity_sd_mps=1.0)
    return {
        "displacement_over_velocity": check_displacement(files[1], usable, layout),
        "turn_over_lean": _lean(files[0], imu, recorded.imu),
        "turn_over_course": _course(files[0], imu, usable, recorded.imu),
    }


def check_upright(file: Path, imu: RecordedImu, q_nb: Array, layout: ImuColumns) -> float:
    """Angle of the first second's specific force from the vertical, rad, by the initial attitude ``q_nb``.

    Raises `ReplayError` where it is large: the axes are others, or the attitude is.
    """
    second = slice(1, 1 + max(1, round(1 / imu.base.interval_s)))
    gained = np.nansum(imu.dv_b[second], axis=0)
    up = -attitude.rotate(q_nb, gained)[2] / max(float(np.linalg.norm(gained)), 1e-12)
    tilt = float(np.arccos(np.clip(up, -1, 1)))
    if tilt > MOST_TILT:
        raise ReplayError(
            f"{file}, columns {', '.join(layout.accel)}: by the initial attitude the specific force points "
            f"{tilt / DEG:.0f} deg from the vertical: allowed is {MOST_TILT / DEG:.0f} deg; see "
            f"recorded.imu.axes = {layout.axes} and the initial attitude"
        )
    return tilt


def course_offset(fixes: Fixes, heading: float) -> float | None:
    """Heading minus course of the first moving fix, rad, or None: it should be small, but need not."""
    moving = np.flatnonzero(np.linalg.norm(fixes.v_n[:, :2], axis=1) > LEAST_SPEED_MPS)
    if len(moving) == 0:
        return None
    north, east = fixes.v_n[moving[0], :2]
    return float(attitude.wrapped(heading - np.arctan2(east, north)))


def _course(file: Path, imu: RecordedImu, fixes: Fixes, layout: ImuColumns) -> float | None:
    """Turn by the gyros about the vertical over the change of course."""
    moving = np.linalg.norm(fixes.v_n[:, :2], axis=1) > LEAST_SPEED_MPS
    if np.count_nonzero(moving) < 3 or not moving.mean() > 0.5:
        return None
    fixes = fixes[moving]
    edges = np.arange(fixes.t_stamp[0], fixes.t_stamp[-1], TURN_S)
    course = np.interp(edges, fixes.t_stamp, np.unwrap(np.arctan2(fixes.v_n[:, 1], fixes.v_n[:, 0])))
    turned, gained = _between(imu, edges)
    turn = -np.sum(turned * _unit(gained), axis=1)
    return _told_by(file, layout, turn, np.diff(course), "change of course")


def _lean(file: Path, imu: RecordedImu, layout: ImuColumns) -> float | None:
    """Turn by the gyros over the turn of the specific force in b, which stays near the vertical."""
    edges = np.arange(imu.time[0], imu.time[-1], LEAN_S)
    turned, gained = _between(imu, edges)
    force = _unit(gained)
    between = 0.5 * (turned[1:] + turned[:-1])
    expected = -np.cross(between, 0.5 * (force[1:] + force[:-1]))
    return _told_by(file, layout, expected, np.diff(force, axis=0), "turn of the specific force")


def _between(imu: RecordedImu, edges: Array) -> tuple[Array, Array]:
    """Sums of the increments between times, (m - 1, 3) each."""
    rows = np.searchsorted(imu.time, edges)
    sums = (
        np.vstack([np.zeros(3), np.cumsum(np.nan_to_num(part), axis=0)]) for part in (imu.dtheta_b, imu.dv_b)
    )
    turned, gained = (np.diff(total[rows], axis=0) for total in sums)
    return turned, gained


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _told_by(file: Path, layout: ImuColumns, turn: Array, reference: Array, what: str) -> float | None:
    """Size of the gyros' turn over that of the reference, (m,) or (m, 3), where the two go together."""
    if len(turn) < 5:
        return None
    # Without their means, which hold a gyro's bias.
    turn, reference = (a - a.mean(axis=0) for a in (turn, reference))
    size, length = float(np.linalg.norm(turn)), float(np.linalg.norm(reference))
    if length < LEAST_TURN or size == 0.0:
        return None
    correlation, ratio = float(np.sum(turn * reference)) / size / length, size / length
    if abs(correlation) < 0.8:
        return None
    columns = f"{file}, columns {', '.join(layout.gyro)}"
    if correlation < 0:
        raise ReplayError(
            f"{columns}: the gyros turn against the {what}, correlation {correlation:.2f}: allowed is a "
            f"positive one; see recorded.imu.axes = {layout.axes}"
        )
    if not 1 / FACTOR < ratio < FACTOR:
        units = layout.gyro_units
        fitting = [
            f"gyro_unit = {unit}"
            for unit, factor in units.items()
            if 1 / FACTOR < ratio * factor / units[layout.gyro_unit] < FACTOR
        ]
        stated, limits = f"{layout.kind} in {layout.gyro_unit}", (1 / FACTOR, FACTOR)
        raise _misfit(file, layout.gyro, f"turn over {what}", ratio, "", stated, limits, fitting)
    return ratio


def _misfit(
    file: Path,
    columns: tuple[str, ...],
    what: str,
    value: float,
    unit: str,
    stated: str,
    limits: tuple[float, float],
    fitting: list[str],
) -> ReplayError:
    hint = f"; it fits {' or '.join(fitting)}" if fitting else ""
    low, high = limits
    return ReplayError(
        f"{file}, columns {', '.join(columns)}: {what} {value:.3g} {unit} as {stated}: "
        f"allowed is {low:.2g} to {high:.3g} {unit}".rstrip()
        + hint
    )

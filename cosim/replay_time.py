"""The time base of a recording: what is wrong with it is refused with its row, or mended and counted."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..align.clock import rows_of
from .replay_map import TIME_UNITS, Recorded, ReplayError

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

INTERVAL_S = 2e-4, 0.2
"""Between the samples of an IMU: what lies outside is a wrong unit of time."""
LEAST_ROWS = 10
_ROUNDING_S = 1e-6
_MOST_INSERTED = 20
"""Rows in gaps for each row of the file: many gaps, each within its limit, would fill the memory."""


@dataclass(frozen=True)
class TimeBase:
    """What was found in one file, and what was done about it."""

    rows: int
    interval_s: float
    """Median time between rows."""
    jitter_s: float
    """Greatest distance of an interval from the median, gaps left out. Times are kept as recorded."""
    moved_rows: int
    """Out of order, and put in their place."""
    repeated_rows: int
    """Equal to another row in time and values, and dropped."""
    not_finite_rows: int
    """With an empty cell, a NaN or an infinity in them."""
    gaps: int
    inserted_rows: int
    """Empty rows that fill the gaps of an IMU, so that the base is uniform again."""
    longest_gap_s: float
    """Longest time without a finite row."""
    unused_rows: int = 0
    """Before the time of the initial attitude."""


def in_order(
    file: Path, time: Array, values: Array, limit_s: float, drop_repeats: bool
) -> tuple[Rows, int, int]:
    """Rows to keep, in order of time; how many were moved; how many were dropped as exact repeats.

    Parameters: ``time`` (n,) s, finite; ``values`` (n, c). Raises `ReplayError` where time goes back by more
    than ``limit_s``.
    """
    latest = np.maximum.accumulate(time)
    back = latest - time
    too_far = back > limit_s + _ROUNDING_S
    if too_far.any():
        row = int(np.argmax(too_far))
        raise ReplayError(
            f"{file}, row {row + 1}: time goes back from {latest[row]:.10g} s to {time[row]:.10g} s; "
            f"allowed is {limit_s:g} s (recorded.backward_limit_s)"
        )
    rows = np.argsort(time, kind="stable")
    moved = int(np.count_nonzero(back > 0))
    if not drop_repeats or (np.diff(time[rows]) > 0).all():
        return rows, moved, 0
    # Equal times stand together, but repeats among them need not be neighbours.
    _, first = np.unique(np.column_stack([time, np.nan_to_num(values, nan=np.pi)]), axis=0, return_index=True)
    kept = np.isin(rows, first)
    return rows[kept], moved, int(np.count_nonzero(~kept))


def uniform(
    file: Path, time: Array, values: Array, recorded: Recorded, from_s: float | None
) -> tuple[Array, Array, TimeBase]:
    """Time and values of an IMU with gaps filled by rows of NaN; nothing is resampled.

    `align.filters.align` needs a time that increases and is uniform to about half an interval: an
    increment belongs to the whole interval before its row, and windows and horizons count rows.

    Parameters: ``time`` (n,) s, ``values`` (n, c). Raises `ReplayError`: goes back too far, two rows at one
    time that differ, an interval that no IMU has, rows too close, too long a stretch without samples.
    """
    n = len(time)
    rows, moved, repeated = in_order(file, time, values, recorded.backward_limit_s, drop_repeats=True)
    time, values, unused = time[rows], values[rows], 0
    if len(time) < LEAST_ROWS:
        raise ReplayError(f"{file}: {len(time)} rows; allowed is {LEAST_ROWS} or more")
    step = np.diff(time)
    dt = float(np.median(step))
    _check_interval(file, dt, recorded.imu.time_unit)
    too_close = np.flatnonzero(step < 0.5 * dt)
    if len(too_close):
        at = int(too_close[0])
        lone = "with other values" if step[at] == 0 else f"{step[at]:.3g} s after the one before"
        raise ReplayError(
            f"{file}, row {rows[at + 1] + 1}: a row at {time[at + 1]:.10g} s, {lone}; "
            f"allowed is {0.5 * dt:.3g} s or more, half the interval"
        )
    if from_s is not None:
        unused = int(np.count_nonzero(time < from_s - 0.5 * dt))
        if len(time) - unused < LEAST_ROWS:
            raise ReplayError(f"{file}: initial.time_s = {from_s:.10g} s: the file ends at {time[-1]:.10g} s")
        time, values, step = time[unused:], values[unused:], step[unused:]
    place = rows_of(time)
    intervals = np.diff(place)
    missing = int(place[-1]) - len(step)
    longest = float(step.max()) if missing else 0.0
    if longest > recorded.gap_limit_s + 1.5 * dt:
        # Before the filling: a jump of years would fill the memory.
        raise _no_samples(file, float(time[np.argmax(step)]), longest, recorded)
    if missing > _MOST_INSERTED * n:
        raise ReplayError(f"{file}: {missing} rows are missing among {n}: allowed are {_MOST_INSERTED * n}")
    filled = np.full((place[-1] + 1, values.shape[1]), np.nan)
    filled[place] = values
    new_time = np.interp(np.arange(len(filled)), place, time)
    bad = np.isnan(filled.sum(axis=1))
    start, length = _longest_run(bad)
    if length * dt > recorded.gap_limit_s:
        raise _no_samples(file, float(new_time[start]), length * dt, recorded)
    base = TimeBase(
        rows=n,
        interval_s=dt,
        jitter_s=float(np.abs(step / intervals - dt).max()),
        moved_rows=moved,
        repeated_rows=repeated,
        not_finite_rows=int(np.count_nonzero(~np.isfinite(values).all(axis=1))),
        gaps=int(np.count_nonzero(intervals > 1)),
        inserted_rows=missing,
        longest_gap_s=length * dt,
        unused_rows=unused,
    )
    return new_time, filled, base


def of_fixes(n: int, time: Array, values: Array, moved: int, repeated: int) -> TimeBase:
    """What there is to tell of fixes at ``time`` (k,) s, of ``n`` rows of a file; none of it is mended."""
    finite = np.isfinite(values).all(axis=1)
    step = np.diff(time)
    dt = float(np.median(step)) if len(step) else 0.0
    gap = step > 1.5 * dt
    good = np.diff(time[finite])
    return TimeBase(
        rows=n,
        interval_s=dt,
        jitter_s=float(np.abs(step[~gap] - dt).max()) if len(step[~gap]) else 0.0,
        moved_rows=moved,
        repeated_rows=repeated,
        not_finite_rows=int(np.count_nonzero(~finite)),
        gaps=int(np.count_nonzero(gap)),
        inserted_rows=0,
        longest_gap_s=float(good.max()) if len(good) else 0.0,
    )


def _check_interval(file: Path, dt: float, unit: str) -> None:
    low, high = INTERVAL_S
    if low <= dt <= high:
        return
    fitting = {other: dt / TIME_UNITS[unit] * factor for other, factor in TIME_UNITS.items()}
    other = [f"{name} ({value:g} s)" for name, value in fitting.items() if low <= value <= high]
    hint = f"; it fits recorded.imu.time_unit = {' or '.join(other)}" if other else ""
    raise ReplayError(
        f"{file}: {dt:g} s between samples with time_unit = {unit}: allowed is {low:g} to {high:g} s{hint}"
    )


def _no_samples(file: Path, at: float, length: float, recorded: Recorded) -> ReplayError:
    return ReplayError(
        f"{file}: no samples for {length:.3g} s from {at:.10g} s; "
        f"allowed is {recorded.gap_limit_s:g} s (recorded.gap_limit_s)"
    )


def _longest_run(bad: NDArray[np.bool_]) -> tuple[int, int]:
    """Start and length of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2]
    if len(lengths) == 0:
        return 0, 0
    longest = int(np.argmax(lengths))
    return int(starts[longest]), int(lengths[longest])

"""The time base of a record of the IMU: which time stamps are right, and which samples are missing.

The samples are the clock: they come at a constant rate. By how many samples a stamp is ahead of that, its
level, rises where samples are missing, stays through jitter, and goes nowhere else. So a stamp is right if
those after it agree with its level; one that is ahead of those that follow, or behind those before, is not.
Jitter is rounded against the phase of the stamps about it, and not interval by interval: a stamp that is late
by more than half an interval is no missing sample.

Where it is known when time begins, and so where the attitude at the start belongs, samples that are missing
there are missing, and a clock that is wrong from then on is waited for; else the first of them are right.

What cannot be told: a clock that steps forward for good looks like missing samples.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .estimate import Array

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

AGREEING = 201
"""Samples, from a stamp on, of which the most must agree with it."""
PHASE_WINDOW = 101
"""Samples over which jitter is averaged."""
FIRST = 11
"""Samples of which the most tell where time begins."""
MOST_FILLED = 1_000_000
"""Rows that a gap may be filled with; a stamp beyond is refused."""


class TimeBase(NamedTuple):
    """Rows of one interval each, and the samples that belong to them."""

    time: Array
    """(m,) s, increasing."""
    interval_s: float
    taken: Mask
    """(n,) of the samples, whether its stamp is right."""
    row: Integers
    """(j,) of those, where they belong."""
    refused: Mask
    """(m,) rows that have no sample, for it was refused."""


def time_base(time: Array, increments: Array, span_s: tuple[float, float] | None = None) -> TimeBase:
    """Parameters: ``time`` (n,) s, as stamped; ``increments`` (n, 6), by which copies are told; ``span_s``,
    from when to when there should be samples: without it time begins as the first of them tell.

    Raises ValueError for fewer than two rows in order of time.
    """
    n = len(time)
    finite = np.isfinite(time)
    every = bool(finite.all())
    step = np.diff(time) if every else np.diff(time[finite])
    forward = step[step > 0]
    if len(forward) == 0:
        raise ValueError("time must increase, over two rows or more")
    # The mean is found sooner; where a sample is missing or too many, some interval is not near it.
    dt = float(forward.mean())
    even = every and len(forward) == len(step) and 0.8 * dt < step.min() and step.max() < 1.2 * dt
    if not even:
        dt = float(np.median(forward))
        even = every and len(forward) == len(step) and step.max() < 1.5 * dt
    start = None if span_s is None else span_s[0]
    if even and (start is None or abs(time[0] - start) < 0.5 * dt):
        taken, row, new_time = np.ones(n, bool), np.arange(n), time
        without = np.zeros(n, bool)
    else:
        dt = _interval(time[finite], dt)
        taken, row, new_time, without = _restored(time, finite, increments, dt, start)
    if span_s is not None:
        lacking = (span_s[1] - new_time[-1]) / dt + 0.25  # the last may be early
        more = int(min(max(lacking, 0.0), MOST_FILLED))
        new_time = np.append(new_time, new_time[-1] + dt * np.arange(1, more + 1)) if more else new_time
        without = np.append(without, np.zeros(more, bool)) if more else without
    return TimeBase(new_time, dt, taken, row, without)


def rows_of(time: Array) -> Integers:
    """Rows, (n,) from 0 on, of one interval each, of stamps (n,) s that increase and are all to be kept."""
    n, step = len(time), np.diff(time)
    dt = float(np.median(step))
    if step.max() < 1.5 * dt:
        return np.arange(n)
    taken, row = levels(ahead_of_count(time, np.arange(n), _interval(time, dt))[0], np.arange(n))
    if not taken.all():  # not those of one clock: each interval for itself
        row = np.concatenate([[0], np.cumsum(np.maximum(np.rint(step / dt), 1.0))]).astype(np.int64)
    return row - row[0]


def levels(ahead: Array, count: Integers, level: float | None = None) -> tuple[Mask, Integers]:
    """Which samples to take, and their rows; the rows of others mean nothing.

    Parameters: ``ahead`` (n,) and ``count`` (n,): by how many intervals each stamp is ahead of its count, and
    that count, which increases; ``level`` of the start, where it is known: no row is before it.
    """
    taken, row = np.ones(len(ahead), bool), np.zeros(len(ahead), np.int64)
    before = -(2**62) if level is None else -1
    level = float(np.median(ahead[:FIRST])) if level is None else level
    changes = np.flatnonzero(ahead != level)
    first = int(changes[0]) if len(changes) else len(ahead)
    row[:first] = count[:first] + int(level)
    last = int(row[first - 1]) if first else before
    for k in range(first, len(ahead)):
        if ahead[k] > level or ahead[k] == level - 1:
            of_most = float(np.median(ahead[k : k + AGREEING]))
            if ahead[k] > level:
                level = max(level, min(ahead[k], np.floor(of_most)))
            elif of_most < level:
                level -= 1  # one sample more than there should be
        place = int(count[k] + level)
        taken[k] = abs(ahead[k] - level) <= 1 and place > last
        if taken[k]:
            row[k], last = place, place
    return taken, row


def ahead_of_count(time: Array, count: Integers, dt: float) -> tuple[Array, Array]:
    """By how many intervals stamps (n,), s, are ahead of their count, (n,), and the time, (n,) s, at which
    each row would be stamped but for jitter, less ``dt`` times the row; rows as `levels` has them."""
    reference = float(np.median(time))
    u = np.clip((time - reference) / dt, -1e12, 1e12)
    turn = np.exp(2j * np.pi * (u - np.rint(u)))
    summed = np.concatenate([[0.0], np.cumsum(turn)])
    half = PHASE_WINDOW // 2
    at = np.arange(len(u))
    mean = summed[np.minimum(at + half + 1, len(u))] - summed[np.maximum(at - half, 0)]
    phase = np.unwrap(np.angle(mean)) / (2 * np.pi)
    return np.rint(u - phase - count), reference + dt * phase


def _interval(time: Array, dt: float) -> float:
    """The interval, s, of stamps (n,) from a rough one: over single intervals, then over many, of which
    jitter is a small part."""
    for lag in (1, 20, 200):
        if len(time) > 2 * lag:
            span = time[lag:] - time[:-lag]
            intervals = np.rint(np.clip(span / dt, 0, 3 * lag))
            close = (intervals > 0) & (np.abs(span - intervals * dt) < 0.5 * dt)
            if lag == 1:
                close &= intervals == 1
            dt = float((span[close] / intervals[close]).mean()) if close.any() else dt
    return dt


def _restored(
    time: Array, finite: Mask, increments: Array, dt: float, start: float | None
) -> tuple[Mask, Integers, Array, Mask]:
    """`TimeBase.taken`, `row`, `time` to the last stamp, and `refused`, of stamps that are not even or do not
    begin at the start."""
    taken, row, count, zero = _placed(time, finite, increments, dt, start)
    if len(row) < 2:
        if start is None:
            raise ValueError("time must increase, over two rows or more")
        rows = int(count[-1]) + 1
        new_time = np.linspace(start, start + dt * count[-1], rows)
        return np.zeros(len(time), bool), row[:0], new_time, np.ones(rows, bool)
    # Samples that were refused at either end have had their time all the same.
    before, after = int(count[taken][0]), int(count[-1] - count[taken][-1])
    if start is None:
        row = row - row[0] + before
    new_time = _filled(_even(time[taken], row, zero, dt), row, row[-1] + 1 + after, dt)
    between = np.diff(np.flatnonzero(taken)) > 1
    refused = np.repeat([before > 0, *between, True], np.diff(row, prepend=-1, append=len(new_time) - 1))
    refused[row] = False
    return taken, row, new_time, refused


def _placed(
    time: Array, finite: Mask, increments: Array, dt: float, start: float | None
) -> tuple[Mask, Integers, Integers, Array]:
    """Samples to take (n,), the rows of those (j,), counts of all (n,), and for those the time, (j,) s, of
    row 0 by their phase."""
    copy = np.zeros(len(time), bool)
    numbers = np.flatnonzero(finite)
    copy[numbers[1:]] = np.diff(time[numbers]) == 0  # a copy takes no time
    order = numbers[np.argsort(time[numbers], kind="stable")]
    alike = np.flatnonzero(np.diff(time[order]) == 0)
    same = (increments[order[alike]] == increments[order[alike + 1]]).all(axis=1)
    copy[order[alike[same] + 1]] = True
    count = np.cumsum(~copy) - 1
    numbers = np.flatnonzero(finite & ~copy)
    ahead, zero = ahead_of_count(time[numbers], count[numbers], dt)
    begins = ahead if start is None else np.rint((start - zero) / dt)
    base = np.median(begins[:FIRST])
    ahead = np.clip(ahead - base, -MOST_FILLED - 1.0, MOST_FILLED + 1.0)
    ahead[ahead > MOST_FILLED] = -MOST_FILLED  # no gap is as long
    good, row = levels(ahead, count[numbers], None if start is None else 0.0)
    taken = np.zeros(len(time), bool)
    taken[numbers[good]] = True
    return taken, row[good], count, (zero + dt * base)[good]


def _even(stamp: Array, row: Integers, zero: Array, dt: float) -> Array:
    """Stamps (j,) s, within a quarter of an interval of their rows' time where any are too close: rates are
    taken over the time between them."""
    if len(stamp) < 2 or (np.diff(stamp) >= 0.5 * dt).all():
        return stamp
    fitted = zero + dt * (row - row[0])
    fitted += np.median(stamp - fitted)
    return np.clip(stamp, fitted - 0.25 * dt, fitted + 0.25 * dt)


def _filled(stamp: Array, row: Integers, rows: int, dt: float) -> Array:
    """Time, (rows,) s, of all rows from the stamps of those that have one."""
    at = np.arange(rows)
    time = np.interp(at, row, stamp)
    time[: row[0]] = stamp[0] - dt * (row[0] - at[: row[0]])
    time[row[-1] + 1 :] = stamp[-1] + dt * (at[row[-1] + 1 :] - row[-1])
    return time

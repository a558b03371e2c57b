"""What an IMU sends, made into a record that a filter can live on.

Samples that are missing or broken are held, at a cost to the covariance, and counted by reason.

A filter that held a sample for too long would know nothing any more: the record ends then (`imu_patience_s`).

What is broken is told without look at any truth:

- a NaN, an infinity, or what no vehicle does (`BEYOND`): not finite;
- a time that does not move on: those samples are refused until it does, and no faster than samples can have
  come since; where samples are missing, their places are filled;
- a value that is repeated to the last bit more often than noise can do by chance: the axis is stuck. How
  often that is, its counts and the record tell (`_judge`); a sensor that is told to have no noise is never
  stuck, for at rest it repeats itself;
- a value that comes again and again, and what lies between stays on one side of it: the axis is saturated,
  and the truth lies beyond; so it does where a repeated value is the greatest of the record, or cuts off
  what was there before.

The whole record is looked at: what noise does, and which values are the ends of an axis. A navigator in
flight would know a stuck axis some 0.05 s later, and a full scale from when it has been met often enough: its
first samples are told here sooner than anybody could tell them in flight.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins.imu import ImuErrors
from ..sins.mechanization import checked_shapes
from ..sins.units import ARCSEC, DEG_PER_SQRT_HOUR, MICRO_G_PER_SQRT_HZ
from ._increments_kernel import count_repeats
from .estimate import Array, SampleOutcome

Mask = NDArray[np.bool_]

HOLD_WINDOW = 10
"""Samples whose mean stands in for one that is held: fewer would hold on to vibration."""
JERK, ANGULAR_ACCELERATION = 10.0, 0.5
"""Standard deviations meanwhile, m/s^3 and rad/s^2: a brisk manoeuvre's."""
EXCESS = 0.5
"""Standard deviation of what lies beyond a full scale, of the full scale."""
SCATTERED = 1e-3
"""Repeats of a value by chance in a whole record, below which repeats far apart mean something too."""
APART = 4
"""Rows from one sample at a full scale to the next: vibration may bring the axis back between them."""
BEYOND = 1e3, 1e4
"""Rate, rad/s, and specific force, m/s^2, that are no measurement."""
LEAST_REPEATS = 5
CHANCE = 1e-9
"""Probability of taking noise for a stuck axis, in a whole record."""
MOST_FILLED = 1_000_000
"""Rows that a gap may be filled with."""


class Record(NamedTuple):
    """Increments without a gap, and what that cost."""

    time: Array
    """(n,) s."""
    increments: Array
    """(n, 6) dtheta_b, rad, and dv_b, m/s."""
    gap_variance: Array
    """(n, 2) that held samples add to those of velocity, (m/s)^2, and misalignment, rad^2."""
    counts: dict[SampleOutcome, int]
    """Samples by what became of them, where it was anything."""
    held: int
    """Rows in which anything was held."""
    end: int
    """Epochs that count: n, or fewer where the IMU was lost."""


def restored(
    time: ArrayLike, dtheta_b: ArrayLike, dv_b: ArrayLike, imu: ImuErrors | None, patience_s: float
) -> Record:
    """The record that a filter takes of what arrived.

    Parameters: ``time`` (n,) s, ``dtheta_b`` and ``dv_b`` (n, 3), rad and m/s, as they came; ``imu``, the
    error budget that is told, by which a repeated value is judged (None: it is not); ``patience_s``, how long
    samples may be held without a break. Raises ValueError for other shapes, fewer than two rows in order of
    time, and a gap that would fill the memory.
    """
    time, dtheta_b, dv_b = checked_shapes(time, dtheta_b, dv_b)
    increments = np.hstack([dtheta_b, dv_b])
    time, increments, dt, reason, refused = _in_time(time, increments)
    most, again = dt * np.repeat(BEYOND, 3), np.zeros(6, np.int64)
    if not count_repeats(increments, most, APART, again):
        reason[(reason == 0) & ~(np.abs(increments) <= most)] = SampleOutcome.NOT_FINITE
    if imu is not None and again.max() >= LEAST_REPEATS:
        _repeated(increments, dt, imu, again, reason)
    increments[0], reason[0] = 0.0, 0  # it has no interval
    variance = np.zeros((len(time), 2))
    if not reason.any():
        counts = {SampleOutcome.OUT_OF_ORDER: refused} if refused else {}
        return Record(time, increments, variance, counts, 0, len(time))
    bad = reason != 0
    saturated = reason == SampleOutcome.SATURATED
    full_scale = np.where(saturated, np.abs(increments), 0.0)
    for column in np.flatnonzero(bad.any(axis=0)):
        _hold(increments[:, column], bad[:, column], saturated[:, column])
    for part, columns, rate in ((0, slice(3, 6), JERK), (1, slice(0, 3), ANGULAR_ACCELERATION)):
        _add_held(variance[:, part], bad[:, columns].any(axis=1), rate, dt)
        _add_beyond(variance[:, part], full_scale[:, columns].max(axis=1))
    spells = _joined(saturated.any(axis=1), HOLD_WINDOW)
    counts = {kind: int((reason == kind).any(axis=1).sum()) for kind in SampleOutcome}
    counts[SampleOutcome.OUT_OF_ORDER] = refused
    counts = {kind: count for kind, count in counts.items() if count}
    end = _end(bad.any(axis=1) | spells, dt, patience_s)
    return Record(time, increments, variance, counts, int(bad.any(axis=1).sum()), end)


def _in_time(time: Array, increments: Array) -> tuple[Array, Array, float, NDArray[np.int8], int]:
    """Time and increments with samples refused that come before their time, and gaps filled by NaN; the
    interval, s; reasons so far, (n, 6); number of samples refused."""
    step = np.diff(time)
    forward = step[step > 0]
    if len(forward) == 0:
        raise ValueError("time must increase, over two rows or more")
    dt = float(np.median(forward))
    kept = np.ones(len(time), bool)
    if len(forward) < len(step):
        kept = _moving_on(time, dt)
        time, increments = time[kept], increments[kept]
        if len(time) < 2:
            raise ValueError("time must increase, over two rows or more")
        step = np.diff(time)
    refused = int(np.count_nonzero(~kept))
    reason = np.zeros((len(time), 6), np.int8)
    intervals = np.maximum(np.rint(step / dt), 1.0)
    missing = int(np.minimum(intervals.sum(), 1e15)) - len(step)
    if missing == 0:
        return time, increments, dt, reason, refused
    if missing > MOST_FILLED:
        raise ValueError(f"time jumps by {step.max():.10g} s, over {missing} samples of {dt:g} s")
    place = np.concatenate([[0], np.cumsum(intervals)]).astype(np.int64)
    # Places that refused samples have left, by the row that follows them.
    follows_refused = np.diff(np.flatnonzero(kept)) > 1
    kind = np.where(follows_refused, SampleOutcome.OUT_OF_ORDER, SampleOutcome.MISSING)
    filled = np.full((place[-1] + 1, 6), np.nan)
    filled[place] = increments
    reason = np.repeat(np.append(0, np.repeat(kind, intervals.astype(int)))[:, None], 6, axis=1)
    reason[place] = 0
    return np.interp(np.arange(len(filled)), place, time), filled, dt, reason.astype(np.int8), refused


def _moving_on(time: Array, dt: float) -> Mask:
    """Which rows to keep of a time that goes back, or is no number: after such a row none that comes sooner
    after the last good one than the samples since can have taken."""
    kept = np.isfinite(time)
    numbers = np.flatnonzero(kept)
    again = np.diff(time[numbers]) == 0  # a copy takes no time
    kept[numbers[1:][again]] = False
    numbers = np.append(numbers[:1], numbers[1:][~again])
    rows = np.cumsum(~np.isfinite(time) | kept)
    last = int(numbers[0])
    while True:
        later = numbers[numbers > last]
        back = np.flatnonzero(np.diff(time[np.append(last, later)]) <= 0)
        if len(back) == 0:
            return kept
        good = int(np.append(last, later)[back[0]])
        later = later[back[0] :]
        due = time[good] + (rows[later] - rows[good] - 0.5) * dt
        fine = np.flatnonzero(time[later] >= due)
        next_good = int(later[fine[0]]) if len(fine) else len(time)
        kept[good + 1 : next_good] = False
        if next_good == len(time):
            return kept
        last = next_good


def _repeated(
    increments: Array, dt: float, imu: ImuErrors, again: NDArray[np.int64], reason: NDArray[np.int8]
) -> None:
    """Mark stuck and saturated samples in ``reason``, (n, 6), of axes with repeats, ``again``, (6,)."""
    gyro = imu.gyro_arw_deg_sqrt_h * DEG_PER_SQRT_HOUR * math.sqrt(dt)
    accel = imu.accel_vrw_ug_sqrt_hz * MICRO_G_PER_SQRT_HZ * math.sqrt(dt)
    sigma = np.repeat([gyro, math.hypot(accel, math.sqrt(2) * imu.vibration_mps)], 3)
    quantum = np.repeat([imu.gyro_quantum_arcsec * ARCSEC, imu.accel_quantum_mps], 3)
    for column in np.flatnonzero((again >= LEAST_REPEATS) & (sigma > 0)):
        rows = np.flatnonzero(reason[:, column] == 0)[1:]
        told = np.zeros(len(rows), np.int8)
        _judge(increments[rows, column], float(sigma[column]), float(quantum[column]), told)
        reason[rows, column] = told


def _judge(value: Array, sigma: float, quantum: float, told: NDArray[np.int8]) -> None:
    """Write to ``told``, (n,), what became of the samples ``value`` of one axis, all of them numbers."""
    levels, count = np.unique(value, return_counts=True)
    if len(levels) < 2:
        return  # nothing tells how fine it measures
    # White noise in counts of q repeats a value with this probability.
    by_count = max(quantum, float(np.diff(levels).min())) / (2 * math.sqrt(math.pi) * sigma)
    chance = max(by_count, _share_repeated(value))
    in_a_row, near = (_repeats_by_chance(p, len(value)) for p in (chance, APART * chance))
    for level in levels[count > min(near, LEAST_REPEATS)]:
        here = value == level
        # What cannot repeat itself by chance does not do so far apart either.
        full_scale = len(_runs(here)) > 1 and len(value) * by_count < SCATTERED
        for first, end in _runs(_joined(here, APART - 1)):
            repeats, inside = int(here[first:end].sum()) - 1, value[first:end]
            one_sided = (inside <= level).all() if level > 0 else (inside >= level).all()
            if repeats < end - first - 1:
                if repeats >= near and one_sided:
                    told[first:end], full_scale = SampleOutcome.SATURATED, True
            elif repeats >= in_a_row:
                if _cuts_off(value, level, first):
                    told[first:end], full_scale = SampleOutcome.SATURATED, True
                else:
                    told[first + 1 : end] = SampleOutcome.STUCK
        if full_scale:
            told[here] = SampleOutcome.SATURATED


def _cuts_off(value: Array, level: float, first: int) -> bool:
    """Whether a value repeated from row ``first`` on is one that the axis does not get beyond: nothing in the
    record does, or it did just before, by more than its noise."""
    size = value * np.sign(level)
    before = size[max(first - HOLD_WINDOW, 0) : first]
    if len(before) > 1 and abs(level) < before.mean() - 4 * before.std():
        return True
    return bool(abs(level) >= size.max())


def _share_repeated(value: Array) -> float:
    """The share of values that were repeated at all, each counted once however often."""
    same = np.diff(value) == 0
    spells = int(np.count_nonzero(same[1:] & ~same[:-1])) + int(same[0])
    return (spells + 1) / (len(value) - int(same.sum()) + 2)


def _repeats_by_chance(p: float, n: int) -> float:
    """So many repeats, of probability ``p`` each, do not come by chance among ``n`` samples."""
    return max(LEAST_REPEATS, math.ceil(math.log(CHANCE / n) / math.log(p))) if p < 1 else math.inf


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def _hold(increments: Array, bad: Mask, saturated: Mask) -> None:
    """Put into bad rows of one axis, (n,), the mean of those before; at the start of those after, and zero
    where there are none. A saturated axis is at its full scale or beyond."""
    for first, end in _runs(bad):
        before = increments[max(first - HOLD_WINDOW, 1) : first]
        if len(before) == 0:
            before = increments[np.flatnonzero(~bad[end:])[:HOLD_WINDOW] + end]
        level = before.mean() if len(before) else 0.0
        if saturated[first]:
            full_scale = increments[first]
            level = max(level, full_scale) if full_scale > 0 else min(level, full_scale)
        increments[first:end] = level


def _add_held(variance: Array, bad: Mask, rate: float, dt: float) -> None:
    """Add what held rows cost to ``variance``, (n,).

    A rate that is held for a time t is wrong by what the vehicle does in it: the angle by ``a t^2 / 2`` for
    an angular acceleration ``a``, and the velocity likewise by the jerk.
    """
    for first, end in _runs(bad):
        held_s = dt * np.arange(end - first + 1)
        variance[first:end] += np.diff((0.5 * rate * held_s**2) ** 2)


def _add_beyond(variance: Array, full_scale: Array) -> None:
    """Add what saturated rows cost to ``variance``, (n,); ``full_scale``, (n,), is zero in others. What lies
    beyond is always on one side, and adds up over a spell."""
    for first, end in _runs(_joined(full_scale > 0, HOLD_WINDOW)):
        variance[first:end] += np.diff(np.cumsum(EXCESS * full_scale[first:end]) ** 2, prepend=0.0)


def _joined(mask: Mask, breaks: int) -> Mask:
    """With breaks of up to so many rows closed."""
    joined = mask.copy()
    for (_, end), (first, _) in pairwise(_runs(mask)):
        if first - end <= breaks:
            joined[end:first] = True
    return joined


def _end(bad: Mask, dt: float, patience_s: float) -> int:
    """Epochs until patience is at an end, of n."""
    for first, end in _runs(bad):
        if (end - first - 0.5) * dt > patience_s:
            return max(first + round(patience_s / dt), 2)
    return len(bad)

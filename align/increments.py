"""What an IMU sends, made into a record that a filter can live on.

Samples that are missing or broken (`clock`, `broken`) are held, at a cost to the covariance, and counted by
reason. Held is the mean of the last good samples of the axis, of so many as cost least. It is wrong by:

- what the vehicle does from the time of those samples on, by an angular acceleration or a jerk: a brisk
  manoeuvre's, or what the record shows where that is more, as in turbulence;
- the noise of that mean;
- what lies beyond a full scale, where that is what is wrong;
- vibration over the time that is held: it comes back, but its part in these samples is lost.

The first three have one sign over a manoeuvre: their standard deviations add up, and what was held before
counts the less, the longer good samples have come since.

A filter that held samples for too long would know nothing any more: the record ends then (`imu_patience_s`).
Good samples make up for as many held ones.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins.imu import ImuErrors
from ..sins.mechanization import checked_shapes
from ._increments_kernel import hold, side_by_side
from .broken import BEFORE, find_broken, joined, white_and_jitter
from .clock import time_base
from .estimate import Array, SampleOutcome

MOST_HELD = 100
"""Samples of which a mean is held, at most."""
ANGULAR_ACCELERATION, JERK = 0.5, 10.0
"""Standard deviations while samples are held, rad/s^2 and m/s^3, at least: a brisk manoeuvre's."""
BLOCK_S = 0.03
"""Time over which the unrest of a record is looked at: shorter is noise, longer averages turbulence."""
MANEUVER_S = 1.0
"""Time over which they keep their sign."""
EXCESS = 0.5
"""Standard deviation of what lies beyond a full scale, of the full scale."""


class Record(NamedTuple):
    """Increments without a gap, and what that cost."""

    time: Array
    """(n,) s."""
    increments: Array
    """(n, 6) dtheta_b, rad, and dv_b, m/s."""
    gap_variance: Array
    """(n, 6) that held samples add to the variances of those, rad^2 and (m/s)^2, in b."""
    counts: dict[SampleOutcome, int]
    """Samples by what became of them, where it was anything."""
    held: int
    """Rows in which anything was held."""
    end: int
    """Epochs that count: n, or fewer where the IMU was lost."""


def conditioned(
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    imu: ImuErrors | None,
    patience_s: float,
    span_s: tuple[float, float] | None = None,
) -> Record:
    """The record that a filter takes of what arrived.

    Parameters: ``time`` (n,) s, ``dtheta_b`` and ``dv_b`` (n, 3), rad and m/s, as they came; ``imu``, the
    error budget that is told, by which samples are judged (None: whether they are numbers is all that is
    asked); ``patience_s``, how long samples may be held; ``span_s``, from when to when there should be
    samples (None: from the first that came to the last). Raises ValueError for other shapes, and fewer than
    two rows in order of time.
    """
    time, dtheta_b, dv_b = checked_shapes(time, dtheta_b, dv_b)
    increments = side_by_side(dtheta_b, dv_b)
    base = time_base(time, increments, span_s)
    n, refused = len(base.time), int(np.count_nonzero(~base.taken))
    reason = np.zeros((n, 6), np.int8)
    if refused or n > len(time):
        came = increments[base.taken]
        increments = np.full((n, 6), np.nan)
        increments[base.row] = came
        reason[:] = np.where(base.refused, SampleOutcome.OUT_OF_ORDER, SampleOutcome.MISSING)[:, None]
        reason[base.row] = 0
    dt = base.interval_s
    find_broken(increments, dt, imu, reason)
    increments[0], reason[0] = 0.0, 0  # it has no interval
    if not reason.any():
        counts = {SampleOutcome.OUT_OF_ORDER: refused} if refused else {}
        return Record(base.time, increments, _nothing(n), counts, 0, n)
    variance = np.zeros((n, 6))
    bad, saturated = reason != 0, reason == SampleOutcome.SATURATED
    white, jitter = (np.zeros(6), np.zeros(6)) if imu is None else white_and_jitter(imu, dt)
    drift = dt * dt * np.repeat([ANGULAR_ACCELERATION, JERK], 3)
    drift = np.maximum(drift, _unrest(increments, bad, dt, white, jitter))
    fading = math.exp(-dt / MANEUVER_S)
    for j in np.flatnonzero(bad.any(axis=0)):
        cost = drift[j], white[j], jitter[j], EXCESS, fading
        hold(increments[:, j], bad[:, j], saturated[:, j], cost, MOST_HELD, variance[:, j])
    counts = {kind: int((reason == kind).any(axis=1).sum()) for kind in SampleOutcome}
    counts[SampleOutcome.OUT_OF_ORDER] = refused
    counts = {kind: count for kind, count in counts.items() if count}
    held = bad.any(axis=1)
    end = _end(held | joined(saturated.any(axis=1), BEFORE), dt, patience_s)
    return Record(base.time, increments, variance, counts, int(held.sum()), end)


@lru_cache(maxsize=4)
def _nothing(n: int) -> Array:
    """What it costs that nothing is held, (n, 6): one array for all records, written to by none."""
    return np.zeros((n, 6))


def _unrest(increments: Array, bad: NDArray[np.bool_], dt: float, white: Array, jitter: Array) -> Array:
    """RMS change of an increment in an interval, (6,), that comes and goes: half the mean square of second
    differences over blocks of `BLOCK_S`, less what noise has in them. A steady change has none, nor is there
    any where no three blocks without a broken sample follow each other."""
    size = max(1, round(BLOCK_S / dt))
    blocks = (len(increments) - 1) // size
    rows = slice(1, 1 + blocks * size)
    whole: NDArray[np.bool_] = ~np.any(bad[rows].reshape(blocks, size, 6), axis=1)
    means = np.where(bad[rows], 0.0, increments[rows]).reshape(blocks, size, 6).mean(axis=1)
    three = whole[2:] & whole[1:-1] & whole[:-2]
    square = np.sum(np.diff(means, n=2, axis=0) ** 2 * three, axis=0) / np.maximum(three.sum(axis=0), 1)
    # A mean of increments has the jitter of both ends, and one between two blocks is in both.
    noise = 3 * white**2 / size + 10 * (jitter / size) ** 2
    return np.sqrt(np.maximum(0.5 * square - noise, 0.0)) / size


def _end(held: NDArray[np.bool_], dt: float, patience_s: float) -> int:
    """Epochs until patience is at an end, of n: good samples make up for as many held ones."""
    balance = np.cumsum(np.where(held, 1, -1))
    owed = balance - np.minimum(np.minimum.accumulate(balance), 0)
    over = owed > patience_s / dt + 0.5
    return max(int(np.argmax(over)), 2) if over.any() else len(held)

"""What is broken in a record of the IMU: values that no sensor sends, told without look at any truth.

- A NaN, an infinity: not finite. More than the unit's full scale: out of range.
- A value that is repeated to the last bit more often than noise can do by chance: the axis is stuck. How
  often that is, its counts and the record tell (`_judge`); a sensor that is told to have no noise is never
  stuck, for at rest it repeats itself.
- A value that comes again and again, and what lies between stays on one side of it: the axis is saturated,
  and the truth lies beyond; so it does where a repeated value is the greatest of the record, or cuts off
  what was there before.

The whole record is looked at: what noise does, and which values are the ends of an axis. A navigator in
flight would know a stuck axis some 0.05 s later, and a full scale from when it has been met often enough: its
first samples are told here sooner than anybody could tell them in flight.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..sins.earth import STANDARD_GRAVITY
from ..sins.imu import ImuErrors
from ..sins.units import ARCSEC, DEG, DEG_PER_SQRT_HOUR, MICRO_G_PER_SQRT_HZ
from ._increments_kernel import count_repeats
from .estimate import Array, SampleOutcome

Mask = NDArray[np.bool_]

BEFORE = 10
"""Samples by which it is told whether a repeated value cuts off; longest break of a spell at full scale."""
SCATTERED = 1e-3
"""Repeats of a value by chance in a whole record, below which repeats far apart mean something too."""
APART = 4
"""Rows from one sample at a full scale to the next: vibration may bring the axis back between them."""
LEAST_REPEATS = 5
CHANCE = 1e-9
"""Probability of taking noise for a stuck axis, in a whole record."""
NOISE_BEYOND = 6.0
"""Standard deviations of noise, beyond a full scale, that are still a measurement."""


def white_and_jitter(imu: ImuErrors, dt: float) -> tuple[Array, Array]:
    """Standard deviations, (6,) and (6,), of an increment's white noise, and of the jitter of its integral,
    vibration and counts, of which an increment has the difference: rad and m/s."""
    gyro = imu.gyro_arw_deg_sqrt_h * DEG_PER_SQRT_HOUR * math.sqrt(dt)
    accel = imu.accel_vrw_ug_sqrt_hz * MICRO_G_PER_SQRT_HZ * math.sqrt(dt)
    count = imu.gyro_quantum_arcsec * ARCSEC / math.sqrt(12), imu.accel_quantum_mps / math.sqrt(12)
    jitter = count[0], math.hypot(imu.vibration_mps, count[1])
    return np.repeat([gyro, accel], 3), np.repeat(jitter, 3)


def find_broken(increments: Array, dt: float, imu: ImuErrors | None, reason: NDArray[np.int8]) -> None:
    """Write the reason, `SampleOutcome`, of each value of ``increments`` (n, 6) that is broken to ``reason``,
    (n, 6), zero where it is not, where there is none yet. ``imu``: what the unit is told to be; without it
    only what is no number is found."""
    most, again = np.full(6, np.finfo(float).max), np.zeros(6, np.int64)
    if imu is not None:
        white, jitter = white_and_jitter(imu, dt)
        full_scale = imu.gyro_full_scale_deg_s * DEG, imu.accel_full_scale_g * STANDARD_GRAVITY
        most = dt * np.repeat(full_scale, 3) + NOISE_BEYOND * np.hypot(white, math.sqrt(2) * jitter)
    if not count_repeats(increments, most, APART, again):
        finite = np.isfinite(increments)
        reason[(reason == 0) & ~finite] = SampleOutcome.NOT_FINITE
        reason[(reason == 0) & (np.abs(increments) > most)] = SampleOutcome.OUT_OF_RANGE
    if imu is not None and again.max() >= LEAST_REPEATS:
        _repeated(increments, dt, imu, again, reason)


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
        full_scale = len(runs(here)) > 1 and len(value) * by_count < SCATTERED
        for first, end in runs(joined(here, APART - 1)):
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
    before = size[max(first - BEFORE, 0) : first]
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


def runs(mask: Mask) -> list[tuple[int, int]]:
    """First and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def joined(mask: Mask, breaks: int) -> Mask:
    """With breaks of up to so many rows closed."""
    closed = mask.copy()
    for (_, end), (first, _) in pairwise(runs(mask)):
        if first - end <= breaks:
            closed[end:first] = True
    return closed

"""The compiled parts of `increments` and `broken`: a look at a record that finds nothing wrong with most of
them, samples that are held, and what those cost."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED

_COLUMNS = 6


@njit(**COMPILED)
def side_by_side(dtheta_b, dv_b):
    """Increments (n, 6) of angle and velocity, (n, 3) each."""
    n = len(dtheta_b)
    increments = np.empty((n, _COLUMNS))
    for k in range(n):
        for j in range(3):
            increments[k, j], increments[k, 3 + j] = dtheta_b[k, j], dv_b[k, j]
    return increments


@njit(**COMPILED)
def count_repeats(increments, most, apart, again):
    """Whether all of ``increments`` (n, 6) are numbers within ``most`` (6,).

    Adds to ``again`` (6,), for each column but its first row: how often its greatest or its least value is
    met, whichever is more, zero if there is a NaN; and pairs of equal values up to ``apart`` rows apart.
    """
    n = len(increments)
    high, low = np.full(_COLUMNS, -math.inf), np.full(_COLUMNS, math.inf)
    beyond = 0
    for k in range(n):
        for j in range(_COLUMNS):
            beyond += not abs(increments[k, j]) <= most[j]
    for k in range(1, n):
        for j in range(_COLUMNS):
            value = increments[k, j]
            high[j] = value if value > high[j] else high[j]
            low[j] = value if value < low[j] else low[j]
    at_high, at_low = np.zeros(_COLUMNS, np.int64), np.zeros(_COLUMNS, np.int64)
    for k in range(1, n):
        for j in range(_COLUMNS):
            at_high[j] += increments[k, j] == high[j]
            at_low[j] += increments[k, j] == low[j]
    for j in range(_COLUMNS):
        if beyond == 0 or not np.isnan(increments[1:, j]).any():
            again[j] += max(at_high[j], at_low[j])
    values = increments.reshape(n * _COLUMNS)[_COLUMNS:]
    for lag in range(1, min(apart, n - 2) + 1):
        # In any column: mostly none, and so counted fast.
        first, second = values[: len(values) - lag * _COLUMNS], values[lag * _COLUMNS :]
        same = 0
        for i in range(len(second)):
            same += first[i] == second[i]
        if same > 0:
            for k in range(1 + lag, n):
                for j in range(_COLUMNS):
                    again[j] += increments[k, j] == increments[k - lag, j]
    return beyond == 0


@njit(**COMPILED)
def hold(increments, bad, saturated, cost, most, variance):
    """Put into rows of one axis, (n,), that are ``bad`` the mean of good ones before; of those that come
    first, at the start, and zero where there are none. A saturated axis is at its full scale or beyond.

    Adds to ``variance``, (n,), what that costs. ``cost``: change of an increment in an interval, standard
    deviations of its white noise, of the jitter of its integral, and of what lies beyond a full scale, of the
    full scale; factor a row by which what was held before counts less. ``most``: samples to take the mean of.
    """
    drift, white, jitter, excess, fading = cost
    n = len(increments)
    good, count = np.zeros(most, np.int64), 0
    drifted, beyond = 0.0, 0.0  # sums of standard deviations, of what has one sign
    level, middle, noise = 0.0, 0.0, 0.0
    for k in range(1, n):
        if not bad[k]:
            good[count % most] = k
            count += 1
            drifted *= fading
            beyond *= fading
            continue
        if k == 1 or not bad[k - 1]:
            if count == 0:
                for row in range(n - 1, k, -1):  # the first of them last
                    if not bad[row]:
                        good[count % most] = row
                        count += 1
            level, middle, noise = _held_mean(increments, good, count, k, drift, white, jitter)
            if saturated[k]:
                level = max(level, increments[k]) if increments[k] > 0 else min(level, increments[k])
            variance[k] += 2 * jitter * jitter
        step = math.hypot(drift * abs(k - middle), noise)
        variance[k] += step * (step + 2 * drifted)
        drifted += step
        if saturated[k]:
            step = excess * abs(increments[k])
            variance[k] += step * (step + 2 * beyond)
            beyond += step
        increments[k] = level


@njit(**COMPILED)
def _held_mean(increments, good, count, k, drift, white, jitter):
    """The mean of the last of the ``good`` rows, a ring, that is held from row k on; the middle of those; its
    standard deviation. Of so many as cost least in row k."""
    least, level, middle, noise = math.inf, 0.0, 0.0, 0.0
    total, rows = 0.0, 0.0
    for m in range(1, min(count, len(good)) + 1):
        row = good[(count - m) % len(good)]
        total += increments[row]
        rows += row
        # Jitter cancels between neighbours, and leaves that of both ends.
        neighbours = abs(row - good[(count - 1) % len(good)]) == m - 1
        variance = (white * white + 2 * jitter * jitter / (m if neighbours else 1)) / m
        age = drift * (k - rows / m)
        if age * age + variance < least:
            least = age * age + variance
            level, middle, noise = total / m, rows / m, math.sqrt(variance)
    return level, middle, noise


@njit(**COMPILED)
def add_held(P, gap_variance, k, C):
    """Add what held increments of epoch k cost, in b, to the covariance; ``C`` (3, 3) is C_nb."""
    for first, of in ((3, 3), (6, 0)):
        for i in range(3):
            for j in range(3):
                s = 0.0
                for b in range(3):
                    s += gap_variance[k, of + b] * (C[i, b] * C[j, b])
                P[first + i, first + j] += s

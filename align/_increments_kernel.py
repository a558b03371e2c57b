"""The compiled look at a record that finds nothing wrong with most of them."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED


@njit(**COMPILED)
def count_repeats(increments, most, apart, again):
    """Whether all of ``increments`` (n, 6) are numbers within ``most`` (6,).

    Adds to ``again`` (6,), for each column but its first row: how often its greatest or its least value is
    met, whichever is more, zero if there is a NaN; and pairs of equal values up to ``apart`` rows apart.
    """
    n, columns = increments.shape
    possible = True
    for j in range(columns):
        high, low, beyond, numbers = -math.inf, math.inf, 0, True
        column = increments[1:, j]
        for k in range(n - 1):
            value = column[k]
            beyond += not abs(value) <= most[j]
            high = value if value > high else high
            low = value if value < low else low
        if beyond > 0 or not abs(increments[0, j]) <= most[j]:
            possible, numbers = False, not np.isnan(column).any()
        at_high, at_low = 0, 0
        for k in range(n - 1):
            at_high += column[k] == high
            at_low += column[k] == low
        if numbers:
            again[j] += max(at_high, at_low)
    values = increments.reshape(n * columns)[columns:]
    for lag in range(1, min(apart, n - 2) + 1):
        # In any column: mostly none, and so counted fast.
        first, second = values[: len(values) - lag * columns], values[lag * columns :]
        same = 0
        for i in range(len(second)):
            same += first[i] == second[i]
        if same > 0:
            for k in range(1 + lag, n):
                for j in range(columns):
                    again[j] += increments[k, j] == increments[k - lag, j]
    return possible

"""Compiled geometry of all pairs of nodes; the tests hold it to numpy's."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED


@njit(**COMPILED)
def distances_and_rates(x, v):
    """Distances (k, m) of all pairs, in the order of `node_pairs`, and their rates.

    ``x`` and ``v``, (k, n, 3), contiguous. The rate of nodes at one place is taken for zero.
    """
    k, n, _ = x.shape
    distances = np.empty((k, n * (n - 1) // 2))
    rates = np.empty((k, n * (n - 1) // 2))
    for epoch in range(k):
        pair = 0
        for i in range(n):
            for j in range(i):
                square = product = 0.0
                for axis in range(3):
                    d = x[epoch, i, axis] - x[epoch, j, axis]
                    square += d * d
                    product += d * (v[epoch, i, axis] - v[epoch, j, axis])
                distance = math.sqrt(square)
                distances[epoch, pair] = distance
                rates[epoch, pair] = product / distance if distance > 0 else 0.0
                pair += 1
    return distances, rates

"""Compiled sweeps of weighted multidimensional scaling; the readable twin is in the tests."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED

UNIT, ADAPTIVE, RESIDUAL = 0, 1, 2
_NO_RESIDUAL = 1e-6
"""m, added to residuals: without noise they vanish, and their inverse is the weight."""


@njit(inline="always", **COMPILED)
def _distance(x, i, j):
    a, b, c = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
    # Nodes at one place: any direction is as good, so none is taken, but nothing is divided by zero.
    return max(math.sqrt(a * a + b * b + c * c), 1e-9)


@njit(**COMPILED)
def residual_means(x, first, other, ranges, part):
    """Per node: mean size of residuals, m; their sum over that of ranges; mean square, m^2."""
    n = len(x)
    mean, relative, square = np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(n):
        m, size, length = 0, 0.0, 0.0
        for k in range(first[i], first[i + 1]):
            if part[i] and part[other[k]]:
                r = abs(ranges[k] - _distance(x, i, other[k])) + _NO_RESIDUAL
                m += 1
                size += r
                length += ranges[k]
                square[i] += r * r
        if m > 0:
            mean[i] = size / m
            relative[i] = size / max(length, _NO_RESIDUAL)
            square[i] /= m
    return mean, relative, square


@njit(**COMPILED)
def sweep(x, first, other, ranges, anchor, part, height, curvature, printed, weights, sweeps, tolerance):
    """Sweep over the nodes, in place of ``x``, until the largest step is below ``tolerance``; return the
    sweeps."""
    n = len(x)
    for done in range(sweeps):
        mean, relative, square = residual_means(x, first, other, ranges, part)
        before = x.copy()
        largest = 0.0
        for i in range(n):
            if anchor[i] or not part[i]:
                continue
            total, norm, reliability = np.zeros(3), 0.0, 0.0
            if weights == ADAPTIVE:
                for k in range(first[i], first[i + 1]):
                    j = other[k]
                    if part[j]:
                        reliability += 1 / (mean[i if printed else j] + relative[i] * ranges[k])
            # As printed all nodes move at once; one after another settles sooner.
            seen = before if printed else x
            for k in range(first[i], first[i + 1]):
                j = other[k]
                if not part[j]:
                    continue
                w = 1.0
                if weights == ADAPTIVE:
                    w = 1 / (mean[i if printed else j] + relative[i] * ranges[k]) / reliability
                elif weights == RESIDUAL:
                    w = 1 / (square[i] + square[j])
                if printed and anchor[j]:
                    w *= 2
                ratio = ranges[k] / _distance(seen, i, j)
                norm += w
                for a in range(3):
                    total[a] += w * (1 - ratio) * seen[j, a]
                    if not printed:
                        total[a] += w * ratio * seen[i, a]
            if norm == 0:
                continue
            step = 0.0
            pull, level = 0.0, 0.0
            if not printed and math.isfinite(height[i]):
                pull = norm / (first[i + 1] - first[i])
                level = -height[i] + 0.5 * curvature * (seen[i, 0] ** 2 + seen[i, 1] ** 2)
            for a in range(3):
                extra = pull if a == 2 else 0.0
                new = (total[a] + extra * level) / (norm + extra)
                step += (new - x[i, a]) ** 2
                x[i, a] = new
            largest = max(largest, step)
        if largest <= tolerance * tolerance or not math.isfinite(largest):
            return done + 1
    return sweeps

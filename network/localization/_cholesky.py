"""Compiled Cholesky factors of normal equations, whose upper triangle alone is used.

Many threads solve fleets at once: these loops start no threads of their own, and give the same digits on
any number of cores. The oracle is numpy.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

from numba import njit

from ...sins._kernels import COMPILED

_PIVOTS = 4


@njit(**COMPILED)
def factorize(A):
    """Cholesky factor U, ``A = U' U``, in place of the upper triangle; False if there is none.

    Four pivot rows at a time, so that a row of what remains is read and written once for four of them.
    """
    n = len(A)
    for first in range(0, n, _PIVOTS):
        end = min(first + _PIVOTS, n)
        for k in range(first, end):
            if not A[k, k] > 0:
                return False
            scale = 1 / math.sqrt(A[k, k])
            for j in range(k, n):
                A[k, j] *= scale
            for i in range(k + 1, end):
                _take(A[i, i:], A[k, i], A[k, i:])
        if end - first == _PIVOTS:
            for i in range(end, n):
                _take_four(A[i, i:], A[first, i:], A[first + 1, i:], A[first + 2, i:], A[first + 3, i:])
    return True


@njit(**COMPILED)
def _take(row, factor, other):
    """``row -= factor * other``; of rows that are passed on as such the compiler knows the strides."""
    for j in range(len(row)):
        row[j] -= factor * other[j]


@njit(**COMPILED)
def _take_four(row, a, b, c, d):
    """The same for four others, whose factors are their first elements."""
    f0, f1, f2, f3 = a[0], b[0], c[0], d[0]
    for j in range(len(row)):
        row[j] -= f0 * a[j] + f1 * b[j] + f2 * c[j] + f3 * d[j]


@njit(**COMPILED)
def substitute(U, b):
    """Solve ``U' U x = b`` in place of ``b``."""
    n = len(U)
    for k in range(n):
        b[k] /= U[k, k]
        _take(b[k + 1 :], b[k], U[k, k + 1 :])
    for k in range(n - 1, -1, -1):
        b[k] = (b[k] - product(U[k, k + 1 :], b[k + 1 :])) / U[k, k]


@njit(**COMPILED)
def product(a, b):
    """Sum of ``a * b``, as four sums side by side: one alone would wait for itself at every term."""
    n = len(a)
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for j in range(0, n - 3, 4):
        s0 += a[j] * b[j]
        s1 += a[j + 1] * b[j + 1]
        s2 += a[j + 2] * b[j + 2]
        s3 += a[j + 3] * b[j + 3]
    for j in range(n - n % 4, n):
        s0 += a[j] * b[j]
    return (s0 + s1) + (s2 + s3)


@njit(**COMPILED)
def covariance_blocks(U, blocks):
    """Diagonal blocks (p, B, B) of the inverse of ``U' U``; ``U`` is overwritten by its inverse."""
    n, B = len(U), blocks.shape[1]
    for k in range(n - 1, -1, -1):
        # Row k of the inverse from the rows below it, which are done.
        pivot = 1 / U[k, k]
        row = U[k].copy()
        for j in range(k, n):
            U[k, j] = 0.0
        U[k, k] = pivot
        for i in range(k + 1, n):
            f = row[i] * pivot
            for j in range(i, n):
                U[k, j] -= f * U[i, j]
    for p in range(len(blocks)):
        for a in range(B):
            for b in range(a + 1):
                total = 0.0
                for j in range(p * B + a, n):
                    total += U[p * B + a, j] * U[p * B + b, j]
                blocks[p, a, b] = blocks[p, b, a] = total

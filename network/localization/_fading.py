"""Compiled sweep of the distributed fading filter, with diagonal R; its readable twin is `fading_ekf.step`.

The links of node i stand in ``first[i]:first[i + 1]`` of ``other``, ``ranges`` and ``R``.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

from numba import njit

from ...sins._kernels import COMPILED

LOST_M = 1e6
"""As far out, or as uncertain, a filter has diverged: its numbers are of no use, and rounding makes its
equations singular."""


@njit(**COMPILED)
def sweep(first, other, ranges, part, free, x, P, Q, R, fading, steps, most, share, adaptive, inflate):
    """One step of every ``free`` node by itself; neighbours stand where they were before it.

    In place: ``x`` (n, 2), ``P`` and ``Q`` (n, 2, 2), ``R`` (links,) and ``fading`` (n,). ``share`` is that
    of new squares in Q and R where they are ``adaptive``; ``inflate`` adds tr(P_j) / 2 to R. Only neighbours
    that take ``part`` count. Nodes that are lost are no longer free.
    """
    before, P_before = x.copy(), P.copy()
    for i in range(len(x)):
        if not free[i]:
            continue
        p00, p01, p11 = P[i, 0, 0], P[i, 0, 1], P[i, 1, 1]
        q00, q01, q11 = Q[i, 0, 0], Q[i, 0, 1], Q[i, 1, 1]
        squares = M = taken = 0.0
        a00 = a01 = a11 = g0 = g1 = 0.0
        for slot in range(first[i], first[i + 1]):
            j = other[slot]
            if not part[j]:
                continue
            u0, u1, d = _sight(before, i, j)
            v = ranges[slot] - d
            r = R[slot] + (0.5 * (P_before[j, 0, 0] + P_before[j, 1, 1]) if inflate else 0.0)
            squares += v * v
            M += u0 * u0 * p00 + 2 * u0 * u1 * p01 + u1 * u1 * p11
            taken += u0 * u0 * q00 + 2 * u0 * u1 * q01 + u1 * u1 * q11 + r
            a00 += u0 * u0 / r
            a01 += u0 * u1 / r
            a11 += u1 * u1 / r
            g0 += u0 * v / r
            g1 += u1 * v / r
        C = squares * (fading[i] / (1 + fading[i]) if steps > 0 else 0.5)
        lam = min(max((C - taken) / M, 1.0), most) if M > 0 else 1.0
        fading[i] = lam
        p00, p01, p11 = lam * p00 + q00, lam * p01 + q01, lam * p11 + q11
        det = p00 * p11 - p01 * p01
        a00 += p11 / det
        a01 -= p01 / det
        a11 += p00 / det
        det = a00 * a11 - a01 * a01
        p00, p01, p11 = a11 / det, -a01 / det, a00 / det
        dx, dy = p00 * g0 + p01 * g1, p01 * g0 + p11 * g1
        if not (abs(x[i, 0] + dx) < LOST_M and abs(x[i, 1] + dy) < LOST_M):
            free[i] = False
            continue
        x[i, 0] += dx
        x[i, 1] += dy
        P[i, 0, 0], P[i, 0, 1], P[i, 1, 0], P[i, 1, 1] = p00, p01, p01, p11
        if not adaptive:
            continue
        for slot in range(first[i], first[i + 1]):
            j = other[slot]
            if part[j]:
                u0, u1, d = _sight(before, i, j)
                left = ranges[slot] - d - u0 * dx - u1 * dy
                spread = u0 * u0 * p00 + 2 * u0 * u1 * p01 + u1 * u1 * p11
                R[slot] += share * (left * left + spread - R[slot])
        Q[i, 0, 0] += share * (dx * dx - q00)
        Q[i, 0, 1] += share * (dx * dy - q01)
        Q[i, 1, 0] = Q[i, 0, 1]
        Q[i, 1, 1] += share * (dy * dy - q11)


@njit(**COMPILED)
def _sight(x, i, j):
    """Unit vector from j to i, and the distance."""
    a, b = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
    d = max(math.sqrt(a * a + b * b), 1e-12)
    return a / d, b / d, d

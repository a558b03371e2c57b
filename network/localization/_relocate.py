"""Compiled search for nodes that do not fit their ranges, and for better places: mirror images, folds."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED

WIDTH = 3.0
"""Of Cauchy's loss, in standard deviations."""
ROUNDS = 12
"""Gauss-Newton steps of one node at most."""


@njit(**COMPILED)
def solve_symmetric(a, b, c, d, e, f, y0, y1, y2):
    """Solution of [[a, b, c], [b, d, e], [c, e, f]] x = y."""
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1 / (a * m00 + b * m01 + c * m02)
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    return (
        scale * (m00 * y0 + m01 * y1 + m02 * y2),
        scale * (m01 * y0 + m11 * y1 + m12 * y2),
        scale * (m02 * y0 + m12 * y1 + m22 * y2),
    )


@njit(**COMPILED)
def gather(i, start, other, ranges, root_weight, doubted, x, places, values):
    """Copy a node's neighbours beyond doubt: ``places`` (m, 3), ``values`` (m, 2): range, root weight; m."""
    m = 0
    for slot in range(start[i], start[i + 1]):
        j = other[slot]
        if root_weight[slot] > 0.0 and not doubted[j]:
            places[m] = x[j]
            values[m, 0], values[m, 1] = ranges[slot], root_weight[slot]
            m += 1
    return m


@njit(**COMPILED)
def robust_cost(places, values, p0, p1, p2):
    """Cauchy's loss of a node's ranges with the node at ``p``."""
    cost = 0.0
    for k in range(len(places)):
        d = math.sqrt((p0 - places[k, 0]) ** 2 + (p1 - places[k, 1]) ** 2 + (p2 - places[k, 2]) ** 2)
        residual = values[k, 1] * (d - values[k, 0]) / WIDTH
        cost += math.log1p(residual * residual)
    return 0.5 * WIDTH * WIDTH * cost


@njit(**COMPILED)
def polish(places, values, p0, p1, p2):
    """A minimum of `robust_cost` near ``p`` by reweighted, damped Gauss-Newton: place and cost."""
    cost = robust_cost(places, values, p0, p1, p2)
    share = 1e-3
    for _ in range(ROUNDS):
        y0 = y1 = y2 = a = b = c = d = e = f = 0.0
        for k in range(len(places)):
            d0, d1, d2 = p0 - places[k, 0], p1 - places[k, 1], p2 - places[k, 2]
            length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            if not length > 0.0:
                continue
            residual = values[k, 1] * (length - values[k, 0])
            w = 1 / (1 + (residual / WIDTH) ** 2)
            scale = values[k, 1] / length
            d0, d1, d2 = scale * d0, scale * d1, scale * d2
            y0 -= w * residual * d0
            y1 -= w * residual * d1
            y2 -= w * residual * d2
            a += w * d0 * d0
            b += w * d0 * d1
            c += w * d0 * d2
            d += w * d1 * d1
            e += w * d1 * d2
            f += w * d2 * d2
        floor = share * (a + d + f) / 3
        if not floor > 0.0:
            break
        s0, s1, s2 = solve_symmetric(a + floor, b, c, d + floor, e, f + floor, y0, y1, y2)
        trial = robust_cost(places, values, p0 + s0, p1 + s1, p2 + s2)
        if trial < cost:
            gain = cost - trial
            p0, p1, p2, cost = p0 + s0, p1 + s1, p2 + s2, trial
            share = max(0.1 * share, 1e-6)
            if gain < 1e-3:
                break
        else:
            share *= 30
    return p0, p1, p2, cost


@njit(**COMPILED)
def spread_of(places):
    """Centroid of places and moments about it: xx, xy, xz, yy, yz, zz, with a floor under the diagonal."""
    m = len(places)
    m0 = m1 = m2 = a = b = c = d = e = f = 0.0
    for k in range(m):
        m0 += places[k, 0] / m
        m1 += places[k, 1] / m
        m2 += places[k, 2] / m
    for k in range(m):
        v0, v1, v2 = places[k, 0] - m0, places[k, 1] - m1, places[k, 2] - m2
        a += v0 * v0
        b += v0 * v1
        c += v0 * v2
        d += v1 * v1
        e += v1 * v2
        f += v2 * v2
    floor = 1e-6 * (a + d + f) + 1e-12
    return (m0, m1, m2), (a + floor, b, c, d + floor, e, f + floor)


@njit(**COMPILED)
def mirrored(p, center, moments):
    """Image of ``p`` in the plane that lies nearest to the places of `spread_of`."""
    a, b, c, d, e, f = moments
    n0, n1, n2 = 0.48, 0.6, 0.64
    # Inverse iteration turns towards the direction of least spread.
    for _ in range(8):
        n0, n1, n2 = solve_symmetric(a, b, c, d, e, f, n0, n1, n2)
        norm = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        n0, n1, n2 = n0 / norm, n1 / norm, n2 / norm
    h = 2 * ((p[0] - center[0]) * n0 + (p[1] - center[1]) * n1 + (p[2] - center[2]) * n2)
    return p[0] - h * n0, p[1] - h * n1, p[2] - h * n2


@njit(**COMPILED)
def from_squares(places, values, center, moments):
    """Position from squared ranges by linear least squares about the centroid."""
    a, b, c, d, e, f = moments
    mean = y0 = y1 = y2 = 0.0
    for pass_ in range(2):
        for k in range(len(places)):
            v0, v1, v2 = places[k, 0] - center[0], places[k, 1] - center[1], places[k, 2] - center[2]
            s = v0 * v0 + v1 * v1 + v2 * v2 - values[k, 0] * values[k, 0]
            if pass_ == 0:
                mean += s / len(places)
            else:
                y0 += 0.5 * (s - mean) * v0
                y1 += 0.5 * (s - mean) * v1
                y2 += 0.5 * (s - mean) * v2
    s0, s1, s2 = solve_symmetric(a, b, c, d, e, f, y0, y1, y2)
    return center[0] + s0, center[1] + s1, center[2] + s2


@njit(**COMPILED)
def place(lo, hi, start, other, ranges, root_weight, doubted, least, before, x, placed):
    """Place doubted nodes that have ``least`` or more neighbours beyond doubt, from these; how many.

    Of the present place, its mirror image in the neighbours' plane, the linear solution from squared ranges
    and its mirror image, each refined, the one that fits best is taken. ``before`` and ``x`` are (n, 3) m.
    """
    longest = 0
    for i in range(lo, hi):
        longest = max(longest, start[i + 1] - start[i])
    store, numbers = np.empty((longest, 3)), np.empty((longest, 2))
    count = 0
    for i in range(lo, hi):
        x[i] = before[i]
        placed[i] = False
        if not doubted[i]:
            continue
        m = gather(i, start, other, ranges, root_weight, doubted, before, store, numbers)
        if m < least:
            continue
        places, values = store[:m], numbers[:m]
        center, moments = spread_of(places)
        here = (before[i, 0], before[i, 1], before[i, 2])
        linear = from_squares(places, values, center, moments)
        best = np.inf
        for s in (here, mirrored(here, center, moments), linear, mirrored(linear, center, moments)):
            p0, p1, p2, cost = polish(places, values, s[0], s[1], s[2])
            if cost < best:
                best = cost
                x[i, 0], x[i, 1], x[i, 2] = p0, p1, p2
        placed[i] = True
        count += 1
    return count


@njit(**COMPILED)
def confirm(lo, hi, start, other, ranges, root_weight, asked, doubted, x, margin, held):
    """Mark in ``held``, (n,), the nodes ``asked`` about that neighbours beyond doubt hold where they are.

    Held is a node by four of them or more, if its mirror image in their plane costs ``margin`` more or is no
    other place, they standing still. The number held.
    """
    longest = 0
    for i in range(lo, hi):
        longest = max(longest, start[i + 1] - start[i])
    store, numbers = np.empty((longest, 3)), np.empty((longest, 2))
    count = 0
    for i in range(lo, hi):
        held[i] = False
        if not asked[i]:
            continue
        m = gather(i, start, other, ranges, root_weight, doubted, x, store, numbers)
        if m < 4:
            continue
        places, values = store[:m], numbers[:m]
        here = (x[i, 0], x[i, 1], x[i, 2])
        center, moments = spread_of(places)
        s = mirrored(here, center, moments)
        p0, p1, p2, cost = polish(places, values, s[0], s[1], s[2])
        apart = math.sqrt((p0 - here[0]) ** 2 + (p1 - here[1]) ** 2 + (p2 - here[2]) ** 2)
        # Nearer than this, both are one minimum.
        one = values[:, 1].max() * apart < 6.0
        held[i] = one or cost > robust_cost(places, values, here[0], here[1], here[2]) + margin
        count += held[i]
    return count


@njit(**COMPILED)
def count_misfits(lo, hi, start, other, ranges, root_weight, fixed, x, limit, misfits):
    """``misfits``, (n,): links of each free node whose residual is above ``limit`` standard deviations."""
    for i in range(lo, hi):
        misfits[i] = 0
        if not fixed[i]:
            for slot in range(start[i], start[i + 1]):
                misfits[i] += misfit(i, slot, other, ranges, root_weight, x, limit)


@njit(**COMPILED)
def misfit(i, slot, other, ranges, root_weight, x, limit):
    """Whether a link's residual is above ``limit`` standard deviations."""
    j = other[slot]
    d = math.sqrt((x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2)
    return root_weight[slot] * abs(d - ranges[slot]) > limit


@njit(**COMPILED)
def doubt(rows, start, other, ranges, root_weight, fixed, x, limit, misfits, doubted):
    """Mark in ``doubted``, (n,), nodes that account for misfits: the worst first.

    ``rows`` are those with misfits. A node's doubt takes its links from its neighbours' ``misfits``. Where
    two nodes have nothing against them but their link, either may be wrong, and both are doubted. A wrong
    node drags its neighbours, so that they misfit with others: a node with less than half the misfits of a
    neighbour is let be, until it is seen without that.
    """
    most = 0
    strongest = np.zeros(len(rows), np.int32)
    for k in range(len(rows)):
        i = rows[k]
        most = max(most, misfits[i])
        for slot in range(start[i], start[i + 1]):
            if root_weight[slot] > 0.0:
                strongest[k] = max(strongest[k], misfits[other[slot]])
    for level in range(most, 0, -1):
        for k in range(len(rows)):
            i = rows[k]
            if misfits[i] != level or 2 * level < strongest[k]:
                continue
            doubted[i] = True
            misfits[i] = 0
            if level > 1:
                for slot in range(start[i], start[i + 1]):
                    j = other[slot]
                    if misfits[j] and misfit(i, slot, other, ranges, root_weight, x, limit):
                        misfits[j] -= 1


@njit(**COMPILED)
def grow(lo, hi, start, other, fixed, before, grown):
    """``grown``, (n,): nodes of ``before`` and their free neighbours."""
    for i in range(lo, hi):
        grown[i] = before[i]
        if not fixed[i]:
            for slot in range(start[i], start[i + 1]):
                grown[i] |= before[other[slot]]

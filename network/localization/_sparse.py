"""Compiled loops over the links of a large network: adjacency, residuals, normal equations, sweeps.

A network is held by rows, one a node: links ``start[i]`` to ``start[i + 1]`` of node ``i`` lead to nodes
``other`` with ``ranges`` m, weighted by ``root_weight`` 1/m, the inverse of their standard deviations. Each
link stands in both its nodes' rows, so that a row is written by nobody else. Loops run over rows ``lo`` to
``hi``; rows of ``fixed`` nodes are passed over, and their steps are zero.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED


@njit(**COMPILED)
def count_links(links, rank, start):
    """Write the first link of each row into ``start``, shape (n + 1,); node k has row ``rank[k]``."""
    start[:] = 0
    for k in range(len(links)):
        start[rank[links[k, 0]] + 1] += 1
        start[rank[links[k, 1]] + 1] += 1
    for i in range(1, len(start)):
        start[i] += start[i - 1]


@njit(**COMPILED)
def fill_rows(links, link_ranges, link_sd, rank, start, other, ranges, root_weight):
    """Write both directions of each link into the rows that `count_links` laid out."""
    free = start[:-1].copy()
    for k in range(len(links)):
        i, j = rank[links[k, 0]], rank[links[k, 1]]
        for here, there in ((i, j), (j, i)):
            slot = free[here]
            free[here] = slot + 1
            other[slot] = there
            ranges[slot] = link_ranges[k]
            root_weight[slot] = 1 / link_sd[k]


@njit(**COMPILED)
def linearize(lo, hi, start, other, ranges, root_weight, fixed, x, jacobian, gradient, block, bend):
    """Residuals and their derivatives at ``x``, (n, 3) m; the rows' share of the cost.

    Written: ``jacobian``, (links, 3), derivative of the weighted residual by this node's position;
    ``gradient``, (n, 3), and ``block``, (n, 6), its own block of the normal matrix: xx, xy, xz, yy, yz, zz;
    ``bend``, (n,) 1/m^2, a bound on what that leaves out, the curvature of the ranges, with one standard
    deviation more of residual. A link of no length has no direction, and no derivative.
    """
    cost = 0.0
    for i in range(lo, hi):
        if fixed[i]:
            continue
        x0, x1, x2 = x[i, 0], x[i, 1], x[i, 2]
        g0 = g1 = g2 = 0.0
        b00 = b01 = b02 = b11 = b12 = b22 = bound = 0.0
        for slot in range(start[i], start[i + 1]):
            j = other[slot]
            d0, d1, d2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
            d = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            w = root_weight[slot]
            residual = w * (d - ranges[slot])
            # Links between two free nodes are met twice.
            cost += (0.5 if fixed[j] else 0.25) * residual * residual
            scale = w / d if d > 0.0 else 0.0
            j0, j1, j2 = scale * d0, scale * d1, scale * d2
            jacobian[slot, 0], jacobian[slot, 1], jacobian[slot, 2] = j0, j1, j2
            bound += scale * (1 + abs(residual))
            g0 += j0 * residual
            g1 += j1 * residual
            g2 += j2 * residual
            b00 += j0 * j0
            b01 += j0 * j1
            b02 += j0 * j2
            b11 += j1 * j1
            b12 += j1 * j2
            b22 += j2 * j2
        gradient[i, 0], gradient[i, 1], gradient[i, 2] = g0, g1, g2
        bend[i] = bound
        block[i, 0], block[i, 1], block[i, 2] = b00, b01, b02
        block[i, 3], block[i, 4], block[i, 5] = b11, b12, b22
    return cost


@njit(**COMPILED)
def damp_and_invert(lo, hi, fixed, block, bend, share, damping, inverse):
    """``damping``, (n,) 1/m^2: ``share`` of ``bend`` and a bit; ``inverse``, (n, 6), of the block with it."""
    for i in range(lo, hi):
        if fixed[i]:
            continue
        floor = share * bend[i] + 1e-6 * (block[i, 0] + block[i, 3] + block[i, 5])
        damping[i] = floor
        # A row without weight has no step.
        if not floor > 0.0:
            inverse[i] = 0.0
            continue
        a, b, c = block[i, 0] + floor, block[i, 1], block[i, 2]
        d, e, f = block[i, 3] + floor, block[i, 4], block[i, 5] + floor
        m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1 / (a * m00 + b * m01 + c * m02)
        inverse[i, 0], inverse[i, 1], inverse[i, 2] = scale * m00, scale * m01, scale * m02
        inverse[i, 3], inverse[i, 4] = scale * (a * f - c * c), scale * (b * c - a * e)
        inverse[i, 5] = scale * (a * d - b * b)


@njit(**COMPILED)
def normal_product(lo, hi, start, other, fixed, jacobian, damping, p, q):
    """``q``, (n, 3): the damped normal matrix times ``p``; the rows' share of ``p q``."""
    total = 0.0
    for i in range(lo, hi):
        if fixed[i]:
            continue
        p0, p1, p2 = p[i, 0], p[i, 1], p[i, 2]
        q0, q1, q2 = damping[i] * p0, damping[i] * p1, damping[i] * p2
        for slot in range(start[i], start[i + 1]):
            j = other[slot]
            j0, j1, j2 = jacobian[slot, 0], jacobian[slot, 1], jacobian[slot, 2]
            along = j0 * (p0 - p[j, 0]) + j1 * (p1 - p[j, 1]) + j2 * (p2 - p[j, 2])
            q0 += j0 * along
            q1 += j1 * along
            q2 += j2 * along
        q[i, 0], q[i, 1], q[i, 2] = q0, q1, q2
        total += np.float64(p0) * q0 + np.float64(p1) * q1 + np.float64(p2) * q2
    return total


@njit(**COMPILED)
def cg_residual(lo, hi, fixed, alpha, p, q, inverse, step, r, z):
    """Move ``step`` along ``p`` and ``r`` against ``q``, precondition ``r`` into ``z``; share of ``r z``."""
    total = 0.0
    for i in range(lo, hi):
        if fixed[i]:
            continue
        for k in range(3):
            step[i, k] += alpha * p[i, k]
            r[i, k] -= alpha * q[i, k]
        r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
        z[i, 0] = inverse[i, 0] * r0 + inverse[i, 1] * r1 + inverse[i, 2] * r2
        z[i, 1] = inverse[i, 1] * r0 + inverse[i, 3] * r1 + inverse[i, 4] * r2
        z[i, 2] = inverse[i, 2] * r0 + inverse[i, 4] * r1 + inverse[i, 5] * r2
        total += np.float64(r0) * z[i, 0] + np.float64(r1) * z[i, 1] + np.float64(r2) * z[i, 2]
    return total


@njit(**COMPILED)
def cg_direction(lo, hi, beta, z, p):
    """The next direction: ``p <- z + beta p``."""
    for i in range(lo, hi):
        for k in range(3):
            p[i, k] = z[i, k] + beta * p[i, k]


@njit(**COMPILED)
def sweep(lo, hi, start, other, ranges, root_weight, fixed, before, x):
    """One sweep of dwMDS with 1/sigma^2 weights, Gao et al. (4) with its self term, over the rows.

    ``before`` and ``x``, (n, 3) m: a node takes from ``x`` the nodes of the same rows that have already
    moved, from ``before`` all others: what comes out does not depend on which rows are swept first.
    """
    for i in range(lo, hi):
        x0, x1, x2 = before[i, 0], before[i, 1], before[i, 2]
        if not fixed[i]:
            s0 = s1 = s2 = total = 0.0
            for slot in range(start[i], start[i + 1]):
                j = other[slot]
                if lo <= j < i:
                    o0, o1, o2 = x[j, 0], x[j, 1], x[j, 2]
                else:
                    o0, o1, o2 = before[j, 0], before[j, 1], before[j, 2]
                d0, d1, d2 = x0 - o0, x1 - o1, x2 - o2
                d = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
                w = root_weight[slot] * root_weight[slot]
                s = w * (ranges[slot] / d - 1.0) if d > 0.0 else 0.0
                s0 += s * d0
                s1 += s * d1
                s2 += s * d2
                total += w
            if total > 0.0:
                scale = 1 / total
                x0 += scale * s0
                x1 += scale * s1
                x2 += scale * s2
        x[i, 0], x[i, 1], x[i, 2] = x0, x1, x2


@njit(**COMPILED)
def probe(lo, hi, start, other, fixed, jacobian, draw, right):
    """``right``, (n, 3): the transposed Jacobian times a sign for each link, +1 or -1, drawn by bit ``draw``.

    The sign is a bit of a hash of the link's nodes (splitmix64), the same in both rows.
    """
    n = np.uint64(len(start))
    for i in range(lo, hi):
        if fixed[i]:
            continue
        r0 = r1 = r2 = 0.0
        for slot in range(start[i], start[i + 1]):
            j = other[slot]
            h = (np.uint64(max(i, j)) * n + np.uint64(min(i, j)) + np.uint64(1)) * np.uint64(
                0x9E3779B97F4A7C15
            )
            h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            h ^= h >> np.uint64(31)
            # The residual changes sign with the direction of its derivative: seen from either end it is one.
            sign = 1.0 if (h >> np.uint64(draw)) & np.uint64(1) else -1.0
            r0 += sign * jacobian[slot, 0]
            r1 += sign * jacobian[slot, 1]
            r2 += sign * jacobian[slot, 2]
        right[i, 0], right[i, 1], right[i, 2] = r0, r1, r2


@njit(**COMPILED)
def add_outer(lo, hi, step, scale, total):
    """Add ``scale`` times the outer product of each row of ``step``, (n, 3), to ``total``, (n, 6)."""
    for i in range(lo, hi):
        a, b, c = np.float64(step[i, 0]), np.float64(step[i, 1]), np.float64(step[i, 2])
        total[i, 0] += scale * a * a
        total[i, 1] += scale * a * b
        total[i, 2] += scale * a * c
        total[i, 3] += scale * b * b
        total[i, 4] += scale * b * c
        total[i, 5] += scale * c * c


@njit(**COMPILED)
def linear_reach(lo, hi, start, ranges, root_weight, fixed, reach):
    """``reach``, (n,) m^2: the squared move across a range that changes it by its deviation, mean over a row.

    To second order a move s across a range d changes it by s^2 / (2 d).
    """
    for i in range(lo, hi):
        reach[i] = 0.0
        count = 0
        if not fixed[i]:
            for slot in range(start[i], start[i + 1]):
                if root_weight[slot] > 0.0:
                    reach[i] += 2 * max(ranges[slot], 0.0) / root_weight[slot]
                    count += 1
        if count:
            reach[i] /= count

"""Compiled damped Gauss-Newton for a fleet: all nodes at once, normal equations kept dense.

State ``S``, shape (n, B), one row a node: position in m (north, east, down), clock offset in m if clocks are unknown,
and, where range-rates are used too, velocity in m/s and clock drift in m/s. B is 3, 4, 6 or 8.

A link (i, j) has the residuals ``range - (|x_i - x_j| + b_i - b_j)`` and
``rate - (e (v_i - v_j) + d_i - d_j)`` with the unit vector e from j to i. Both are odd in the two nodes: the derivatives
by node j's state are those by node i's with the other sign, so a link adds one block to two places of the diagonal
and takes it from one beside it. The readable twin of `assemble` is in the tests.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED

SQUARED, HUBER, ONE_SIDED = 0, 1, 2
_PANEL = 4
MOST_DAMPING = 1e12


@njit(inline="always", **COMPILED)
def robust(t, loss, threshold):
    """Cost and weight of a residual in standard deviations."""
    if loss == SQUARED or (t <= threshold and (loss == ONE_SIDED or t >= -threshold)):
        return 0.5 * t * t, 1.0
    size = abs(t)
    return threshold * (size - 0.5 * threshold), threshold / size


@njit(**COMPILED)
def cost_of(S, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior, height, w_height,
            curvature):  # fmt: skip
    """Half the sum of squared residuals in standard deviations, robust for ranges."""
    kind, threshold = int(loss[0]), loss[1]
    V = 4 if clocks else 3
    cost = 0.0
    for m in range(len(links)):
        if w_range[m] == 0:
            continue
        i, j = links[m, 0], links[m, 1]
        x, y, z = S[i, 0] - S[j, 0], S[i, 1] - S[j, 1], S[i, 2] - S[j, 2]
        d = math.sqrt(x * x + y * y + z * z)
        r = ranges[m] - d
        if clocks:
            r -= S[i, 3] - S[j, 3]
        cost += robust(r * math.sqrt(w_range[m]), kind, threshold)[0]
        if rates_used:
            r = rates[m]
            if d > 0:
                r -= (
                    x * (S[i, V] - S[j, V])
                    + y * (S[i, V + 1] - S[j, V + 1])
                    + z * (S[i, V + 2] - S[j, V + 2])
                ) / d
            if clocks:
                r -= S[i, 7] - S[j, 7]
            cost += 0.5 * w_rate[m] * r * r
    for i in range(len(S)):
        for a in range(S.shape[1]):
            r = prior[i, a] - S[i, a]
            cost += 0.5 * w_prior[i, a] * r * r
        if w_height[i] > 0:
            r = height[i] + S[i, 2] - 0.5 * curvature * (S[i, 0] ** 2 + S[i, 1] ** 2)
            cost += 0.5 * w_height[i] * r * r
    return cost


@njit(**COMPILED)
def assemble(S, place, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior, height,
             w_height, curvature, A, g):  # fmt: skip
    """Write the upper triangle of the normal equations ``A`` and their right-hand side ``g``; return the cost.

    ``place`` (n,) is the block of each node in ``A``, -1 for a node that stays where it is. Weights of zero leave out
    a link, a prior or a height.
    """
    kind, threshold = int(loss[0]), loss[1]
    n, B = S.shape
    V = 4 if clocks else 3
    A[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    u, q, block = np.zeros(B), np.zeros(B), np.zeros((B, B))
    for m in range(len(links)):
        if w_range[m] == 0:
            continue
        i, j = links[m, 0], links[m, 1]
        x, y, z = S[i, 0] - S[j, 0], S[i, 1] - S[j, 1], S[i, 2] - S[j, 2]
        d = math.sqrt(x * x + y * y + z * z)
        # Nodes at one place have no direction to each other: their range tells nothing to first order.
        inverse = 1 / d if d > 0 else 0.0
        u[0], u[1], u[2] = x * inverse, y * inverse, z * inverse
        r = ranges[m] - d
        if clocks:
            r -= S[i, 3] - S[j, 3]
            u[3] = 1.0
        c, weight = robust(r * math.sqrt(w_range[m]), kind, threshold)
        cost += c
        w1 = w_range[m] * weight
        w2, r2 = 0.0, 0.0
        if rates_used:
            w2 = w_rate[m]
            a, b, c = S[i, V] - S[j, V], S[i, V + 1] - S[j, V + 1], S[i, V + 2] - S[j, V + 2]
            along = u[0] * a + u[1] * b + u[2] * c
            r2 = rates[m] - along
            q[0], q[1], q[2] = (
                (a - along * u[0]) * inverse,
                (b - along * u[1]) * inverse,
                (c - along * u[2]) * inverse,
            )
            q[V], q[V + 1], q[V + 2] = u[0], u[1], u[2]
            if clocks:
                r2 -= S[i, 7] - S[j, 7]
                q[7] = 1.0
            cost += 0.5 * w2 * r2 * r2
        pi, pj = place[i] * B, place[j] * B
        for a in range(B):
            pull = w1 * r * u[a] + w2 * r2 * q[a]
            if pi >= 0:
                g[pi + a] += pull
            if pj >= 0:
                g[pj + a] -= pull
            for b in range(B):
                block[a, b] = w1 * u[a] * u[b] + w2 * q[a] * q[b]
        if pi >= 0:
            _add(A, pi, pi, block, 1.0)
        if pj >= 0:
            _add(A, pj, pj, block, 1.0)
        if pi >= 0 and pj >= 0:
            _add(A, min(pi, pj), max(pi, pj), block, -1.0)
    for i in range(n):
        p = place[i] * B
        for a in range(B):
            r = prior[i, a] - S[i, a]
            cost += 0.5 * w_prior[i, a] * r * r
            if p >= 0:
                g[p + a] += w_prior[i, a] * r
                A[p + a, p + a] += w_prior[i, a]
        if w_height[i] > 0:
            r = height[i] + S[i, 2] - 0.5 * curvature * (S[i, 0] ** 2 + S[i, 1] ** 2)
            cost += 0.5 * w_height[i] * r * r
            if p >= 0:
                u[0], u[1], u[2] = curvature * S[i, 0], curvature * S[i, 1], -1.0
                for a in range(3):
                    g[p + a] += w_height[i] * r * u[a]
                    for b in range(3):
                        A[p + a, p + b] += w_height[i] * u[a] * u[b]
    return cost


@njit(inline="always", **COMPILED)
def _add(A, row, column, block, sign):
    for a in range(len(block)):
        for b in range(len(block)):
            A[row + a, column + b] += sign * block[a, b]


@njit(**COMPILED)
def factorize(A):
    """Cholesky factor U, ``A = U' U``, in place of the upper triangle; False if ``A`` is not positive definite.

    Four pivot rows at a time, so that a row of what remains is read and written once for four of them.
    """
    n = len(A)
    for first in range(0, n, _PANEL):
        end = min(first + _PANEL, n)
        for k in range(first, end):
            if not A[k, k] > 0:
                return False
            scale = 1 / math.sqrt(A[k, k])
            for j in range(k, n):
                A[k, j] *= scale
            for i in range(k + 1, end):
                f = A[k, i]
                for j in range(i, n):
                    A[i, j] -= f * A[k, j]
        if end - first < _PANEL:
            continue
        for i in range(end, n):
            f0, f1, f2, f3 = A[first, i], A[first + 1, i], A[first + 2, i], A[first + 3, i]
            for j in range(i, n):
                A[i, j] -= (
                    f0 * A[first, j] + f1 * A[first + 1, j] + f2 * A[first + 2, j] + f3 * A[first + 3, j]
                )
    return True


@njit(**COMPILED)
def substitute(U, b):
    """Solve ``U' U x = b`` in place of ``b``."""
    n = len(U)
    for k in range(n):
        b[k] /= U[k, k]
        f = b[k]
        for j in range(k + 1, n):
            b[j] -= f * U[k, j]
    for k in range(n - 1, -1, -1):
        total = b[k]
        for j in range(k + 1, n):
            total -= U[k, j] * b[j]
        b[k] = total / U[k, k]


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


@njit(**COMPILED)
def moved(S, place, step):
    """The state after a step (N,) of the unknowns."""
    B = S.shape[1]
    after = S.copy()
    for i in range(len(S)):
        if place[i] >= 0:
            for a in range(B):
                after[i, a] += step[place[i] * B + a]
    return after


@njit(**COMPILED)
def minimize(S, place, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior, height,
             w_height, curvature, floor, damping, max_iterations, tolerance, A, g):  # fmt: skip
    """Levenberg-Marquardt on ``S`` in place; ``floor`` (B,) is added to the diagonal of unknowns without a prior.

    Ends when a step, in standard deviations over all unknowns, is below ``tolerance``; a first ``damping`` of zero
    makes it Gauss-Newton while that succeeds. Returns the cost, the number of iterations and whether it
    converged; ``A`` then holds the factor of the undamped normal equations at the last point but one, which is the
    solution to within the tolerance.
    """
    N, B = len(g), S.shape[1]
    cost = assemble(S, place, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior, height,
                    w_height, curvature, A, g)  # fmt: skip
    _support(A, floor, B)
    step = np.empty(N)
    kept = A.copy() if damping > 0 else A
    for iteration in range(1, max_iterations + 1):
        done = False
        while not done:
            if damping > 0:
                A[:] = kept
                for k in range(N):
                    A[k, k] *= 1 + damping
            step[:] = g
            solved = factorize(A)
            if solved:
                substitute(A, step)
                after = moved(S, place, step)
                new_cost = cost_of(after, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior,
                                   w_prior, height, w_height, curvature)  # fmt: skip
                decrement = 0.0
                for k in range(N):
                    decrement += g[k] * step[k]
                # Close to the end, rounding alone may raise the cost.
                if decrement <= tolerance**2 or new_cost <= cost:
                    done = True
            if not done:
                if damping == 0:
                    assemble(S, place, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior,
                             height, w_height, curvature, A, g)  # fmt: skip
                    _support(A, floor, B)
                    kept = A.copy()
                damping = max(10 * damping, 1e-4)
                if damping > MOST_DAMPING:
                    return cost, iteration, False
        S[:] = after
        if decrement <= tolerance**2 and damping < 1e-2:
            if damping > 0:
                A[:] = kept
                factorize(A)
            return new_cost, iteration, True
        damping = 0.1 * damping if damping > 1e-9 else 0.0
        cost = assemble(S, place, rates_used, clocks, links, ranges, w_range, rates, w_rate, loss, prior, w_prior,
                        height, w_height, curvature, A, g)  # fmt: skip
        _support(A, floor, B)
        kept = A.copy() if damping > 0 else A
    factorize(A)
    return cost, max_iterations, False


@njit(inline="always", **COMPILED)
def _support(A, floor, B):
    for k in range(len(A)):
        A[k, k] += floor[k % B]

"""Compiled damped Gauss-Newton for a fleet: all nodes at once, normal equations kept dense.

State ``S``, shape (n, B), one row a node: position in m (north, east, down), clock offset in m if clocks
are unknown, and, where range-rates are used too, velocity in m/s and clock drift in m/s. B is 3, 4, 6 or 8.

A link (i, j) has the residuals ``range - (|x_i - x_j| + b_i - b_j)`` and
``rate - (e (v_i - v_j) + d_i - d_j)``, with the unit vector e from j to i. Both are odd in the two nodes:
the derivatives by the state of j are those by the state of i with the other sign. So a link adds one
block to two places of the diagonal, and takes it from one beside it.

The oracle of the derivatives in `evaluate` is its own cost, that of `minimize` is
`scipy.optimize.least_squares`.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._cholesky import factorize, product, substitute
from .problem import Array, Integers

SQUARED, HUBER, ONE_SIDED = 0, 1, 2
_MOST_DAMPING = 1e12
_SHRINKING = 0.3
"""Least shrinkage of a step, squared, for which the factor is kept."""


class Terms(NamedTuple):
    """The terms of the sum of squares; a weight is an inverse variance, and zero leaves its term out."""

    links: Integers
    """(m, 2)."""
    ranges: Array
    """(m,) m."""
    w_range: Array
    """(m,)."""
    rates: Array
    """(m,) m/s; (0,) where there are none."""
    w_rate: Array
    """(m,)."""
    loss: int
    """Of ranges: `SQUARED`, `HUBER` or `ONE_SIDED`."""
    threshold: float
    """Standard deviations beyond which a residual counts less than its square."""
    clocks: bool
    """Whether clocks are unknown."""
    prior: Array
    """(n, B) what is known of the state before."""
    w_prior: Array
    """(n, B)."""
    height: Array
    """(n,) m."""
    w_height: Array
    """(n,)."""
    curvature: float
    """1/m, see `problem.RangeProblem`."""


@njit(**COMPILED)
def robust(t, loss, threshold):
    """Cost and weight of a residual in standard deviations."""
    if loss == SQUARED or (t <= threshold and (loss == ONE_SIDED or t >= -threshold)):
        return 0.5 * t * t, 1.0
    size = abs(t)
    return threshold * (size - 0.5 * threshold), threshold / size


@njit(**COMPILED)
def sight(S, i, j, rated, clocks):
    """What node i should measure of node j: the direction from j to i, range and range rate, and the
    derivative of the rate by the position of i.

    Scalars alone go in and out: arrays cost more to hand over than all of this.
    """
    x, y, z = S[i, 0] - S[j, 0], S[i, 1] - S[j, 1], S[i, 2] - S[j, 2]
    d = math.sqrt(x * x + y * y + z * z)
    # Nodes at one place have no direction to each other: to first order their range tells nothing.
    inverse = 1 / d if d > 0 else 0.0
    x, y, z = x * inverse, y * inverse, z * inverse
    rate, qx, qy, qz = 0.0, 0.0, 0.0, 0.0
    if rated:
        V = 4 if clocks else 3
        vx, vy, vz = S[i, V] - S[j, V], S[i, V + 1] - S[j, V + 1], S[i, V + 2] - S[j, V + 2]
        rate = x * vx + y * vy + z * vz
        qx, qy, qz = (vx - rate * x) * inverse, (vy - rate * y) * inverse, (vz - rate * z) * inverse
    if clocks:
        d += S[i, 3] - S[j, 3]
        if rated:
            rate += S[i, 7] - S[j, 7]
    return x, y, z, d, rate, qx, qy, qz


@njit(**COMPILED)
def evaluate(S, place, terms, A, g):
    """Half the sum of squares, robust for ranges; its negative gradient ``g`` (N,) and, unless ``A`` is
    empty, the upper triangle of the normal equations.

    ``place`` (n,) is the block of each node in ``A``, -1 for a node that stays where it is.
    """
    n, B = S.shape
    with_matrix = len(A) > 0
    A[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    links, ranges, rates = terms.links, terms.ranges, terms.rates
    w_range, w_rate = terms.w_range, terms.w_rate
    clocks, loss, threshold = terms.clocks, terms.loss, terms.threshold
    rated = len(rates) > 0
    V = 4 if clocks else 3
    # Derivatives of range and rate by the state of the first node; the zeros and ones in them stay.
    u, q = np.zeros(B), np.zeros(B)
    if clocks:
        u[3] = 1.0
        if rated:
            q[7] = 1.0
    for m in range(len(links)):
        w1 = w_range[m]
        if w1 == 0:
            continue
        x, y, z, distance, rate, qx, qy, qz = sight(S, links[m, 0], links[m, 1], rated, clocks)
        u[0], u[1], u[2] = x, y, z
        r1 = ranges[m] - distance
        share, weight = robust(r1 * math.sqrt(w1), loss, threshold)
        w1 *= weight
        r2, w2 = 0.0, 0.0
        if rated:
            q[0], q[1], q[2] = qx, qy, qz
            q[V], q[V + 1], q[V + 2] = x, y, z
            r2, w2 = rates[m] - rate, w_rate[m]
        cost += share + 0.5 * w2 * r2 * r2
        i, j = place[links[m, 0]] * B, place[links[m, 1]] * B
        f1, f2 = w1 * r1, w2 * r2
        if i >= 0:
            for a in range(B):
                g[i + a] += f1 * u[a] + f2 * q[a]
        if j >= 0:
            for a in range(B):
                g[j + a] -= f1 * u[a] + f2 * q[a]
        if with_matrix:
            upper, lower = min(i, j), max(i, j)
            for a in range(B):
                ua, qa = w1 * u[a], w2 * q[a]
                for b in range(B):
                    term = ua * u[b] + qa * q[b]
                    if i >= 0:
                        A[i + a, i + b] += term
                    if j >= 0:
                        A[j + a, j + b] += term
                    if upper >= 0:
                        A[upper + a, lower + b] -= term
    for k in range(n):
        i = place[k] * B
        for a in range(B):
            r = terms.prior[k, a] - S[k, a]
            cost += 0.5 * terms.w_prior[k, a] * r * r
            if i >= 0:
                g[i + a] += terms.w_prior[k, a] * r
                if with_matrix:
                    A[i + a, i + a] += terms.w_prior[k, a]
        w = terms.w_height[k]
        if w > 0:
            r = terms.height[k] + S[k, 2] - 0.5 * terms.curvature * (S[k, 0] ** 2 + S[k, 1] ** 2)
            cost += 0.5 * w * r * r
            if i >= 0:
                u[0], u[1], u[2] = terms.curvature * S[k, 0], terms.curvature * S[k, 1], -1.0
                for a in range(3):
                    g[i + a] += w * r * u[a]
                    if with_matrix:
                        for b in range(3):
                            A[i + a, i + b] += w * u[a] * u[b]
    return cost


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
def support(A, floor):
    """Add ``floor`` (B,), the least information on each component of a state, to the diagonal of ``A``."""
    for k in range(len(A)):
        A[k, k] += floor[k % len(floor)]


@njit(**COMPILED)
def minimize(S, place, terms, floor, damping, max_iterations, tolerance, A, g):
    """Levenberg-Marquardt on ``S`` in place, with the normal equations of `evaluate` and `support`.

    Steps without damping go on with the same factor for as long as they shrink quickly. It ends when a step,
    in standard deviations over all unknowns, is below ``tolerance``. Returns the cost before that step, the
    number of factors made, and whether it converged; ``A`` holds the last of them, made at a point before the
    end, and damped if it had to be.
    """
    new_cost = np.inf
    no_matrix, step, new_g = np.empty((0, 0)), np.empty_like(g), np.empty_like(g)
    for iteration in range(1, max_iterations + 1):
        while True:
            cost = evaluate(S, place, terms, A, g)
            support(A, floor)
            for k in range(len(g)):
                A[k, k] *= 1 + damping
            step[:] = g
            if factorize(A):
                substitute(A, step)
                decrement = product(g, step)
                after = moved(S, place, step)
                new_cost = evaluate(after, place, terms, no_matrix, new_g)
                # So close to the end rounding alone may raise the cost.
                if new_cost <= cost or decrement <= tolerance**2:
                    break
            damping = max(10 * damping, 1e-4)
            if damping > _MOST_DAMPING:
                return cost, iteration, False
        S[:] = after
        if decrement <= tolerance**2 and damping < 1e-2:
            return new_cost, iteration, True
        while damping == 0:
            step[:] = new_g
            substitute(A, step)
            before, decrement = decrement, product(new_g, step)
            if decrement > _SHRINKING * before:
                break
            if decrement <= tolerance**2:
                S[:] = moved(S, place, step)
                return new_cost, iteration, True
            after = moved(S, place, step)
            trial = evaluate(after, place, terms, no_matrix, new_g)
            if trial > new_cost:
                break
            S[:] = after
            new_cost = trial
        damping = 0.1 * damping if damping > 1e-5 else 0.0
    return new_cost, max_iterations, False

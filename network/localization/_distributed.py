"""Compiled loop over epochs of the distributed solver: each node estimates itself, sweep by sweep.

States and terms as in `_dense`. What a node knows of another is that one's last broadcast that was received,
carried on at the velocity that it told. Epochs of a node go together by its own covariance, which fades.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._cholesky import covariance_blocks, factorize, substitute
from ._dense import robust, sight

FADING = 2.0
"""lambda of Wan et al.'s (8), which they bound from below alone, at the most that is stable: of an epoch's
ranges half as much counts at the next."""
_MOST_MISFIT = 9.0
"""As in `_tracking`."""
_CLOCK_SD = 1.0
"""m and m/s, by which a clock may run off its drift between two epochs."""


@njit(**COMPILED)
def track(
    t, S, P, told_S, told_P, place, first, w_range, w_rate, ranges, rates, beliefs, heights,
    adjacent, before, acceleration, lost, out,
):  # fmt: skip
    """Solve epoch after epoch; ``S`` (n, B) and ``P`` (n, B, B) go from the start to the last one.

    Parameters
    ----------
    t : (1 + k,) s, of the epoch of ``S`` and of those to come.
    told_S, told_P : as ``S`` and ``P``, of the last broadcasts that were received.
    place : (n,) below zero for nodes that take no part. first, w_range, w_rate, ranges, rates, beliefs,
        heights, out : as of `_tracking.track`. Neighbours and residuals are counted at the last sweep, with
        the neighbours' uncertainty in the weights.
    adjacent : (first (n + 1,), other (2 m,), link (2 m,), sign (2 m,)), the links of each node.
    before : (n, B) beliefs of the epoch of ``S``; becomes those of the last one.
    acceleration : m/s^2, standard deviation of each component of a node's, from one epoch to the next.
    lost : (k, sweeps, n) broadcasts that nobody received.
    """
    states, own_cov, cov, misfit, residuals, neighbours, converged, _ = out
    n, B = S.shape
    V = 4 if first.clocks else 3
    prior, prior_P, S_after = np.empty((n, B)), np.empty((n, B, B)), np.empty((n, B))
    for k in range(len(ranges)):
        dt = t[k + 1] - t[k]
        shift = _shift(before, beliefs[k], first.w_prior, place, dt, V)
        _carry(S, P, dt, shift, acceleration, FADING, V)
        _carry(told_S, told_P, dt, shift, acceleration, 1.0, V)
        before[:] = beliefs[k]
        for i in range(n):
            if first.w_prior[i, 0] > 0:
                S[i] = beliefs[k, i]
                P[i] = 0.0
                for a in range(B):
                    P[i, a, a] = 1 / first.w_prior[i, a]
        prior[:], prior_P[:] = S, P
        misfit[k], residuals[k], neighbours[k], converged[k] = 0.0, 0, 0, True
        sweeps = lost.shape[1]
        for sweep in range(sweeps):
            for i in range(n):
                if place[i] >= 0 and not lost[k, sweep, i]:
                    told_S[i], told_P[i] = S[i], P[i]
            S_after[:] = S
            for i in range(n):
                if place[i] < 0 or first.w_prior[i, 0] > 0:
                    continue
                well = _update(i, S_after[i], P[i], prior[i], prior_P[i], told_S, told_P, S[i], place, first,
                               ranges[k], w_range[k], rates[k], w_rate[k], heights[k], adjacent)  # fmt: skip
                converged[k] = converged[k] and well
            S[:] = S_after
        for i in range(n):
            if place[i] >= 0:
                misfit[k, i], residuals[k, i], neighbours[k, i] = _misfit(
                    i,
                    S[i],
                    told_S,
                    told_P,
                    place,
                    first,
                    ranges[k],
                    w_range[k],
                    rates[k],
                    w_rate[k],
                    adjacent,
                )
        states[k] = S
        own_cov[k] = P[0] if place[0] >= 0 else np.full((B, B), np.nan)
        if k == 0:
            cov[:] = np.nan
            for i in range(n):
                if place[i] >= 0:
                    cov[i] = P[i]


@njit(**COMPILED)
def _shift(before, now, w_prior, place, dt, V):
    """(3,) m, by which the frame's origin has moved back under the nodes, as anchors see it: their beliefs
    err by what stays, and go on at the mean of two velocities."""
    shift, count = np.zeros(3), 0
    for i in range(len(now)):
        if place[i] >= 0 and w_prior[i, 0] > 0:
            count += 1
            for a in range(3):
                shift[a] += now[i, a] - before[i, a] - 0.5 * (now[i, V + a] + before[i, V + a]) * dt
    return shift / max(count, 1)


@njit(**COMPILED)
def _carry(S, P, dt, shift, acceleration, fading, V):
    """Carry states on in straight lines, and their covariances with what accelerations may do."""
    n, B = S.shape
    for i in range(n):
        for a in range(V):
            S[i, a] += S[i, V + a] * dt
        for a in range(3):
            S[i, a] += shift[a]
        for a in range(B):
            for b in range(B):
                P[i, a, b] *= fading
        # P <- F P F', F with dt from each velocity to its position.
        for a in range(V):
            for b in range(B):
                P[i, a, b] += dt * P[i, V + a, b]
        for a in range(V):
            for b in range(B):
                P[i, b, a] += dt * P[i, b, V + a]
        for a in range(V):
            q = acceleration * acceleration if a < 3 else 0.0
            P[i, a, a] += 0.25 * q * dt**4 + (_CLOCK_SD**2 * dt if a == 3 else 0.0)
            P[i, a, V + a] += 0.5 * q * dt**3
            P[i, V + a, a] += 0.5 * q * dt**3
            P[i, V + a, V + a] += q * dt * dt + (_CLOCK_SD**2 * dt if a == 3 else 0.0)


@njit(**COMPILED)
def _along(P, u):
    total = 0.0
    for a in range(len(u)):
        for b in range(len(u)):
            total += u[a] * P[a, b] * u[b]
    return total


@njit(**COMPILED)
def _pair(own, other, pair, sign, rated, clocks, u, q):
    """Predicted range and rate of a link, of which a node is the first (``sign`` 1) or the second (-1); their
    derivatives by the node's state into ``u`` and ``q`` (B,), which are minus those by its neighbour's."""
    pair[0], pair[1] = own, other
    x, y, z, distance, rate, qx, qy, qz = sight(pair, 0, 1, rated, clocks)
    V = 4 if clocks else 3
    u[0], u[1], u[2] = x, y, z
    if rated:
        q[0], q[1], q[2] = qx, qy, qz
        q[V], q[V + 1], q[V + 2] = x, y, z
    if clocks:
        # Offsets count from the link's first node to its second.
        u[3], q[7] = sign, sign
        distance += (sign - 1) * (own[3] - other[3])
        rate += (sign - 1) * (own[7] - other[7])
    return distance, rate


@njit(**COMPILED)
def _update(
    i, out_S, out_P, prior, prior_P, told_S, told_P, now, place, first,
    ranges, w_range, rates, w_rate, height, adjacent,
):  # fmt: skip
    """The estimate of node i from what it knew before the epoch and the epoch's ranges, linear at ``now``.

    Each range counts once an epoch, however many sweeps there are: they make neighbours' places better.
    """
    B = len(now)
    starts, others, links, signs = adjacent
    clocks, rated = first.clocks, len(rates) > 0
    A, g = np.zeros((B, B)), np.zeros(B)
    A[:] = prior_P
    inverse = np.empty((1, B, B))
    if not factorize(A):
        return False
    covariance_blocks(A, inverse)
    A[:] = inverse[0]
    for a in range(B):
        for b in range(B):
            g[a] += inverse[0, a, b] * (prior[b] - now[b])
    pair, u, q = np.empty((2, B)), np.zeros(B), np.zeros(B)
    for slot in range(starts[i], starts[i + 1]):
        j, m, sign = others[slot], links[slot], signs[slot]
        if w_range[m] == 0 or place[j] < 0:
            continue
        distance, rate = _pair(now, told_S[j], pair, sign, rated, clocks, u, q)
        r1 = ranges[m] - distance
        w1 = 1 / (1 / w_range[m] + _along(told_P[j], u))
        _, weight = robust(r1 * np.sqrt(w1), first.loss, first.threshold)
        w1 *= weight
        w2, r2 = 0.0, 0.0
        if rated and w_rate[m] > 0:
            w2 = 1 / (1 / w_rate[m] + _along(told_P[j], q))
            r2 = rates[m] - rate
        for a in range(B):
            g[a] += w1 * r1 * u[a] + w2 * r2 * q[a]
            for b in range(a, B):
                A[a, b] += w1 * u[a] * u[b] + w2 * q[a] * q[b]
    w = first.w_height[i]
    if w > 0:
        r = height[i] + now[2] - 0.5 * first.curvature * (now[0] ** 2 + now[1] ** 2)
        h = np.zeros(B)
        h[0], h[1], h[2] = first.curvature * now[0], first.curvature * now[1], -1.0
        for a in range(3):
            g[a] += w * r * h[a]
            for b in range(a, 3):
                A[a, b] += w * h[a] * h[b]
    if not factorize(A):
        return False
    substitute(A, g)
    covariance_blocks(A, inverse)
    for a in range(B):
        out_S[a] = now[a] + g[a]
    out_P[:] = inverse[0]
    return True


@njit(**COMPILED)
def _misfit(i, own, told_S, told_P, place, first, ranges, w_range, rates, w_rate, adjacent):
    """Sum of squares of a node's residuals, as `_tracking` has it; their number; and its neighbours."""
    starts, others, links, signs = adjacent
    clocks, rated, B = first.clocks, len(rates) > 0, len(own)
    pair, u, q = np.empty((2, B)), np.zeros(B), np.zeros(B)
    total, count, near = 0.0, 0, 0
    for slot in range(starts[i], starts[i + 1]):
        j, m, sign = others[slot], links[slot], signs[slot]
        if w_range[m] == 0 or place[j] < 0:
            continue
        distance, rate = _pair(own, told_S[j], pair, sign, rated, clocks, u, q)
        r1 = ranges[m] - distance
        total += min(r1 * r1 / (1 / w_range[m] + _along(told_P[j], u)), _MOST_MISFIT)
        count += 1
        near += 1
        if rated and w_rate[m] > 0:
            r2 = rates[m] - rate
            total += r2 * r2 / (1 / w_rate[m] + _along(told_P[j], q))
            count += 1
    return total, count, near

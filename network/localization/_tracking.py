"""Compiled loop over epochs: one maximum-likelihood solution each, started from the ones before.

States, terms and blocks as in `_dense`; node 0, the own ship, has the last block of all.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._cholesky import covariance_blocks, factorize, product
from ._dense import Terms, evaluate, minimize, sight, support

_MOST_MISFIT = 9.0
"""A few ranges without line of sight are no contradiction, however long they are."""


@njit(**COMPILED)
def track(
    t, S, place, first, w_range, w_rate, ranges, rates, beliefs, heights, floor, weak, tolerance, most, out
):
    """Solve epoch after epoch; ``S`` (n, B) goes from the start to the state of the last one.

    Parameters
    ----------
    t : (1 + k,) s, of the epoch of ``S`` and of those to come.
    first : `Terms` of the first epoch; its ``w_prior`` tells what is known of anchors, and is zero for other
        nodes. Theirs is where the epochs before put them, with information ``weak`` (B,): it keeps a node
        that hears nobody in its place, and is of no weight for one that is located.
    ranges, w_range, rates, w_rate : (k, m). beliefs : (k, n, B) of anchors. heights : (k, n).
    most : greatest number of iterations an epoch.
    out : states (k, n, B); covariance of node 0 (k, B, B); covariances of all at the first epoch (n, B, B);
        misfit (k, n), residuals in it (k, n) and usable neighbours (k, n), as of `_misfits`; converged (k,);
        the part of those covariances that is of the anchors' errors (n, B, B), or (0, B, B) if not asked for.
    """
    states, own_cov, cov, misfit, residuals, neighbours, converged, shared = out
    n, B = S.shape
    V = 4 if first.clocks else 3
    N = 0
    for i in range(n):
        if place[i] >= 0:
            N += B
    A, g = np.empty((N, N)), np.empty(N)
    prior, w_prior, last = np.empty((n, B)), first.w_prior.copy(), S.copy()
    for i in range(n):
        for a in range(B):
            if w_prior[i, a] == 0:
                w_prior[i, a] = weak[a]
    blocks = np.empty((N // B, B, B))
    for k in range(len(ranges)):
        _predict(S, last, place, t[k + 1] - t[k], V)
        for i in range(n):
            for a in range(B):
                prior[i, a] = beliefs[k, i, a] if first.w_prior[i, a] > 0 else S[i, a]
        terms = Terms(
            first.links,
            ranges[k],
            w_range[k],
            rates[k],
            w_rate[k],
            first.loss,
            first.threshold,
            first.clocks,
            prior,
            w_prior,
            heights[k],
            first.w_height,
            first.curvature,
        )
        _, factors, converged[k] = minimize(S, place, terms, floor, 0.0, most, tolerance, A, g)
        if factors > 1:
            # The start was far: its factor does not serve for the covariance.
            evaluate(S, place, terms, A, g)
            support(A, floor)
            converged[k] &= factorize(A)
        states[k] = S
        own_cov[k] = np.nan
        if place[0] >= 0:
            own = A[N - B :, N - B :].copy()
            covariance_blocks(own, blocks[:1])
            own_cov[k] = blocks[0]
        if k == 0:
            covariance_blocks(A, blocks)
            cov[:] = np.nan
            for i in range(n):
                if place[i] >= 0:
                    cov[i] = blocks[place[i]]
            if len(shared) > 0:
                of_anchors(A, place, first.w_prior, shared)
        _misfits(S, terms, misfit[k], residuals[k], neighbours[k])


@njit(**COMPILED)
def _predict(S, last, place, dt, V):
    """Carry states on: velocities as they changed since ``last``, the epoch before, positions by velocities
    against the fleet's mean, since the frame goes along with the fleet. ``last`` becomes what ``S`` was."""
    n, B = S.shape
    for a in range(3):
        mean, count = 0.0, 0
        for i in range(n):
            if place[i] >= 0:
                mean += S[i, V + a]
                count += 1
        mean /= max(count, 1)
        for i in range(n):
            v = S[i, V + a]
            if place[i] >= 0:
                S[i, a] += (v - mean) * dt
                S[i, V + a] += v - last[i, V + a]
            last[i, V + a] = v
    if B == 8:
        for i in range(n):
            if place[i] >= 0:
                S[i, 3] += S[i, 7] * dt


@njit(**COMPILED)
def of_anchors(V, place, w_prior, shared):
    """What the errors of anchors, with information ``w_prior`` (n, B), make of each node's covariance.

    ``V`` is the inverse of the factor, as `covariance_blocks` leaves it: ``V V'`` is the covariance, and its
    block beside an anchor is what a node moves by with the information that the anchor brings.
    """
    n, B = w_prior.shape
    shared[:] = 0.0
    moved = np.empty(B)
    for i in range(n):
        if place[i] < 0:
            continue
        for j in range(n):
            if place[j] < 0 or w_prior[j, 0] == 0:
                continue
            for b in range(B):
                column = place[j] * B + b
                for a in range(B):
                    row = place[i] * B + a
                    start = max(row, column)
                    moved[a] = product(V[row, start:], V[column, start:])
                for a in range(B):
                    for c in range(B):
                        shared[i, a, c] += w_prior[j, b] * moved[a] * moved[c]


@njit(**COMPILED)
def _misfits(S, terms, misfit, residuals, neighbours):
    """Sum of squares of each node's residuals in standard deviations, of a range at most `_MOST_MISFIT`."""
    misfit[:] = 0.0
    residuals[:] = 0
    neighbours[:] = 0
    links, ranges, rates = terms.links, terms.ranges, terms.rates
    w_range, w_rate = terms.w_range, terms.w_rate
    for m in range(len(links)):
        if w_range[m] == 0:
            continue
        _, _, _, distance, rate, _, _, _ = sight(S, links[m, 0], links[m, 1], True, terms.clocks)
        w2, r1, r2 = w_rate[m], ranges[m] - distance, rates[m] - rate
        size = min(w_range[m] * r1 * r1, _MOST_MISFIT) + w2 * r2 * r2
        for end in range(2):
            i = links[m, end]
            misfit[i] += size
            residuals[i] += 2 if w2 > 0 else 1
            neighbours[i] += 1

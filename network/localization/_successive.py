"""Compiled location of one node after another by those already located.

Links stand by node: those of node i in ``first[i]:first[i + 1]`` of `other`, `rho`, `sign`, `sd`.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._one_node import inverse_of, locate

_WAVE = 1.5
"""Nodes this much less well determined than the best are taken together with it."""


@njit(**COMPILED)
def successive(first, other, rho, sign, sd, height, height_sd, curvature, p, loss, state, cov, located,
               usable, starts, least, references, max_gdop, margin, ambiguous_too, other_side):  # fmt: skip
    """Locate one node after another, the best determined first, by the ones located before.

    ``state`` (n, 4) and ``cov`` (n, 4, 4) hold the ``located`` nodes and are filled, with ``located``, in
    place; ``starts`` (n, 4) is NaN for nodes that start from the linear solution. A node is taken when it
    has ``least`` located neighbours, its dilution of precision is below ``max_gdop`` and its mirror image
    costs ``margin`` more; with ``ambiguous_too``, one whose image costs less than that is taken when there
    are no others left, on the worse side for nodes of ``other_side``. With ``references`` above zero, that
    many neighbours are used, those nearest to one sphere around the node first, and more only while the
    dilution is too large. Returns margins (n,), NaN where a node was never tried.
    """
    n = len(located)
    trial, trial_cov = np.full((n, 4), np.nan), np.zeros((n, 4, 4))
    margins, quality, stale = np.full(n, np.nan), np.full(n, np.inf), np.ones(n, np.bool_)
    while True:
        best, sure = np.inf, False
        for i in range(n):
            if located[i] or not usable[i]:
                continue
            if stale[i]:
                stale[i] = False
                chosen = np.empty(first[i + 1] - first[i], np.int64)
                m = 0
                for k in range(first[i], first[i + 1]):
                    if located[other[k]]:
                        chosen[m] = k
                        m += 1
                quality[i] = np.inf
                if m < least:
                    continue
                chosen = chosen[:m]
                take = m
                if 0 < references < m:
                    chosen = chosen[np.argsort(np.abs(rho[chosen] - np.median(rho[chosen])))]
                    take = references
                while True:
                    picked = chosen[:take]
                    w, ranges = np.empty(take), np.empty(take)
                    noise = 0.0
                    for a in range(take):
                        k = picked[a]
                        j = other[k]
                        noise += sd[k] ** 2 / take
                        w[a] = 1 / (sd[k] ** 2 + _along(cov[j], starts[i], state[j]))
                        ranges[a] = rho[k] + sign[k] * state[j, 3]
                    has_height = math.isfinite(height[i])
                    trial[i], H, rival, margins[i] = locate(
                        starts[i], state[other[picked], :3], ranges, sign[picked], w, loss,
                        height[i] if has_height else 0.0, height_sd**-2 if has_height else 0.0, curvature, p,
                    )  # fmt: skip
                    if other_side[i] and margins[i] < margin:
                        trial[i] = rival
                    trial_cov[i, :p, :p] = inverse_of(H)
                    quality[i] = math.sqrt(trial_cov[i, 0, 0] + trial_cov[i, 1, 1] + trial_cov[i, 2, 2])
                    if quality[i] <= max_gdop * math.sqrt(noise) or take == m:
                        break
                    take += 1
                if not quality[i] <= max_gdop * math.sqrt(noise):
                    quality[i] = np.inf
            if quality[i] < np.inf:
                clear = margins[i] >= margin
                if clear and not sure:
                    best, sure = quality[i], True
                elif clear == sure:
                    best = min(best, quality[i])
        if best == np.inf or not (sure or ambiguous_too):
            return margins
        for i in range(n):
            if (
                located[i]
                or not usable[i]
                or not quality[i] <= _WAVE * best
                or (sure and not margins[i] >= margin)
            ):
                continue
            located[i] = True
            state[i] = trial[i]
            cov[i] = trial_cov[i]
            for k in range(first[i], first[i + 1]):
                stale[other[k]] = True


@njit(**COMPILED)
def _along(P, here, there):
    """Variance that a range gets from the uncertainty P of the reference and its clock."""
    x, y, z = here[0] - there[0], here[1] - there[1], here[2] - there[2]
    d2 = x * x + y * y + z * z
    if not d2 > 0:
        return (P[0, 0] + P[1, 1] + P[2, 2]) / 3 + P[3, 3]
    u = np.array([x, y, z]) / math.sqrt(d2)
    total = P[3, 3]
    for a in range(3):
        for b in range(3):
            total += u[a] * P[a, b] * u[b]
    return total

"""How far ranges contradict where anchors say they are, and each other, at epochs as they were solved."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..fleet import OWN_SHIP
from ._dense import ONE_SIDED, SQUARED, Terms
from .problem import Array, Booleans, Integers

_CUT = 3.0
"""Standard deviations at which a node's residuals are cut off, so that a few cannot speak for all."""
_UNTOLD = 0.05
"""Share of a bias of all ranges that a move of the node must leave, for them to tell of it."""


class Evidence(NamedTuple):
    """Consecutive epochs as they were solved: k epochs, n nodes, m pairs, B numbers a node's state."""

    t: Array
    """(k,) s."""
    terms: Terms
    """Of the first epoch: links, loss, clocks, heights' weights, and what is known of anchors."""
    states: Array
    """(k, n, B)."""
    started: Booleans
    """(n,) nodes that took part."""
    floor: Array
    """(B,) information at which it is held where there is none."""
    w_range: Array
    """(k, m), zero for pairs that did not range each other."""
    w_rate: Array
    ranges: Array
    """(k, m) m."""
    rates: Array
    heights: Array
    """(k, n) m."""
    beliefs: Array
    """(k, n, B) of all that were anchors at first, still believed or not."""
    belief_sd: Array
    """(B,) of these."""


_OF_EPOCHS = ("t", "states", "w_range", "w_rate", "ranges", "rates", "heights", "beliefs")


def joined(parts: Sequence[Evidence], last: int | None = None) -> Evidence:
    """Consecutive evidence as one, with the terms and nodes of the last; of it the ``last`` epochs alone, if
    given."""
    rows = slice(None if last is None else -last, None)
    columns = {name: np.concatenate([getattr(part, name) for part in parts])[rows] for name in _OF_EPOCHS}
    return parts[-1]._replace(**columns)


def range_residuals(seen: Evidence) -> tuple[Array, Array]:
    """(k, m) of all pairs, and directions (k, m, 3) from the second to the first of each."""
    i, j = seen.terms.links.T
    u, distance = _sights(seen.states, i, j)
    residual = seen.ranges - distance
    if seen.terms.clocks:
        residual = residual - (seen.states[:, i, 3] - seen.states[:, j, 3])
    return residual, u


def gradients(seen: Evidence) -> Array:
    """(k, n, B) of half the sum of squares without beliefs, negative: where others would have each node."""
    terms, S = seen.terms, seen.states
    i, j = terms.links.T
    V = 4 if terms.clocks else 3
    u, distance = _sights(S, i, j)
    r1 = seen.ranges - distance
    v = S[:, i, V : V + 3] - S[:, j, V : V + 3]
    rate = np.einsum("kma,kma->km", u, v)
    q = (v - rate[..., None] * u) / np.maximum(distance, 1.0)[..., None]
    r2 = seen.rates - rate
    if terms.clocks:
        r1 = r1 - (S[:, i, 3] - S[:, j, 3])
        r2 = r2 - (S[:, i, 7] - S[:, j, 7])
    size = r1 * np.sqrt(seen.w_range)
    doubted = size > terms.threshold if terms.loss == ONE_SIDED else abs(size) > terms.threshold
    doubted &= terms.loss != SQUARED
    f1 = seen.w_range * r1 * np.where(doubted, terms.threshold / np.maximum(abs(size), 1e-9), 1.0)
    f2 = seen.w_rate * r2
    pulls = np.zeros((*f1.shape, S.shape[2]))
    pulls[..., :3] = f1[..., None] * u + f2[..., None] * q
    pulls[..., V : V + 3] = f2[..., None] * u
    if terms.clocks:
        pulls[..., 3], pulls[..., 7] = f1, f2
    pairs, side = _of_nodes(terms.links, S.shape[1])
    gradient = np.einsum("knpb,np->knb", pulls[:, pairs], side)
    level = terms.curvature * S[..., :2]
    off = seen.heights - (0.5 * np.einsum("kna,kna->kn", level, S[..., :2]) - S[..., 2])
    pull = terms.w_height * off
    gradient[..., :2] += pull[..., None] * level
    gradient[..., 2] -= pull
    return gradient


def biases(seen: Evidence) -> Array:
    """(k, n) what all ranges of a node are too long by, in standard deviations; NaN where they cannot tell.

    Neighbours are taken for known. Where they are not, residuals are smaller than that lets expect. Links
    with the own ship are not looked at: they err together where it is the own ship that has no sight.
    """
    terms, n = seen.terms, seen.states.shape[1]
    residual, u = range_residuals(seen)
    root_w = np.sqrt(seen.w_range) * (terms.links != OWN_SHIP).all(axis=1)
    residual = (residual * root_w).clip(-_CUT, _CUT)
    moves = u * root_w[..., None]
    if terms.clocks:
        moves = np.concatenate([moves, root_w[..., None]], axis=-1)
    # A bias of a node makes all its ranges longer; what a move makes longer turns with the end.
    pairs, side = _of_nodes(terms.links, n)
    moves, root_w, residual = moves[:, pairs] * side[..., None], root_w[:, pairs], residual[:, pairs]
    turned = moves.swapaxes(2, 3)
    M = turned @ moves
    c, d = (turned @ column[..., None] for column in (root_w, residual))
    bias2, told = np.sum(root_w**2, axis=2), np.sum(root_w * residual, axis=2)
    M += (1e-9 * np.trace(M, axis1=2, axis2=3)[..., None, None] + 1e-30) * np.eye(M.shape[2])
    along = np.linalg.solve(M, c)[..., 0]
    left2 = bias2 - np.sum(along * c[..., 0], axis=2)
    told -= np.sum(along * d[..., 0], axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(left2 > _UNTOLD**2 * bias2, told / np.sqrt(left2), np.nan)


def _of_nodes(links: Integers, n: int) -> tuple[Integers, Array]:
    """Pairs (n, n - 1) of each node, all being there, and 1 where it is the first of them, -1 where not."""
    number = np.zeros((n, n), np.int64)
    number[links[:, 0], links[:, 1]] = number[links[:, 1], links[:, 0]] = np.arange(len(links))
    others = ~np.eye(n, dtype=bool)
    pairs = number[others].reshape(n, n - 1)
    return pairs, np.where(links[pairs, 0] == np.arange(n)[:, None], 1.0, -1.0)


def _sights(S: Array, i: Integers, j: Integers) -> tuple[Array, Array]:
    """Unit vectors (k, m, 3) from the second to the first nodes of pairs, and distances (k, m)."""
    apart = S[:, i, :3] - S[:, j, :3]
    distance = np.linalg.norm(apart, axis=-1)
    return apart / np.maximum(distance, 1e-9)[..., None], distance

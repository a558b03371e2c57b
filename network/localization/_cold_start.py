"""Positions of a large network from nothing: paths from anchors, dwMDS, and a second look at misfits."""

from collections.abc import Callable

import numpy as np

from . import _flood, _relocate, _sparse
from ._newton import Newton
from ._rows import Rows
from .problem import Array, Booleans

NEAREST_ANCHORS = 8
FLOOD_ROUNDS = 6
RIDGE = 0.01
SWEEPS = 40
"""Of dwMDS. They bring most nodes near; what they leave, Gauss-Newton does quicker."""
SECOND_LOOKS = 8
RINGS = (1, 2, 3)
"""Links from a misfit that a second look takes in, by turns: folds lie behind the nodes that show them."""
LOOSE = 1e-6
"""Share of the cost that a step must promise, on the way."""
NEWTON_STEPS = 4
"""Before each second look."""
LEAST_TRUSTED = (10, 8, 6, 5, 4)
"""Neighbours that a node needs to be placed from them: those that have most go first."""
MISFIT_SD = 5.0
"""A range further from its distance is no noise: of a normal distribution one in two million is."""


def cold_start(rows: Rows, newton: Newton, anchor_x: Array, progress: Callable[[float], None]) -> Array:
    """Positions, (n, 3) m by rows, in most places next to the least cost.

    Gauss-Newton leaves nodes and groups of them folded over. Ranges that misfit tell where: what lies about
    them is placed again from without, node by node.
    """
    x = linear_start(rows, anchor_x)
    y = x.copy()
    for k in range(SWEEPS):
        rows.each(_sparse.sweep, *rows.links, rows.fixed, x, y)
        x, y = y, x
        progress(0.3 * k / SWEEPS)
    for k in range(SECOND_LOOKS):
        x = newton.solve(x, LOOSE, NEWTON_STEPS).x
        progress(0.3 + 0.7 * (k + 1) / SECOND_LOOKS)
        doubted = misfits(rows, x)
        if not doubted.any():
            break
        for _ in range(RINGS[k % len(RINGS)]):
            grown = np.empty_like(doubted)
            rows.each(_relocate.grow, rows.start, rows.other, rows.fixed, doubted, grown)
            doubted = grown
        x = _placed_again(rows, x, doubted)
    return x


def linear_start(rows: Rows, anchor_x: Array) -> Array:
    """Positions, (n, 3) m by rows, by linear least squares from lengths of paths to the nearest anchors.

    Paths bend: their lengths are scaled as those between anchors are to the distance, as in DV-distance.
    """
    n = len(rows.fixed)
    x = np.where(rows.anchor[:, None], anchor_x, 0.0)
    anchors = np.full((n, NEAREST_ANCHORS), -1, np.int32)
    lengths = np.full((n, NEAREST_ANCHORS), np.inf, np.float32)
    at = np.flatnonzero(rows.anchor)
    anchors[at, 0], lengths[at, 0] = at, 0.0
    lists, others = (anchors, lengths), (anchors.copy(), lengths.copy())
    # A node whom the rounds do not reach starts at the centre of the anchors.
    x[~rows.anchor] = anchor_x[at].mean(axis=0)
    for _ in range(FLOOD_ROUNDS):
        changed = any(rows.each(_flood.flood, rows.start, rows.other, rows.ranges, *lists, *others))
        lists, others = others, lists
        if not changed:
            break
    cross, square = np.sum(rows.each(_flood.path_stretch, rows.anchor, x, *lists), axis=0)
    stretch = cross / square if square > 0 else 1.0
    rows.each(_flood.multilaterate, rows.fixed, *lists, stretch, RIDGE, x)
    return x


def misfits(rows: Rows, x: Array) -> Booleans:
    """Nodes that account for ranges that their distances do not fit, if there are any: the worst about."""
    n = len(x)
    count, doubted = np.zeros(n, np.int32), np.zeros(n, np.bool_)
    rows.each(_relocate.count_misfits, *rows.links, rows.fixed, x, MISFIT_SD, count)
    _relocate.doubt(np.flatnonzero(count), *rows.links, rows.fixed, x, MISFIT_SD, count, doubted)
    return doubted


def _placed_again(rows: Rows, x: Array, doubted: Booleans) -> Array:
    """Positions with the doubted nodes placed from those beyond doubt, and then from each other."""
    y, placed = np.empty_like(x), np.empty_like(doubted)
    for least in LEAST_TRUSTED:
        while sum(rows.each(_relocate.place, *rows.links, doubted, least, x, y, placed)):
            x, y = y, x
            doubted = doubted & ~placed
    return x

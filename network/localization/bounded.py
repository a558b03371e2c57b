"""One node from ranges whose errors are uniform within a share of the distance: the exact treatment.

A range r says that the distance lies in ``[r / (1 + s), r / (1 - s)]``, and of that no more than that nearer
is likelier: the likelihood of m ranges is ``prod 1 / (2 s d_i)`` where all these rings meet, and nought
elsewhere. Its edges move with the position, so that it has no Cramer-Rao bound; errors shrink like 1/m and
not like its root. The mean over where the rings meet has the least mean squared error of all estimates,
averaged over a field in which a node may be anywhere.
"""

from typing import NamedTuple

import numpy as np

from .beacons import Heard
from .plane import distances, lengths
from .problem import Array, Booleans

_COARSE, _FINE = 10, (32, 200)
"""Cells of a grid in each direction, while a box shrinks and at the end."""
_LEAST = 100
"""Points in a region that are enough; fewer, as in a thin one, call for the finest grid."""
_ROUNDS = 30
_FILLED = 0.7
"""Share of each side of a box that the cells which may hold the node span when it shrinks no further."""


class Region(NamedTuple):
    """Where the rings of a node meet."""

    x: Array
    """(n, 2) m, the mean; NaN where they meet nowhere in the box that was searched."""
    cov: Array
    """(n, 2, 2) m^2, about the mean."""


def posterior_mean(seen: Heard, share: float, x0: Array, half_m: Array) -> Region:
    """Mean and covariance of nodes (n,) in a plane, by grids in boxes x0 (n, 2) +- ``half_m`` (n,).

    A box shrinks to the cells that no ring excludes whole, until these fill it: nothing of what is inside the
    first box is lost.
    """
    rise = np.broadcast_to(seen.rise, seen.ranges.shape)
    x, cov = np.full(x0.shape, np.nan), np.full((*x0.shape, 2), np.nan)
    for i, own in enumerate(seen.heard):
        rings = seen.anchors[i][own], rise[i][own], seen.ranges[i][own]
        points = _points(*rings, share, x0[i] - half_m[i], x0[i] + half_m[i])
        if not len(points):
            continue
        # To first order: the region is far smaller than distances are long.
        centre = points.mean(axis=0)
        d, u = distances(centre, *rings[:2])
        weight = np.exp(-(points - centre) @ np.sum(u / d[:, None], axis=0))
        weight /= weight.sum()
        x[i] = weight @ points
        cov[i] = (points - x[i]).T @ ((points - x[i]) * weight[:, None])
    return Region(x, cov)


def _points(anchors: Array, rise: Array, ranges: Array, share: float, low: Array, high: Array) -> Array:
    """(k, 2) points of one node, of a fine grid, that all rings hold."""
    rings = _Rings(anchors, rise, ranges / (1 + share), ranges / (1 - share))
    for _ in range(_ROUNDS):
        rings = rings.cutting((low + high) / 2, float(np.linalg.norm(high - low)) / 2)
        points, cell = _grid(low, high, _COARSE)
        may = rings.hold(points, float(np.linalg.norm(cell)) / 2)
        if not may.any():
            return points[:0]
        size = high - low
        low, high = points[may].min(axis=0) - cell / 2, points[may].max(axis=0) + cell / 2
        if (high - low > _FILLED * size).all():
            break
    inside = np.empty((0, 2))
    for cells in _FINE:
        points, _ = _grid(low, high, cells)
        inside = points[rings.hold(points, 0.0)]
        if len(inside) >= _LEAST:
            break
    return inside


class _Rings(NamedTuple):
    anchors: Array
    rise: Array
    lower: Array
    upper: Array

    def hold(self, points: Array, reach: float) -> Booleans:
        """(k,) whether all rings hold something within ``reach`` of the points (k, 2)."""
        d = lengths(points, self.anchors, self.rise)
        return np.all((d + reach >= self.lower) & (d - reach <= self.upper), axis=-1)

    def cutting(self, centre: Array, reach: float) -> "_Rings":
        """Those that do not hold all within ``reach`` of the centre: a distance changes no faster than a
        position."""
        d = lengths(centre, self.anchors, self.rise)
        cuts = (d - reach < self.lower) | (d + reach > self.upper)
        return _Rings(*(part[cuts] for part in self))


def _grid(low: Array, high: Array, cells: int) -> tuple[Array, Array]:
    """Centres (cells^2, 2) of the cells of a box, and the size of a cell."""
    cell = (high - low) / cells
    axes = low[:, None] + cell[:, None] * (np.arange(cells) + 0.5)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2), cell

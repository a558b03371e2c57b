"""DV-distance: multilateration from anchors that a node does not hear, by the lengths of paths to them."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from .plane import distances, gauss_newton, lateration
from .problem import Array, RangeProblem
from .spherical import locate_successively


def path_distances(problem: RangeProblem) -> Array:
    """(k, n) m, shortest way along links from each of the k anchors to each node, infinite where there is
    none."""
    n = problem.nodes
    i, j = problem.links.T
    # A range of zero would not count as a link; with clocks, ranges may even be negative.
    graph = csr_matrix((np.maximum(problem.ranges, 1e-3), (i, j)), shape=(n, n))
    return dijkstra(graph, directed=False, indices=np.flatnonzero(problem.anchor))


def path_lateration(problem: RangeProblem, nearest: int | None = 4, linear: bool = False) -> Array:
    """Positions (n, 2) m in the plane by path lengths as they are (Niculescu and Nath's DV-distance).

    Nodes that paths join to three beacons: by maximum likelihood, all lengths being taken as equally good,
    or by the ``linear`` equations; NaN of others, beacons as they are. Of
    the ``nearest`` beacons by path, all if None. A path is longer than the distance wherever it bends, so
    that further beacons add more bias than they take away noise.
    """
    beacons = problem.anchor_x[problem.anchor, :2]
    paths = path_distances(problem).T
    heard = np.isfinite(paths)
    joined = (heard.sum(axis=1) >= 3) & ~problem.anchor
    x = np.full((problem.nodes, 2), np.nan)
    x[problem.anchor] = beacons
    if not joined.any():
        return x
    k = len(beacons) if nearest is None else min(nearest, len(beacons))
    order = np.argsort(paths[joined], axis=1, kind="stable")[:, :k]
    lengths, anchors = np.take_along_axis(paths[joined], order, axis=1), beacons[order]
    heard = np.isfinite(lengths)
    lengths = np.where(heard, lengths, 1.0)
    x_linear = lateration(anchors, lengths, heard)
    if linear:
        x[joined] = x_linear
        return x
    sd = np.where(heard, 1.0, np.inf)
    centre = np.average(anchors, axis=1, weights=np.broadcast_to(heard[..., None], anchors.shape))
    # Beacons near a line leave a second minimum across it: the linear solution starts on either side.
    starts = np.stack([centre + 0.01, x_linear])
    twice = np.stack([lengths, lengths])
    found = gauss_newton(anchors, twice, sd, starts, 0.05, 12).x
    misfit = np.sum(((distances(found, anchors)[0] - twice) / sd) ** 2, axis=-1)
    x[joined] = np.where((misfit[1] < misfit[0])[:, None], found[1], found[0])
    return x


def dv_distance(problem: RangeProblem, relative_sd: float = 0.15) -> Array:
    """Positions (n, 3) m of the nodes that paths join to four anchors, NaN of others; those of anchors as
    they are.

    Each anchor corrects the paths from it by its mean ratio of distance to path length to the other
    anchors; what is left is taken as an error of ``relative_sd`` of the length. Heights are used where
    there are any.
    """
    paths = path_distances(problem)
    anchors = np.flatnonzero(problem.anchor)
    apart = np.linalg.norm(problem.anchor_x[anchors, None] - problem.anchor_x[anchors], axis=2)
    between = paths[:, anchors]
    told = np.isfinite(between) & (between > 0)
    ratio = np.divide(
        np.where(told, apart, 0.0).sum(axis=1),
        np.where(told, between, 0.0).sum(axis=1),
        out=np.ones(len(anchors)),
        where=told.any(axis=1),
    )
    estimated = paths * ratio[:, None]
    at, node = np.nonzero(np.isfinite(estimated) & ~problem.anchor)
    ranges = estimated[at, node]
    by_path = RangeProblem(
        links=np.column_stack([node, anchors[at]]),
        ranges=ranges,
        range_sd=np.maximum(relative_sd * ranges, 1.0),
        anchor=problem.anchor,
        anchor_x=problem.anchor_x,
        height=problem.height,
        height_sd=problem.height_sd,
        curvature=problem.curvature,
    )
    return locate_successively(by_path, max_gdop=1e6).x

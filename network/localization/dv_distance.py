"""DV-distance: multilateration from anchors that a node does not hear, by the lengths of paths to them."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

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

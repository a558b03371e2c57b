"""From ranges in a plane to positions, cold: the chain for plane networks of a few hundred nodes.

`chain.localize` holds every node against its mirror images in space, which in a plane network of low degree
takes it tens of seconds; here a node and its reflection across the line of its neighbours are what there is.
"""

from dataclasses import replace

import numpy as np

from .dv_distance import dv_distance, path_lateration
from .plane import distances, gauss_newton
from .plane_network import PlaneSolution, least_squares_in_plane
from .problem import Array, Booleans, Integers, RangeProblem
from .spherical import neighbors

_ROUGH_M = 1e-3
"""Last step on the way."""
_LOOKS = 12
"""Second looks at most; each that finds nothing better is the last."""
MARGIN = 10.0
"""Of the cost, in variances: half the chain's, which counts whole squares."""
_APART = 3.0
"""Standard deviations of a range from which on two places are not one."""
_BETTER = 1.0
"""Decrease of the cost, in variances, from which on another place is a better one."""


def locate_in_plane(
    problem: RangeProblem, covariance: bool = True, max_iterations: int = 60
) -> PlaneSolution:
    """Positions of all nodes that paths join to three beacons, by least squares from a cold start.

    DV-distance with corrected paths, least squares over all nodes, and then second looks: nodes whose own
    ranges fit better across the line of their neighbours are put there, and least squares go on from there if
    that lowers the cost. Without a verdict: what is folded over and fits as well stays so; `certain` tells.
    """
    start = path_lateration(problem)
    corrected = dv_distance(problem)[:, :2]
    known = np.isfinite(start[:, 0]) & np.isfinite(corrected[:, 0])
    start[known] = corrected[known]
    best = least_squares_in_plane(problem, start, False, max_iterations, _ROUGH_M)
    for _ in range(_LOOKS):
        flipped, moved = _across(problem, best.x)
        if not flipped.any():
            break
        found = least_squares_in_plane(problem, moved, False, max_iterations, _ROUGH_M)
        if found.cost > best.cost - _BETTER:
            break
        best = replace(found, iterations=best.iterations + found.iterations)
    if not covariance:
        return best
    final = least_squares_in_plane(problem, best.x, True, max_iterations)
    return replace(final, iterations=best.iterations + final.iterations)


def certain(problem: RangeProblem, x: Array, margin: float = MARGIN) -> Booleans:
    """(n,) beacons, and nodes that ranges to such nodes hold in one place: the chain's verdict, in the plane.

    Across the line of the neighbours that are certain themselves a node's cost must be ``margin`` variances
    higher. A group that is folded over as a whole is not told from one in its place.
    """
    sure = np.isfinite(x[:, 0])
    while True:
        at, gain, _ = _mirrored(problem, np.where(sure[:, None], x, np.nan), 3)
        held = problem.anchor.copy()
        held[at] = gain <= -margin
        if (held == sure).all():
            return sure
        sure = sure & held


def _across(problem: RangeProblem, x: Array) -> tuple[Booleans, Array]:
    """Nodes that fit their own ranges better on the other side of their neighbours, and positions with them.

    Of nodes next to each other only those that gain most go at a time.
    """
    at, gain, mirrored = _mirrored(problem, x, 2)
    gains = np.zeros(problem.nodes)
    gains[at] = gain
    i, j = problem.links.T
    most = np.zeros(problem.nodes)
    np.maximum.at(most, i, gains[j])
    np.maximum.at(most, j, gains[i])
    flipped, moved = (gains > _BETTER) & (gains >= most), x.copy()
    moved[at] = np.where(flipped[at, None], mirrored, x[at])
    return flipped, moved


def _mirrored(problem: RangeProblem, x: Array, least: int) -> tuple[Integers, Array, Array]:
    """Nodes with so many neighbours, by how much their cost is lower across the line of these, and where."""
    other, ranges, sd = _padded(problem, x)
    heard = np.isfinite(sd)
    at = np.flatnonzero(np.isfinite(x[:, 0]) & ~problem.anchor & (heard.sum(axis=1) >= least))
    other, ranges, sd, heard = other[at], ranges[at], sd[at], heard[at]
    anchors = np.where(heard[..., None], x[other], 0.0)
    centre = anchors.sum(axis=1) / heard.sum(axis=1)[:, None]
    apart = np.where(heard[..., None], anchors - centre[:, None], 0.0)
    _, vectors = np.linalg.eigh(np.swapaxes(apart, 1, 2) @ apart)
    normal = vectors[:, :, 0]
    off = np.sum((x[at] - centre) * normal, axis=1)
    image = gauss_newton(anchors, ranges, sd, x[at] - 2 * off[:, None] * normal, 1e-3, 8).x
    cost = [0.5 * np.sum(((distances(y, anchors)[0] - ranges) / sd) ** 2, axis=1) for y in (x[at], image)]
    # The image may come back to where the node is: another place it is not, then.
    elsewhere = np.linalg.norm(image - x[at], axis=1) > _APART * np.median(problem.range_sd)
    return at, np.where(elsewhere & np.isfinite(cost[1]), cost[0] - cost[1], -np.inf), image


def _padded(problem: RangeProblem, x: Array) -> tuple[Integers, Array, Array]:
    """Neighbours, ranges and deviations (n, M) of each node; infinite deviations where there is none."""
    links = neighbors(problem)
    node = np.repeat(np.arange(problem.nodes), np.diff(links.first))
    column = np.arange(len(node)) - links.first[node]
    shape = (problem.nodes, int(column.max(initial=0)) + 1)
    other, ranges, sd = np.zeros(shape, np.int64), np.ones(shape), np.full(shape, np.inf)
    other[node, column], ranges[node, column] = links.other, problem.ranges[links.link]
    located = np.isfinite(x[links.other, 0])
    sd[node[located], column[located]] = problem.range_sd[links.link[located]]
    return other, ranges, sd

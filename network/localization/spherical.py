"""Spherical location: nodes one after another from ranges to nodes already located (Gao et al., Theorem
1)."""

from dataclasses import dataclass

import numpy as np

from ._successive import successive
from .least_squares import LOSSES, Loss
from .problem import Array, Booleans, Integers, RangeProblem


@dataclass(frozen=True)
class Neighbors:
    """The links of a problem by node: those of node i in ``first[i]:first[i + 1]`` of the rest."""

    first: Integers
    """(n + 1,)"""
    other: Integers
    """(2 m,) the node at the other end."""
    link: Integers
    """(2 m,) which link it is."""
    sign: Array
    """(2 m,) +1 where the node comes first in the link: sign of its clock offset in the range."""


def neighbors(problem: RangeProblem) -> Neighbors:
    """The links by node."""
    m = len(problem.links)
    node = problem.links.T.ravel()
    order = np.argsort(node, kind="stable")
    first = np.searchsorted(node[order], np.arange(problem.nodes + 1))
    sign = np.where(order < m, 1.0, -1.0)
    return Neighbors(first, problem.links[:, ::-1].T.ravel()[order], order % max(m, 1), sign)


@dataclass(frozen=True)
class Located:
    """What successive location makes of a network."""

    x: Array
    """(n, 3) m, NaN where not located."""
    clock: Array
    """(n,) m"""
    cov: Array
    """(n, 3, 3) m^2, with what the references' own uncertainty adds, their correlation left out."""
    located: Booleans
    """(n,)"""
    margin: Array
    """(n,) by how much the sum of squared residuals is higher at the mirror image; NaN where never tried."""


def locate_successively(
    problem: RangeProblem,
    links: Neighbors | None = None,
    loss: Loss | None = None,
    usable: Booleans | None = None,
    x0: Array | None = None,
    clock0: Array | None = None,
    min_neighbors: int = 4,
    references: int = 0,
    max_gdop: float = 30.0,
    min_margin: float = 20.0,
    ambiguous_too: bool = True,
    other_side: Booleans | None = None,
) -> Located:
    """Locate anchors' neighbours, then theirs, the best determined first.

    A position is the minimum of the weighted squared residuals to the references, started from the linear
    solution of Theorem 1 and, because that says little across the plane that fits the references best, from
    the other side of the plane as well. References count with the variance of the range and of their own
    position.

    Parameters
    ----------
    usable : (n,) nodes to locate; all by default.
    x0, clock0 : (n, 3), (n,) m, places to start from, where finite, instead of the linear solution.
    min_neighbors : located neighbours that a node needs; five where clocks are unknown, if this is less.
    references : how many neighbours to use, those nearest to one sphere around the node first, more only
        while the
        dilution is above ``max_gdop`` (step 2 and Fig. 1 of Gao et al.); 0 for all of them.
    max_gdop : largest root of the trace of the position's covariance over the ranges' standard deviation.
    min_margin : increase of the sum of squared residuals at the mirror image from which on a position is
        unique. ambiguous_too : take the better of two images that differ less, once nothing better is left.
        other_side : (n,) ambiguous nodes of which the worse image is taken: another start, for a search.
    """
    links = links or neighbors(problem)
    loss = loss or Loss(kind="squared")
    n = problem.nodes
    state, cov, starts = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.full((n, 4), np.nan)
    state[problem.anchor, :3] = problem.anchor_x[problem.anchor]
    cov[problem.anchor, :3, :3] = problem.anchor_sd**2 * np.eye(3)
    if x0 is not None:
        starts[:, :3] = x0
        starts[:, 3] = 0.0 if clock0 is None else clock0
    located = problem.anchor.copy()
    margin = successive(
        links.first,
        links.other,
        problem.ranges[links.link],
        links.sign,
        problem.range_sd[links.link],
        np.full(n, np.nan) if problem.height is None else problem.height,
        problem.height_sd,
        problem.curvature,
        4 if problem.clocks else 3,
        np.array([LOSSES[loss.kind], loss.threshold]),
        state,
        cov,
        located,
        np.ones(n, np.bool_) if usable is None else usable,
        starts,
        max(min_neighbors, 5 if problem.clocks else 0),
        references,
        max_gdop,
        min_margin,
        ambiguous_too,
        np.zeros(n, np.bool_) if other_side is None else other_side,
    )
    x = np.where(located[:, None], state[:, :3], np.nan)
    return Located(x, np.where(located, state[:, 3], np.nan), cov[:, :3, :3], located, margin)

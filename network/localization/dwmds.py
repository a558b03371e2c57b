"""Distributed weighted multidimensional scaling, as Gao et al. print it and mended (their equations 2 to
9)."""

from typing import Literal

import numpy as np

from ._sweeps import sweep
from .problem import Array, Booleans, RangeProblem
from .spherical import Neighbors, neighbors

Weights = Literal["unit", "adaptive", "residual"]
_WEIGHTS: dict[Weights, int] = {"unit": 0, "adaptive": 1, "residual": 2}


def dwmds(
    problem: RangeProblem,
    x0: Array,
    update: Literal["mended", "printed"] = "mended",
    weights: Weights = "unit",
    sweeps: int = 100,
    tolerance_m: float = 0.1,
    usable: Booleans | None = None,
    links: Neighbors | None = None,
) -> Array:
    """Positions (n, 3) m after sweeps over the nodes, each moved to where its neighbours put it.

    ``update="printed"`` is (3) and (4) as printed. ``"mended"`` departs from it three times:

    - (3), (4): the sum lacks the node's own term, without which the result is no position (it is not even
      moved along
      when all positions are). From the cost (2) follows, with the term,
      ``x_i <- sum_j w_ij [x_j + (dhat_ij / d_ij) (x_i - x_j)] / sum_j w_ij``.
    - (3), (4): the factor 2 on anchors is absent from the cost (2), so it is 1.
    - (6): the mean residual is over the links of node i and so the same for all its neighbours; to tell
      reliable
      neighbours from others it has to be that of node j. (7), which sums over the index that it leaves
      free, is taken to sum over j in both forms.

    ``weights``: ``"unit"``; ``"adaptive"``, (5) to (9); ``"residual"``, symmetric instead: the inverse of
    the mean square residual of the two nodes together, because (9) makes w_ij and w_ji differ and the
    sweeps no descent on (2). Heights act as f(x_i) in (2), on the mended update, with the weight of one
    link.

    Parameters
    ----------
    x0 : (n, 3) m, start; rows of anchors are taken from the problem, nodes whose start is NaN take no part.
    sweeps, tolerance_m : most sweeps, and the largest step of any node at which they end sooner.
    usable : (n,) nodes that take part; by default those whose start is finite.

    Offsets of clocks are left out: ranges must be free of them. Diverging positions, as the printed form
    makes them, are returned as they are.
    """
    links = links or neighbors(problem)
    x = np.where(problem.anchor[:, None], problem.anchor_x, x0)
    part = np.isfinite(x.sum(axis=1)) & (True if usable is None else usable | problem.anchor)
    height = np.full(problem.nodes, np.nan) if problem.height is None else problem.height
    x = np.where(part[:, None], x, 0.0)
    sweep(
        x,
        links.first,
        links.other,
        np.maximum(problem.ranges[links.link], 0.0),
        problem.anchor,
        part,
        height,
        problem.curvature,
        update == "printed",
        _WEIGHTS[weights],
        sweeps,
        tolerance_m,
    )
    return np.where(part[:, None], x, np.nan)

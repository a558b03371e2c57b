"""Maximum-likelihood positions of a fleet from a start: damped Gauss-Newton, and its robust forms."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from ...sins.settings import Settings
from . import _cholesky, _dense
from .problem import Array, Booleans, RangeProblem

LOSSES = {"squared": _dense.SQUARED, "huber": _dense.HUBER, "one_sided": _dense.ONE_SIDED}
"""What the compiled loops call the losses."""
FLOOR = np.array([1e-5, 1e-5, 1e-5, 1e-7]) ** 2
"""Information that keeps unknown directions finite: 100 km of position, 10,000 km of clock offset."""


class Loss(Settings):
    """How a residual of a range counts."""

    kind: Literal["squared", "huber", "one_sided"] = "one_sided"
    """`one_sided` doubts long ranges alone: what is not in line of sight can only be too long."""
    threshold: float = Field(default=2.5, gt=0, le=100)
    """Standard deviations up to which a residual counts by its square."""


@dataclass(frozen=True)
class Refined:
    """A least-squares solution."""

    x: Array
    """(n, 3) m; the rows of nodes that took no part are NaN."""
    clock: Array | None
    """(n,) m, where clocks were unknown."""
    cov: Array
    """(n, 3, 3) m^2, each node's own; zero for anchors that stay where they are, NaN where ``x`` is."""
    cost: float
    """Half the sum of squared residuals in standard deviations, robust ones as their loss has them."""
    iterations: int
    converged: bool


def refine(
    problem: RangeProblem,
    x0: Array,
    loss: Loss | None = None,
    usable: Booleans | None = None,
    clock0: Array | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-4,
) -> Refined:
    """The minimum of the weighted, possibly robust, sum of squares near a start.

    Parameters
    ----------
    x0 : (n, 3) m, start; rows of anchors are taken from the problem.
    usable : (n,) nodes that take part; by default those whose start is finite, and anchors.
    clock0 : (n,) m, start of the clock offsets; zero by default.
    tolerance : size of the last step, in standard deviations of all unknowns together.

    Where the geometry leaves a direction unknown, the covariance has some (100 km)^2 there.
    """
    loss = loss or Loss(kind="squared")
    n, B = problem.nodes, 4 if problem.clocks else 3
    start = np.where(problem.anchor[:, None], problem.anchor_x, x0)
    part = np.isfinite(start.sum(axis=1))
    if usable is not None:
        part &= usable | problem.anchor
    S = np.zeros((n, B))
    S[:, :3] = np.where(part[:, None], start, 0.0)
    if clock0 is not None and problem.clocks:
        S[:, 3] = np.where(part & ~problem.anchor, clock0, 0.0)
    w_prior = np.zeros((n, B))
    free = part.copy()
    if problem.anchor_sd > 0:
        w_prior[problem.anchor, :3] = problem.anchor_sd**-2
        # The clock of an anchor is known far better than any range.
        w_prior[problem.anchor, 3:] = 1e6
    else:
        free &= ~problem.anchor
    place = np.where(free, np.cumsum(free) - 1, -1)
    N = B * int(free.sum())
    joined = part[problem.links].all(axis=1)
    height = np.full(n, np.nan) if problem.height is None else problem.height
    has_height = np.isfinite(height) & part
    A, g = np.empty((N, N)), np.empty(N)
    terms = _dense.Terms(
        links=problem.links,
        ranges=problem.ranges,
        w_range=np.where(joined, problem.range_sd**-2, 0.0),
        rates=np.empty(0),
        w_rate=np.empty(0),
        loss=LOSSES[loss.kind],
        threshold=loss.threshold,
        clocks=problem.clocks,
        prior=S.copy(),
        w_prior=w_prior,
        height=np.where(has_height, height, 0.0),
        w_height=np.where(has_height, problem.height_sd**-2.0, 0.0),
        curvature=problem.curvature,
    )
    cost, iterations, converged = _dense.minimize(
        S, place, terms, FLOOR[:B], 1e-3, max_iterations, tolerance, A, g
    )
    _dense.evaluate(S, place, terms, A, g)
    _dense.support(A, FLOOR[:B])
    _cholesky.factorize(A)
    blocks = np.empty((N // B, B, B))
    _cholesky.covariance_blocks(A, blocks)
    cov = np.full((n, 3, 3), np.nan)
    cov[part] = 0.0
    cov[free] = blocks[:, :3, :3]
    x = np.where(part[:, None], S[:, :3], np.nan)
    clock = np.where(part, S[:, 3], np.nan) if problem.clocks else None
    return Refined(x, clock, cov, float(cost), int(iterations), bool(converged))

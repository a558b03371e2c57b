"""Gauss-Newton on a large network: normal equations by preconditioned conjugate gradients, never formed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import _sparse
from ._rows import Rows
from .problem import Array

Singles = NDArray[np.float32]
STEP_CG, COVARIANCE_CG = (0.1, 15), (0.01, 300)
"""Share of the residual that the linear system is left with, and iterations at most. In a step more of them
would go to a few weak nodes, which the next steps move on."""
LEAST_SHARE, MOST_SHARE = 0.03, 1e6
"""Of the neglected curvature's bound, in the damping."""


@dataclass(frozen=True)
class Solution:
    """Where Gauss-Newton ended."""

    x: Array
    cost: float
    iterations: int
    converged: bool


class Newton:
    """Workspace and steps: single precision in the linear system, double in gradient and positions."""

    def __init__(self, rows: Rows) -> None:
        n, ends = len(rows.fixed), len(rows.other)
        self._rows = rows
        self._jacobian = np.zeros((ends, 3), np.float32)
        self._gradient, self._block, self._bend = np.zeros((n, 3)), np.zeros((n, 6), np.float32), np.zeros(n)
        self._damping, self._inverse = np.zeros(n, np.float32), np.zeros((n, 6), np.float32)
        self._step, self._r, self._z, self._p, self._q = (np.zeros((n, 3), np.float32) for _ in range(5))

    def solve(
        self,
        x: Array,
        tolerance: float,
        iterations: int,
        progress: Callable[[float], None] | None = None,
    ) -> Solution:
        """Steps until one promises to lower the cost by less than ``tolerance`` of it; that one is taken.

        The damping is a share of `_sparse.linearize`'s bound on the curvature that Gauss-Newton neglects,
        so that a node which hardly anything holds in one direction does not leave what its equations are
        true for.
        """
        x, cost = x.copy(), self._linearize(x)
        share = 0.3
        for k in range(1, iterations + 1):
            self._cg(-self._gradient, share, *STEP_CG)
            trial = x + self._step
            promised = -0.5 * float(np.vdot(self._gradient, self._step))
            new = self._linearize(trial)
            if new <= cost:
                gain, x, cost = cost - new, trial, new
                if promised <= tolerance * cost:
                    return Solution(x, cost, k, True)
                if gain > 0.5 * promised:
                    share = max(share / 5, LEAST_SHARE)
            elif new <= cost * (1 + 1e-12) and promised <= tolerance * cost:
                # Rounding of the cost decides no more.
                self._linearize(x)
                return Solution(x, cost, k, True)
            else:
                cost = self._linearize(x)
                share *= 8
                if share > MOST_SHARE:
                    return Solution(x, cost, k, False)
            if progress:
                progress(k / iterations)
        return Solution(x, cost, iterations, False)

    @property
    def last_step(self) -> Singles:
        """(n, 3) m, what `solve` tried last."""
        return self._step

    def own_variance(self, x: Array) -> Array:
        """(n,) m^2, sum of the variances of each node's position near ``x`` if its neighbours' were known."""
        self._linearize(x)
        rows = self._rows
        rows.each(
            _sparse.damp_and_invert, rows.fixed, self._block, self._bend, 0.0, self._damping, self._inverse
        )
        return self._inverse[:, [0, 3, 5]].sum(axis=1, dtype=np.float64)

    def covariance(self, draws: int) -> Array:
        """(n, 3, 3) m^2, estimate of each node's covariance; zero for fixed ones.

        The mean outer product of ``draws`` (at most 64) errors that independent errors of the ranges would
        give, to first order at the last `solve`'s result: unbiased, with a relative standard deviation of
        sqrt(2 / draws) in a variance.
        """
        rows, cov = self._rows, np.zeros((len(self._gradient), 6))
        right = np.zeros_like(self._gradient)
        for draw in range(draws):
            rows.each(_sparse.probe, rows.start, rows.other, rows.fixed, self._jacobian, draw, right)
            self._cg(right, 0.0, *COVARIANCE_CG)
            rows.each(_sparse.add_outer, self._step, 1 / draws, cov)
        return cov[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]

    def _linearize(self, x: Array) -> float:
        rows = self._rows
        return rows.total(
            _sparse.linearize,
            *rows.links,
            rows.fixed,
            x,
            self._jacobian,
            self._gradient,
            self._block,
            self._bend,
        )

    def _cg(self, right: Array, share: float, forcing: float, most: int) -> None:
        """Solve the damped normal equations into ``_step``, to a ``forcing`` share of the residual."""
        rows, fixed = self._rows, self._rows.fixed
        system = (rows.start, rows.other, fixed, self._jacobian, self._damping, self._p, self._q)
        vectors = (self._p, self._q, self._inverse, self._step, self._r, self._z)
        rows.each(
            _sparse.damp_and_invert, fixed, self._block, self._bend, share, self._damping, self._inverse
        )
        for vector in (self._step, self._p, self._q, self._z):
            vector[:] = 0
        self._r[:] = right
        rz = first = rows.total(_sparse.cg_residual, fixed, np.float32(0), *vectors)
        rows.each(_sparse.cg_direction, np.float32(0), self._z, self._p)
        for _ in range(most):
            if rz <= forcing * forcing * first:
                break
            alpha = rz / rows.total(_sparse.normal_product, *system)
            before, rz = rz, rows.total(_sparse.cg_residual, fixed, np.float32(alpha), *vectors)
            rows.each(_sparse.cg_direction, np.float32(rz / before), self._z, self._p)

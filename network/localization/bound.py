"""What ranges can tell: Cramer-Rao bound, nodes that can be located at all, and which estimates went
astray."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, eigh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from .problem import Array, Booleans, Integers, RangeProblem

_UNKNOWN = 1e-9
"""Eigenvalue, of the information scaled to a unit diagonal, below which a direction counts as unknown."""


@dataclass(frozen=True)
class Bound:
    """The least covariance that an unbiased estimate can have."""

    cov: Array
    """(n, 3, 3) m^2; NaN for nodes that cannot be located, zero for anchors that stay where they are."""
    localizable: Booleans
    """(n,) nodes that no motion can shift, to first order, without changing what is measured."""

    @property
    def sd(self) -> Array:
        """(n,) m, root of the trace of each node's bound."""
        return np.sqrt(np.trace(self.cov, axis1=1, axis2=2))


def fisher_information(problem: RangeProblem, x: Array) -> tuple[Array, Integers]:
    """Information on the unknowns at the positions ``x`` (n, 3), and the block of each node in it.

    Returns the matrix (k B, k B), B = 3 (north, east, down) or 4 (and clock), and (n,) the block of each
    node, -1 for anchors that stay where they are. Standard deviations of ranges are taken as known.
    """
    n, B = problem.nodes, 4 if problem.clocks else 3
    free = np.ones(n, np.bool_) if problem.anchor_sd > 0 else ~problem.anchor
    block = np.where(free, np.cumsum(free) - 1, -1)
    i, j = problem.links.T
    apart = x[i] - x[j]
    d = np.linalg.norm(apart, axis=1)
    u = np.divide(apart, d[:, None], out=np.zeros_like(apart), where=d[:, None] > 0)
    if problem.clocks:
        u = np.column_stack([u, np.ones(len(u))])
    outer = u[:, :, None] * u[:, None, :] / (problem.range_sd**2)[:, None, None]
    k = int(free.sum())
    blocks = np.zeros((k, k, B, B))
    for a, b, part in ((i, i, outer), (j, j, outer), (i, j, -outer), (j, i, -outer)):
        rows, columns = block[a], block[b]
        keep = (rows >= 0) & (columns >= 0)
        np.add.at(blocks, (rows[keep], columns[keep]), part[keep])
    diagonal = blocks[np.arange(k), np.arange(k)]
    if problem.height is not None:
        slope = np.column_stack([problem.curvature * x[:, :2], -np.ones(n)])
        part = slope[:, :, None] * slope[:, None, :] / problem.height_sd**2
        has = free & np.isfinite(problem.height)
        diagonal[block[has], :3, :3] += part[has]
    if problem.anchor_sd > 0:
        rows = block[problem.anchor]
        diagonal[rows[:, None], np.arange(3), np.arange(3)] += problem.anchor_sd**-2
        if problem.clocks:
            diagonal[rows, 3, 3] += 1e6
    blocks[np.arange(k), np.arange(k)] = diagonal
    return blocks.transpose(0, 2, 1, 3).reshape(k * B, k * B), block


def cramer_rao(problem: RangeProblem, x: Array) -> Bound:
    """The bound at the true positions ``x`` (n, 3) m, for Gaussian errors; dense, for up to some 2,000 nodes.

    Where the information is singular, by its eigenvalues, the nodes that its null space moves cannot be
    located; the bound of the others is that of the pseudo-inverse.
    """
    n, B = problem.nodes, 4 if problem.clocks else 3
    J, block = fisher_information(problem, x)
    k = len(J) // B
    cov, localizable = np.zeros((n, 3, 3)), np.ones(n, np.bool_)
    if not k:
        return Bound(cov, localizable)
    inverse, moved = np.zeros_like(J), np.zeros(len(J), np.bool_)
    joined = coo_matrix((np.abs(J) > 0).reshape(k, B, k, B).any(axis=(1, 3)))
    parts, label = connected_components(joined, directed=False)
    for part in range(parts):
        rows = np.flatnonzero(np.repeat(label == part, B))
        inverse[np.ix_(rows, rows)], moved[rows] = _pseudo_inverse(J[np.ix_(rows, rows)])
    diagonal = np.arange(k)
    blocks = inverse.reshape(k, B, k, B)[diagonal, :, diagonal, :][:, :3, :3]
    free = block >= 0
    localizable[free] = ~moved.reshape(k, B)[:, :3].any(axis=1)
    cov[free] = blocks
    cov[~localizable] = np.nan
    return Bound(cov, localizable)


def _pseudo_inverse(J: Array) -> tuple[Array, Booleans]:
    """Pseudo-inverse, and which unknowns the null space moves."""
    scale = np.sqrt(np.diag(J))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = J / scale / scale[:, None]
    try:
        factor = np.linalg.cholesky(scaled)
        regular = bool(np.diag(factor).min() > 1e-3)
    except np.linalg.LinAlgError:
        factor, regular = scaled, False
    if regular:
        # Far from singular, pivots tell as much as eigenvalues, and sooner.
        inverse = cho_solve((factor, True), np.eye(len(J)))
        return inverse / scale / scale[:, None], np.zeros(len(J), np.bool_)
    values, vectors = eigh(scaled)
    known = values > _UNKNOWN
    moved = (vectors[:, ~known] ** 2).sum(axis=1) > 1e-6
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return inverse / scale / scale[:, None], moved


def normalized_error_squared(x: Array, truth: Array, cov: Array) -> Array:
    """(n,) error squared in units of the covariance, of three degrees of freedom; NaN where the estimate
    has none, where the covariance has none, and for anchors that stay where they are."""
    result = np.full(len(x), np.nan)
    good = np.isfinite(x).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    good &= np.trace(cov, axis1=1, axis2=2) > 0
    error = (x - truth)[good]
    result[good] = np.einsum("ka,ka->k", error, np.linalg.solve(cov[good], error[:, :, None])[:, :, 0])
    return result


def flipped(x: Array, truth: Array, cov: Array, probability: float = 1e-6) -> Booleans:
    """(n,) nodes whose error is beyond what the noise explains: mirrored or otherwise in the wrong place.

    Told from the truth, so for evaluation alone: the normalised error squared by ``cov`` (n, 3, 3), the
    Cramer-Rao bound, is above what chance exceeds with this ``probability``.
    """
    return np.nan_to_num(normalized_error_squared(x, truth, cov)) > chdtri(3, probability)

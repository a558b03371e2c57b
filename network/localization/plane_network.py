"""A network in the plane with sparse matrices: its ranges, their derivatives, least squares over all nodes.

The state (2 k,) m holds north and east of the k free nodes, one after another; what a link adds to the
normal equations stands where its two nodes meet, so that their factor grows little faster than the network.
"""

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs, dtbtrs  # pyright: ignore[reportAttributeAccessIssue]
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from .plane import check_anchors, check_ranges, distances
from .problem import Array, Booleans, Integers, LocalizationError, RangeProblem


@dataclass(frozen=True)
class PlaneNetwork:
    """The links between nodes that take part, of which one at least is free."""

    problem: RangeProblem
    x: Array
    """(n, 2) m, the start; of nodes that take no part zero."""
    part: Booleans
    """(n,) beacons, and nodes that have a start."""

    @cached_property
    def free(self) -> Booleans:
        """(n,) nodes whose position is unknown and that a link holds."""
        linked = np.zeros(len(self.part), np.bool_)
        linked[self.problem.links[self._counted]] = True
        return linked & self.part & ~self.problem.anchor

    @property
    def unknowns(self) -> int:
        """Length of the state, 2 k."""
        return 2 * int(self.free.sum())

    @cached_property
    def _counted(self) -> Booleans:
        links = self.problem.links
        both = self.part[links].all(axis=1) & ~self.problem.anchor[links].all(axis=1)
        return np.asarray(both)

    @cached_property
    def links(self) -> Integers:
        """(m, 2)."""
        return self.problem.links[self._counted]

    @cached_property
    def ranges(self) -> Array:
        """(m,) m."""
        return self.problem.ranges[self._counted]

    @cached_property
    def range_sd(self) -> Array:
        """(m,) m."""
        return self.problem.range_sd[self._counted]

    @cached_property
    def place(self) -> Integers:
        """(n,) which pair of the state is a node's, -1 for none."""
        return np.where(self.free, np.cumsum(self.free) - 1, -1)

    @cached_property
    def _pattern(self) -> tuple[Integers, Integers, Booleans]:
        at = self.place[self.links]
        held = at >= 0
        columns = (2 * at[:, :, None] + np.arange(2)).reshape(-1, 4)
        kept = np.repeat(held, 2, axis=1)
        starts = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
        return columns[kept], starts, kept

    def predicted(self, x: Array) -> tuple[Array, csr_matrix]:
        """Distances (m,) at positions (n, 2), and their derivatives H (m, 2 k)."""
        i, j = self.links.T
        d, u = (values[:, 0] for values in distances(x[i], x[j][:, None]))
        H = copy(self._derivatives)
        H.data = np.hstack([u, -u])[self._pattern[2]]
        return d, H

    @cached_property
    def _derivatives(self) -> csr_matrix:
        """H without its values: making one anew is most of the work of a prediction."""
        columns, starts, _ = self._pattern
        return csr_matrix((np.zeros(len(columns)), columns, starts), shape=(len(self.links), self.unknowns))

    @cached_property
    def _normal_pattern(self) -> tuple[Integers, Integers, Integers, Integers]:
        """Rows and column starts of the normal matrix, its diagonal, and where each product of H goes."""
        columns, starts, _ = self._pattern
        count, N = np.diff(starts), self.unknowns
        pairs = np.repeat(np.arange(len(columns)), np.repeat(count, count))
        first = np.repeat(np.repeat(starts[:-1], count), np.repeat(count, count))
        other = first + (np.arange(len(pairs)) - np.searchsorted(pairs, pairs))
        keys, slot = np.unique(columns[pairs] * N + columns[other], return_inverse=True)
        column_starts = np.searchsorted(keys, N * np.arange(N + 1))
        diagonal = np.searchsorted(keys, (N + 1) * np.arange(N))
        return keys % N, column_starts, diagonal, np.stack([slot, pairs, other])

    def entries(self, H: csr_matrix, w: Array, supported: Array | float = 0.0) -> Array:
        """Those of ``H^T W H`` with weights w (m,), and ``supported`` (2 k,) added to its diagonal.

        The pattern is made once, which the general product of two sparse matrices would do each time.
        """
        rows, _, diagonal, (slot, one, other) = self._normal_pattern
        weighted = np.repeat(w, np.diff(H.indptr)) * H.data
        entries = np.asarray(np.bincount(slot, weighted[one] * H.data[other], len(rows)), np.float64)
        entries[diagonal] += supported
        return entries

    def diagonal(self, entries: Array) -> Array:
        """(2 k,) of the normal matrix."""
        return np.asarray(entries[self._normal_pattern[2]])

    def normal(self, entries: Array) -> csc_matrix:
        """The normal matrix of `entries`."""
        rows, starts, *_ = self._normal_pattern
        return csc_matrix((entries, rows, starts), shape=(self.unknowns, self.unknowns))

    @cached_property
    def _band(self) -> tuple[Integers, int, Integers, Integers]:
        """Order of the unknowns that keeps the normal matrix near its diagonal, its width there, which
        entries are of the lower half, and where they stand in LAPACK's band."""
        rows, starts, *_ = self._normal_pattern
        order = reverse_cuthill_mckee(self.normal(np.ones(len(rows))).tocsr(), symmetric_mode=True)
        rank = np.argsort(order)
        row, column = rank[rows], np.repeat(rank, np.diff(starts))
        lower = np.flatnonzero(row >= column)
        below = (row - column)[lower]
        width = int(below.max(initial=0)) + 1
        return order, width, lower, column[lower] * width + below

    def factorized(self, entries: Array) -> "Factor":
        """Factor of the normal matrix of `entries`. Raises `LinAlgError` if it is not positive definite."""
        order, width, lower, at = self._band
        band = np.zeros(self.unknowns * width)
        band[at] = entries[lower]
        factor, info = dpbtrf(band.reshape(-1, width).T, lower=1, overwrite_ab=1)
        if info:
            raise np.linalg.LinAlgError("the ranges leave normal equations that are not positive definite")
        return Factor(factor, order)

    def moved(self, x: Array, step: Array) -> Array:
        """Positions (n, 2) after a step (2 k,) of the state."""
        after = x.copy()
        after[self.free] += step.reshape(-1, 2)
        return after


def plane_network(problem: RangeProblem, x0: Array) -> PlaneNetwork:
    """The network of the nodes whose start x0 (n, 2) is finite. Raises `LocalizationError` for its shape."""
    if x0.shape != (problem.nodes, 2):
        raise LocalizationError(f"x0 must have shape {(problem.nodes, 2)}; got {x0.shape}")
    x = np.where(problem.anchor[:, None], problem.anchor_x[:, :2], x0)
    part = np.asarray(np.isfinite(x).all(axis=1))
    return PlaneNetwork(problem, np.where(part[:, None], x, 0.0), part)


def check_plane_network(problem: RangeProblem) -> None:
    """Raise `LocalizationError` for a network that cannot be located as a whole, and say what is wrong.

    Ranges that are not positive; fewer than three beacons, or beacons on one line; parts of the network
    that no beacon is in, or fewer than three.
    """
    check_ranges(problem.ranges, problem.range_sd)
    check_anchors(problem.anchor_x[problem.anchor, :2])
    n, (i, j) = problem.nodes, problem.links.T
    _, part = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (n, n)), directed=False)
    beacons = np.bincount(part, problem.anchor)
    for label in np.unique(part[~problem.anchor]):
        if beacons[label] < 3:
            members = np.flatnonzero(part == label)
            nodes = ", ".join(str(node) for node in members[:5]) + (", ..." if len(members) > 5 else "")
            raise LocalizationError(
                f"disconnected: the part of {len(members)} nodes ({nodes}) has {beacons[label]:.0f} beacons:"
                " at least 3 are needed"
            )


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of normal equations, as a band."""

    band: Array
    """(width, 2 k), lower."""
    order: Integers
    """(2 k,) unknown that stands at each place of the band."""

    def solve(self, right: Array) -> Array:
        """x (2 k, ...) of ``A x = right``."""
        x = np.empty_like(right)
        x[self.order], _ = dpbtrs(self.band, right[self.order], lower=1, overwrite_b=1)
        return x

    def squares(self, right: Array) -> float:
        """``tr(right^T A^-1 right)``, right (2 k, ...), by half of a solution."""
        half, _ = dtbtrs(self.band, right[self.order], uplo="L", overwrite_b=1)
        return float(np.sum(half**2))

    def own_blocks(self) -> Array:
        """(k, 2, 2) blocks on the diagonal of the inverse."""
        N = len(self.order)
        blocks = np.empty((N // 2, 2, 2))
        for first in range(0, N, _COLUMNS):
            columns = np.arange(first, min(first + _COLUMNS, N))
            right = np.zeros((N, len(columns)))
            right[columns, columns - first] = 1.0
            solved = self.solve(right)
            own = columns.reshape(-1, 2)
            blocks[own[:, 0] // 2] = solved[own[:, :, None], own[:, None, :] - first]
        return blocks


_COLUMNS = 200
"""Of an inverse at a time."""


@dataclass(frozen=True)
class PlaneSolution:
    """A minimum of the weighted squares."""

    x: Array
    """(n, 2) m, NaN for nodes that took no part."""
    cov: Array
    """(n, 2, 2) m^2, each node's own; zero for beacons, NaN where ``x`` is or where it was not asked for."""
    cost: float
    """Half the sum of squared residuals in standard deviations."""
    iterations: int
    converged: bool


def least_squares_in_plane(
    problem: RangeProblem,
    x0: Array,
    covariance: bool = True,
    max_iterations: int = 100,
    tolerance_m: float = 1e-4,
) -> PlaneSolution:
    """Levenberg-Marquardt over all nodes together, from a start (n, 2) m; NaN rows take no part.

    Where the ranges leave a direction open, the covariance has some (1,000 standard deviations of a range)^2
    there.
    """
    net = plane_network(problem, x0)
    x, damping, converged, iterations = net.x, 1e-2, False, 0
    if not net.free.any():
        return PlaneSolution(_finite(net, x), _covariances(net, None), 0.0, 0, True)
    w = net.range_sd**-2.0
    d, H = net.predicted(x)
    cost = _cost(net, d, w)
    while iterations < max_iterations and not converged:
        g, A = H.T @ (w * (net.ranges - d)), net.entries(H, w)
        size = net.diagonal(A)
        while iterations < max_iterations:
            iterations += 1
            step = net.factorized(net.entries(H, w, damping * (size + 1e-6 * size.max()))).solve(g)
            trial = net.moved(x, step)
            trial_d, trial_H = net.predicted(trial)
            trial_cost = _cost(net, trial_d, w)
            if trial_cost <= cost:
                converged = bool(np.abs(step).max() <= tolerance_m)
                x, d, H, cost = trial, trial_d, trial_H, trial_cost
                damping = max(damping / 5, 1e-9)
                break
            if np.abs(step).max() <= tolerance_m:
                converged = True
                break
            damping *= 8
    blocks = None
    if covariance:
        blocks = net.factorized(net.entries(H, w, 1e-6 * np.median(w))).own_blocks()
    return PlaneSolution(_finite(net, x), _covariances(net, blocks), cost, iterations, converged)


def _cost(net: PlaneNetwork, d: Array, w: Array) -> float:
    return 0.5 * float(np.sum(w * (net.ranges - d) ** 2))


def _finite(net: PlaneNetwork, x: Array) -> Array:
    return np.where((net.free | net.problem.anchor)[:, None], x, np.nan)


def _covariances(net: PlaneNetwork, blocks: Array | None) -> Array:
    cov = np.full((net.problem.nodes, 2, 2), np.nan)
    cov[net.problem.anchor] = 0.0
    if blocks is not None:
        cov[net.free] = blocks
    return cov

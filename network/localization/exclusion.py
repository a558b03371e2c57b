"""Whom to leave out so that all others agree: fault exclusion, as receivers of satellites do it.

A node that contradicts the others is no proof against it: the others may be wrong, or all of them disturbed.
So it is left out on trial, the last seconds are solved again without it, and only if nothing is then left to
object to, and the node still contradicts, is it found out. What ranges disagree by beyond their noise, as
where a side has no line of sight, widens all limits: few can be told to lie while many are off.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.special import chdtri, ndtri

from ..fleet import OWN_SHIP
from ._cholesky import covariance_blocks, factorize
from ._dense import SQUARED, evaluate, support
from .contradictions import Evidence, biases, gradients, range_residuals
from .problem import Array, Booleans, Integers

MARGIN = 1.2
"""On all limits: standard deviations are known to that, where the geometry changes within a window, nodes fly
by each other, and a loss doubts some ranges."""
KNOWN_M = 50.0
"""Standard deviation to which others have to know an anchor's place."""
_LEAST_NODES = 5
"""Of which the spread of all nodes' biases is known."""
_KEPT = 40
"""Sets of each size that are followed up in the search: of nine anchors half of all, of fifteen the best. A
smallest set all of whose parts are beyond these is not found."""


@dataclass(frozen=True)
class Limits:
    """At which noise passes for a contradiction.

    ``windows`` are lengths in epochs, ``chance`` is that of noise passing a limit in one test, ``constant``
    the part of a range's stated variance that lasts: to average does not help against it.
    """

    windows: tuple[int, ...]
    chance: float
    constant: float

    @cached_property
    def ranges(self) -> float:
        """Standard deviations of the bias of a node's ranges."""
        return MARGIN * float(-ndtri(self.chance / 2))

    @cached_property
    def _of_beliefs(self) -> dict[int, float]:
        return {B: MARGIN * float(np.sqrt(chdtri(B, self.chance))) for B in (6, 8)}

    def belief(self, numbers: int) -> float:
        """Standard deviations of a belief of 6 numbers, or 8 with a clock, all together."""
        return self._of_beliefs[numbers]

    def share(self, window: int, excess: float = 0.0) -> float:
        """Variance of a range's mean over a window, if ``excess`` of its stated variance lasts besides."""
        return self.constant + (1 - self.constant) / window + excess


@dataclass(frozen=True)
class _Joint:
    """All anchors' beliefs against all ranges, in standard deviations of beliefs: a anchors, B numbers."""

    left: Array
    """(a, B) beliefs less the best fit to all of them and to the ranges."""
    cov: Array
    """(a, B, a, B) of these."""

    def gained(self, sets: Integers) -> Array:
        """(s,) by how much the sum of squares falls without the beliefs of each of the sets (s, size)."""
        size = sets.shape[1] * self.left.shape[1]
        left = self.left[sets].reshape(len(sets), size, 1)
        cov = self.cov[sets[:, :, None], :, sets[:, None, :]].transpose(0, 1, 3, 2, 4)
        whole = cov.reshape(len(sets), size, size)
        return np.einsum("sia,sia->s", left, np.linalg.solve(whole, left))


class Stand:
    """Where the nodes stand at the last of some epochs, as they were solved without some.

    ``anchor`` (n,) marks those whose beliefs are judged, whether they are believed or not.
    """

    def __init__(self, seen: Evidence, anchor: Booleans, limits: Limits) -> None:
        self._limits, n = limits, len(anchor)
        self._windows = [window for window in limits.windows if window <= len(seen.t)]
        C, place = covariance(seen)
        # What has just begun is seen in the last epoch, what is small in the mean of many.
        ratios = [_variance_ratio(seen, window, C, place, limits.chance) for window in self._windows]
        self.ratio = max(ratio for ratio, _ in ratios)
        """Mean square of all ranges' residuals over that which is stated, as far as the fit leaves it."""
        self.excess = max(ratio - 1 if ratio > noise else 0.0 for ratio, noise in ratios)
        """Variance of ranges beyond what is stated, over what is stated; 0 where it is no more than noise."""
        squares = np.sum(seen.w_range * range_residuals(seen)[0] ** 2, axis=0)
        of_nodes = np.bincount(seen.terms.links.ravel(), np.repeat(squares, 2), n)
        of_nodes[OWN_SHIP] = 0.0
        self.worst = int(np.argmax(of_nodes))
        """The node whose ranges are off by most, whatever its place."""
        z = biases(seen)
        self._biases = [np.mean(z[-window:], axis=0) for window in self._windows]
        known = np.flatnonzero(anchor & seen.started)
        pulls, off = gradients(seen)[:, known], (seen.beliefs - seen.states)[:, known]
        sd = seen.belief_sd
        self._n, self._size, self._rows = n, len(sd), known
        C = C[place[known]][:, :, place[known]] / sd[:, None, None] / sd
        # Others that hardly know where it is, or where they are, cannot contradict an anchor.
        spread, held = np.einsum("aiai->ai", C)[:, :3].max(axis=1), seen.terms.w_prior[known, 0] > 0
        self._known = np.where(held, 1 / np.maximum(1 - spread, 1e-12), spread) < (KNOWN_M / sd[0]) ** 2
        told = self._averages(pulls * sd), self._averages(off / sd)
        believed = np.repeat(held, len(sd))
        self._told = [(C, believed, *means) for means in zip(*told, strict=True)]

    def _averages(self, rows: Array) -> list[Array]:
        return [np.mean(rows[-window:], axis=0) for window in self._windows]

    def of_ranges(self, excess: float) -> Array:
        """(n,) bias of each node's ranges over its limit, the worst of the windows."""
        found = np.zeros(self._n)
        for window, z in zip(self._windows, self._biases, strict=True):
            share = self._limits.share(window, excess)
            found = np.maximum(found, range_excess(z[None] / np.sqrt(share))[0] / self._limits.ranges)
        return found

    def to_disbelieve(self, excess: float, most: int) -> tuple[frozenset[int], bool]:
        """The fewest anchors that the search finds, at most ``most``, after whom no belief contradicts the
        others, and True; or those after whom they do least, and False."""
        joints, limit2 = self._joints(excess), self._limits.belief(self._size) ** 2
        if not joints:
            return frozenset(), True
        judged = np.flatnonzero(self._known).tolist()
        gains: dict[tuple[int, ...], Array] = {(): np.zeros(len(joints))}
        best, kept = (), [()]
        for _ in range(most + 1):
            further = sorted({tuple(sorted({*out, i})) for out in kept for i in judged if i not in out})
            if not further:
                break
            rows = np.stack([joint.gained(np.array(further)) for joint in joints], axis=1)
            gains.update(zip(further, rows, strict=True))
            for out in kept:
                more = [gains[tuple(sorted({*out, i}))] - gains[out] for i in judged if i not in out]
                if len(more) and np.max(more) <= limit2 and self._each_needed(out, gains, limit2):
                    return self._named(out), True
            best = kept[0]
            kept = sorted(further, key=lambda out: -float(gains[out].max()))[:_KEPT]
        return self._named(best), False

    def _named(self, rows: tuple[int, ...]) -> frozenset[int]:
        return frozenset(self._rows[list(rows)].tolist())

    @staticmethod
    def _each_needed(out: tuple[int, ...], gains: dict[tuple[int, ...], Array], limit2: float) -> bool:
        """Whether each of a set contradicts all others who are believed, as far as that was worked out: it
        passes where the set without one of them was not followed up."""
        without = [gains.get(rest) for rest in combinations(out, len(out) - 1)] if out else []
        return all(less is None or np.max(gains[out] - less) > limit2 for less in without)

    def _joints(self, excess: float) -> list[_Joint]:
        """For each window, what is left if all are believed, from the ranges' part of this solution."""
        found: list[_Joint] = []
        for window, (C, believed, pull, off) in zip(self._windows, self._told, strict=True):
            share = self._limits.share(window, excess)
            size = len(believed)
            of_ranges = (np.linalg.inv(C.reshape(size, size)) - np.diag(believed.astype(float))) / share
            fit = np.linalg.inv(of_ranges + np.eye(size))
            left = off.ravel() - fit @ (pull.ravel() / share + off.ravel())
            # Directions that nobody knows but by beliefs leave nothing.
            cov = np.eye(size) - fit + 1e-9 * np.eye(size)
            found.append(_Joint(left.reshape(off.shape), cov.reshape(*off.shape, *off.shape)))
        return found if len(self._rows) else []


def covariance(seen: Evidence) -> tuple[Array, Integers]:
    """(p, B, p, B) of all started nodes' states at the first epoch, of all pairs that ranged each other at
    any, and the place (n,) of each node in it."""
    V, place = inverse_factor(seen)
    B = seen.states.shape[2]
    V = np.triu(V)
    return (V @ V.T).reshape(len(V) // B, B, len(V) // B, B), place


def inverse_factor(seen: Evidence, blocks: Array | None = None) -> tuple[Array, Integers]:
    """``V``, upper triangle, with the covariance ``V V'``, and each node's place in it; blocks of the
    covariance's diagonal go to ``blocks``.

    An epoch with fewer pairs has smaller gradients than these say, never larger ones.
    """
    B = seen.states.shape[2]
    place = np.where(seen.started, np.cumsum(seen.started) - 1, -1)
    most = seen.w_range.max(axis=0), seen.w_rate.max(axis=0)
    terms = seen.terms._replace(loss=SQUARED, w_range=most[0], w_rate=most[1])
    N = B * int(seen.started.sum())
    A = np.empty((N, N))
    evaluate(seen.states[0].copy(), place, terms, A, np.empty(N))
    support(A, seen.floor)
    factorize(A)
    covariance_blocks(A, np.empty((0, B, B)) if blocks is None else blocks)
    return A, place


def range_excess(bias: Array) -> Array:
    """(w, n) nodes' biases (w, n), in standard deviations, NaN if unknown, against those of all nodes."""
    known = np.isfinite(bias)
    off = bias - _medians(bias)
    # What befalls all nodes, as detours do that nobody was told of, is no lie of one.
    spread = 1.4826 * _medians(abs(off))
    enough = (known.sum(axis=1) >= _LEAST_NODES)[:, None]
    return np.where(known & enough, abs(off) / np.fmax(spread, 1.0), 0.0)


def _medians(rows: Array) -> Array:
    """(w, 1) of each row's numbers; NaN of a row with none."""
    count = np.isfinite(rows).sum(axis=1, keepdims=True)
    ordered = np.sort(rows, axis=1)
    middle = [np.take_along_axis(ordered, np.maximum(count - 1 + i, 0) // 2, axis=1) for i in (0, 1)]
    return 0.5 * (middle[0] + middle[1])


def _variance_ratio(
    seen: Evidence, window: int, C: Array, place: Integers, chance: float
) -> tuple[float, float]:
    """Mean square of all ranges' residuals over the last epochs, in variances and over what the fit leaves of
    1, and its limit.

    Those of the own ship are left to the judgement of its fixes: where its links are blocked, the fleet's
    others still know where they are.
    """
    i, j = seen.terms.links.T
    pairs = seen.w_range.any(axis=0) & (i != OWN_SHIP) & (j != OWN_SHIP)
    residual, u = range_residuals(seen)
    u = u[0, pairs]
    if seen.terms.clocks:
        u = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    a, b, w = place[i[pairs]], place[j[pairs]], seen.w_range[-window:, pairs]
    D = u.shape[1]
    apart = C[a, :D, a, :D] + C[b, :D, b, :D] - C[a, :D, b, :D] - C[b, :D, a, :D]
    fitted = w.max(axis=0) * np.einsum("ma,mab,mb->m", u, apart, u)
    freedom = float(np.sum((w > 0) * (1 - np.minimum(fitted, 1.0))))
    if freedom < 1:
        return np.inf, 1.0
    ratio = float(np.sum(w * residual[-window:, pairs] ** 2)) / freedom
    noise = max(MARGIN**2, float(chdtri(freedom, chance)) / freedom)
    return ratio, noise

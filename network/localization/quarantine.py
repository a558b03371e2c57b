"""Nodes that contradict the others from epoch to epoch are found out, and left out from then on.

Two things are watched. What an *anchor says of itself* is held against where everybody else's ranges put
it: the solution without its belief, had from the one with it by the gradient of the others' terms. And the
*ranges of a node* are held against each other: whatever makes all of them too long, or too short, beyond
what a move of the node, or its clock, explains. Both are averaged over windows, from a single epoch to ten
seconds: the short ones find large lies at once, the long ones small lies and slow ramps.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy.stats import chi2, norm

from ...sins.settings import Settings
from ..fleet import OWN_SHIP
from ..record import QuarantineReason
from ._dense import ONE_SIDED, SQUARED, Terms
from .problem import Array, Booleans, Integers

WINDOWS_S = (0.0, 1.0, 10.0)
"""Lengths of the windows; the first is one epoch."""
_CUT = 3.0
"""Standard deviations at which a node's residuals are cut off, so that a few cannot speak for all."""
_UNTOLD = 0.05
"""Share of a bias of all ranges that a move of the node must leave, for them to tell of it."""
_LEAST_NODES = 5
"""Of which the spread of all nodes' biases is known."""


class QuarantineSettings(Settings):
    """When a node is found out."""

    false_alarms_per_hour: float = Field(default=1e-3, ge=1e-12, le=1)
    """Chance, at most about, at which noise alone quarantines a given node within an hour."""


class Evidence(NamedTuple):
    """Consecutive epochs as they were solved: k epochs, n nodes, m pairs, B numbers a node's state."""

    t: Array
    """(k,) s."""
    terms: Terms
    """Of the first epoch: links, loss, clocks, heights' weights, and what is known of anchors."""
    states: Array
    """(k, n, B)."""
    cov: Array
    """(n, B, B) of each node's state, and the part of it that is of the anchors' errors."""
    shared: Array
    started: Booleans
    """(n,) nodes that took part."""
    w_range: Array
    """(k, m), zero for pairs that did not range each other."""
    w_rate: Array
    ranges: Array
    """(k, m) m."""
    rates: Array
    heights: Array
    """(k, n) m."""


@dataclass(frozen=True)
class Found:
    """A node that was found out, and at which of the epochs."""

    epoch: int
    node: int
    reason: QuarantineReason


class Monitor:
    """Watches a fleet of nodes, of which ``anchor`` (n,) say where they are, at ``rate_hz`` epochs a second.

    ``constant_share`` is the part of a range's stated variance that is constant over time: to average does
    not help against it. Fewer than half of the anchors are ever left out, since who is right is settled by
    majority; and never the own ship, whose fixes are judged where they are made.
    """

    def __init__(
        self, settings: QuarantineSettings, anchor: Booleans, rate_hz: float, constant_share: float = 0.0
    ) -> None:
        n = len(anchor)
        self.since_s: Array = np.full(n, np.nan)
        """(n,) s, when each node was quarantined; NaN for those that were not."""
        self.reason: Integers = np.full(n, int(QuarantineReason.NONE))
        """(n,) `QuarantineReason`."""
        self._anchor, self._constant = anchor, constant_share
        self._windows = sorted({max(1, round(length * rate_hz)) for length in WINDOWS_S})
        # Windows overlap, and so do their tests: their number times the chance of each is a bound.
        tests = 2 * len(self._windows) * 3600 * rate_hz
        self._chance = settings.false_alarms_per_hour / tests
        self._forget()

    @property
    def disbelieved(self) -> Booleans:
        """(n,) anchors that are not asked where they are."""
        return self.reason == QuarantineReason.BELIEF

    @property
    def silenced(self) -> Booleans:
        """(n,) nodes whose ranges are not used."""
        return self.reason == QuarantineReason.RANGES

    def judge(self, seen: Evidence) -> Found | None:
        """The first node that is found out, and the epoch; what came after it is then not looked at.

        Its epoch is to be solved again, without it.
        """
        shift, bias = _gradients(seen), _biases(seen)
        fallible = self._anchor & seen.started & (self.reason == QuarantineReason.NONE)
        if (
            2 * np.count_nonzero(self._anchor & (self.reason != QuarantineReason.NONE)) + 2
            > self._anchor.sum()
        ):
            fallible[:] = False
        anchors = np.flatnonzero(fallible)
        limits = np.sqrt(chi2.isf(self._chance, seen.states.shape[2])), norm.isf(self._chance / 2)
        for epoch in range(len(seen.t)):
            self._shifts.append(shift[epoch])
            self._biases.append(bias[epoch])
            longest = self._windows[-1]
            del self._shifts[:-longest], self._biases[:-longest]
            excess = np.stack(
                [
                    self._belief_excess(seen, anchors) / limits[0],
                    self._range_excess(fallible | ~self._anchor) / limits[1],
                ]
            )
            if excess.max(initial=0.0) > 1:
                kind, node = np.unravel_index(np.argmax(excess), excess.shape)
                found = Found(epoch, int(node), QuarantineReason(int(kind) + 1))
                self.since_s[node], self.reason[node] = seen.t[epoch], found.reason
                # What was seen of others had its lies in it.
                self._forget()
                return found
        return None

    def _forget(self) -> None:
        self._shifts: list[Array] = []
        self._biases: list[Array] = []

    def _belief_excess(self, seen: Evidence, anchors: Integers) -> Array:
        """(n,) distance of anchors' beliefs from where others have them, in standard deviations of B numbers
        together, the greatest of all windows."""
        excess = np.zeros(len(self._anchor))
        if not len(anchors):
            return excess
        w = seen.terms.w_prior[anchors]
        R = np.einsum("ab,bc->abc", 1 / w, np.eye(w.shape[1]))
        P, shared = seen.cov[anchors], seen.shared[anchors]
        constant, noise = R - 2 * P + shared, P - shared
        for window in self._windows:
            recent = np.array(self._shifts[-window:])[:, anchors]
            if len(recent) < window:
                continue
            mean = recent.mean(axis=0) / w
            share = self._constant + (1 - self._constant) / window
            # In standard deviations of the belief: the numbers of a state differ in size.
            cov = (constant + share * noise) * np.sqrt(w[:, :, None] * w[:, None])
            scaled = mean * np.sqrt(w)
            with np.errstate(invalid="ignore"):
                square = np.einsum("ab,ab->a", scaled, np.linalg.solve(cov, scaled[..., None])[..., 0])
            excess[anchors] = np.fmax(excess[anchors], np.sqrt(np.maximum(square, 0.0)))
        return excess

    def _range_excess(self, judged: Booleans) -> Array:
        """(n,) bias of nodes' ranges in standard deviations, against that of all nodes, the greatest of all
        windows."""
        excess = np.zeros(len(judged))
        for window in self._windows:
            recent = np.array(self._biases[-window:])
            known = np.isfinite(recent).all(axis=0) if len(recent) == window else np.zeros(len(judged), bool)
            if known.sum() < _LEAST_NODES:
                continue
            mean = recent[:, known].mean(axis=0) / np.sqrt(self._constant + (1 - self._constant) / window)
            off = mean - np.median(mean)
            # What befalls all nodes, as detours do that nobody was told of, is no lie of one.
            excess[known] = np.maximum(excess[known], abs(off) / max(1.0, 1.4826 * np.median(abs(off))))
        excess[~judged | (self.reason == QuarantineReason.RANGES)] = 0.0
        excess[OWN_SHIP] = 0.0
        return excess


def _gradients(seen: Evidence) -> Array:
    """(k, n, B) of half the sum of squares without beliefs, negative: where others would have each node."""
    terms, S = seen.terms, seen.states
    i, j = terms.links.T
    V = 4 if terms.clocks else 3
    u, distance = _sights(S, i, j)
    r1 = seen.ranges - distance
    v = S[:, i, V : V + 3] - S[:, j, V : V + 3]
    rate = np.einsum("kma,kma->km", u, v)
    q = (v - rate[..., None] * u) / np.maximum(distance, 1.0)[..., None]
    r2 = seen.rates - rate
    if terms.clocks:
        r1 = r1 - (S[:, i, 3] - S[:, j, 3])
        r2 = r2 - (S[:, i, 7] - S[:, j, 7])
    size = r1 * np.sqrt(seen.w_range)
    doubted = size > terms.threshold if terms.loss == ONE_SIDED else abs(size) > terms.threshold
    doubted &= terms.loss != SQUARED
    f1 = seen.w_range * r1 * np.where(doubted, terms.threshold / np.maximum(abs(size), 1e-9), 1.0)
    f2 = seen.w_rate * r2
    pulls = np.zeros((*f1.shape, S.shape[2]))
    pulls[..., :3] = f1[..., None] * u + f2[..., None] * q
    pulls[..., V : V + 3] = f2[..., None] * u
    if terms.clocks:
        pulls[..., 3], pulls[..., 7] = f1, f2
    gradient = np.einsum("kmb,mn->knb", pulls, _ends(i, j, S.shape[1]), optimize=True)
    level = terms.curvature * S[..., :2]
    off = seen.heights - (0.5 * np.einsum("kna,kna->kn", level, S[..., :2]) - S[..., 2])
    pull = terms.w_height * off
    gradient[..., :2] += pull[..., None] * level
    gradient[..., 2] -= pull
    return gradient


def _biases(seen: Evidence) -> Array:
    """(k, n) what all ranges of a node are too long by, in standard deviations; NaN where they cannot tell.

    Neighbours are taken for known. Where they are not, residuals are smaller than that lets expect.
    """
    terms, S = seen.terms, seen.states
    i, j = terms.links.T
    n = S.shape[1]
    u, distance = _sights(S, i, j)
    root_w = np.sqrt(seen.w_range)
    residual = seen.ranges - distance
    if terms.clocks:
        residual = residual - (S[:, i, 3] - S[:, j, 3])
    residual = (residual * root_w).clip(-_CUT, _CUT)
    moves = u * root_w[..., None]
    if terms.clocks:
        moves = np.concatenate([moves, root_w[..., None]], axis=-1)
    B = moves.shape[2]
    # A bias of a node makes all its ranges longer; what a move makes longer turns with the end.
    signed = _ends(i, j, n)
    to = abs(signed)
    M = np.einsum("kma,kmb,mn->knab", moves, moves, to, optimize=True)
    c = np.einsum("kma,mn->kna", moves * root_w[..., None], signed, optimize=True)
    d = np.einsum("kma,mn->kna", moves * residual[..., None], signed, optimize=True)
    bias2, told = root_w**2 @ to, (root_w * residual) @ to
    M += 1e-9 * np.einsum("knaa->kn", M)[..., None, None] * np.eye(B) + 1e-30 * np.eye(B)
    along = np.linalg.solve(M, np.stack([c, d], axis=-1))
    left2 = bias2 - np.einsum("kna,kna->kn", c, along[..., 0])
    told -= np.einsum("kna,kna->kn", c, along[..., 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(left2 > _UNTOLD**2 * bias2, told / np.sqrt(left2), np.nan)


def _ends(i: Integers, j: Integers, n: int) -> Array:
    """(m, n): 1 at the first node of each pair, -1 at the second."""
    ends = np.zeros((len(i), n))
    rows = np.arange(len(i))
    ends[rows, i], ends[rows, j] = 1.0, -1.0
    return ends


def _sights(S: Array, i: Integers, j: Integers) -> tuple[Array, Array]:
    """Unit vectors (k, m, 3) from the second to the first nodes of pairs, and distances (k, m)."""
    apart = S[:, i, :3] - S[:, j, :3]
    distance = np.linalg.norm(apart, axis=-1)
    return apart / np.maximum(distance, 1e-9)[..., None], distance

"""Nodes that contradict the others from epoch to epoch are found out, and left out from then on.

Two things are watched. What an *anchor says of itself* is held against where everybody else's ranges put
it: the solution without its belief, had from the one with it by the gradient of the others' terms. And the
*ranges of a node* are held against each other: whatever makes all of them too long, or too short, beyond
what a move of the node, or its clock, explains. Both are averaged over windows, from a single epoch to some
seconds: the short ones find large lies at once, the long ones small lies and slow ramps.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.stats import chi2, norm

from ...sins.settings import Settings
from ..fleet import OWN_SHIP
from ..record import QuarantineReason
from ._cholesky import covariance_blocks, factorize
from ._dense import SQUARED, evaluate, support
from ._tracking import of_anchors
from .contradictions import Evidence, biases, gradients
from .problem import Array, Booleans, Integers

WINDOWS_S = (0.0, 1.0, 3.0)
"""Lengths of the windows; the first is one epoch. Over longer ones the geometry changes, and the bias of a
loss that doubts long ranges shows."""
_MARGIN = 1.2
"""On all limits: standard deviations are known to that, where the geometry changes within a window, nodes fly
by each other, and a loss doubts some ranges."""
_KNOWN_M = 50.0
"""Standard deviation to which others have to know an anchor's place."""
_CHANGED = 0.1
"""Share of the pairs that range each other whose change makes another network."""
_LEAST_NODES = 5
"""Of which the spread of all nodes' biases is known."""


class QuarantineSettings(Settings):
    """When a node is found out."""

    false_alarms_per_hour: float = Field(default=1e-3, ge=1e-12, le=1)
    """Chance, at most about, at which noise alone quarantines a given node within an hour."""


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
        self._pairs = np.zeros(n * (n - 1) // 2, np.bool_)
        self._forget()

    @property
    def may_leave_out_an_anchor(self) -> bool:
        """Whether fewer than half would be left out then."""
        left_out = np.count_nonzero(self._anchor & (self.reason != QuarantineReason.NONE))
        return bool(2 * (left_out + 1) < np.count_nonzero(self._anchor))

    def judge(self, seen: Evidence) -> Found | None:
        """The first node that is found out, and the epoch; what came after it is then not looked at.

        Its epoch is to be solved again, without it.
        """
        self._note_suspects(seen)
        pairs = seen.w_range.any(axis=0)
        if np.count_nonzero(pairs != self._pairs) > _CHANGED * np.count_nonzero(self._pairs):
            # Windows over another network than this, as where a jammer sets in, have other spreads.
            self._forget()
        self._pairs = pairs
        fallible = self._anchor & seen.started & (self.reason == QuarantineReason.NONE)
        fallible &= self.may_leave_out_an_anchor
        disbelieved = self.reason == QuarantineReason.BELIEF
        judged = (fallible | disbelieved | ~self._anchor) & (self.reason != QuarantineReason.RANGES)
        judged[OWN_SHIP] = False
        new = len(seen.t)
        self._shifts = np.concatenate([self._shifts.reshape(-1, *seen.states.shape[1:]), gradients(seen)])
        self._biases = np.concatenate([self._biases.reshape(-1, len(self._anchor)), biases(seen)])
        alone = np.sqrt(chi2.isf(self._chance, seen.states.shape[2])), norm.isf(self._chance / 2)
        limits = _MARGIN * np.array(alone)
        excess = np.zeros((new, 2, len(self._anchor)))
        cov = _covariances(seen)
        spread = np.sqrt(np.einsum("naa->na", cov[0][seen.started])[:, :3].sum(axis=1))
        if np.mean(spread < _KNOWN_M) < 0.9:
            # A fleet that is taken apart judges nobody.
            self._forget()
            return None
        for window in self._windows:
            share = self._constant + (1 - self._constant) / window
            rows = slice(max(new - max(len(self._shifts) - window + 1, 0), 0), None)
            mean = _means(self._shifts, window, new)
            of_belief = (
                _belief_excess(seen.terms.w_prior, *cov, np.flatnonzero(fallible), mean, share) / limits[0]
            )
            excess[rows, 0] = np.maximum(excess[rows, 0], of_belief)
            of_ranges = _range_excess(_means(self._biases, window, new) / np.sqrt(share)) / limits[1]
            excess[rows, 1] = np.maximum(excess[rows, 1], of_ranges * judged)
        self._shifts, self._biases = (
            rows[-(self._windows[-1] - 1) :] for rows in (self._shifts, self._biases)
        )
        over = np.flatnonzero(excess.max(axis=(1, 2)) > 1)
        if not len(over):
            return None
        epoch = int(over[0])
        # False ranges pull anchors, too; where an anchor says it is pulls no more than one range of a node.
        of_belief, of_ranges = excess[epoch]
        if of_ranges.max() > 1:
            found = Found(epoch, int(np.argmax(of_ranges)), QuarantineReason.RANGES)
        else:
            found = Found(epoch, int(np.argmax(of_belief)), QuarantineReason.BELIEF)
        node = found.node
        self.since_s[node] = np.fmin(self.since_s[node], seen.t[epoch])
        self.reason[node] = found.reason
        # What was seen of others had its lies in it.
        self._forget()
        return found

    def _note_suspects(self, seen: Evidence) -> None:
        """Anchors that the start left out: the tracker asks them back once they are beyond suspicion."""
        standing_back = self._anchor & ~seen.started & (self.reason == QuarantineReason.NONE)
        asked_back = seen.started & (self.reason == QuarantineReason.START)
        self.reason[standing_back], self.since_s[standing_back] = QuarantineReason.START, seen.t[0]
        self.reason[asked_back], self.since_s[asked_back] = QuarantineReason.NONE, np.nan

    def _forget(self) -> None:
        self._shifts, self._biases = np.zeros(0), np.zeros(0)


def _means(rows: Array, window: int, most: int) -> Array:
    """Means over the windows of so many rows that end with the last ``most`` rows; fewer, if rows are. NaN of
    windows with a NaN in them."""
    known = np.isfinite(rows)
    sums, counts = np.cumsum(np.where(known, rows, 0.0), axis=0), np.cumsum(known, axis=0)
    sums[window:] -= sums[:-window].copy()
    counts[window:] -= counts[:-window].copy()
    return np.where(counts == window, sums / window, np.nan)[window - 1 :][-most:]


def _covariances(seen: Evidence) -> tuple[Array, Array]:
    """(n, B, B) of each node's state at the first epoch, of all pairs that ranged each other at any;
    and the part that is of the anchors' errors.

    An epoch with fewer pairs has smaller gradients than these say, never larger ones.
    """
    n, B = seen.states.shape[1:]
    place = np.where(seen.started, np.cumsum(seen.started) - 1, -1)
    most = seen.w_range.max(axis=0), seen.w_rate.max(axis=0)
    terms = seen.terms._replace(loss=SQUARED, w_range=most[0], w_rate=most[1])
    N = B * int(seen.started.sum())
    A, blocks = np.empty((N, N)), np.empty((N // B, B, B))
    evaluate(seen.states[0].copy(), place, terms, A, np.empty(N))
    support(A, seen.floor)
    factorize(A)
    covariance_blocks(A, blocks)
    cov, shared = np.full((n, B, B), np.nan), np.empty((n, B, B))
    cov[seen.started] = blocks
    of_anchors(A, place, terms.w_prior, shared)
    return cov, shared


def _belief_excess(
    w_prior: Array, cov: Array, shared: Array, anchors: Integers, gradient: Array, share: float
) -> Array:
    """(w, n) distance of anchors' beliefs from where others have them, in standard deviations of all numbers
    of a state together. ``gradient`` (w, n, B) are means, with ``share`` of a single epoch's noise."""
    excess = np.zeros(gradient.shape[:2])
    # In standard deviations of the belief: the numbers of a state differ in size.
    sd = w_prior[anchors] ** -0.5
    size = sd[:, :, None] * sd[:, None]
    P, common = cov[anchors] / size, shared[anchors] / size
    of_mean = np.eye(P.shape[1]) - 2 * P + common + share * (P - common)
    scaled = gradient[:, anchors] * sd
    white = np.linalg.solve(of_mean, scaled.transpose(1, 2, 0)).transpose(2, 0, 1)
    # Others that hardly know where it is, or where they are, cannot contradict an anchor.
    told = 1 - np.einsum("aii->ai", P)[:, :3].max(axis=1) > (sd[:, 0] / _KNOWN_M) ** 2
    excess[:, anchors] = told * np.sqrt(np.maximum(np.einsum("wab,wab->wa", scaled, white), 0.0))
    return excess


def _range_excess(bias: Array) -> Array:
    """(w, n) nodes' biases (w, n), in standard deviations, NaN if unknown, against those of all nodes."""
    known = np.isfinite(bias)
    enough = known.sum(axis=1) >= _LEAST_NODES
    excess = np.zeros(bias.shape)
    off = bias[enough] - np.nanmedian(bias[enough], axis=1, keepdims=True)
    # What befalls all nodes, as detours do that nobody was told of, is no lie of one.
    spread = 1.4826 * np.nanmedian(abs(off), axis=1, keepdims=True)
    excess[enough] = np.nan_to_num(abs(off) / np.maximum(spread, 1.0))
    return excess

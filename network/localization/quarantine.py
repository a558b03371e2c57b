"""Nodes that contradict the others from epoch to epoch are found out, and left out from then on.

Two things are watched. What an *anchor says of itself* is held against where everybody else's ranges put
it: the solution without its belief, had from the one with it by the gradient of the others' terms. And the
*ranges of a node* are held against each other: whatever makes all of them too long, or too short, beyond
what a move of the node, or its clock, explains. Both are averaged over windows, from a single epoch to some
seconds: the short ones find large lies at once, the long ones small lies and slow ramps.

That somebody contradicts is an alarm, no more: who it is, if it is a few at all, `exclusion` finds out.
"""

from collections.abc import Collection

import numpy as np
from pydantic import Field

from ...sins.settings import Settings
from ..fleet import OWN_SHIP
from ..record import QuarantineReason
from ._tracking import of_anchors
from .contradictions import Evidence, biases, gradients
from .exclusion import KNOWN_M, Limits, inverse_factor, range_excess
from .problem import Array, Booleans, Integers

WINDOWS_S = (0.0, 1.0, 3.0)
"""Lengths of the windows; the first is one epoch. Over longer ones the geometry changes, and the bias of a
loss that doubts long ranges shows."""
_CHANGED = 0.1
"""Share of the pairs that range each other whose change makes another network."""


class QuarantineSettings(Settings):
    """When a node is found out."""

    false_alarms_per_hour: float = Field(default=1e-3, ge=1e-12, le=1)
    """Chance, at most about, at which noise alone quarantines a given node within an hour."""


class Monitor:
    """Watches a fleet of nodes, of which ``anchor`` (n,) say where they are, at ``rate_hz`` epochs a second.

    ``constant_share`` is the part of a range's stated variance that is constant over time: to average does
    not help against it. Fewer than half of the anchors are ever left out, since who is right is settled by
    majority; and never the own ship, whose fixes are judged where they are made. Nothing bounds the number of
    other nodes whose ranges are not used; whoever is left out returns only if a later alarm names others.
    """

    def __init__(
        self, settings: QuarantineSettings, anchor: Booleans, rate_hz: float, constant_share: float = 0.0
    ) -> None:
        n = len(anchor)
        self.anchor = anchor
        self.since_s: Array = np.full(n, np.nan)
        """(n,) s, when each node was quarantined; NaN for those that are not."""
        self.found_out: list[tuple[int, float]] = []
        """Node and time, s, of each time that one was found out, whether it was asked back since or not."""
        self.suspected: Booleans = np.zeros(n, np.bool_)
        """(n,) anchors that stood back as suspects of a start at some time."""
        self.reason: Integers = np.full(n, int(QuarantineReason.NONE))
        """(n,) `QuarantineReason`."""
        self.disturbed_s: list[float] = []
        """Epochs, s, at which nodes contradict each other and no few of them are at fault."""
        windows = sorted({max(1, round(length * rate_hz)) for length in WINDOWS_S})
        # Windows overlap, and so do their tests: their number times the chance of each is a bound.
        tests = 2 * len(windows) * 3600 * rate_hz
        self.limits = Limits(tuple(windows), settings.false_alarms_per_hour / tests, constant_share)
        self._pairs = np.zeros(n * (n - 1) // 2, np.bool_)
        nothing = np.zeros(0)
        self._known = -np.inf, np.zeros(0, np.bool_), nothing, (nothing, nothing)
        self._forget()

    @property
    def remembered(self) -> int:
        """How many epochs the windows hold that will be judged with those to come."""
        return len(self._shifts)

    def left_out(self, reason: QuarantineReason) -> frozenset[int]:
        """The nodes that are, for this."""
        return frozenset(np.flatnonzero(self.reason == reason).tolist())

    def may_disbelieve(self, silent: Collection[int]) -> int:
        """How many anchors at most: with those of the silent that are anchors, fewer than half."""
        return max((int(self.anchor.sum()) - 1) // 2 - int(self.anchor[list(silent)].sum()), 0)

    def leave_out(self, disbelieved: Collection[int], silent: Collection[int], t: float) -> None:
        """Note who is left out from ``t``, s, on. Who is no longer among them is asked back."""
        before = self.left_out(QuarantineReason.BELIEF) | self.left_out(QuarantineReason.RANGES)
        self.found_out += [(node, t) for node in sorted({*disbelieved, *silent} - before)]
        for nodes, reason in ((disbelieved, QuarantineReason.BELIEF), (silent, QuarantineReason.RANGES)):
            for node in self.left_out(reason).difference(disbelieved, silent):
                self.reason[node], self.since_s[node] = QuarantineReason.NONE, np.nan
            self.reason[list(nodes)] = reason
            self.since_s[list(nodes)] = np.fmin(self.since_s[list(nodes)], t)
        # What was seen of others had their lies in it.
        self._forget()

    def alarm(self, seen: Evidence) -> int | None:
        """The first of the epochs at which somebody contradicts the others."""
        self._note_suspects(seen)
        pairs = seen.w_range.any(axis=0)
        if np.count_nonzero(pairs != self._pairs) > _CHANGED * np.count_nonzero(self._pairs):
            # Windows over another network than this, as where a jammer sets in, have other spreads.
            self._forget()
        self._pairs = pairs
        silent = self.left_out(QuarantineReason.RANGES)
        fallible = self.anchor & seen.started & (self.reason == QuarantineReason.NONE)
        judged = self.judged(silent)
        self._shifts = np.concatenate([self._shifts.reshape(-1, *seen.states.shape[1:]), gradients(seen)])
        self._biases = np.concatenate([self._biases.reshape(-1, len(self.anchor)), biases(seen)])
        new, windows = len(seen.t), self.limits.windows
        cov = self._covariances_of(seen)
        spread = np.sqrt(np.einsum("naa->na", cov[0][seen.started])[:, :3].sum(axis=1))
        if np.mean(spread < KNOWN_M) < 0.9:
            # A fleet that is taken apart judges nobody.
            self._forget()
            return None
        excess = np.zeros(new)
        for window in windows:
            share = self.limits.share(window)
            rows = slice(max(new - max(len(self._shifts) - window + 1, 0), 0), None)
            mean = _means(self._shifts, window, new)
            of_belief = _belief_excess(seen.terms.w_prior, *cov, np.flatnonzero(fallible), mean, share)
            of_belief /= self.limits.belief(seen.states.shape[2])
            of_ranges = range_excess(_means(self._biases, window, new) / np.sqrt(share)) / self.limits.ranges
            worst = np.maximum(of_belief.max(axis=1), (of_ranges * judged).max(axis=1))
            excess[rows] = np.maximum(excess[rows], worst)
        self._shifts, self._biases = (rows[-(windows[-1] - 1) :] for rows in (self._shifts, self._biases))
        over = np.flatnonzero(excess > 1)
        return int(over[0]) if len(over) else None

    def judged(self, silent: Collection[int]) -> Booleans:
        """(n,) nodes whose ranges are judged while those of others are not used."""
        judged = ~np.isin(np.arange(len(self.anchor)), list(silent))
        if not self.may_disbelieve(silent):
            judged &= ~self.anchor | (self.reason == QuarantineReason.BELIEF)
        judged[OWN_SHIP] = False
        return judged

    def _covariances_of(self, seen: Evidence) -> tuple[Array, Array]:
        """Of the first of the epochs, or of some before: for so long the windows take them for constant."""
        valid_until_s, started, w_prior, cov = self._known
        same = np.array_equal(started, seen.started) and np.array_equal(w_prior, seen.terms.w_prior)
        if not same or seen.t[0] >= valid_until_s or not len(self._shifts) > len(seen.t):
            cov = _covariances(seen)
            self._known = seen.t[0] + WINDOWS_S[-1] - 1e-6, seen.started, seen.terms.w_prior, cov
        return cov

    def _note_suspects(self, seen: Evidence) -> None:
        """Anchors that the start left out: the tracker asks them back once they are beyond suspicion."""
        standing_back = self.anchor & ~seen.started & (self.reason == QuarantineReason.NONE)
        asked_back = seen.started & (self.reason == QuarantineReason.START)
        self.suspected |= standing_back
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
    """(n, B, B) of each node's state, and the part of it that is of the anchors' errors."""
    n, B = seen.states.shape[1:]
    blocks, shared = np.empty((int(seen.started.sum()), B, B)), np.empty((n, B, B))
    V, place = inverse_factor(seen, blocks)
    cov = np.full((n, B, B), np.nan)
    cov[seen.started] = blocks
    of_anchors(V, place, seen.terms.w_prior, shared)
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
    told = 1 - np.einsum("aii->ai", P)[:, :3].max(axis=1) > (sd[:, 0] / KNOWN_M) ** 2
    excess[:, anchors] = told * np.sqrt(np.maximum(np.einsum("wab,wab->wa", scaled, white), 0.0))
    return excess

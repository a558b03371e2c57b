"""Position and velocity of a fleet's nodes, epoch by epoch, from ranges and range rates together.

Each epoch is solved by itself: with a squared loss by maximum likelihood, and with errors as independent of
other epochs' as its measurements. The epoch before is where the search starts, no more.

Ranges and range rates are solved together: a range rate tells of a direction, and so of positions, as much as
of velocities, and velocities from range rates at given positions would have to bear the errors of these.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ..clock import SPEED_OF_LIGHT, ClockSettings
from ..fleet import OWN_SHIP
from . import _tracking
from ._dense import Terms, minimize
from .chain import LocalizationSettings, localize
from .contradictions import Evidence
from .epochs import Epochs, Track
from .gossip import Gossip
from .least_squares import LOSSES
from .problem import Array, Booleans, Integers, NodeOutcome, RangeProblem

RESTART_S = 5.0
"""Interval at which nodes that have no position are started anew, and after which a lost one has none."""
FIRST_RESTART_S = 1.0
"""The same after the first try that left the own ship without a position; each further one doubles it."""
TOLERANCE = 0.03
"""Size of the last step of an epoch, in standard deviations of all unknowns together."""
INCONSISTENT_CHANCE = 1e-6
"""Chance, about, at which noise alone makes a node count as inconsistent."""
_ITERATIONS = 20
_NANOSECOND = 1e-9


class _Component(NamedTuple):
    """Standard deviations of one component of a node's state."""

    anchor: float
    """Of what an anchor believes."""
    floor: float
    """At which the information is held where there is none, so that equations can be solved."""
    weak: float
    """Of the epoch before as knowledge of this one: it keeps a node that hears nobody where it was."""


class Tracker:
    """Follows a fleet through consecutive epochs.

    Parameters
    ----------
    anchor : (n,). anchor_position_sd, anchor_velocity_sd : m and m/s, of each component that anchors believe.
    altitude_sd : m, of the heights.
    clocks : settings of the clocks where ranging is one-way; None where clocks cancel.
    """

    def __init__(
        self,
        anchor: Booleans,
        settings: LocalizationSettings,
        anchor_position_sd: float,
        anchor_velocity_sd: float,
        altitude_sd: float = np.nan,
        clocks: ClockSettings | None = None,
    ) -> None:
        self._anchor, self._settings, self._altitude_sd = anchor, settings, altitude_sd
        self._clocks = clocks is not None
        # Anchors that err less than this would make the equations stiff, and no fix better.
        self._anchor_position_sd = max(anchor_position_sd, 1e-2)
        components = [_Component(self._anchor_position_sd, 1e5, 1e4)] * 3
        components += [_Component(max(anchor_velocity_sd, 1e-4), 1e4, 1e3)] * 3
        if clocks is not None:
            offset_sd = max(SPEED_OF_LIGHT * clocks.sync_sd_ns * _NANOSECOND, 1e-2)
            drift_sd = max(SPEED_OF_LIGHT * clocks.frequency_stability, 1e-4)
            components.insert(3, _Component(offset_sd, 1e7, 1e6))
            components.append(_Component(drift_sd, 1e3, 1e2))
        anchor_sd, floor_sd, weak_sd = np.array(components).T
        self._all_anchors, self._anchor_sd = anchor, anchor_sd
        self._w_prior = np.where(anchor[:, None], anchor_sd**-2.0, 0.0)
        self._floor, self._weak = floor_sd**-2.0, weak_sd**-2.0
        n, first = len(anchor), 4 if self._clocks else 3
        self._kinematic = [0, 1, 2, first, first + 1, first + 2]
        self._S = np.zeros((n, len(components)))
        self._started = anchor.copy()
        self._located_s = np.full(n, -np.inf)
        self._chain_s, self._wait_s = -np.inf, 0.5 * FIRST_RESTART_S
        self._t: float | None = None
        self._chain_outcome = np.full(n, int(NodeOutcome.TOO_FEW_NEIGHBOURS))
        self._gossip = Gossip(settings, np.diag(weak_sd**2), n)
        self._silenced = np.zeros(n, np.bool_)

    def leave_out(self, disbelieved: Collection[int], silent: Collection[int]) -> None:
        """From now on take these anchors, and no others, for nodes like others; use no ranges of the silent,
        nor of those that were silent before."""
        out = np.isin(np.arange(len(self._anchor)), list(disbelieved))
        fallen = self._anchor & out
        self._anchor = self._all_anchors & ~out
        self._w_prior = np.where(self._anchor[:, None], self._anchor_sd**-2.0, 0.0)
        self._started[fallen] &= self._t is not None
        self._located_s[fallen] = -np.inf if self._t is None else self._t
        self._silenced[list(silent)], self._started[list(silent)] = True, False
        self._chain_outcome[list(silent)] = NodeOutcome.QUARANTINED

    def start(self, epochs: Epochs) -> Booleans:
        """Start nodes that have no place at the first epoch, if it is time to; (n,) those that now have."""
        before = self._started.copy()
        missing = not (before | self._silenced).all()
        if missing and epochs.t[0] - self._chain_s >= self._wait_s:
            self._start(self._audible(epochs))
            patient = min(2 * self._wait_s, RESTART_S)
            self._wait_s = RESTART_S if self._started[OWN_SHIP] else patient
        return self._started & ~before

    def advance(self, epochs: Epochs) -> Track:
        """Estimates of the next epochs. Nodes are started at the first of them, if at all."""
        self.start(epochs)
        return self.follow(epochs)

    def follow(self, epochs: Epochs) -> Track:
        """As `advance`, of nodes that were started before."""
        epochs = self._audible(epochs)
        k, (n, B) = len(epochs.t), self._S.shape
        beliefs = self._beliefs(epochs)
        i, j = epochs.pairs.T
        joined = epochs.heard & self._started[i] & self._started[j]
        w_range, w_rate = joined * epochs.range_sd**-2.0, joined * epochs.rate_sd**-2.0
        terms = self._terms(epochs, beliefs[0], w_range[0], w_rate[0])
        states, own_cov = np.empty((k, n, B)), np.empty((k, B, B))
        cov, shared = np.empty((n, B, B)), np.empty((0 if self._settings.tracker == "epoch" else n, B, B))
        misfit, residuals = np.empty((k, n)), np.empty((k, n), np.int64)
        neighbours, converged = np.empty((k, n), np.int64), np.empty(k, np.bool_)
        heights = np.broadcast_to(terms.height, (k, n)) if epochs.height is None else epochs.height
        out = states, own_cov, cov, misfit, residuals, neighbours, converged, shared
        times = np.concatenate([[epochs.t[0] if self._t is None else self._t], epochs.t])
        # A copy, row by row: any other view is another type, for which the loops would be compiled again.
        heights = np.array(heights, order="C")
        if self._settings.solver == "distributed":
            self._gossip.advance(
                self._S, self._place(), epochs, times, terms, w_range, w_rate, beliefs, heights, out
            )
        else:
            _tracking.track(
                times,
                self._S,
                self._place(),
                terms,
                w_range,
                w_rate,
                epochs.ranges,
                epochs.rates,
                beliefs,
                heights,
                self._floor,
                self._weak,
                TOLERANCE,
                _ITERATIONS,
                out,
            )
        self._t = float(epochs.t[-1])
        solved = epochs.t, terms, states, self._started.copy(), self._floor
        told = epochs.ranges, epochs.rates, heights, beliefs, self._anchor_sd
        seen = Evidence(*solved, w_range, w_rate, *told)
        own_cov, cov, shared = (
            part[:, self._kinematic][:, :, self._kinematic] for part in (own_cov, cov, shared)
        )
        sd = np.sqrt(np.einsum("nii->ni", cov))
        spread = np.tile(np.sqrt(np.sum(sd[:, :3] ** 2, axis=-1)), (k, 1))
        spread[:, OWN_SHIP] = np.sqrt(np.einsum("kii->k", own_cov[:, :3, :3]))

        outcome = np.full((k, n), int(NodeOutcome.LOCATED))
        limit = chdtri(np.maximum(residuals - B, 1), INCONSISTENT_CHANCE)
        outcome[misfit > limit] = NodeOutcome.INCONSISTENT
        outcome[spread > self._settings.max_position_sd_m] = NodeOutcome.SINGULAR
        outcome[~converged] = NodeOutcome.NOT_CONVERGED
        outcome[neighbours < self._settings.min_neighbors] = NodeOutcome.TOO_FEW_NEIGHBOURS
        outcome[:, ~self._started] = self._chain_outcome[~self._started]
        outcome[:, self._anchor & self._started] = NodeOutcome.ANCHOR
        self._forget(epochs.t, outcome)
        kept = np.isin(outcome, [NodeOutcome.LOCATED, NodeOutcome.ANCHOR])[..., None]
        own_cov[outcome[:, OWN_SHIP] != NodeOutcome.LOCATED] = np.nan
        x, v = states[..., :3], states[..., self._kinematic[3] : self._kinematic[5] + 1]
        x, v = np.where(kept, x, np.nan), np.where(kept, v, np.nan)
        return Track(x, v, own_cov, sd, outcome, cov, shared, seen)

    def _start(self, epochs: Epochs) -> None:
        """Locate nodes that are not started from the ranges of the first epoch alone."""
        heard = epochs.heard[0]
        found = localize(
            RangeProblem(
                links=epochs.pairs[heard],
                ranges=epochs.ranges[0, heard],
                range_sd=epochs.range_sd[0, heard],
                anchor=self._anchor,
                anchor_x=epochs.belief_x[0],
                anchor_sd=self._anchor_position_sd,
                height=None if epochs.height is None else epochs.height[0],
                height_sd=self._altitude_sd,
                curvature=epochs.curvature,
                clocks=self._clocks,
            ),
            self._settings,
        )
        self._chain_s = self._t = float(epochs.t[0])
        self._chain_outcome = np.where(found.suspect, int(NodeOutcome.INCONSISTENT), found.outcome)
        self._chain_outcome[self._silenced] = NodeOutcome.QUARANTINED
        # A biased anchor pulls the nodes around it: it has to stand back until it is beyond suspicion.
        self._started[self._anchor] = ~(found.suspect | self._silenced)[self._anchor]
        new = ~self._started & (found.outcome == NodeOutcome.LOCATED)
        if not new.any():
            return
        beliefs = self._beliefs(epochs)
        self._S[self._anchor] = beliefs[0, self._anchor]
        self._S[new] = beliefs[0, self._anchor].mean(axis=0)
        self._S[new, :3] = found.x[new]
        if found.clock is not None:
            self._S[new, 3] = found.clock[new]
        self._started |= new
        self._located_s[new] = self._chain_s
        i, j = epochs.pairs.T
        joined = heard & self._started[i] & self._started[j]
        w_range, w_rate = joined * epochs.range_sd[0] ** -2.0, joined * epochs.rate_sd**-2.0
        N = int(self._started.sum()) * self._S.shape[1]
        terms = self._terms(epochs, beliefs[0], w_range, w_rate)
        minimize(
            self._S,
            self._place(),
            terms,
            self._floor,
            1e-3,
            self._settings.max_iterations,
            TOLERANCE,
            np.empty((N, N)),
            np.empty(N),
        )
        self._gossip.start(self._S, new, found.cov)

    def _audible(self, epochs: Epochs) -> Epochs:
        heard = epochs.heard & ~self._silenced[epochs.pairs].any(axis=1)
        return replace(epochs, heard=heard) if self._silenced.any() else epochs

    def _beliefs(self, epochs: Epochs) -> Array:
        """(k, n, B) what all anchors say of themselves, believed or not; their clocks they take for right."""
        beliefs = np.zeros((*epochs.belief_x.shape[:2], self._S.shape[1]))
        both = np.concatenate([epochs.belief_x, epochs.belief_v], axis=-1)
        beliefs[..., self._kinematic] = np.where(self._all_anchors[:, None], both, 0.0)
        return beliefs

    def _place(self) -> Integers:
        """(n,) block of each started node among the unknowns; the own ship's is the last."""
        others = np.flatnonzero(self._started[1:]) + 1
        place = np.full(len(self._started), -1)
        place[others] = np.arange(len(others))
        place[OWN_SHIP] = len(others) if self._started[OWN_SHIP] else -1
        return place

    def _terms(self, epochs: Epochs, belief: Array, w_range: Array, w_rate: Array) -> Terms:
        """The sum of squares of the first epoch, with weights (m,) of its own or of its group."""
        n = len(self._anchor)
        has_height = epochs.height is not None
        return Terms(
            links=epochs.pairs,
            ranges=epochs.ranges[0],
            w_range=w_range,
            rates=epochs.rates[0],
            w_rate=w_rate,
            loss=LOSSES[self._settings.loss],
            threshold=self._settings.loss_threshold,
            clocks=self._clocks,
            prior=belief,
            w_prior=self._w_prior,
            height=np.zeros(n) if epochs.height is None else epochs.height[0],
            w_height=np.where(
                self._started & has_height, self._altitude_sd**-2.0 if has_height else 0.0, 0.0
            ),
            curvature=epochs.curvature,
        )

    def _forget(self, t: Array, outcome: Integers) -> None:
        """Nodes that were not located for a while, or contradicted others throughout, have to start anew."""
        located = outcome == NodeOutcome.LOCATED
        latest = np.where(located, t[:, None], -np.inf).max(axis=0)
        self._located_s = np.maximum(self._located_s, latest)
        absent = t[-1] - self._located_s > RESTART_S
        contradicted = (outcome == NodeOutcome.INCONSISTENT).all(axis=0)
        lost = self._started & ~self._anchor & (absent | contradicted)
        self._chain_outcome[lost] = outcome[-1, lost]
        self._started &= ~lost

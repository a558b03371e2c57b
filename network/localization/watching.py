"""A fleet that is tracked under the eyes of a `quarantine.Monitor`."""

from collections import deque
from collections.abc import Collection
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..record import QuarantineReason
from .contradictions import joined
from .epochs import Epochs, Track
from .exclusion import Stand
from .quarantine import Monitor
from .tracking import Tracker

_LeftOut = tuple[frozenset[int], frozenset[int]]
"""Anchors that are not believed, and nodes whose ranges are not used."""


class _Past(NamedTuple):
    """Epochs that were solved, and the tracker before."""

    tracker: Tracker
    epochs: Epochs


class WatchedTracker:
    """A new tracker without the nodes that the monitor has found out, and without those that it will."""

    def __init__(self, tracker: Tracker, monitor: Monitor) -> None:
        self._tracker, self._monitor = tracker, monitor
        self._past: deque[_Past] = deque()
        self._disbelieved: frozenset[int] = frozenset()
        self._silent: frozenset[int] = frozenset()
        self._leave_out(*(monitor.left_out(r) for r in (QuarantineReason.BELIEF, QuarantineReason.RANGES)))

    def advance(self, epochs: Epochs) -> Track:
        """As `Tracker.advance`. The epoch at which a node is found out is solved without it, and those after;
        none before it is. Epochs are judged in blocks as they are given, of up to a second: which links there
        are, and so how far nodes are known, is taken of a whole block. Covariances are those after the last
        that was found out, and from before of nodes that are not located then."""
        parts: list[Track] = []
        while len(epochs.t):
            if self._tracker.start(epochs).any():
                self._past.clear()
            before = deepcopy(self._tracker)
            track = self._tracker.follow(epochs)
            assert track.seen is not None
            self._trim(self._monitor.remembered)
            at = self._monitor.alarm(track.seen)
            if self._monitor.remembered <= len(epochs.t):
                self._past.clear()
            found = None if at is None else self._at_fault([*self._past, _Past(before, epochs[: at + 1])])
            if at is None or found is None:
                if at is not None:
                    self._monitor.disturbed_s += epochs.t[at:].tolist()
                self._past.append(_Past(before, epochs))
                parts.append(track)
                break
            self._tracker = before
            if at:
                parts.append(self._tracker.follow(epochs[:at]))
            self._leave_out(*found)
            self._monitor.leave_out(*found, float(epochs.t[at]))
            epochs = epochs[at:]
        last = parts[-1]
        sd, cov, shared = last.sd.copy(), last.cov.copy(), last.shared.copy()
        for part in reversed(parts[:-1]):
            unknown = np.isnan(sd).any(axis=1)
            sd[unknown], cov[unknown] = part.sd[unknown], part.cov[unknown]
            if len(shared):
                shared[unknown] = part.shared[unknown]
        return replace(
            last,
            sd=sd,
            cov=cov,
            shared=shared,
            x=np.concatenate([part.x for part in parts]),
            v=np.concatenate([part.v for part in parts]),
            own_cov=np.concatenate([part.own_cov for part in parts]),
            outcome=np.concatenate([part.outcome for part in parts]),
        )

    def _trim(self, remembered: int) -> None:
        """Forget what the monitor's windows no longer hold."""
        while sum(len(past.epochs.t) for past in list(self._past)[1:]) >= remembered and self._past:
            self._past.popleft()

    def _at_fault(self, past: list[_Past]) -> _LeftOut | None:
        """Whom not to believe, and whose ranges not to use, from the last epoch on; None if no few are."""
        stand = self._tried(past, self._disbelieved, self._silent)
        found, named = self._contradicting(past, stand)
        if found is not None or not stand.excess:
            return found
        # Ranges disagree: is it all ranges of the one that stood out, or of one or two that are off by most?
        cures: list[tuple[float, _LeftOut]] = []
        tried = [named] if len(named) == 1 else []
        tried.append(frozenset({stand.worst}))
        for nodes in tried:
            disbelieved, silent = self._disbelieved - nodes, self._silent | nodes
            after = self._tried(past, disbelieved, silent)
            if after.excess and len(nodes) == 1 and nodes != named:
                tried.append(nodes | {after.worst})
            if not after.excess and self._named(after, 0.0, disbelieved, silent) == (disbelieved, silent):
                cures.append((after.ratio, (disbelieved, silent)))
        return min(cures, key=lambda cure: cure[0])[1] if cures else None

    def _contradicting(self, past: list[_Past], stand: Stand) -> tuple[_LeftOut | None, frozenset[int]]:
        """Those who stand out by the noise that is stated, and by what ranges of the others turn out to
        disagree by, with nobody else beside them; None if there are none. And who was named first."""
        before = out = self._disbelieved, self._silent
        stands, excess, first = {out: stand}, 0.0, frozenset[int]()
        while (named := self._named(stands[out], excess, *out)) != out:
            if named is None or named in stands:
                return None, first
            first = first or (named[0] | named[1]) - (before[0] | before[1])
            stands[named] = self._tried(past, *named)
            blamed = named[1] - out[1]
            out, excess = named, stands[named].excess
            if any(stands[before].of_ranges(excess)[node] <= 1 for node in blamed & named[1]):
                return None, first
        return (None if out == before else out), first

    def _named(
        self, stand: Stand, excess: float, disbelieved: frozenset[int], silent: frozenset[int]
    ) -> _LeftOut | None:
        """Who else, or else who, is at fault where these are left out; None if no few are."""
        of_ranges = stand.of_ranges(excess) * self._monitor.judged(silent)
        if of_ranges.max() > 1:
            # False ranges pull anchors, too; where an anchor says it is pulls no more than one range of it.
            return disbelieved, silent | {int(np.argmax(of_ranges))}
        named, agreed = stand.to_disbelieve(excess, self._monitor.may_disbelieve(silent))
        return (named, silent) if agreed or named != disbelieved else None

    def _tried(self, past: list[_Past], disbelieved: Collection[int], silent: Collection[int]) -> Stand:
        """Where nodes would stand at the end, had these been left out."""
        tracker = deepcopy(past[0].tracker)
        tracker.leave_out(disbelieved, silent)
        seen = [tracker.follow(each.epochs).seen for each in past]
        windows = self._monitor.limits.windows
        evidence = joined([part for part in seen if part is not None], windows[-1])
        judged = self._monitor.anchor & ~np.isin(np.arange(len(self._monitor.anchor)), list(silent))
        return Stand(evidence, judged, self._monitor.limits)

    def _leave_out(self, disbelieved: frozenset[int], silent: frozenset[int]) -> None:
        self._tracker.leave_out(disbelieved, silent)
        self._disbelieved, self._silent = disbelieved, silent

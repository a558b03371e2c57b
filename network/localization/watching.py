"""A fleet that is tracked under the eyes of a `quarantine.Monitor`."""

from copy import deepcopy
from dataclasses import replace

import numpy as np

from ..record import QuarantineReason
from .epochs import Epochs
from .quarantine import Monitor
from .tracking import Track, Tracker


class WatchedTracker:
    """A new tracker without the nodes that the monitor has found out, and without those that it will."""

    def __init__(self, tracker: Tracker, monitor: Monitor) -> None:
        self._tracker, self._monitor = tracker, monitor
        for node in np.flatnonzero(
            np.isin(monitor.reason, (QuarantineReason.BELIEF, QuarantineReason.RANGES))
        ):
            self._leave_out(int(node), QuarantineReason(monitor.reason[node]))

    def advance(self, epochs: Epochs) -> Track:
        """As `Tracker.advance`. The epoch at which a node is found out is solved without it, and those after:
        no estimate rests on what came later. Covariances are those after the last that was found out."""
        parts: list[Track] = []
        while len(epochs.t):
            before = deepcopy(self._tracker)
            track = self._tracker.advance(epochs)
            assert track.seen is not None
            found = self._monitor.judge(track.seen)
            if found is None:
                parts.append(track)
                break
            self._tracker = before
            if found.epoch:
                parts.append(self._tracker.advance(epochs[: found.epoch]))
            self._leave_out(found.node, found.reason)
            epochs = epochs[found.epoch :]
        last = parts[-1]
        return replace(
            last,
            x=np.concatenate([part.x for part in parts]),
            v=np.concatenate([part.v for part in parts]),
            own_cov=np.concatenate([part.own_cov for part in parts]),
            outcome=np.concatenate([part.outcome for part in parts]),
        )

    def _leave_out(self, node: int, reason: QuarantineReason) -> None:
        leave_out = self._tracker.disbelieve if reason == QuarantineReason.BELIEF else self._tracker.silence
        leave_out(node)

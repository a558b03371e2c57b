"""What a run of the fleet's network leaves beside its fixes: for the report, the recording and the scores."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class FixFate(IntEnum):
    """What became of the own ship's fix of an epoch."""

    DELIVERED = 0
    TOO_FEW_NEIGHBOURS = 1
    """Not made: fewer usable neighbours than a fix needs."""
    UNLOCALIZABLE = 2
    """Not made: the geometry leaves the position too uncertain."""
    AMBIGUOUS = 3
    """Not made: a mirror image fits the ranges as well."""
    INCONSISTENT = 4
    """Not made: the residuals are larger than the noise allows."""
    NOT_CONVERGED = 5
    """Not made: the estimate did not settle."""
    NO_ROUTE = 6
    """Made, and lost: no way from its maker to the own ship."""
    LOST = 7
    """Made, and lost after the last retry, or in a queue that was full."""
    STILL_QUEUED = 8
    """Made, and still on its way when the network's time ended."""


class QuarantineReason(IntEnum):
    """Why a node was quarantined."""

    NONE = 0
    BELIEF = 1
    """Others' ranges contradict where this anchor says it is, or what its clock shows: that is not used."""
    RANGES = 2
    """Its ranges are too long or too short for wherever it may be: they are not used."""
    START = 3
    """This anchor was a suspect when nodes were located from nothing, and stands back until it is none."""


@dataclass(frozen=True)
class FaultRecord:
    """Who lied, and who was found out; n nodes."""

    lying_s: Array
    """(n,) s, truth: from when on each node lies; NaN for honest ones."""
    silenced: Booleans
    """(n,) nodes whose tags are wrong: their links were not used."""
    quarantined_s: Array
    """(n,) s, since when each node is quarantined at the end; NaN for those that are not."""
    quarantined_for: Integers
    """(n,) `QuarantineReason`, at the end."""
    found_out: Array
    """(f, 2) node, and s: each time that one was found out (`QuarantineReason` BELIEF, RANGES); it may have
    been asked back since."""
    suspected: Booleans
    """(n,) anchors that stood back as suspects of a start at some time."""
    forged_arrival: Array
    """(p,) s, truth: times of arrival of packets that an intruder made up or changed."""
    replayed_arrival: Array
    """(q,) s, truth: those of packets that an intruder sent again."""
    disturbed_s: Array = field(default_factory=lambda: np.zeros(0))
    """(d,) s, epochs at which nodes contradicted each other and no few were at fault: many may be off, as
    where a side has no line of sight."""

    @property
    def found_s(self) -> Array:
        """(n,) s, when each node that lies was first found out from its lie on; NaN for all others. One that
        stands back as a suspect of a start to the end needs no finding."""
        waits = (self.quarantined_for == QuarantineReason.START) & (self.quarantined_s >= self.lying_s)
        found = np.where(waits, self.quarantined_s, np.nan)
        for node, t in self._found_out:
            if t >= self.lying_s[node]:
                found[node] = np.fmin(found[node], t)
        return found

    @property
    def left_out_without_cause(self) -> Booleans:
        """(n,) nodes that were found out at some time and had not lied until then."""
        false = np.zeros(len(self.lying_s), np.bool_)
        for node, t in self._found_out:
            false[node] |= not t >= self.lying_s[node]
        return false

    @property
    def out_without_cause(self) -> Booleans:
        """(n,) those of `left_out_without_cause` that have not been asked back since, nor found out again
        after a lie."""
        false = np.zeros(len(self.lying_s), np.bool_)
        for node, t in self._found_out:
            false[node] = not t >= self.lying_s[node]
        return false & np.isin(self.quarantined_for, (QuarantineReason.BELIEF, QuarantineReason.RANGES))

    @property
    def _found_out(self) -> list[tuple[int, float]]:
        return [(int(node), float(t)) for node, t in self.found_out]


@dataclass(frozen=True)
class NetworkRecord:
    """One run of the network, k epochs of n nodes; node 0 is the own ship."""

    time: Array
    """(k,) s, at which positions and ranges are true."""
    lla: Array
    """(k, n, 3) true positions, rad, rad, m."""
    anchor: Booleans
    """(n,)."""
    error_n: Array
    """(k, n, 3) estimated less true position, NED at the fleet's centre, m; NaN where there is none."""
    sd_n: Array
    """(k, n, 3) standard deviations that the estimator states, NED, m; NaN likewise."""
    velocity_error_n: Array
    """(k, n, 3) NED, m/s."""
    outcome: Integers
    """(k, n) `localization.problem.NodeOutcome`."""
    cov: Array
    """(k, 6, 6) of the own ship's position and velocity, NED at the own ship, m and m/s."""
    fate: Integers
    """(k,) `FixFate` of the own ship's fix."""
    delay: Array
    """(k,) s, of the own ship's fixes; NaN where none arrived."""
    fleet_delay: Array
    """(p,) s, of all delivered packets of all nodes."""
    link_time: Array
    """(s,) s, at which the links are stated."""
    linked: Booleans
    """(s, n, n) pairs that range each other."""
    head: Booleans
    """(s, n) cluster heads; all False under DMDG."""
    maker: int
    """The node that makes the own ship's fixes."""
    sent: int
    """Packets handed to the network, of all nodes."""
    delivered: int
    """Packets that arrived, of all nodes."""
    queued: int
    """Packets still on their way when the network's time ended, of all nodes."""
    transmissions: int
    """Times that they were sent, retries included."""
    slots_used: int
    """Slots (CSMA: mini-slots) in which a node sent."""
    slots: int
    """Slots (CSMA: mini-slots) that went by, with the warm-up before and the time that last packets had."""
    faults: FaultRecord | None = None
    """None where nobody looked."""

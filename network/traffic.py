"""Packets of the fleet's network: what is sent, and what becomes of it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class TrafficError(ValueError):
    """Packets that cannot be sent; one line."""


class PacketFate(IntEnum):
    """What became of a packet."""

    DELIVERED = 0
    NO_ROUTE = 1
    """Its holder had no way to its destination over the links of the moment."""
    RETRIES_EXHAUSTED = 2
    """Lost on one hop as often as it may be sent."""
    QUEUE_FULL = 3
    STILL_QUEUED = 4
    """On its way when time ended, or not yet made."""


@dataclass(frozen=True)
class Traffic:
    """Packets in order of creation.

    Raises `TrafficError` for wrong shapes, times that are not finite or not in order, negative nodes and
    packets to their own source.
    """

    created: Array
    """(p,) s."""
    source: Integers
    """(p,) node that makes the packet."""
    destination: Integers
    """(p,) node that it is for."""

    def __post_init__(self) -> None:
        p = len(self.created)
        for name in ("created", "source", "destination"):
            if getattr(self, name).shape != (p,):
                raise TrafficError(f"{name} must have shape {(p,)}; got {getattr(self, name).shape}")
        if not np.isfinite(self.created).all():
            raise TrafficError("times of creation must be finite")
        if (np.diff(self.created) < 0).any():
            raise TrafficError("packets must be in order of creation")
        if p and min(self.source.min(), self.destination.min()) < 0:
            raise TrafficError("nodes are numbered from 0")
        if (self.source == self.destination).any():
            raise TrafficError(f"node {self.source[self.source == self.destination][0]} sends to itself")

    def __len__(self) -> int:
        return len(self.created)

    @property
    def flow(self) -> Integers:
        """(p,) number of each packet's flow: packets of one source to one destination are one flow."""
        pairs = np.column_stack((self.source, self.destination))
        return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(len(self)).astype(np.int64)


def periodic_traffic(
    source: Integers,
    destination: Integers,
    start_s: float,
    end_s: float,
    period_s: float,
    phase: Array | None = None,
) -> Traffic:
    """One packet a period from each source (f,) to its destination (f,), from ``start_s`` to ``end_s``.

    Flow k sends at ``start_s + phase[k] + i period_s``; phases, (f,) s, are 0 by default: all at once, as
    fixes of one epoch are. Packets of one instant are in the order of their flows.

    Raises `TrafficError` for a period that is not positive and phases that are not within one period.
    """
    phase = np.zeros(len(source)) if phase is None else phase
    if not period_s > 0:
        raise TrafficError(f"period_s = {period_s:g} s must be positive")
    if not ((phase >= 0) & (phase < period_s)).all():
        raise TrafficError(f"phases must be within the period of {period_s:g} s")
    # The small part lets a last packet count that falls on end_s but for rounding.
    k = max(int(np.floor((end_s - start_s) / period_s + 1e-6)) + 1, 0)
    created = (start_s + np.arange(k)[:, np.newaxis] * period_s + phase).ravel()
    flow = np.tile(np.arange(len(source)), k)
    order = np.argsort(created, kind="stable")
    order = order[created[order] <= end_s + 1e-6 * period_s]
    return Traffic(created[order], source[flow[order]], destination[flow[order]])


@dataclass(frozen=True)
class Deliveries:
    """What became of the packets of a `Traffic`, p packets; n nodes, s link tables.

    The delay of a delivered packet is the sum of its four parts, `slot_wait`, `queue_wait`, `retry_wait` and
    `carriage`, each summed over its hops, s; all are NaN for a packet that did not arrive.
    """

    traffic: Traffic
    arrival: Array
    """(p,) s, when the last bit of the payload was at the destination; NaN for none."""
    fate: Integers
    """(p,) `PacketFate`."""
    hops: Integers
    """(p,) nodes that the packet reached."""
    transmissions: Integers
    """(p,) times it was sent, retries included."""
    slot_wait: Array
    """(p,) TDMA: from when a holder had the packet to that holder's next slot. CSMA: from the head of the
    queue to the first transmission, by back-off and by deferring to others."""
    queue_wait: Array
    """(p,) behind packets that came before it."""
    retry_wait: Array
    """(p,) from the first transmission of a hop to the one that was received."""
    carriage: Array
    """(p,) payload and propagation."""
    head: Booleans
    """(s, n) cluster heads; all False under DMDG."""
    slots: int
    """Slots that went by from the first packet on (CSMA: mini-slots)."""
    slots_used: int
    """Slots in which a node sent (CSMA: mini-slots)."""
    collisions: int
    """Transmissions that another one spoiled at the receiver; none under TDMA."""
    queue_peak: int
    """Packets in the longest queue of all."""

    @property
    def delivered(self) -> Booleans:
        """(p,)."""
        return self.fate == PacketFate.DELIVERED

    @property
    def delay(self) -> Array:
        """(p,) s from creation to arrival; NaN for packets that did not arrive."""
        return self.arrival - self.traffic.created

    def counts(self) -> dict[PacketFate, int]:
        """Number of packets of each fate."""
        return {fate: int((self.fate == fate).sum()) for fate in PacketFate}

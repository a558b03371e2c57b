"""Packets on their way and the queues that hold them, in compiled form.

Inlined: a call that hands on this many arrays takes longer than what it does.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..sins._kernels import COMPILED
from ._routes import next_hop
from .traffic import PacketFate

SLOT_WAIT, QUEUE_WAIT, RETRY_WAIT, CARRIAGE = range(4)
SLOTS, SLOTS_USED, COLLISIONS, QUEUE_PEAK = range(4)

_DELIVERED = int(PacketFate.DELIVERED)
_NO_ROUTE = int(PacketFate.NO_ROUTE)
RETRIES_EXHAUSTED = int(PacketFate.RETRIES_EXHAUSTED)
_QUEUE_FULL = int(PacketFate.QUEUE_FULL)

ROUNDING_S = 1e-9
"""A packet made this little after a slot began was made at its beginning, but for rounding."""


class Packets(NamedTuple):
    """The packets of a `Traffic` and their state; times in s."""

    created: NDArray[np.float64]
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    arrival: NDArray[np.float64]
    fate: NDArray[np.int64]
    hops: NDArray[np.int64]
    sent: NDArray[np.int64]
    parts: NDArray[np.float64]
    """(p, 4) of the delay."""
    ready: NDArray[np.float64]
    """When the holder had it."""
    turn: NDArray[np.float64]
    """TDMA: the holder's first slot since. CSMA: when it was at the head of the queue."""
    tried: NDArray[np.float64]
    """When the holder first sent it."""
    tries: NDArray[np.int64]
    """Times that the holder sent it."""
    void: NDArray[np.float64]


class Queues(NamedTuple):
    """First-in, first-out queues of n nodes, in rings of equal length."""

    ring: NDArray[np.int64]
    first: NDArray[np.int64]
    length: NDArray[np.int64]
    fresh: NDArray[np.int64]
    """Packets at the end of the queue that have not seen a slot of their holder's."""
    told: NDArray[np.int64]
    """Lengths that the nodes last told, and the packets that others have been heard to send them since."""


@njit(inline="always", **COMPILED)
def enter(packets, queues, packet, node, time, totals):
    """Put a packet at the end of a node's queue."""
    size = queues.ring.shape[1]
    if queues.length[node] == size:
        packets.fate[packet] = _QUEUE_FULL
        return
    queues.ring[node, (queues.first[node] + queues.length[node]) % size] = packet
    queues.length[node] += 1
    queues.fresh[node] += 1
    totals[QUEUE_PEAK] = max(totals[QUEUE_PEAK], queues.length[node])
    packets.ready[packet] = time
    packets.tries[packet] = 0


@njit(inline="always", **COMPILED)
def leave(queues, node):
    """Take the packet at the head of a node's queue out of it."""
    queues.first[node] = (queues.first[node] + 1) % queues.ring.shape[1]
    queues.length[node] -= 1
    queues.fresh[node] = min(queues.fresh[node], queues.length[node])


@njit(inline="always", **COMPILED)
def enter_created(packets, queues, first, time, totals):
    """Put the packets from ``first`` on that are made by ``time`` in their queues; the first made later."""
    while first < len(packets.created) and packets.created[first] <= time:
        enter(packets, queues, first, packets.source[first], packets.created[first], totals)
        first += 1
    return first


@njit(inline="always", **COMPILED)
def receive(packets, queues, packet, node, sent, arrival, totals):
    """A packet sent at ``sent`` is at ``node``, which keeps it or is to pass it on."""
    packets.parts[packet, RETRY_WAIT] += sent - packets.tried[packet]
    packets.parts[packet, CARRIAGE] += arrival - sent
    packets.hops[packet] += 1
    if node == packets.target[packet]:
        packets.fate[packet] = _DELIVERED
        packets.arrival[packet] = arrival
    else:
        enter(packets, queues, packet, node, arrival, totals)
        queues.told[node] += 1


@njit(inline="always", **COMPILED)
def head_of_queue(packets, queues, links, table, node):
    """The first packet in a node's queue that has a way, and its next hop; those before it are lost.

    -1, -1 for none.
    """
    while queues.length[node]:
        packet = queues.ring[node, queues.first[node]]
        to = next_hop(links, table, node, packets.target[packet], queues.told, packets.void, packet)
        if to >= 0:
            return packet, to
        packets.fate[packet] = _NO_ROUTE
        leave(queues, node)
    return -1, -1

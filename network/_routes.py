"""Compiled routing: the next hop of a packet over the links of the moment.

Readable twins: `dmdg.next_hop`, `leach.next_hop`.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..sins._kernels import COMPILED


class Links(NamedTuple):
    """Tables of links, s tables of n nodes, and what routing needs besides."""

    time: NDArray[np.float64]
    """(s,) s, from which each table holds; the first holds before its time as well."""
    distance: NDArray[np.float64]
    """(s, n, n) m, symmetric, as is ``linked``."""
    linked: NDArray[np.bool_]
    """(s, n, n)."""
    relay: NDArray[np.bool_]
    """(s, n) nodes that pass on packets of others: all under DMDG, heads under LEACH."""
    own_head: NDArray[np.int64]
    """(s, n) each node's cluster head, -1 for none; of no use under DMDG."""
    clustered: bool
    """LEACH, not DMDG."""
    load_weight: float
    """m a packet."""
    hop_count: NDArray[np.int64]
    """(n, n) work space: hops from each node (second) to a target (first), -1 where there is no way."""
    hop_table: NDArray[np.int64]
    """(n,) table that ``hop_count`` to this target is for, -1 at first."""


@njit(**COMPILED)
def _count_hops(linked, relay, target, count):
    """Hops to ``target`` from every relay, breadth first, into ``count`` (n,)."""
    n = len(count)
    count[:] = -1
    count[target] = 0
    reached = np.empty(n, dtype=np.int64)
    reached[0] = target
    first, last = 0, 1
    while first < last:
        node = reached[first]
        first += 1
        for other in range(n):
            if count[other] < 0 and linked[node, other] and relay[other]:
                count[other] = count[node] + 1
                reached[last] = other
                last += 1


@njit(**COMPILED)
def _shortest_hop(links, table, holder, target):
    """Neighbour on a path of fewest hops to ``target`` over relays, the one nearest to it; -1 for none."""
    if links.hop_table[target] != table:
        _count_hops(links.linked[table], links.relay[table], target, links.hop_count[target])
        links.hop_table[target] = table
    count = links.hop_count[target]
    best, nearest = -1, np.inf
    for other in range(len(count)):
        if links.linked[table, holder, other] and count[holder] > 0 and count[other] == count[holder] - 1:
            distance = links.distance[table, target, other]
            if distance < nearest:
                best, nearest = other, distance
    return best


@njit(inline="always", **COMPILED)
def _geographic_hop(links, table, holder, target, told, void, packet):
    """DMDG. ``void`` (p,) m: the distance to go at which each packet last met a void; inf for none."""
    if links.linked[table, holder, target]:
        return target
    distance = links.distance[table, target]
    if distance[holder] < void[packet]:
        best, least = -1, np.inf
        for other in range(len(distance)):
            if links.linked[table, holder, other] and distance[other] < distance[holder]:
                cost = distance[other] + links.load_weight * told[other]
                if cost < least:
                    best, least = other, cost
        if best >= 0:
            return best
        void[packet] = distance[holder]
    return _shortest_hop(links, table, holder, target)


@njit(inline="always", **COMPILED)
def next_hop(links, table, holder, target, told, void, packet):
    """Node that ``holder`` sends ``packet`` to on its way to ``target``; -1 for no way.

    ``told`` (n,) packets that are taken to be in each node's queue.
    """
    if not links.clustered:
        return _geographic_hop(links, table, holder, target, told, void, packet)
    own_head = links.own_head[table]
    if own_head[holder] != holder:
        return own_head[holder]
    if own_head[target] == holder:
        return target
    if own_head[target] < 0:
        return -1
    return _shortest_hop(links, table, holder, own_head[target])

"""LEACH, the baseline: clusters whose heads take turns, and traffic that goes by way of the heads.

Low-energy adaptive clustering hierarchy (Heinzelman, Chandrakasan and Balakrishnan, 2000). Time is divided
into rounds. In each, a node that has not been a head in this epoch of 1/p rounds becomes one with
probability

    T = p / (1 - p (r mod 1/p)),    p = heads / nodes,    r the number of the round,

so that each is a head once in an epoch. The choices here:

- An epoch has 1/p rounds, rounded. Rounds are counted from time 0.
- If no node becomes a head, the one with the least draw does, of those that have not been one in this
  epoch; if all have been, of all.
- Each node draws from a generator of its own.
- A node joins the nearest of the heads it has a link to, at every table of links. Without one it is on its
  own, and packets from it or to it have no route.
- A packet goes from a member to its own head, from there to the head of its destination, and from there to
  the destination, even where the two have a link. Heads that have no link to each other go over other
  heads, on a path of fewest hops. Packets that are at a node as it ceases to be a head go on as if it had
  made them.
- Heads pass packets on one by one; they do not merge them.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


def elect_heads(nodes: int, rounds: int, heads: int, rng: Generator) -> Booleans:
    """Which nodes are heads in each round, (rounds, nodes), with ``heads`` of them in a round on average."""
    p = heads / nodes
    epoch = round(1 / p)
    draws = np.stack([child.random(rounds) for child in rng.spawn(nodes)], axis=1)
    head = np.zeros((rounds, nodes), dtype=np.bool_)
    eligible = np.ones(nodes, dtype=np.bool_)
    for r in range(rounds):
        if r % epoch == 0:
            eligible[:] = True
        head[r] = eligible & (draws[r] < p / (1 - p * (r % epoch)))
        if not head[r].any():
            candidates = eligible if eligible.any() else np.ones(nodes, dtype=np.bool_)
            head[r, np.argmin(np.where(candidates, draws[r], np.inf))] = True
        eligible &= ~head[r]
    return head


def heads_at(link_time: Array, nodes: int, heads: int, round_s: float, rng: Generator) -> Booleans:
    """Heads at each table of links, (s, nodes): those of the round that ``link_time`` (s,) s falls in."""
    # The small part lets a round begin at a table that falls on it but for rounding.
    number = np.floor(link_time / round_s + 1e-9).astype(np.int64)
    return elect_heads(nodes, int(number.max()) + 1, heads, rng)[number]


def own_heads(distance: Array, linked: Booleans, head: Booleans) -> Integers:
    """The head that each node has joined, (s, n): itself for a head, -1 for none.

    Takes ``distance`` (s, n, n) m, ``linked`` (s, n, n) and ``head`` (s, n).
    """
    reach = np.where(linked & head[:, np.newaxis, :], distance, np.inf)
    nearest = np.where(np.isfinite(reach.min(axis=2)), reach.argmin(axis=2), -1)
    return np.where(head, np.arange(head.shape[1]), nearest).astype(np.int64)


def ranging_mask(linked: Booleans, head: Booleans) -> Booleans:
    """Pairs that range each other, (s, n, n): linked ones of which at least one is a head (s, n).

    A node hears the adverts of all heads in reach and ranges with each of them, not with its own alone.
    """
    return linked & (head[:, :, np.newaxis] | head[:, np.newaxis, :])


def next_hop(
    holder: int, target: int, distance: Array, linked: Booleans, head: Booleans, own_head: Integers
) -> int:
    """Node that ``holder`` sends a packet for ``target`` to, -1 for none: the twin of the compiled form.

    ``distance``, ``linked`` (n, n), ``head``, ``own_head`` (n,) are one table. Of several heads on paths of
    fewest hops, the one nearest to the target's head is taken.
    """
    if not head[holder]:
        return int(own_head[holder])
    end = int(own_head[target])
    if end == holder:
        return target
    if end < 0:
        return -1
    among_heads = linked & head & head[:, np.newaxis]
    hops = shortest_path(among_heads.astype(float), unweighted=True, indices=end)
    onward = among_heads[holder] & np.isfinite(hops) & (hops == hops[holder] - 1)
    return int(np.argmin(np.where(onward, distance[end], np.inf))) if onward.any() else -1

"""DMDG routing: geographic, balanced by load.

Gao et al. name DMDG with "GLB-DMECR geographic routing"; the reference that defines it is not at hand. The
choices here:

- A holder sends a packet to its destination if it has a link to it.
- If not, to that neighbour, of those that are nearer to the destination than itself, which has the least
  distance to it plus a weight times the packets that are taken to be in the neighbour's queue.
- Where no neighbour is nearer (a void), on a path of fewest hops, and so on from node to node until the
  packet is nearer to the destination than the void was: going back to greedy steps at once would go round
  in circles.
- Where there is no path, the packet is dropped.
- The next hop is chosen anew each time a packet is sent. Positions and links are those of the latest table,
  which all nodes have: what each broadcasts in its slots is taken to be known to all.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


def next_hop(
    holder: int,
    target: int,
    distance: Array,
    linked: Booleans,
    load: Array | Integers,
    load_weight: float,
    void: float = np.inf,
) -> tuple[int, float]:
    """Node that ``holder`` sends a packet for ``target`` to, -1 for none: the twin of the compiled form.

    ``distance`` (n, n) m and ``linked`` (n, n) are one table, ``load`` (n,) packets, ``load_weight`` m a
    packet. ``void`` is the distance to go, m, at which the packet last met a void, infinite for none; what it
    is from now on is the second result.
    """
    if linked[holder, target]:
        return target, void
    to_go = distance[target]
    if to_go[holder] < void:
        nearer = linked[holder] & (to_go < to_go[holder])
        if nearer.any():
            return int(np.argmin(np.where(nearer, to_go + load_weight * load, np.inf))), void
        void = float(to_go[holder])
    hops = shortest_path(linked.astype(float), unweighted=True, indices=target)
    onward = linked[holder] & np.isfinite(hops) & (hops == hops[holder] - 1)
    return (int(np.argmin(np.where(onward, to_go, np.inf))) if onward.any() else -1), void


def path(
    source: int, target: int, distance: Array, linked: Booleans, load: Array | Integers, load_weight: float
) -> list[int]:
    """Nodes of a packet's way over one table, source and target included; ends early where there is none."""
    nodes, void = [source], np.inf
    while nodes[-1] != target:
        node, void = next_hop(nodes[-1], target, distance, linked, load, load_weight, void)
        if node < 0:
            break
        nodes.append(node)
    return nodes

"""Time-division channel sharing (TDMA): who may send when.

Gao et al. name TDMA slots, at the beginning of which a node gathers and broadcasts; the reference that
defines them is not at hand. The choices here:

- A slot holds one packet: its payload and a guard, the time a signal takes over the longest link. One node
  of the whole fleet sends in a slot; slots are not used again far away.
- A frame holds one slot for each node, in the order of a key that each node has, and extra slots spread
  evenly among them. Slots are counted from time 0: when traffic starts does not shift the frame.
- An extra slot goes to the relays in turn, in the order of their slots. Under LEACH relays are the cluster
  heads. Under DMDG they are the nodes that last told of a packet left in their queue; if there is none, the
  slot stays empty. All nodes are taken to know which these are.
- A node sends the first packet in its queue. It learns at once, and at no cost, whether it was received,
  and sends it again in its next slot if not, up to a number of retries. A packet that arrives at a relay
  can be sent on in the next slot.
- A node tells how long its queue is, after what it sends, in each of its slots. All others hear it, and hear
  as well which relay a packet goes to, which makes that relay's queue one longer.
- Whether what is sent in a slot is lost is drawn for each slot, used or not, from a generator for each
  node.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


def slot_order(slot_key: NDArray[np.float64] | Integers) -> Integers:
    """Nodes in the order of their slots, (n,); equal keys (n,) in the order of the nodes."""
    return np.argsort(slot_key, kind="stable").astype(np.int64)


def slot_owners(slot_key: NDArray[np.float64] | Integers, extra_slots: int) -> Integers:
    """Owner of each slot of a frame, (n + extra_slots,); -1 for an extra slot."""
    n = len(slot_key)
    owners = np.full(n + extra_slots, -1, dtype=np.int64)
    # Extra slot k of e stands at the middle of the k-th of e equal parts of the frame.
    extra = (2 * np.arange(extra_slots) + 1) * len(owners) // (2 * max(extra_slots, 1))
    owners[np.setdiff1d(np.arange(len(owners)), extra)] = slot_order(slot_key)
    return owners


def lost_slots(owners: Integers, frames: int, loss_probability: float, rng: Generator) -> Booleans:
    """Whether what is sent in each slot is lost, (frames, slots of a frame).

    ``rng`` is spawned for the extra slots and for each node: one more node leaves the draws of the others as
    they are.
    """
    lost = np.zeros((frames, len(owners)), dtype=np.bool_)
    if loss_probability > 0:
        extra, nodes = rng.spawn(2)
        drawn_by = dict(enumerate(nodes.spawn(int(owners.max()) + 1)))
        for column, owner in enumerate(owners.tolist()):
            lost[:, column] = drawn_by.get(owner, extra).random(frames) < loss_probability
    return lost


def slots_between(start_s: float, end_s: float, slot_s: float) -> tuple[int, int]:
    """The slot that ``start_s`` falls in, and the first that is not over by ``end_s``."""
    # The small part lets a slot count that begins or ends there but for rounding.
    first = int(np.floor(start_s / slot_s + 1e-6))
    return first, max(int(np.floor(end_s / slot_s + 1e-6)), first)

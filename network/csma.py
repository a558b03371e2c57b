"""Channel sharing by carrier sense (CSMA), the alternative to TDMA slots.

Gao et al. name it beside TDMA and do not define it. The model is slotted CSMA (Kleinrock and Tobagi, 1975),
with a back-off that doubles. The choices here:

- Time goes in mini-slots, at least as long as a signal takes over the longest link; a packet is on the air
  for as many as its payload and that time need. All nodes keep the mini-slots.
- A node with a packet waits for a random number of mini-slots in which it hears nobody, at most the window,
  and sends. It hears those it has a link to, from the mini-slot after the one in which they began. The
  window doubles with each retry up to its largest.
- A packet is spoiled if, while it is on the air, its receiver sends, or another node with a link to its
  receiver does: one that began in the same mini-slot, or one that its sender has no link to (a hidden one).
  There is no capture of the stronger signal, and no request to send.
- The sender learns at the end of the packet, at no cost, whether it was received. It is retried like one
  lost.
- A node tells the length of its queue with each packet; all others hear it, and hear as well which relay a
  packet goes to.
- One generator is drawn from, in the order of events: back-offs, and whether a packet is lost at its end.
"""

import math


def airtime(seconds: float, mini_slot_s: float) -> int:
    """Mini-slots that a packet of so many seconds, its way included, is on the air for."""
    return max(math.ceil(seconds / mini_slot_s - 1e-9), 1)

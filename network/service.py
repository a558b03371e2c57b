"""What the network did for the fixes, and what became of each of the own ship's."""

from dataclasses import dataclass

import numpy as np

from ..sins.units import MILLISECOND
from .broadcasts import Broadcasts
from .fleet import OWN_SHIP
from .localization.problem import NodeOutcome
from .protocol import ProtocolSettings
from .record import Array, FixFate, Integers
from .tdma import slots_between
from .traffic import Deliveries, PacketFate


@dataclass(frozen=True)
class Service:
    """What the network did for the fixes: `NetworkRecord` has the same, of all nodes."""

    fate: Integers
    """(k,) `PacketFate` of the own ship's fixes."""
    delay: Array
    """(k,) s."""
    fleet_delay: Array
    maker: int
    sent: int
    delivered: int
    queued: int
    transmissions: int
    slots_used: int
    slots: int


def delivered(deliveries: Deliveries, maker: int, k: int) -> Service:
    """Fixes that other nodes make, and send."""
    own = np.flatnonzero(deliveries.traffic.destination == OWN_SHIP)[-k:]
    return Service(
        fate=deliveries.fate[own],
        delay=deliveries.delay[own],
        fleet_delay=deliveries.delay[deliveries.delivered],
        maker=maker,
        sent=len(deliveries.traffic),
        delivered=int(deliveries.delivered.sum()),
        queued=int((deliveries.fate == PacketFate.STILL_QUEUED).sum()),
        transmissions=int(deliveries.transmissions.sum()),
        slots_used=deliveries.slots_used,
        slots=deliveries.slots,
    )


def broadcast(told: Broadcasts, k: int, settings: ProtocolSettings, first_s: float, last_s: float) -> Service:
    """Fixes that each node makes itself, of what all broadcast; the last k epochs are those of the fixes."""
    first, last = slots_between(first_s, last_s, settings.slot_ms * MILLISECOND)
    return Service(
        fate=np.full(k, int(PacketFate.DELIVERED)),
        delay=told.delay[-k:],
        fleet_delay=np.repeat(told.delay[-k:], told.lost.shape[2]),
        maker=OWN_SHIP,
        sent=told.lost.size,
        delivered=told.lost.size - int(told.lost.sum()),
        queued=0,
        transmissions=told.lost.size,
        slots_used=told.lost.size,
        slots=last - first,
    )


_UNMADE = {
    NodeOutcome.TOO_FEW_NEIGHBOURS: FixFate.TOO_FEW_NEIGHBOURS,
    NodeOutcome.SINGULAR: FixFate.UNLOCALIZABLE,
    NodeOutcome.AMBIGUOUS: FixFate.AMBIGUOUS,
    NodeOutcome.INCONSISTENT: FixFate.INCONSISTENT,
    NodeOutcome.NOT_CONVERGED: FixFate.NOT_CONVERGED,
}
_UNDELIVERED = {
    PacketFate.NO_ROUTE: FixFate.NO_ROUTE,
    PacketFate.RETRIES_EXHAUSTED: FixFate.LOST,
    PacketFate.QUEUE_FULL: FixFate.LOST,
    PacketFate.STILL_QUEUED: FixFate.STILL_QUEUED,
}


def fates(outcome: Integers, packet: Integers) -> Integers:
    """`FixFate` (k,) from the own ship's `NodeOutcome` and from the `PacketFate` of its packet, (k,) each."""
    fate = np.full(len(outcome), -1)
    fate[(outcome == NodeOutcome.LOCATED) & (packet == PacketFate.DELIVERED)] = FixFate.DELIVERED
    for code, reason in _UNDELIVERED.items():
        fate[packet == code] = reason
    for code, reason in _UNMADE.items():
        fate[outcome == code] = reason
    assert (fate >= 0).all()
    return fate

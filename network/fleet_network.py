"""The fleet's network as a source of fixes: who ranges whom, where that puts them, when the own ship is told.

At each epoch all nodes that hear each other have ranged each other in their slots of the frame before, and
range rates carry the ranges forward to the epoch (over 25 ms at 6 m/s^2 that leaves 2 mm). Each node's fix
is computed by another node, its solver, and sent to it as one packet. So a fix is true at its epoch, and
late by what the network takes to carry it. That the solver has all ranges of the frame at its end is taken
for granted: their own way to it, which over several hops takes as many frames, is not simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.random import Generator
from pydantic import Field, model_validator

from ..sins.settings import Settings
from ..sins.units import MILLISECOND
from .broadcasts import Broadcasts, check_sweeps, draw_broadcasts
from .fixes import Fixes, FixesError
from .fleet import OWN_SHIP, CentrePath, Fleet, FleetSettings, draw_formation
from .localization.chain import LocalizationSettings
from .localization.problem import NodeOutcome
from .protocol import ProtocolError, ProtocolSettings, carry, solvers
from .radio import Radio, RadioSettings
from .record import Array, FixFate, Integers, NetworkRecord
from .survey import survey
from .tdma import slots_between
from .topology import draw_topology
from .traffic import Deliveries, PacketFate, periodic_traffic

WARM_UP_S = 2.0
"""Time for which the network carries packets before the first epoch, so that its queues are as they are."""
AFTER_S = 1.0
"""Time that packets of the last epochs have to arrive."""


class FleetNetwork(Settings):
    """Fixes from a simulated fleet (Gao et al., sections 2 and 3)."""

    kind: Literal["network"] = "network"
    rate_hz: float = Field(default=10.0, ge=1, le=100)
    """Epochs, and fixes of each node, a second; the search for each starts at the one before."""
    fleet: FleetSettings = FleetSettings()
    radio: RadioSettings = RadioSettings()
    protocol: ProtocolSettings = ProtocolSettings()
    localization: LocalizationSettings = LocalizationSettings()

    @model_validator(mode="after")
    def _workable(self) -> Self:
        fleet = self.fleet
        across = np.hypot(2 * fleet.radius_m, fleet.height_m)
        try:
            self.protocol.check(fleet.nodes)
            self.protocol.guard(min(self.radio.link_radius_m, across))
            if self.localization.solver == "distributed":
                check_sweeps(self.localization.sweeps, fleet.nodes, self.rate_hz, self.protocol)
        except ProtocolError as error:
            raise ValueError(str(error)) from error
        return self


def fly_network(
    path: CentrePath,
    start_s: float,
    end_s: float,
    settings: FleetNetwork,
    generator: Callable[[str], Generator],
) -> tuple[Fixes, NetworkRecord]:
    """The own ship's fixes from ``start_s`` to ``end_s``, in order of arrival, and what the network did.

    Parameters
    ----------
    path : of the fleet's centre, over the whole interval at least.
    generator : gives the random numbers of "fleet", "radio" and "protocol".

    Raises `FixesError` for an interval that ends before it starts.
    """
    if not start_s <= end_s:
        raise FixesError(f"fixes from {start_s:g} s to {end_s:g} s: the end is before the start")
    # The small part lets a last epoch count that falls on end_s but for rounding.
    k = int(np.floor((end_s - start_s) * settings.rate_hz + 1e-6)) + 1
    t = np.minimum(start_s + np.arange(k) / settings.rate_hz, end_s)
    fleet = Fleet(draw_formation(settings.fleet, generator("fleet")), path)
    formation = fleet.formation
    radio = Radio(settings.radio, formation.nodes, generator("radio"), formation.anchor)
    heads_rng, losses_rng = generator("protocol").spawn(2)

    warm_up_s = min(WARM_UP_S, start_s - float(path.time[0]))
    update_s = settings.protocol.route_update_s
    tables = np.arange(start_s - warm_up_s, end_s + 1e-9, update_s)
    topology = draw_topology(fleet, radio, tables, settings.protocol, heads_rng)
    early = int(warm_up_s * settings.rate_hz)
    first_s, last_s = start_s - early / settings.rate_hz, end_s + AFTER_S
    if settings.localization.solver == "distributed":
        sweeps, loss = settings.localization.sweeps, settings.radio.loss_probability
        times = np.concatenate([first_s + np.arange(early) / settings.rate_hz, t])
        told = draw_broadcasts(times, sweeps, formation.slot_key, settings.protocol, loss, losses_rng)
        lost = told.lost[early:]
        found = survey(fleet, radio, topology, t, settings.fleet, settings.localization, lost)
        service = _broadcast(told, k, settings.protocol, first_s, last_s)
    else:
        found = survey(fleet, radio, topology, t, settings.fleet, settings.localization)
        solver = solvers(formation.solver_key)
        traffic = periodic_traffic(solver, np.arange(formation.nodes), first_s, end_s, 1 / settings.rate_hz)
        deliveries = carry(
            traffic,
            topology.time,
            topology.distance,
            topology.linked,
            settings.protocol,
            formation.slot_key,
            settings.radio.loss_probability,
            losses_rng,
            last_s,
            topology.head if settings.protocol.kind == "leach" else None,
        )
        service = _delivered(deliveries, int(solver[OWN_SHIP]), k)
    maker = service.maker
    fate = _fates(found.outcome[:, OWN_SHIP], service.fate)
    kept = np.flatnonzero(fate == FixFate.DELIVERED)
    delay = np.full(k, np.nan)
    delay[kept] = service.delay[kept]
    fixes = Fixes(
        t_valid=t[kept],
        # The solver's clock states the time; the own ship reads it by its own.
        t_stamp=(t + found.clock_offset[:, maker] - found.clock_offset[:, OWN_SHIP])[kept],
        t_arrival=(t + delay)[kept],
        lla=found.own_lla[kept],
        v_n=found.own_v_n[kept],
        cov=found.own_cov[kept],
        source=np.full(len(kept), maker, dtype=np.int64),
        sequence=kept.astype(np.int64),
    )
    record = NetworkRecord(
        time=t,
        lla=found.lla,
        anchor=formation.anchor,
        error_n=found.error_n,
        sd_n=found.sd_n,
        velocity_error_n=found.velocity_error_n,
        outcome=found.outcome,
        cov=found.own_cov,
        fate=fate,
        delay=delay,
        fleet_delay=service.fleet_delay,
        link_time=topology.time,
        linked=topology.ranging,
        head=topology.head,
        maker=maker,
        sent=service.sent,
        delivered=service.delivered,
        queued=service.queued,
        transmissions=service.transmissions,
        slots_used=service.slots_used,
        slots=service.slots,
    )
    return fixes.sorted_by_arrival(), record


@dataclass(frozen=True)
class _Service:
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


def _delivered(deliveries: Deliveries, maker: int, k: int) -> _Service:
    """Fixes that other nodes make, and send."""
    own = np.flatnonzero(deliveries.traffic.destination == OWN_SHIP)[-k:]
    return _Service(
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


def _broadcast(
    told: Broadcasts, k: int, settings: ProtocolSettings, first_s: float, last_s: float
) -> _Service:
    """Fixes that each node makes itself, of what all broadcast; the last k epochs are those of the fixes."""
    first, last = slots_between(first_s, last_s, settings.slot_ms * MILLISECOND)
    return _Service(
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


def _fates(outcome: Integers, packet: Integers) -> Integers:
    """`FixFate` (k,) from the own ship's `NodeOutcome` and from the `PacketFate` of its packet, (k,) each."""
    fate = np.full(len(outcome), -1)
    fate[(outcome == NodeOutcome.LOCATED) & (packet == PacketFate.DELIVERED)] = FixFate.DELIVERED
    for code, reason in _UNDELIVERED.items():
        fate[packet == code] = reason
    for code, reason in _UNMADE.items():
        fate[outcome == code] = reason
    assert (fate >= 0).all()
    return fate

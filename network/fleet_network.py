"""The fleet's network as a source of fixes: who ranges whom, where that puts them, when the own ship is told.

At each epoch all nodes that hear each other have ranged each other in their slots of the frame before, and
range rates carry the ranges forward to the epoch (over 25 ms at 6 m/s^2 that leaves 2 mm). Each node's fix
is computed by another node, its solver, and sent to it as one packet. So a fix is true at its epoch, and
late by what the network takes to carry it. That the solver has all ranges of the frame at its end is taken
for granted: their own way to it, which over several hops takes as many frames, is not simulated.
"""

from collections.abc import Callable
from typing import Literal, Self

import numpy as np
from numpy.random import Generator
from pydantic import Field, model_validator

from ..sins.settings import Settings
from .fixes import Fixes, FixesError
from .fleet import OWN_SHIP, CentrePath, Fleet, FleetSettings, draw_formation
from .localization.chain import LocalizationSettings
from .localization.problem import NodeOutcome
from .protocol import ProtocolError, ProtocolSettings, carry, solvers
from .radio import Radio, RadioSettings
from .record import FixFate, Integers, NetworkRecord
from .survey import survey
from .topology import draw_topology
from .traffic import PacketFate, periodic_traffic

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
    found = survey(fleet, radio, topology, t, settings.fleet, settings.localization)

    solver = solvers(formation.solver_key)
    early = int(warm_up_s * settings.rate_hz)
    traffic = periodic_traffic(
        solver, np.arange(formation.nodes), start_s - early / settings.rate_hz, end_s, 1 / settings.rate_hz
    )
    deliveries = carry(
        traffic,
        topology.time,
        topology.distance,
        topology.linked,
        settings.protocol,
        formation.slot_key,
        settings.radio.loss_probability,
        losses_rng,
        end_s + AFTER_S,
        topology.head if settings.protocol.kind == "leach" else None,
    )
    own = np.flatnonzero(traffic.destination == OWN_SHIP)[-k:]
    maker = int(solver[OWN_SHIP])
    fate = _fates(found.outcome[:, OWN_SHIP], deliveries.fate[own])
    kept = np.flatnonzero(fate == FixFate.DELIVERED)
    delay = np.full(k, np.nan)
    delay[kept] = deliveries.delay[own][kept]
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
        fleet_delay=deliveries.delay[deliveries.delivered],
        link_time=topology.time,
        linked=topology.ranging,
        head=topology.head,
        maker=maker,
        sent=len(traffic),
        delivered=int(deliveries.delivered.sum()),
        queued=int((deliveries.fate == PacketFate.STILL_QUEUED).sum()),
        transmissions=int(deliveries.transmissions.sum()),
        slots_used=deliveries.slots_used,
        slots=deliveries.slots,
    )
    return fixes.sorted_by_arrival(), record


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

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
from .attacks import Attacked, attacked
from .authentication import Authentication
from .broadcasts import check_sweeps, draw_broadcasts
from .faults import NetworkFaults, Trouble, drawn
from .fixes import Fixes, FixesError
from .fleet import OWN_SHIP, CentrePath, Fleet, FleetSettings, draw_formation
from .localization.chain import LocalizationSettings
from .localization.quarantine import Monitor
from .protocol import ProtocolError, ProtocolSettings, carry, solvers
from .radio import Radio, RadioSettings
from .record import Booleans, FaultRecord, FixFate, NetworkRecord
from .service import broadcast, delivered, fates
from .survey import survey
from .topology import draw_topology
from .traffic import periodic_traffic

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
    authentication: Authentication | None = None
    """Tags on the packets to the own ship, and on what anchors say; by default there are none."""
    faults: NetworkFaults = NetworkFaults()

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
        self.faults.check(fleet.nodes, self.localization.solver)
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
    generator : gives the random numbers of "fleet", "radio", "protocol" and "network faults".

    Raises `FixesError` for an interval that ends before it starts.
    """
    if not start_s <= end_s:
        raise FixesError(f"fixes from {start_s:g} s to {end_s:g} s: the end is before the start")
    # The small part lets a last epoch count that falls on end_s but for rounding.
    k = int(np.floor((end_s - start_s) * settings.rate_hz + 1e-6)) + 1
    t = np.minimum(start_s + np.arange(k) / settings.rate_hz, end_s)
    fleet = Fleet(draw_formation(settings.fleet, generator("fleet")), path)
    formation = fleet.formation
    faults_rng, attacks_rng = generator("network faults").spawn(2)
    takeoff_lla = path.truth.at(path.time[:1])[0][0]
    one_way = settings.radio.ranging == "one_way"
    trouble = drawn(
        settings.faults, settings.authentication, fleet, takeoff_lla, start_s, one_way, faults_rng
    )
    radio = Radio(
        settings.radio,
        formation.nodes,
        generator("radio"),
        formation.anchor,
        trouble and trouble.disturbances,
    )
    monitor = _monitor(settings, formation.anchor)
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
        found = survey(fleet, radio, topology, t, settings.fleet, settings.localization, lost, trouble)
        service = broadcast(told, k, settings.protocol, first_s, last_s)
    else:
        found = survey(
            fleet, radio, topology, t, settings.fleet, settings.localization, None, trouble, monitor
        )
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
        service = delivered(deliveries, int(solver[OWN_SHIP]), k)
    maker = service.maker
    fate = fates(found.outcome[:, OWN_SHIP], service.fate)
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
    fixes, intruders = attacked(
        fixes.sorted_by_arrival(),
        settings.faults.attacks,
        settings.authentication,
        () if trouble is None else trouble.intruders,
        start_s,
        1 / settings.rate_hz,
        attacks_rng,
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
        faults=_fault_record(formation.nodes, trouble, monitor, intruders),
    )
    return fixes, record


def _monitor(settings: FleetNetwork, anchor: Booleans) -> Monitor | None:
    """Who watches the nodes, if anybody does."""
    watched, radio = settings.localization.quarantine, settings.radio
    if watched is None:
        return None
    constant, white = radio.range_bias_sd_m**2, radio.range_sd_m**2
    return Monitor(watched, anchor, settings.rate_hz, constant / (constant + white))


def _fault_record(
    nodes: int, trouble: Trouble | None, monitor: Monitor | None, intruders: Attacked
) -> FaultRecord:
    never = np.full(nodes, np.nan)
    return FaultRecord(
        lying_s=never if trouble is None else trouble.lies.since_s,
        silenced=np.zeros(nodes, np.bool_) if trouble is None else trouble.silenced,
        quarantined_s=never if monitor is None else monitor.since_s,
        quarantined_for=np.zeros(nodes, np.int64) if monitor is None else monitor.reason,
        forged_arrival=intruders.forged,
        replayed_arrival=intruders.replayed,
        disturbed_s=np.array(() if monitor is None else monitor.disturbed_s),
        found_out=np.array([] if monitor is None else monitor.found_out).reshape(-1, 2),
        suspected=np.zeros(nodes, np.bool_) if monitor is None else monitor.suspected,
    )

"""The protocol of the fleet's network: how packets share the channel, and which way they go.

`dmdg` and `leach` say which way; `tdma` and `csma` how the channel is shared; `carry` lets a network carry a
`Traffic`.
"""

from typing import Literal, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from ..sins.settings import Settings
from ..sins.units import MILLISECOND
from . import csma, leach, tdma
from ._queues import (
    CARRIAGE,
    COLLISIONS,
    QUEUE_PEAK,
    QUEUE_WAIT,
    RETRY_WAIT,
    SLOT_WAIT,
    SLOTS,
    SLOTS_USED,
    Packets,
    Queues,
)
from ._routes import Links
from ._slots import carry_csma, carry_tdma
from .traffic import Deliveries, PacketFate, Traffic

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

MICROSECOND = 1e-6


class ProtocolError(ValueError):
    """A network that cannot work; one line."""


class ProtocolSettings(Settings):
    """The protocol: routing, channel sharing, queues and retries."""

    kind: Literal["dmdg", "leach"] = "dmdg"
    access: Literal["tdma", "csma"] = "tdma"
    payload_bits: int = Field(default=500, ge=1, le=1_000_000)
    data_rate_mbps: float = Field(default=2.0, ge=1e-3, le=1e5)
    guard_us: float | None = Field(default=None, ge=0, le=1e5)
    """Time a signal may take on its way; without it, what it takes over the longest link there is."""
    max_retries: int = Field(default=4, ge=0, le=1000)
    """Times that a packet is sent again on one hop before it is given up."""
    queue_length: int = Field(default=64, ge=1, le=100_000)
    """Packets that a node can hold."""
    route_update_s: float = Field(default=1.0, ge=1e-3, le=1e4)
    """Period of the tables of links and positions that routes are chosen by."""

    slot_ms: float = Field(default=0.5, ge=1e-3, le=1e4)
    """TDMA: a slot holds the payload and the guard."""
    extra_slots: int = Field(default=0, ge=0, le=10_000)
    """TDMA: slots of a frame for relays (DMDG) or cluster heads (LEACH), beside one for each node."""

    mini_slot_us: float = Field(default=150.0, ge=1, le=1e6)
    """CSMA: time within which a node hears that another has begun to send; at least the guard."""
    window_min: int = Field(default=16, ge=1, le=65_536)
    """CSMA: mini-slots of back-off, at most, before a first transmission; twice as many for each retry."""
    window_max: int = Field(default=1024, ge=1, le=65_536)

    load_weight_m: float = Field(default=3000.0, ge=0, le=1e6)
    """DMDG: how much farther from the destination a relay may be for one packet less in its queue."""

    heads: int = Field(default=10, ge=1, le=1_000_000)
    """LEACH: cluster heads in a round, on average."""
    round_s: float = Field(default=20.0, ge=1e-3, le=1e6)
    """LEACH: time for which heads are heads."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.window_min > self.window_max:
            raise ValueError(
                f"window_min = {self.window_min} mini-slots must not exceed window_max = {self.window_max}"
            )
        self._check_slot((self.guard_us or 0.0) * MICROSECOND)
        return self

    @property
    def payload_s(self) -> float:
        """Time a payload is on the air, s."""
        return self.payload_bits / (self.data_rate_mbps * 1e6)

    def check(self, nodes: int) -> None:
        """Raise `ProtocolError` for more heads than nodes."""
        if self.kind == "leach" and self.heads > nodes:
            raise ProtocolError(f"heads = {self.heads} must be at most the number of nodes, {nodes}")

    def guard(self, longest_link_m: float) -> float:
        """Guard, s. Raises `ProtocolError` if the longest link, or a slot, does not go with it."""
        needed = longest_link_m / speed_of_light
        guard = needed if self.guard_us is None else self.guard_us * MICROSECOND
        if guard < needed:
            raise ProtocolError(
                f"guard_us = {self.guard_us:g} us is shorter than a signal takes over the longest link, "
                f"{longest_link_m / 1e3:.4g} km: at least {_rounded_up(needed / MICROSECOND):g} us"
            )
        self._check_slot(guard)
        return guard

    def _check_slot(self, guard: float) -> None:
        if self.access == "tdma" and self.slot_ms * MILLISECOND < self.payload_s + guard:
            raise ProtocolError(
                f"slot_ms = {self.slot_ms:g} ms is shorter than its payload of "
                f"{self.payload_s / MILLISECOND:.4g} ms and its guard of {guard / MILLISECOND:.4g} ms: "
                f"at least {_rounded_up((self.payload_s + guard) / MILLISECOND):g} ms"
            )
        if self.access == "csma" and self.mini_slot_us * MICROSECOND < guard:
            raise ProtocolError(
                f"mini_slot_us = {self.mini_slot_us:g} us is shorter than the guard: "
                f"at least {_rounded_up(guard / MICROSECOND):g} us"
            )


def solvers(solver_key: Array | Integers) -> Integers:
    """The node that computes each node's fix, (n,): the next in the order of a key (n,), cyclic.

    Raises `ProtocolError` for fewer than two nodes.
    """
    if len(solver_key) < 2:
        raise ProtocolError(f"a fix is computed by another node; got {len(solver_key)} nodes")
    order = np.argsort(solver_key, kind="stable")
    solver = np.empty(len(order), dtype=np.int64)
    solver[order] = np.roll(order, -1)
    return solver


def carry(
    traffic: Traffic,
    link_time: Array,
    distance: Array,
    linked: Booleans,
    settings: ProtocolSettings,
    slot_key: Array | Integers,
    loss_probability: float,
    rng: Generator,
    end_s: float,
    head: Booleans | None = None,
) -> Deliveries:
    """Send packets over a network of n nodes until ``end_s``.

    ``link_time`` (s,) s, not negative, is when each table of ``distance`` (s, n, n) m and ``linked``
    (s, n, n) begins to hold; the first holds before as well. ``slot_key`` (n,) orders the nodes' slots. A
    transmission is lost with ``loss_probability``. ``head`` (s, n) are LEACH's cluster heads, drawn if they
    are not given. Only slots that are over by ``end_s`` are used. ``rng`` is spawned, first for cluster
    heads and then for losses (see `tdma` and `csma`); the same seed gives the same deliveries.

    Raises `ProtocolError` for arrays that do not go together, nodes that are not in the network, more heads
    than nodes, a guard shorter than the longest link and a slot shorter than its payload and guard.
    """
    head_rng, loss_rng = rng.spawn(2)
    s, n = len(link_time), len(slot_key)
    _check_tables(traffic, link_time, distance, linked, s, n)
    if not 0 <= loss_probability <= 1:
        raise ProtocolError(f"loss_probability = {loss_probability:g} must be between 0 and 1")
    settings.check(n)
    clustered = settings.kind == "leach"
    if not clustered:
        head = np.zeros((s, n), dtype=np.bool_)
    elif head is None:
        head = leach.heads_at(link_time, n, settings.heads, settings.round_s, head_rng)
    links = Links(
        time=link_time,
        distance=np.ascontiguousarray(distance),
        linked=np.ascontiguousarray(linked),
        relay=head if clustered else np.ones((s, n), dtype=np.bool_),
        own_head=leach.own_heads(distance, linked, head) if clustered else np.zeros((s, n), dtype=np.int64),
        clustered=clustered,
        load_weight=settings.load_weight_m,
        hop_count=np.empty((n, n), dtype=np.int64),
        hop_table=np.full(n, -1, dtype=np.int64),
    )
    packets, queues = _new_packets(traffic), _new_queues(n, settings.queue_length)
    guard_s = settings.guard(float(distance[linked].max(initial=0.0)))
    first_s = float(traffic.created[0]) if len(traffic) else end_s
    if settings.access == "tdma":
        order = tdma.slot_order(slot_key)
        owners = tdma.slot_owners(slot_key, settings.extra_slots)
        slot_s = settings.slot_ms * MILLISECOND
        first, last = tdma.slots_between(first_s, end_s, slot_s)
        frames = last // len(owners) - first // len(owners) + 1
        lost = tdma.lost_slots(owners, frames, loss_probability, loss_rng)
        totals = carry_tdma(
            packets, queues, links, order, owners, lost,
            slot_s, settings.payload_s, speed_of_light, settings.max_retries, first, last,
        )  # fmt: skip
    else:
        mini_s = settings.mini_slot_us * MICROSECOND
        first, last = tdma.slots_between(first_s, end_s, mini_s)
        totals = carry_csma(
            packets, queues, links, loss_rng, loss_probability,
            mini_s, csma.airtime(settings.payload_s + guard_s, mini_s), settings.payload_s, speed_of_light,
            settings.max_retries, settings.window_min, settings.window_max, first, last,
        )  # fmt: skip

    packets.parts[packets.fate != PacketFate.DELIVERED] = np.nan
    return Deliveries(
        traffic=traffic,
        arrival=packets.arrival,
        fate=packets.fate,
        hops=packets.hops,
        transmissions=packets.sent,
        slot_wait=packets.parts[:, SLOT_WAIT],
        queue_wait=packets.parts[:, QUEUE_WAIT],
        retry_wait=packets.parts[:, RETRY_WAIT],
        carriage=packets.parts[:, CARRIAGE],
        head=head,
        slots=int(totals[SLOTS]),
        slots_used=int(totals[SLOTS_USED]),
        collisions=int(totals[COLLISIONS]),
        queue_peak=int(totals[QUEUE_PEAK]),
    )


def _rounded_up(value: float) -> float:
    """The least number of four digits that is not less: what a message can tell to use."""
    digit = 10.0 ** (np.floor(np.log10(value)) - 3) if value > 0 else 1.0
    return float(np.ceil(value / digit * (1 - 1e-12)) * digit)


def _check_tables(
    traffic: Traffic, link_time: Array, distance: Array, linked: Booleans, s: int, n: int
) -> None:
    if distance.shape != (s, n, n) or linked.shape != (s, n, n) or s == 0:
        raise ProtocolError(
            f"distance and linked must have shape {(max(s, 1), n, n)}; got {distance.shape}, {linked.shape}"
        )
    if not (np.diff(link_time) > 0).all() or link_time[0] < 0:
        raise ProtocolError("times of the link tables must increase and not be negative")
    if (linked != linked.transpose(0, 2, 1)).any():
        raise ProtocolError("links must join both nodes in both directions")
    if not np.isfinite(distance).all():
        raise ProtocolError("distances must be finite")
    if len(traffic) and max(traffic.source.max(), traffic.destination.max()) >= n:
        raise ProtocolError(f"traffic must be between nodes 0 to {n - 1}")
    if len(traffic) and traffic.created[0] < 0:
        raise ProtocolError("packets must not be made before time 0")


def _new_packets(traffic: Traffic) -> Packets:
    p = len(traffic)
    return Packets(
        created=traffic.created,
        source=traffic.source,
        target=traffic.destination,
        arrival=np.full(p, np.nan),
        fate=np.full(p, int(PacketFate.STILL_QUEUED)),
        hops=np.zeros(p, dtype=np.int64),
        sent=np.zeros(p, dtype=np.int64),
        parts=np.zeros((p, 4)),
        ready=np.zeros(p),
        turn=np.zeros(p),
        tried=np.zeros(p),
        tries=np.zeros(p, dtype=np.int64),
        void=np.full(p, np.inf),
    )


def _new_queues(nodes: int, length: int) -> Queues:
    return Queues(
        ring=np.zeros((nodes, length), dtype=np.int64),
        first=np.zeros(nodes, dtype=np.int64),
        length=np.zeros(nodes, dtype=np.int64),
        fresh=np.zeros(nodes, dtype=np.int64),
        told=np.zeros(nodes, dtype=np.int64),
    )

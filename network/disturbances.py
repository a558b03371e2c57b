"""What befalls the radio: jammers, a side without line of sight, clocks that jump, false ranges."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..sins import earth
from ..sins.settings import Settings
from .fleet import OWN_SHIP, Fleet
from .lies import Chosen, Lies
from .observations import node_pairs

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]


class _Lasting(Settings):
    start_s: float = Field(default=0.0, ge=0, le=3600)
    """From the start of the alignment."""
    duration_s: float = Field(default=3600.0, ge=0.01, le=3600)

    def lasts(self, at_s: Array) -> Booleans:
        """Whether it is on at times ``at_s`` (k,) from the start of the alignment."""
        return (at_s >= self.start_s) & (at_s < self.start_s + self.duration_s)


class Jammer(_Lasting):
    """Links of nodes inside a vertical cylinder reach less far."""

    of: Literal["fleet", "takeoff"] = "fleet"
    """What it stands north and east of: the fleet's centre, and flies with it, or the place of take-off."""
    north_m: float = Field(default=0.0, ge=-1e7, le=1e7)
    east_m: float = Field(default=0.0, ge=-1e7, le=1e7)
    radius_m: float = Field(default=10_000.0, gt=0, le=1e7)
    share: float = Field(default=0.7, ge=0, lt=1)
    """By which the link radius of nodes inside falls. Of overlapping jammers the powers lost add up."""


class BlockedSide(_Lasting):
    """Nodes on one side have no line of sight: links make detours, drawn as `nlos_mean_m` says."""

    links: Literal["own_ship", "all"] = "own_ship"
    """The own ship's links with nodes on that side of it; or all links of nodes on that side of the fleet's
    centre."""
    bearing_deg: float = Field(default=90.0, ge=-360, le=360)
    """Of the middle of that side, from true north over east."""


class ClockJump(Chosen):
    """Clocks jump ahead, and stay ahead: what sets them to network time does not see it."""

    at_s: float = Field(default=10.0, ge=0, le=3600)
    """From the start of the alignment."""
    jump_us: float = Field(default=1.0, ge=-1e6, le=1e6)
    """1 us is 300 m of one-way range."""


class Disturbances:
    """What befalls the radios of a fleet at times of the simulation's clock, ``start_s`` the alignment's."""

    def __init__(
        self,
        jammers: tuple[Jammer, ...],
        blocked: tuple[BlockedSide, ...],
        jumps: tuple[tuple[ClockJump, NDArray[np.int64]], ...],
        lies: Lies,
        fleet: Fleet,
        takeoff_lla: Array,
        start_s: float,
    ) -> None:
        self._jammers, self._blocked, self._jumps, self._lies = jammers, blocked, jumps, lies
        self._fleet, self._takeoff, self._start_s = fleet, takeoff_lla[None], start_s
        self._pairs = node_pairs(fleet.formation.nodes)

    def lost_decades(self, t: Array, x_e: Array) -> Array:
        """(k, n) decades by which the link radius of each node falls, at ``t`` (k,), ``x_e`` (k, n, 3)."""
        lost = np.zeros(x_e.shape[:2])
        for jammer in self._jammers:
            of = self._fleet.centre(t) if jammer.of == "fleet" else self._takeoff
            away = np.hypot(*np.moveaxis(_ned(x_e, of)[..., :2] - [jammer.north_m, jammer.east_m], -1, 0))
            inside = (away <= jammer.radius_m) & jammer.lasts(t - self._start_s)[:, None]
            lost -= inside * np.log10(1 - jammer.share)
        return lost

    def pairs_lost_decades(self, t: Array, x_e: Array) -> Array:
        """(k, m) the same of pairs, which hear each other both or not at all: that of the worse end."""
        lost = self.lost_decades(t, x_e)
        return np.maximum(lost[:, self._pairs[:, 0]], lost[:, self._pairs[:, 1]])

    def blocked(self, t: Array, x_e: Array) -> Booleans:
        """(k, m) pairs without line of sight."""
        i, j = self._pairs.T
        blocked = np.zeros((len(t), len(i)), np.bool_)
        for side in self._blocked:
            own = side.links == "own_ship"
            of = earth.lla_from_ecef(x_e[:, OWN_SHIP]) if own else self._fleet.centre(t)
            bearing = np.radians(side.bearing_deg)
            there = _ned(x_e, of)[..., :2] @ [np.cos(bearing), np.sin(bearing)] > 0
            pairs = there[:, i] & (j == OWN_SHIP) if own else there[:, i] | there[:, j]
            blocked |= pairs & side.lasts(t - self._start_s)[:, None]
        return blocked

    def clocks_ahead(self, t: Array) -> Array:
        """(k, n) s, by which clocks have jumped."""
        ahead = np.zeros((len(t), self._fleet.formation.nodes))
        for jump, nodes in self._jumps:
            ahead[:, nodes] += 1e-6 * jump.jump_us * (t - self._start_s >= jump.at_s)[:, None]
        return ahead

    def false_ranges(self, t: Array) -> Array:
        """(k, m) m, what is lied of ranges."""
        of_nodes = self._lies.ranges(t)
        return of_nodes[:, self._pairs[:, 0]] + of_nodes[:, self._pairs[:, 1]]


def _ned(x_e: Array, of: Array) -> Array:
    """(k, n, 3) of nodes from places ``of`` (k, 3) or (1, 3), lla, in the plane that is level there."""
    return (x_e - earth.ecef_from_lla(of)[:, None]) @ earth.C_en(of[:, 0], of[:, 1])

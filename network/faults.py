"""What goes wrong in the fleet's network, by will or by chance; times count from the alignment's start."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from pydantic import Field

from ..sins.settings import Settings
from .attacks import Attack
from .authentication import Authentication
from .disturbances import BlockedSide, ClockJump, Disturbances, Jammer
from .fleet import Fleet
from .lies import Array, Booleans, Chosen, Lie, Lies


class NetworkFaults(Settings):
    """Faults of the network; there are none by default."""

    attacks: tuple[Attack, ...] = Field(default=(), max_length=20)
    """On packets to the own ship."""
    lies: tuple[Lie, ...] = Field(default=(), max_length=20)
    wrong_keys: Chosen = Chosen()
    """Nodes that have not the key which they should have: with `Authentication` nobody believes them."""
    jamming: tuple[Jammer, ...] = Field(default=(), max_length=20)
    blocked_side: tuple[BlockedSide, ...] = Field(default=(), max_length=20)
    clock_jumps: tuple[ClockJump, ...] = Field(default=(), max_length=20)

    def check(self, nodes: int, solver: str) -> None:
        """Raise ValueError for nodes that are not there, and for attacks on packets that nobody sends."""
        chosen = (*self.lies, self.wrong_keys, *self.clock_jumps)
        for number in (number for choice in chosen for number in choice.nodes):
            if number >= nodes:
                raise ValueError(
                    f"faults: node {number}: allowed is 0 to {nodes - 1}, as there are {nodes} nodes"
                )
        if self.attacks and solver == "distributed":
            raise ValueError(
                'faults.attacks with localization.solver = "distributed": the own ship makes its fixes'
                ' itself, and there is no packet to attack; allowed is solver = "central"'
            )

    def check_begins(self, window_s: float) -> None:
        """Raise ValueError for a fault that begins when the alignment, of ``window_s``, is over."""
        begins = [
            (f"{name}[{number}].start_s", fault.start_s)
            for name in ("attacks", "lies", "jamming", "blocked_side")
            for number, fault in enumerate(getattr(self, name))
        ]
        begins += [(f"clock_jumps[{i}].at_s", jump.at_s) for i, jump in enumerate(self.clock_jumps)]
        for name, begin_s in begins:
            if begin_s >= window_s:
                raise ValueError(
                    f"fixes.faults.{name} = {begin_s:g} s: must be before the end of the alignment,"
                    f" at {window_s:g} s"
                )


@dataclass(frozen=True)
class Trouble:
    """The faults of one run."""

    lies: Lies
    intruders: tuple[int, ...]
    """Nodes without the right key."""
    silenced: Booleans
    """(n,) those of them that are found out."""
    disturbances: Disturbances


def drawn(
    faults: NetworkFaults,
    authentication: Authentication | None,
    fleet: Fleet,
    takeoff_lla: Array,
    start_s: float,
    one_way: bool,
    rng: Generator,
) -> Trouble | None:
    """Who and what is at fault in a run whose alignment starts at ``start_s``; None where nothing is.

    ``one_way`` tells whether clocks are in the ranges: an anchor's that jumps is then a lie.
    """
    if faults.model_copy(update={"attacks": ()}) == NetworkFaults():
        return None
    anchor = fleet.formation.anchor
    lies_rng, keys_rng, jumps_rng = rng.spawn(3)
    lies = Lies(faults.lies, anchor, start_s, lies_rng)
    intruders = faults.wrong_keys.drawn(anchor, keys_rng)
    jumping = zip(faults.clock_jumps, jumps_rng.spawn(len(faults.clock_jumps)), strict=True)
    jumps = tuple((jump, jump.drawn(anchor, child)) for jump, child in jumping)
    for jump, nodes in jumps:
        false = nodes[anchor[nodes]] if one_way else nodes[:0]
        lies.since_s[false] = np.fmin(lies.since_s[false], start_s + jump.at_s)
    silenced = np.zeros(len(anchor), np.bool_)
    silenced[intruders] = authentication is not None
    disturbances = Disturbances(faults.jamming, faults.blocked_side, jumps, lies, fleet, takeoff_lla, start_s)
    return Trouble(lies, tuple(intruders.tolist()), silenced, disturbances)

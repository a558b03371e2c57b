"""Who hears whom, and who is a cluster head, at the times at which routes are chosen."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from . import leach
from .fleet import Fleet
from .protocol import ProtocolSettings
from .radio import Radio

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Topology:
    """Tables of links; each holds until the next one."""

    time: Array
    """(s,) s."""
    distance: Array
    """(s, n, n) m."""
    linked: Booleans
    """(s, n, n) pairs whose power reaches the sensitivity."""
    ranging: Booleans
    """(s, n, n) linked pairs that range each other: all of them under DMDG, those with a head under LEACH."""
    head: Booleans
    """(s, n) cluster heads; all False under DMDG."""

    def at(self, t: Array) -> Integers:
        """Number of the table that holds at each of the times (k,), s."""
        return np.maximum(np.searchsorted(self.time, t + 1e-9, side="right") - 1, 0)


def draw_topology(
    fleet: Fleet, radio: Radio, time: Array, settings: ProtocolSettings, rng: Generator
) -> Topology:
    """Tables at ``time`` (s,), s; ``rng`` elects LEACH's heads.

    Raises `ProtocolError` for more heads than nodes.
    """
    x_e, _ = fleet.at(time)
    distance = np.linalg.norm(x_e[:, :, None] - x_e[:, None], axis=-1)
    linked = radio.linked(distance, radio.lost_decades(time, x_e))
    s, n = x_e.shape[:2]
    if settings.kind != "leach":
        return Topology(time, distance, linked, linked, np.zeros((s, n), np.bool_))
    settings.check(n)
    head = leach.heads_at(time, n, settings.heads, settings.round_s, rng)
    return Topology(time, distance, linked, leach.ranging_mask(linked, head), head)

"""Broadcasts of the distributed solver: one of each node a frame, in its own slot, as many as it has sweeps.

At an epoch nodes have their ranges, as with the central solver. In the first whole frame after it all
broadcast what they take their states for, and at its end all update; and so for each sweep. What a node has
at the end of the last frame is its fix: no packet brings it. Extra slots stay empty.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from ..sins.units import MILLISECOND
from . import tdma
from .protocol import ProtocolError, ProtocolSettings

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True)
class Broadcasts:
    """Broadcasts about k epochs."""

    lost: Booleans
    """(k, sweeps, n) those that nobody received."""
    delay: Array
    """(k,) s, from each epoch to the end of its last sweep."""


def frame_s(nodes: int, settings: ProtocolSettings) -> float:
    """Length of a frame, s."""
    return (nodes + settings.extra_slots) * settings.slot_ms * MILLISECOND


def check_sweeps(sweeps: int, nodes: int, rate_hz: float, settings: ProtocolSettings) -> None:
    """Raise `ProtocolError` where sweeps cannot be broadcast: without slots of all nodes' own, or in time."""
    if settings.kind != "dmdg" or settings.access != "tdma":
        told = f'kind = "{settings.kind}"' if settings.kind != "dmdg" else f'access = "{settings.access}"'
        raise ProtocolError(
            f'localization.solver = "distributed" with protocol.{told}: nodes broadcast in slots of their'
            ' own; allowed is kind = "dmdg" with access = "tdma"'
        )
    frame = frame_s(nodes, settings)
    most = int(1 / (rate_hz * frame) + 1e-6)
    if sweeps > most:
        raise ProtocolError(
            f"localization.sweeps = {sweeps}: a frame takes {frame / MILLISECOND:g} ms, so that {most} fit"
            f" between epochs at {rate_hz:g} Hz"
        )


def draw_broadcasts(
    t: Array,
    sweeps: int,
    slot_key: Array,
    settings: ProtocolSettings,
    loss_probability: float,
    rng: Generator,
) -> Broadcasts:
    """Broadcasts about the epochs ``t`` (k,), s; ``slot_key`` (n,) orders the nodes' slots."""
    owners, n = tdma.slot_owners(slot_key, settings.extra_slots), len(slot_key)
    frame = frame_s(n, settings)
    # The small part lets a frame count that begins at the epoch but for rounding.
    first = np.ceil(t / frame - 1e-6)
    slots = tdma.lost_slots(owners, len(t) * sweeps, loss_probability, rng)
    own = np.argsort(owners, kind="stable")[settings.extra_slots :]
    # Whole frames are told from what a limit allows: a nanosecond is rounding.
    delay = np.round((first + sweeps) * frame - t, 9)
    return Broadcasts(slots[:, own].reshape(len(t), sweeps, n), delay)

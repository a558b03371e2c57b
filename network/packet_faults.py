"""Faults of packets on their way to the own ship, whatever their source."""

from numpy.random import Generator

from ..sins.settings import Settings
from .fixes import Fixes


class PacketFaults(Settings):
    """What befalls packets."""


def faulty(fixes: Fixes, faults: PacketFaults, rng: Generator) -> Fixes:
    """The packets as they arrive."""
    return fixes

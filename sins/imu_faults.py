"""Faults of an inertial measurement unit: what its increments are while it is broken."""

from .imu import Imu
from .settings import Settings


class ImuFault(Settings):
    """One fault, for a time."""


def faulty(imu: Imu, faults: tuple[ImuFault, ...]) -> Imu:
    """The increments as a broken unit gives them."""
    return imu

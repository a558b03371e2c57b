"""Clocks of the nodes: offset and frequency error against network time.

Gao et al., section 2.1, ask for ranges to 10 m, a relative stability of 1e-10, an accuracy of 5e-9 and a
delay of at most 50 ms. 10 m is 33 ns; a clock whose frequency is off by 5e-9 gets there in 6.7 s, and runs
off by 0.25 ns, 7.5 cm, in 50 ms. So the accuracy holds the ranges only where clocks are synchronised faster
than that, where their offsets are estimated, or where ranging is two-way and clocks cancel. The stability
of 1e-10 is 3 cm/s of range rate.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field

from ..sins.settings import Settings
from ._held import Held

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]

SPEED_OF_LIGHT = 299_792_458.0
"""m/s"""
_NANOSECOND = 1e-9


class ClockSettings(Settings):
    """Errors of the clocks; accuracy and stability are those of Gao et al., section 2.1."""

    frequency_accuracy: float = Field(default=5e-9, ge=0, le=1e-4)
    """Bound of a clock's frequency error, uniform within +- this, constant over a run, dimensionless."""
    frequency_stability: float = Field(default=1e-10, ge=0, le=1e-4)
    """Standard deviation of the white part of the frequency error from epoch to epoch, dimensionless."""
    resync_s: float = Field(default=1.0, ge=0.01, le=1e4)
    """Interval at which all clocks are set to network time anew."""
    sync_sd_ns: float = Field(default=10.0, ge=0, le=1e9)
    """Standard deviation of what is left of the offset by it."""


class Clocks:
    """Clocks of ``n`` nodes. Node i draws from the i-th child of each effect's child of ``rng``.

    Anchors define network time: their offsets stay at what the last synchronisation left, and their
    frequency errors are the white part alone.
    """

    def __init__(self, settings: ClockSettings, anchor: Booleans, rng: Generator) -> None:
        n = len(anchor)
        constant, sync, white = (child.spawn(n) for child in rng.spawn(3))
        accuracy = settings.frequency_accuracy * np.array([g.uniform(-1, 1) for g in constant])
        self._accuracy: Array = np.where(anchor, 0.0, accuracy)
        self._stability = settings.frequency_stability
        self._sync_sd_s = settings.sync_sd_ns * _NANOSECOND
        self._sync = Held(settings.resync_s, lambda rows: _normal(sync, rows))
        self._white = white

    def at(self, t: Array) -> tuple[Array, Array]:
        """Offset (k, n) s of each clock ahead of network time, and frequency error (k, n), at ``t`` (k,), s.

        Epochs come in ascending order, in chunks of any length, and each only once. The offset runs on with
        the constant part of the frequency error; what the white part adds to it, below 1e-10 s in a second,
        is left out.
        """
        sync, since = self._sync.at(t)
        offset = self._sync_sd_s * sync + self._accuracy * since[:, None]
        return offset, self._accuracy + self._stability * _normal(self._white, len(t))


def _normal(generators: list[Generator], rows: int) -> Array:
    """(rows, n), one column from each generator."""
    return np.stack([g.standard_normal(rows) for g in generators], axis=-1)

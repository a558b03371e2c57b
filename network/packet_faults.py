"""Faults of packets on their way to the own ship, whatever their source."""

from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field

from ..sins import earth
from ..sins.settings import Settings
from .fixes import Array, Fixes, concatenate

# One child generator each, in this order: a new effect joins at the end, so that old draws stay.
_OUTLIERS, _DETOURS, _COPIES, _EFFECTS = range(4)


class PacketFaults(Settings):
    """What befalls packets; nothing by default."""

    outlier_share: float = Field(default=0.0, ge=0, le=1)
    """Share of packets whose position and velocity are false, each by a vector whose direction is drawn."""
    outlier_position_m: float = Field(default=100.0, ge=0, le=1e6)
    outlier_velocity_mps: float = Field(default=10.0, ge=0, le=1e4)
    detour_share: float = Field(default=0.0, ge=0, le=1)
    """Share of packets that take a detour, which adds a delay uniform from 0 to `detour_max_s`: they are
    overtaken."""
    detour_max_s: float = Field(default=2.0, ge=0, le=60)
    copies: int = Field(default=1, ge=1, le=20)
    """So many of each packet arrive, those after the first each with a further delay uniform up to
    `copy_delay_max_s`."""
    copy_delay_max_s: float = Field(default=0.5, gt=0, le=60)

    @property
    def at_work(self) -> bool:
        """Whether anything may befall a packet."""
        return self.outlier_share > 0 or self.detour_share > 0 or self.copies > 1


def faulty(fixes: Fixes, faults: PacketFaults, rng: Generator) -> Fixes:
    """The packets as they arrive, in order of arrival.

    ``rng`` is spawned once for each effect, which is drawn for every packet whether or not it is at work.
    """
    if not faults.at_work or not len(fixes):
        return fixes
    rngs, packet = rng.spawn(_EFFECTS), _packets(fixes)
    outlier, aside = _outliers(packet, faults, rngs[_OUTLIERS])
    k = len(outlier)
    detour = np.where(rngs[_DETOURS].random(k) < faults.detour_share, faults.detour_max_s, 0.0)
    detour *= rngs[_DETOURS].random(k)
    false = np.flatnonzero(outlier[packet])
    lla, v_n = fixes.lla.copy(), fixes.v_n.copy()
    lla[false] = earth.displaced(lla[false], faults.outlier_position_m * aside[packet[false], 0])
    v_n[false] += faults.outlier_velocity_mps * aside[packet[false], 1]
    sent = replace(fixes, lla=lla, v_n=v_n, t_arrival=fixes.t_arrival + detour[packet])
    # From 0 to the greatest, 0 excluded: the first is the first.
    later = faults.copy_delay_max_s * (1 - rngs[_COPIES].random((faults.copies - 1, len(sent))))
    return concatenate([sent, *(replace(sent, t_arrival=sent.t_arrival + delay) for delay in later)])


def origins(fixes: Fixes, faults: PacketFaults, rng: Generator) -> NDArray[np.int64]:
    """Which row of ``fixes`` each of the packets that `faulty` returned was, (k,), given an ``rng`` like
    its."""
    numbered = replace(fixes, t_valid=np.arange(float(len(fixes))))
    return faulty(numbered, faults, rng).t_valid.astype(np.int64)


def outliers(fixes: Fixes, faults: PacketFaults, rng: Generator) -> NDArray[np.bool_]:
    """Which of the packets that `faulty` returned it had made false, (k,), given an ``rng`` like its: for the
    scores, no receiver knows it."""
    if not faults.outlier_share or not len(fixes):
        return np.zeros(len(fixes), bool)
    packet = _packets(fixes)
    return _outliers(packet, faults, rng.spawn(_EFFECTS)[_OUTLIERS])[0][packet]


def _packets(fixes: Fixes) -> NDArray[np.int64]:
    """One number for each packet sent, (k,): copies share it."""
    sent = np.stack([fixes.source, fixes.sequence], axis=1)
    return np.unique(sent, axis=0, return_inverse=True)[1].reshape(-1)


def _outliers(
    packet: NDArray[np.int64], faults: PacketFaults, rng: Generator
) -> tuple[NDArray[np.bool_], Array]:
    """Which of the packets sent are outliers, (p,), and directions, (p, 2, 3), of position and velocity."""
    sent = int(packet.max()) + 1
    outlier = rng.random(sent) < faults.outlier_share
    aside = rng.standard_normal((sent, 2, 3))
    return outlier, aside / np.linalg.norm(aside, axis=2, keepdims=True)

"""The fixes that reach a filter, checked, and the epochs of the record they belong to."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..network.fixes import Fixes
from .estimate import Array, FixOutcome

Integers = NDArray[np.int64]


class Reception(NamedTuple):
    """Fixes in order of arrival, as the compiled loops take them."""

    lla: Array
    """(k, 3)."""
    v_n: Array
    """(k, 3)."""
    cov: Array
    """(k, 6, 6)."""
    t_reference: Array
    """(k,) s, that a fix's age counts from: its stamp or its arrival."""
    arrival_epoch: Integers
    """(k,)."""
    reference_epoch: Integers
    """(k,) first epoch not before the reference."""
    packet: Integers
    """(k,) one number per packet sent."""
    source: Integers
    """(k,) counted from 0."""
    sequence: Integers
    """(k,) as sent."""


class Received(NamedTuple):
    """Fixes in order of arrival, and what is to be known of them however a filter treats their delays."""

    fixes: Fixes
    outcome: Integers
    """(k,) NOT_FINITE, INVALID or UNAUTHENTIC for fixes that nobody must use, PENDING for the others."""
    arrival_epoch: Integers
    packet: Integers
    source: Integers


def received(time: Array, fixes: Fixes) -> Received:
    """Fixes, in any order, that are to be taken with the record of epochs ``time``, (n,) s."""
    fixes = fixes.sorted_by_arrival()
    k = len(fixes)
    outcome = np.full(k, FixOutcome.PENDING, dtype=np.int64)
    outcome[~_are_covariances(fixes.cov) | (np.abs(fixes.lla[:, 0]) > np.pi / 2)] = FixOutcome.INVALID
    for values in (fixes.lla, fixes.v_n, fixes.cov):
        finite = np.isfinite(values)
        if not finite.all():
            outcome[~finite.reshape(k, -1).all(axis=1)] = FixOutcome.NOT_FINITE
    outcome[~fixes.authentic] = FixOutcome.UNAUTHENTIC
    source, packet = _numbered(fixes)
    return Received(fixes, outcome, np.searchsorted(time, fixes.t_arrival), packet, source)


def counted_from(time: Array, found: Received, by_stamp: bool, stamp_sd: float) -> tuple[Integers, Reception]:
    """Outcome so far, (k,), of fixes whose age counts from their stamp, of standard deviation ``stamp_sd`` s,
    or from their arrival; and the fixes as the compiled loops take them.

    A fix that must not be used has the reason for its outcome, the others are PENDING.
    """
    fixes = found.fixes
    dt = (time[-1] - time[0]) / (len(time) - 1)
    reference = fixes.t_stamp if by_stamp else fixes.t_arrival
    outcome = found.outcome.copy()
    whole = (outcome == FixOutcome.PENDING) | (outcome == FixOutcome.INVALID)
    outcome[whole & (reference < time[0])] = FixOutcome.LATE
    if by_stamp:
        early = fixes.t_stamp > fixes.t_arrival + dt + 5 * stamp_sd
        outcome[whole & early] = FixOutcome.FUTURE
    reference_epoch = found.arrival_epoch
    if by_stamp:
        reference_epoch = np.minimum(np.searchsorted(time, reference), reference_epoch)
    return outcome, Reception(
        lla=fixes.lla,
        v_n=fixes.v_n,
        cov=fixes.cov,
        t_reference=reference,
        arrival_epoch=found.arrival_epoch,
        reference_epoch=reference_epoch,
        packet=found.packet,
        source=found.source,
        sequence=fixes.sequence,
    )


def _are_covariances(cov: Array) -> NDArray[np.bool_]:
    """Which of the matrices, (k, 6, 6), are symmetric and positive definite."""
    if len(cov) > 1 and (cov == cov[0]).all():
        # The usual case: one noise for all fixes, and often for all runs.
        return np.full(len(cov), _is_covariance(cov[0].tobytes()))
    finite = np.isfinite(cov.reshape(len(cov), 36)).all(axis=1)
    cov = np.where(finite.reshape(-1, 1, 1), cov, np.eye(6))
    scale = np.sqrt(np.abs(np.einsum("kii->ki", cov)))
    asymmetry = np.abs(cov - cov.swapaxes(1, 2)).max(axis=(1, 2)) if len(cov) else np.zeros(0)
    symmetric = asymmetry <= 1e-9 * scale.max(axis=1, initial=0.0) ** 2
    # Scaled to unit diagonal, or metres would hide what is wrong in metres per second.
    scaled = cov / np.maximum(scale[:, :, None] * scale[:, None, :], 1e-300)
    return finite & symmetric & (np.linalg.eigvalsh(scaled).min(axis=1, initial=np.inf) > 1e-12)


@lru_cache(maxsize=16)
def _is_covariance(cov: bytes) -> bool:
    return bool(_are_covariances(np.frombuffer(cov).reshape(1, 6, 6))[0])


def _numbered(fixes: Fixes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Source and packet of each fix, (k,), counted from 0 in order of source and of (source, sequence)."""
    order = np.lexsort((fixes.sequence, fixes.source))
    by_source, by_sequence = fixes.source[order], fixes.sequence[order]
    new_source = by_source[1:] != by_source[:-1]
    new_packet = new_source | (by_sequence[1:] != by_sequence[:-1])
    source, packet = np.zeros(len(fixes), np.int64), np.zeros(len(fixes), np.int64)
    source[order[1:]], packet[order[1:]] = np.cumsum(new_source), np.cumsum(new_packet)
    return source, packet

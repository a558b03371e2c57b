"""The fixes that reach a filter, checked, and the epochs of the record they belong to."""

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


def received(time: Array, fixes: Fixes, by_stamp: bool, stamp_sd: float) -> tuple[Integers, Reception]:
    """Outcome so far, (k,), of fixes in order of arrival, and what is to be known of them.

    Parameters: ``time`` (n,) s, of the record; ``by_stamp``, whether a fix counts from its stamp, of standard
    deviation ``stamp_sd`` s, or from its arrival. A fix that must not be used has the reason for its
    outcome, the others are PENDING.
    """
    k = len(fixes)
    dt = (time[-1] - time[0]) / (len(time) - 1)
    reference = fixes.t_stamp if by_stamp else fixes.t_arrival
    outcome = np.full(k, FixOutcome.PENDING, dtype=np.int64)
    outcome[reference < time[0]] = FixOutcome.LATE
    if by_stamp:
        outcome[fixes.t_stamp > fixes.t_arrival + dt + 5 * stamp_sd] = FixOutcome.FUTURE
    for values in (fixes.lla, fixes.v_n, fixes.cov):
        finite = np.isfinite(values)
        if not finite.all():
            outcome[~finite.reshape(k, -1).all(axis=1)] = FixOutcome.NOT_FINITE
    invalid = ~_are_covariances(fixes.cov) | (np.abs(fixes.lla[:, 0]) > np.pi / 2)
    outcome[(outcome == FixOutcome.PENDING) & invalid] = FixOutcome.INVALID
    outcome[~fixes.authentic] = FixOutcome.UNAUTHENTIC
    arrival_epoch = np.searchsorted(time, fixes.t_arrival)
    reference_epoch = np.minimum(np.searchsorted(time, reference), arrival_epoch)
    source, packet = _numbered(fixes)
    return outcome, Reception(
        fixes.lla,
        fixes.v_n,
        fixes.cov,
        reference,
        arrival_epoch,
        reference_epoch,
        packet,
        source,
        fixes.sequence,
    )


def _are_covariances(cov: Array) -> NDArray[np.bool_]:
    """Which of the matrices, (k, 6, 6), are symmetric and positive definite."""
    if len(cov) > 1 and np.array_equal(cov, np.broadcast_to(cov[0], cov.shape)):
        # The usual case: one noise for all fixes.
        return np.repeat(_are_covariances(cov[:1]), len(cov))
    finite = np.isfinite(cov.reshape(len(cov), 36)).all(axis=1)
    cov = np.where(finite.reshape(-1, 1, 1), cov, np.eye(6))
    scale = np.sqrt(np.abs(np.einsum("kii->ki", cov)))
    asymmetry = np.abs(cov - cov.swapaxes(1, 2)).max(axis=(1, 2)) if len(cov) else np.zeros(0)
    symmetric = asymmetry <= 1e-9 * scale.max(axis=1, initial=0.0) ** 2
    # Scaled to unit diagonal, or metres would hide what is wrong in metres per second.
    scaled = cov / np.maximum(scale[:, :, None] * scale[:, None, :], 1e-300)
    return finite & symmetric & (np.linalg.eigvalsh(scaled).min(axis=1, initial=np.inf) > 1e-12)


def _numbered(fixes: Fixes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Source and packet of each fix, (k,), counted from 0 in order of source and of (source, sequence)."""
    order = np.lexsort((fixes.sequence, fixes.source))
    by_source, by_sequence = fixes.source[order], fixes.sequence[order]
    new_source = by_source[1:] != by_source[:-1]
    new_packet = new_source | (by_sequence[1:] != by_sequence[:-1])
    source, packet = np.zeros(len(fixes), np.int64), np.zeros(len(fixes), np.int64)
    source[order[1:]], packet[order[1:]] = np.cumsum(new_source), np.cumsum(new_packet)
    return source, packet

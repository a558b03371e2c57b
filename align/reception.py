"""What reaches a filter: increments and fixes, checked, and the epochs of the record they belong to."""

import numpy as np
from numpy.typing import NDArray

from ..network.fixes import Fixes
from .estimate import Array, FixOutcome

Integers = NDArray[np.int64]


def finite_increments(increments: Array) -> tuple[Array, int]:
    """Replace rows that are not finite by the last good row (zero at the very start); count them."""
    finite = np.isfinite(increments)
    if finite.all():
        return increments, 0
    bad = ~finite.all(axis=1)
    last_good = np.maximum.accumulate(np.where(bad, -1, np.arange(len(increments))))
    increments = np.where((last_good < 0)[:, None], 0.0, increments[last_good])
    return np.ascontiguousarray(increments), int(np.count_nonzero(bad))


def received(time: Array, fixes: Fixes, by_stamp: bool) -> tuple[Integers, tuple[Array | Integers, ...]]:
    """Outcome so far, (k,), of fixes in order of arrival, and the tuple that `_alignment_kernel.align` takes.

    Parameters: ``time`` (n,) s, of the record; ``by_stamp``, whether a fix counts from its stamp or from its
    arrival. A fix that must not be used has the reason for its outcome, the others are PENDING.
    """
    k = len(fixes)
    dt = (time[-1] - time[0]) / (len(time) - 1)
    reference = fixes.t_stamp if by_stamp else fixes.t_arrival
    outcome = np.full(k, FixOutcome.PENDING, dtype=np.int64)
    if by_stamp:
        outcome[fixes.t_stamp > fixes.t_arrival + dt] = FixOutcome.FUTURE
        outcome[fixes.t_stamp < time[0]] = FixOutcome.LATE
    for values in (fixes.lla, fixes.v_n, fixes.cov):
        finite = np.isfinite(values)
        if not finite.all():
            outcome[~finite.reshape(k, -1).all(axis=1)] = FixOutcome.NOT_FINITE
    outcome[(outcome == FixOutcome.PENDING) & ~_are_covariances(fixes.cov)] = FixOutcome.BAD_COVARIANCE
    arrival_epoch = np.searchsorted(time, fixes.t_arrival)
    reference_epoch = np.minimum(np.searchsorted(time, reference), arrival_epoch)
    source, packet = _numbered(fixes)
    return outcome, (
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

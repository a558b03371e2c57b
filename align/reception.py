"""What reaches a filter: increments and fixes, checked, and the epochs of the record they belong to."""

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


HOLD_WINDOW = 10
"""Samples whose mean stands in for a sample that is not finite: fewer would hold on to vibration."""
HELD = 10.0, 0.5
"""Standard deviations of jerk, m/s^3, and angular acceleration, rad/s^2, meanwhile: a brisk manoeuvre's."""


def finite_increments(increments: Array, dt: float) -> tuple[Array, Array, int]:
    """Replace rows that are not finite, and say what that costs.

    Parameters: ``increments`` (n, 6), ``dt`` s. Returns the increments, with the mean of the
    rows before each gap in its place (zero at the very start); the variances (n, 2) of velocity,
    (m/s)^2, and misalignment, rad^2, that the replacements add; and the number of rows replaced.

    A rate that is held for a time t is wrong by what the vehicle does in it: the angle by ``a t^2 / 2``
    for an angular acceleration ``a``, and the velocity likewise by the jerk.
    """
    variance = np.zeros((len(increments), 2))
    bad = np.flatnonzero(~np.isfinite(increments).all(axis=1))
    if len(bad) == 0:
        return increments, variance, 0
    increments = increments.copy()
    for gap in np.split(bad, np.flatnonzero(np.diff(bad) > 1) + 1):
        first, end = gap[0], gap[-1] + 1
        before = increments[max(first - HOLD_WINDOW, 0) : first]
        increments[first:end] = before.mean(axis=0) if first else 0.0
        held_s = dt * np.arange(len(gap) + 1)[:, None]
        variance[first:end] = np.diff((0.5 * np.array(HELD) * held_s**2) ** 2, axis=0)
    return increments, variance, len(bad)


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

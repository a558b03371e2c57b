"""One node, in a plane or in space, against nodes that know where they are: whole batches of such problems.

Arrays may have leading axes, one problem for each element. d is 2 or 3, m the number of anchors. An anchor
that a node does not hear has an infinite standard deviation, and any finite range.
"""

from typing import NamedTuple

import numpy as np

from ...sins.gaussian import apply, transposed
from .problem import Array, Booleans, Integers, LocalizationError, RangeProblem

_HEIGHT_SD_M = 1e-3
"""Of nodes that are known to lie in the plane; far below any range's, and not so far as to be stiff."""
_SINGULAR = 1e-15
"""Eigenvalue, over the largest, below which a direction counts as unknown."""


class Located(NamedTuple):
    """Positions of one node each."""

    x: Array
    """(..., d) m."""
    cov: Array
    """(..., d, d) m^2."""
    converged: Booleans
    """(...)."""


def distances(x: Array, anchors: Array, rise: Array | float = 0.0) -> tuple[Array, Array]:
    """Distances (..., m) from x (..., d) to anchors (..., m, d), and their gradients (..., m, d) in x.

    ``rise`` (..., m) m is what anchors stand above the node where that is known and no component of x: the
    distance is the slant one then, and its gradient shorter than a unit vector.
    """
    apart = x[..., None, :] - anchors
    d = _slant(apart, rise)
    return d, apart / np.maximum(d, 1e-12)[..., None]


def lengths(x: Array, anchors: Array, rise: Array | float = 0.0) -> Array:
    """The same distances (..., m) without their gradients."""
    return _slant(x[..., None, :] - anchors, rise)


def information(x: Array, anchors: Array, range_sd: Array, rise: Array | float = 0.0) -> Array:
    """Fisher information (..., d, d) of ranges with Gaussian errors of known standard deviation, at x."""
    _, u = distances(x, anchors, rise)
    return transposed(u) @ (u * _weights(range_sd, u)[..., None])


def range_bound(x: Array, anchors: Array, range_sd: Array, rise: Array | float = 0.0) -> Array:
    """Cramer-Rao bound (..., d, d) of one node at its true position x."""
    return np.linalg.inv(information(x, anchors, range_sd, rise)).astype(np.float64)


def lateration(anchors: Array, ranges: Array, heard: Booleans | None = None) -> Array:
    """The linear solution (..., d) from differences of squared ranges.

    Each range's square less that of the last heard anchor is linear in the position; least squares of these
    equations weighs them alike, although their errors are neither equal nor independent. ``heard`` (..., m)
    is all of them by default.
    """
    heard = np.ones(ranges.shape, bool) if heard is None else np.broadcast_to(heard, ranges.shape)
    anchors = np.broadcast_to(anchors, (*ranges.shape, anchors.shape[-1]))
    last = ranges.shape[-1] - 1 - np.argmax(heard[..., ::-1], axis=-1)
    reference = np.take_along_axis(anchors, last[..., None, None], axis=-2)
    reference_range = np.take_along_axis(ranges, last[..., None], axis=-1)
    A = 2 * (anchors - reference) * heard[..., None]
    squares = np.sum(anchors**2 - reference**2, axis=-1)
    b = np.where(heard, squares + reference_range**2 - ranges**2, 0.0)
    return apply(np.linalg.pinv(A), b)


def weighted_lateration(anchors: Array, ranges: Array, range_sd: Array) -> Array:
    """The linear solution (..., d) with each squared range weighed by its own variance, (2 r sd)^2.

    Differences are from the weighted mean instead of one anchor's, which no single range's error enters
    whole. Any rise that all anchors share drops out, so that slant ranges serve as they are.
    """
    w = _weights(2 * ranges * range_sd, ranges[..., None])
    w = w / w.sum(axis=-1, keepdims=True)
    anchors = np.broadcast_to(anchors, (*ranges.shape, anchors.shape[-1]))
    centre = np.sum(w[..., None] * anchors, axis=-2, keepdims=True)
    apart = anchors - centre
    # What is the same in all of them has no part in the solution: the columns of A are centred.
    b = np.sum(apart**2, axis=-1) - ranges**2
    root = np.sqrt(w)
    return centre[..., 0, :] + apply(np.linalg.pinv(2 * apart * root[..., None]), root * b)


def gauss_newton(
    anchors: Array,
    ranges: Array,
    range_sd: Array,
    x0: Array,
    tolerance_m: float = 1e-4,
    max_iterations: int = 50,
    rise: Array | float = 0.0,
    huber: float = np.inf,
) -> Located:
    """Weighted nonlinear least squares from a start (..., d), with the covariance at the solution.

    ``rise`` is that of `distances`. A step is at most as long as the mean range, so that a start on the
    wrong side does not throw it out. Residuals of more than ``huber`` standard deviations count by Huber's
    loss, and less in the covariance.
    """
    x0 = np.asarray(x0, float)
    lead, d, m = x0.shape[:-1], x0.shape[-1], np.shape(ranges)[-1]

    def flat(values: Array | float, *own: int) -> Array:
        return np.broadcast_to(values, lead + own).reshape(-1, *own)

    x = flat(x0, d).copy()
    anchors, ranges, rise = flat(anchors, m, d), flat(ranges, m), flat(rise, m)
    w = flat(np.asarray(range_sd, float) ** -2.0, m)
    reach = np.sum(ranges * w, axis=-1) / np.sum(w, axis=-1)
    moving = np.arange(len(x))
    for _ in range(max_iterations):
        at = x[moving], anchors[moving], rise[moving]
        inverse, gradient = _normal(*at, ranges[moving], w[moving], huber)
        step = apply(inverse, gradient)
        length = np.linalg.norm(step, axis=-1)
        step *= np.minimum(1.0, reach[moving] / np.maximum(length, 1e-12))[..., None]
        x[moving] += step
        moving = moving[length > tolerance_m]
        if not len(moving):
            break
    cov, _ = _normal(x, anchors, rise, ranges, w, huber)
    still = np.ones(len(x), bool)
    still[moving] = False
    return Located(x.reshape(x0.shape), cov.reshape(*lead, d, d), still.reshape(lead))


def _normal(
    x: Array, anchors: Array, rise: Array, ranges: Array, w: Array, huber: float
) -> tuple[Array, Array]:
    """Pseudo-inverse of the normal equations (n, d, d), and their right side (n, d)."""
    d, u = distances(x, anchors, rise)
    shared = w * _huber_weights((ranges - d) * np.sqrt(w), huber)
    values, vectors = np.linalg.eigh(transposed(u) @ (u * shared[..., None]))
    known = np.abs(values) > _SINGULAR * np.abs(values).max(axis=-1, keepdims=True)
    weights = np.divide(1.0, values, out=np.zeros_like(values), where=known)
    inverse = (vectors * weights[..., None, :]) @ transposed(vectors)
    return inverse, apply(transposed(u), (ranges - d) * shared)


def check_ranges(ranges: Array, range_sd: Array) -> None:
    """Raises `LocalizationError` for ranges or deviations that are not positive numbers."""
    for name, values in (("range", ranges), ("range_sd", range_sd)):
        bad = ~(values > 0) | np.isnan(values) | ((name == "range") & np.isinf(values))
        if bad.any():
            where = int(np.flatnonzero(bad)[0])
            raise LocalizationError(
                f"{name} {where} = {values.ravel()[where]:g} m: must be positive and finite"
            )


def check_anchors(anchors: Array, least: int | None = None) -> None:
    """Raises `LocalizationError` for fewer anchors (m, d) than d + 1, and for those on a line or plane."""
    count, d = anchors.shape
    least = d + 1 if least is None else least
    if count < least:
        raise LocalizationError(f"{count} anchors: at least {least} are needed in {d} dimensions")
    centred = anchors - anchors.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[-1] < 1e-6 * max(spread[0], 1e-12):
        shape = "a line" if d == 2 else "a plane"
        raise LocalizationError(f"all {count} anchors lie on {shape}: what is mirrored in it fits as well")


def in_plane(
    links: Integers, ranges: Array, range_sd: Array, anchor: Booleans, anchor_x: Array
) -> RangeProblem:
    """A network in a plane as a problem in space whose nodes are known to have no height.

    ``anchor_x`` (n, 2). What is found has a third component of zero, and a bound of it of (1 mm)^2.
    """
    flat = np.column_stack([np.where(anchor[:, None], anchor_x, 0.0), np.zeros(len(anchor))])
    return RangeProblem(
        links=np.asarray(links, np.int64),
        ranges=ranges,
        range_sd=range_sd,
        anchor=anchor,
        anchor_x=flat,
        height=np.zeros(len(anchor)),
        height_sd=_HEIGHT_SD_M,
    )


def _huber_weights(r: Array, threshold: float) -> Array:
    """Weights (..., m) of residuals in standard deviations."""
    return threshold / np.maximum(np.abs(r), threshold) if np.isfinite(threshold) else np.ones_like(r)


def _slant(apart: Array, rise: Array | float) -> Array:
    return np.sqrt(np.einsum("...d,...d->...", apart, apart) + np.square(rise))


def _weights(range_sd: Array, like: Array) -> Array:
    """Inverse variances (..., m); zero where the deviation is infinite."""
    return np.broadcast_to(np.asarray(range_sd, float) ** -2.0, like.shape[:-1])

"""Nodes on the ground against an anchor that flies past: both sides of its track, and which of them it is.

From a straight flight a node and its mirror image in the vertical plane of the track have the same ranges.
Every estimator here follows both, and tells which by their likelihood; where the odds are not clear the node
is ambiguous. Leading axes are nodes, sides (2) before them.

A height above the earth is a range to its centre, one more anchor for least squares and for the bound.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cubature import Filter, track_beacons
from .plane import distances, gauss_newton, range_bound, weighted_lateration
from .problem import Array, Booleans
from .ranging import RangeNoise

LOG_ODDS = np.log(1000.0)
"""Of one side against the other, from which on there is no doubt."""
LEAST_BEACONS = 6
"""That a node must hear: three coordinates, and something to tell the side by."""
_STARTS = (0.125, 0.25, 0.5, 0.75)
"""Shares of the ranges, the first ones, after which a filter may take over from least squares."""
_CURVATURE = 0.2
"""Of a range's noise: what the curvature of spheres about the beacons may come to over the covariance that a
filter starts from. The estimate is not normal otherwise, and no filter here can carry it."""


@dataclass(frozen=True)
class Passed:
    """What nodes (...) have of a leg's m beacons."""

    anchors: Array
    """(..., m, 3) m, as broadcast."""
    ranges: Array
    """(..., m) m"""
    heard: Booleans
    """(..., m)"""
    noise: RangeNoise
    earth_centre: Array
    """(3,) m"""
    earth_radius: float
    """m, to the height that nodes are expected at."""
    height_sd: float
    """m, of a node's height above the anchors' datum, the anchors' own error in it included."""

    def among(self, taken: Booleans) -> "Passed":
        """With fewer beacons, ``taken`` (..., m) of those heard."""
        return replace(self, heard=self.heard & taken)

    def with_height(self, x: Array) -> tuple[Array, Array, Array]:
        """Anchors, ranges and deviations (..., m + 1) with the earth's centre as the last anchor; deviations
        at the distances from x (..., 3)."""
        d, _ = distances(x, self.anchors)
        sd, one = np.where(self.heard, self.noise.at(d), np.inf), (*d.shape[:-1], 1)
        anchors, ranges = np.broadcast_to(self.anchors, (*d.shape, 3)), np.broadcast_to(self.ranges, d.shape)
        return (
            np.concatenate([anchors, np.broadcast_to(self.earth_centre, (*one, 3))], axis=-2),
            np.concatenate([ranges, np.full(one, self.earth_radius)], axis=-1),
            np.concatenate([sd, np.full(one, self.height_sd)], axis=-1),
        )


class Fix(NamedTuple):
    """Positions of nodes."""

    x: Array
    """(..., 3) m; NaN for nodes that heard too little."""
    cov: Array
    """(..., 3, 3) m^2"""
    ambiguous: Booleans
    """(...) whether the other side is not ruled out."""


class Start(NamedTuple):
    """What filters begin from."""

    x: Array
    """(2, ..., 3) m, on both sides."""
    cov: Array
    """(2, ..., 3, 3) m^2"""
    cost: Array
    """(2, ...) half the sums of squared residuals."""
    later: Passed
    """The ranges that have no part in it."""
    few: Booleans
    """(...) nodes that hear too little for any estimate."""


def bound(passed: Passed, x: Array) -> Array:
    """Cramer-Rao bound (..., 3, 3) at true positions on the anchors' datum, NaN for nodes that hear too
    little."""
    anchors, _, sd = passed.with_height(x)
    few = _few(passed)
    sd = np.where(few[..., None], 1.0, sd)
    return np.where(few[..., None, None], np.nan, range_bound(x, anchors, sd))


def least_squares(passed: Passed) -> Fix:
    """All ranges at once."""
    x, cov, cost = _both(passed)
    return _chosen(_few(passed), x, cov, -cost)


def filtered(start: Start, kind: Filter) -> Fix:
    """The ranges that a start has left, one by one, both sides in parallel."""
    later = start.later
    both = (2, *later.ranges.shape)
    states = track_beacons(
        kind,
        start.x,
        start.cov,
        np.broadcast_to(later.anchors, (*both, 3)),
        np.broadcast_to(later.ranges, both),
        later.noise,
        np.broadcast_to(later.heard, both),
    )
    last = deque(states, maxlen=1)[0]
    return _chosen(start.few, last.x, last.P, last.log_likelihood - start.cost)


def on_the_ground(fix: Fix, passed: Passed, own_sd: float) -> Fix:
    """The fix freed of what is known of the anchors' own error, and with what is not in its covariance.

    Ranges place a node relative to the track that is broadcast, an error of which, the same for all beacons,
    shifts it as a whole. The height alone is known from elsewhere: of a difference between it and the fix a
    share is the track's, ``own_sd^2 / height_sd^2``.
    """
    share = own_sd**2 / passed.height_sd**2
    inward = passed.earth_centre - fix.x
    distance = np.linalg.norm(inward, axis=-1, keepdims=True)
    down = inward / distance
    kept = np.eye(3) - share * down[..., :, None] * down[..., None, :]
    x = fix.x + share * (distance - passed.earth_radius) * down
    return Fix(x, kept @ fix.cov @ kept + own_sd**2 * kept, fix.ambiguous)


def begun(passed: Passed) -> Start:
    """Least squares of the first ranges, as many as it takes until what they leave open is nearly normal."""
    few, passed = _few(passed), _all_for_the_deaf(passed)
    count = np.cumsum(passed.heard, axis=-1)
    early = np.zeros(passed.heard.shape, bool)
    x, cov, cost = _both(passed)
    pending = np.ones(x.shape[1:-1], bool)
    for share in _STARTS:
        now = count <= np.maximum(share * count[..., -1:], LEAST_BEACONS)
        x_now, cov_now, cost_now = _both(passed.among(now))
        d, _ = distances(x_now, passed.anchors)
        d = np.where(passed.heard, d, np.inf)
        bend = np.trace(cov_now, axis1=-2, axis2=-1) / (2 * d.min(axis=-1))
        flat = (bend < _CURVATURE * passed.noise.at(d.min(axis=-1))).all(axis=0)
        begins = pending & (flat | (share == _STARTS[-1]))
        early = np.where(begins[..., None], now, early)
        x = np.where(begins[..., None], x_now, x)
        cov = np.where(begins[..., None, None], cov_now, cov)
        cost = np.where(begins, cost_now, cost)
        pending &= ~begins
    return Start(x, cov, cost, passed.among(~early), few)


def _both(passed: Passed) -> tuple[Array, Array, Array]:
    """Solutions (2, ..., 3) on both sides, covariances, and half the sums of squared residuals."""
    passed = _all_for_the_deaf(passed)
    x = _starts(passed)
    terms = passed.with_height(x)
    found = gauss_newton(*terms, x)
    anchors, ranges, sd = passed.with_height(found.x)
    d, _ = distances(found.x, anchors)
    return found.x, found.cov, 0.5 * np.sum(((ranges - d) / sd) ** 2, axis=-1)


def _starts(passed: Passed) -> Array:
    """(2, ..., 3) where the ranges put a node beside a straight track: along it by their linear equations,
    across it by what is left of them, at the expected height."""
    sd = np.where(passed.heard, passed.noise.at(passed.ranges), np.inf)
    w = (passed.ranges * sd) ** -2.0
    w = w / w.sum(axis=-1, keepdims=True)
    centre = np.sum(w[..., None] * passed.anchors, axis=-2, keepdims=True)
    flat = (passed.anchors - centre)[..., :2]
    _, axes = np.linalg.eigh(np.swapaxes(flat * w[..., None], -1, -2) @ flat)
    axis = axes[..., -1]
    way = np.einsum("...md,...d->...m", flat, axis)
    along = weighted_lateration(way[..., None], passed.ranges, sd)[..., 0]
    across = np.sum(w * (passed.ranges**2 - (along[..., None] - way) ** 2), axis=-1)
    foot = centre[..., 0, :2] + along[..., None] * axis
    left = np.stack([-axis[..., 1], axis[..., 0]], axis=-1)
    expected = passed.earth_centre[2] - passed.earth_radius
    rise = expected - centre[..., 0, 2]
    offset = np.sqrt(np.maximum(across - rise**2, (0.1 * rise) ** 2))[..., None]
    sides = np.stack([foot + offset * left, foot - offset * left])
    drop = np.sum(sides**2, axis=-1, keepdims=True) / (2 * passed.earth_radius)
    return np.concatenate([sides, expected + drop], axis=-1)


def _chosen(few: Booleans, x: Array, cov: Array, log_likelihood: Array) -> Fix:
    """The likelier side of two (2, ...)."""
    best = np.argmax(log_likelihood, axis=0)

    def of(values: Array, side: NDArray[np.intp]) -> Array:
        at = side.reshape(1, *side.shape, *(1,) * (values.ndim - side.ndim - 1))
        return np.take_along_axis(values, at, axis=0)[0]

    apart = np.linalg.norm(x[0] - x[1], axis=-1)
    spread = np.sqrt(np.trace(cov[0] + cov[1], axis1=-2, axis2=-1))
    near = np.abs(log_likelihood[0] - log_likelihood[1]) < LOG_ODDS
    return Fix(
        np.where(few[..., None], np.nan, of(x, best)),
        np.where(few[..., None, None], np.nan, of(cov, best)),
        near & (apart > spread) & ~few,
    )


def _all_for_the_deaf(passed: Passed) -> Passed:
    """All beacons for nodes that hear too little, to have something to solve; `_chosen` drops them."""
    return replace(passed, heard=passed.heard | _few(passed)[..., None])


def _few(passed: Passed) -> Booleans:
    return passed.heard.sum(axis=-1) < LEAST_BEACONS

"""Nodes that listen to one moving anchor: solutions from all its beacons at once.

Xu et al. (CAAI Transactions on Intelligent Systems 14, 2019), sections 1.2 and 2.3. Leading axes are nodes;
m is the number of beacons, and a beacon that a node does not hear has ``heard`` False and any range.

- (2) takes d_i for the horizontal range; what is measured is the slant range. In the differences of (3) and
  (4) the height drops out, since all beacons are at one height: `plane.lateration` of slant ranges is right.
  It is not where ranges are used one by one, as in least squares.
- (4) takes the last beacon's range from all others: its error is in every equation, and it is the farthest.
  The paper calls this maximum likelihood; least squares of these equations weighs all alike. Mended:
  `plane.weighted_lateration`, of ranges freed of what squaring adds to their mean.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .plane import (
    Located,
    check_anchors,
    check_ranges,
    distances,
    gauss_newton,
    lateration,
    weighted_lateration,
)
from .problem import Array, Booleans, LocalizationError
from .ranging import RangeNoise


@dataclass(frozen=True)
class Heard:
    """What nodes (...) hear, each its own beacons in order of time, padded to the longest list."""

    anchors: Array
    """(..., m, d) m."""
    ranges: Array
    """(..., m) m, slant."""
    heard: Booleans
    """(..., m); False where a list has ended."""
    rise: Array | float = 0.0
    """(..., m) m, of the beacon above the node, where that is known and anchors have two components."""

    def sd(self, noise: RangeNoise, d: Array) -> Array:
        """(..., m) m, at distances d; infinite where nothing is heard."""
        return np.where(self.heard, noise.at(d), np.inf)


def listening(beacons: Array, ranges: Array, heard: Booleans, rise: Array | float = 0.0) -> Heard:
    """Of ``beacons`` (m, 2) those that each node hears, ``heard`` (..., m), with ``ranges`` (..., m) m.

    Raises `LocalizationError` for a node that hears fewer than three or none but on a line, of which a
    mirror image hears the same, and for ranges that are not positive.
    """
    for node in np.ndindex(heard.shape[:-1]):
        own = heard[node]
        try:
            check_ranges(ranges[node][own], np.ones(own.sum()))
            check_anchors(beacons[own])
        except LocalizationError as error:
            raise LocalizationError(f"node {', '.join(map(str, node))}: {error}") from error
    order = np.argsort(~heard, axis=-1, kind="stable")[..., : int(heard.sum(axis=-1).max())]
    taken = np.take_along_axis(heard, order, axis=-1)
    rises = np.broadcast_to(np.asarray(rise, float), ranges.shape)
    return Heard(
        anchors=beacons[order],
        ranges=np.where(taken, np.take_along_axis(ranges, order, axis=-1), 1.0),
        heard=taken,
        rise=np.take_along_axis(rises, order, axis=-1),
    )


def linear(seen: Heard) -> Array:
    """(2) to (4) as printed, (..., d)."""
    return lateration(seen.anchors, seen.ranges, seen.heard)


def linear_weighted(seen: Heard, noise: RangeNoise) -> Array:
    """(2) to (4) as mended, (..., d)."""
    ranges = seen.ranges / np.sqrt(1 + noise.share**2)
    return weighted_lateration(seen.anchors, ranges, seen.sd(noise, ranges))


def least_squares(seen: Heard, noise: RangeNoise, x0: Array) -> Located:
    """Least squares, each range weighed by its measured length."""
    sd = seen.sd(noise, seen.ranges)
    return gauss_newton(seen.anchors, seen.ranges, sd, x0, rise=seen.rise)


def quasi_likelihood(seen: Heard, noise: RangeNoise, x0: Array, rounds: int = 50) -> Located:
    """Least squares, each range weighed by its length at the estimate.

    Where the measured length gives the weight, a range that is too short by chance counts for a good one,
    which draws nodes to the beacons. Weights at the estimate solve ``sum u (r - d) / sd(d)^2 = 0``, which
    holds on average at the truth: of all estimates that know no more than mean and variance of the ranges
    none is better in large samples, and `plane.range_bound` with sd(d) is its covariance.
    """
    return _repeated(seen, x0, lambda d: (seen.ranges, seen.sd(noise, d)), rounds)


def log_likelihood(seen: Heard, log_sd: float, x0: Array, rounds: int = 50) -> Located:
    """Maximum likelihood for path loss (1): least squares of the logarithms of ranges.

    Around an estimate a residual of logarithms is one of lengths, ``d (ln r - ln d)``, of deviation
    ``log_sd d``. Ranges are of mean one, as those of `ranging.PathLossErrors`.
    """
    logs = np.log(seen.ranges) + 0.5 * log_sd**2

    def terms(d: Array) -> tuple[Array, Array]:
        return d * (1 + logs - np.log(d)), seen.sd(RangeNoise(share=log_sd), d)

    return _repeated(seen, x0, terms, rounds)


def _repeated(seen: Heard, x0: Array, terms: Callable[[Array], tuple[Array, Array]], rounds: int) -> Located:
    """Gauss-Newton steps with ranges and deviations that depend on the distances at the step before."""
    x, done = x0, np.zeros(x0.shape[:-1], bool)
    step = Located(x0, np.empty(0), done)
    for _ in range(rounds):
        d = distances(x, seen.anchors, seen.rise)[0]
        step = gauss_newton(seen.anchors, *terms(d), x, max_iterations=1, rise=seen.rise)
        # A node that is done stays where it is, whoever else is in its batch.
        x, done = np.where(done[..., None], x, step.x), done | step.converged
        if done.all():
            break
    return Located(x, step.cov, done)

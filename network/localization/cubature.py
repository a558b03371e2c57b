"""A node that stays where it is, tracked over the beacons of a moving anchor: cubature and extended filters.

Xu et al. (CAAI Transactions on Intelligent Systems 14, 2019), eqs. 5 to 8, on `sins.gaussian`.

- (5) prints the covariance R for the noise of the state and for that of the range; the first is Q. Ranges
  are scalars here, of variance R; ``process_sd_m`` is the root of Q in each component.
- (6) is the time update, with f the identity: a node does not move. (7), (8) and the gain between them are
  `square_root_cubature_update`.
- The threshold of section 2.2: see `Threshold`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ...sins.gaussian import (
    Array,
    cubature_points,
    cubature_update,
    kalman_update,
    lower_root,
    square_root_cubature_update,
    transposed,
)
from .plane import distances, lengths
from .problem import Booleans
from .ranging import RangeNoise


class Filter(StrEnum):
    """How the covariance is carried, and the range made linear."""

    EXTENDED = "ekf"
    CUBATURE = "ckf"
    SQUARE_ROOT = "srckf"


class Threshold(StrEnum):
    """What becomes of the deviations D_j of (6) below a threshold."""

    NONE = "none"
    PRINTED = "printed"
    """``D_j < alpha`` is set to zero. Cubature points come in pairs, so this takes one of each: the
    covariance is halved at each beacon, and the filter stops listening."""
    SIZE = "size"
    """``|D_j| < alpha`` is set to zero: a filter whose deviation has come below alpha stops there."""
    INFORMATION = "information"
    """The covariance is left alone. A range whose predicted deviation is below alpha of its own noise is not
    used: it would shrink the variance along it by less than alpha squared, and costs a whole update."""


class State(NamedTuple):
    """Estimates after a beacon."""

    x: Array
    """(..., d) m."""
    P: Array
    """(..., d, d) m^2."""
    log_likelihood: Array
    """(...) of the ranges so far, less what does not depend on the state."""
    used: Array
    """(...) number of ranges taken in."""
    lost: Booleans
    """(...) whether the covariance has ceased to be positive definite; x and P stay as they were then."""


@dataclass(frozen=True)
class Rules:
    """Of a filter, besides its kind."""

    process_sd_m: float = 0.0
    threshold: Threshold = Threshold.NONE
    alpha: float = 0.0
    """m, or with `Threshold.INFORMATION` a share of the standard deviation of a range."""
    process_noise_is_R: bool = False
    """Takes (5) at its word: the variance of the range at hand is that of the process noise as well."""


def track_beacons(
    kind: Filter,
    x0: Array,
    P0: Array,
    anchors: Array,
    ranges: Array,
    noise: RangeNoise,
    heard: Booleans | None = None,
    rise: Array | float = 0.0,
    rules: Rules | None = None,
) -> Iterator[State]:
    """The state after each beacon, all nodes of a batch at once.

    x0 (..., d), P0 (..., d, d); anchors (..., m, d), ranges (..., m), ``heard`` (..., m), ``rise`` as in
    `plane.distances`. The standard deviation of a range is that at the predicted distance: taken from the
    measured one it would give more weight to ranges that are too short. All is done in the precision of x0.
    """
    rules = rules or Rules()
    batch, dtype = x0.shape[:-1], x0.dtype
    heard = np.ones(ranges.shape, bool) if heard is None else heard
    anchors = np.broadcast_to(anchors, (*batch, *anchors.shape[-2:])).astype(dtype)
    rises = np.broadcast_to(np.asarray(rise, dtype), ranges.shape)
    ranges = ranges.astype(dtype)
    root, lost = _roots(P0.astype(dtype))
    state = State(x0, P0.astype(dtype), np.zeros(batch), np.zeros(batch), lost)
    for k in range(ranges.shape[-1]):
        beacon = anchors[..., k : k + 1, :], rises[..., k : k + 1]
        d = lengths(state.x, *beacon)
        R = noise.at(d) ** 2
        now = heard[..., k, None, None]
        predicted, predicted_root = _predicted(state, root, R, rules)
        P, root = np.where(now, predicted, state.P), np.where(now, predicted_root, root)
        x, ok = state.x, heard[..., k] & ~state.lost
        if rules.threshold is Threshold.INFORMATION:
            _, u = distances(state.x, *beacon)
            ok = ok & (np.linalg.norm(u @ root, axis=-1) >= rules.alpha * np.sqrt(R))[..., 0]
        if kind is Filter.EXTENDED:
            innovation = ranges[..., k : k + 1] - d
            _, u = distances(x, *beacon)
            new = kalman_update(x, P, innovation, u, R[..., None])
            S = new.innovation_cov
        else:
            points = cubature_points(x, root)
            images = lengths(points, beacon[0][..., None, :, :], beacon[1][..., None, :])
            z = ranges[..., k : k + 1]
            innovation = z - images.mean(axis=-2)
            if kind is Filter.CUBATURE:
                new = cubature_update(x, P, points, images, z, R[..., None])
                S = new.innovation_cov
            else:
                new = square_root_cubature_update(x, points, images, z, np.sqrt(R)[..., None])
                S = new.innovation_cov**2
        if kind is Filter.SQUARE_ROOT:
            new_root, fails = new.P, ~np.isfinite(new.P).all(axis=(-2, -1))
            new_P = new_root @ transposed(new_root)
        else:
            new_P, (new_root, fails) = new.P, _roots(new.P)
        taken = ok & ~fails
        S = np.where(taken, S[..., 0, 0], 1.0)
        gained = -0.5 * (np.log(S) + innovation[..., 0] ** 2 / S)
        root = np.where(taken[..., None, None], new_root, root)
        state = State(
            np.where(taken[..., None], new.x, x),
            np.where(taken[..., None, None], new_P, P),
            state.log_likelihood + np.where(taken, gained, 0.0),
            state.used + taken,
            state.lost | (ok & fails),
        )
        yield state


def _predicted(state: State, root: Array, R: Array, rules: Rules) -> tuple[Array, Array]:
    """Covariance and its root after the time update, eq. 6, with the threshold on the deviations."""
    n = root.shape[-1]
    zeroing = rules.threshold in (Threshold.PRINTED, Threshold.SIZE)
    if not (zeroing or rules.process_sd_m or rules.process_noise_is_R):
        return state.P, root
    D = np.concatenate([root, -root], axis=-1) / np.asarray(np.sqrt(2), root.dtype)
    if zeroing:
        size = D if rules.threshold is Threshold.PRINTED else np.abs(D)
        D = np.where(size < rules.alpha, 0, D)
    Q = rules.process_sd_m**2 + (R[..., None] if rules.process_noise_is_R else 0.0)
    root_Q = np.broadcast_to(np.sqrt(Q) * np.eye(n), root.shape).astype(root.dtype)
    root = lower_root(np.concatenate([transposed(D), root_Q], axis=-2))
    return root @ transposed(root), root


def _roots(P: Array) -> tuple[Array, Booleans]:
    """Lower square roots (..., n, n), and which covariances have none: their rows are the unit matrix."""
    try:
        return np.linalg.cholesky(P), np.zeros(P.shape[:-2], bool)
    except np.linalg.LinAlgError:
        one = np.eye(P.shape[-1], dtype=P.dtype)
        bad = np.zeros(P.shape[:-2], bool)
        for at in np.ndindex(bad.shape):
            try:
                np.linalg.cholesky(P[at])
            except np.linalg.LinAlgError:
                bad[at] = True
        return np.linalg.cholesky(np.where(bad[..., None, None], one, P)), bad

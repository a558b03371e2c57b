"""The fading adaptive extended Kalman filter that refines positions, of Wan, Wu and Feng.

States are positions that do not move, so A is the identity and there is no control; every step takes the
same ranges again. `step` is one pass of the equations over whole batches of such filters; what a filter's
state and ranges are, `distributed_ekf` and `central_ekf` say.

References
----------
.. [1] J. Wan, J. Wu, R. Feng, "Application of Kalman filter algorithm to node localization in wireless
       sensor networks" (in Chinese), 2008: eqs. 8 to 13 and 16 to 20.
.. [2] A. P. Sage, G. W. Husa, "Adaptive filtering with unknown prior statistics", Joint Automatic Control
       Conference (1969): what [1]_ takes Q and R from, without printing it.
.. [3] A. H. Mohamed, K. P. Schwarz, "Adaptive Kalman filtering for INS/GPS", Journal of Geodesy 73 (1999).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from ...sins.gaussian import apply, kalman_update, transposed
from ...sins.settings import Settings
from .problem import Array, Booleans


class FadingEkf(Settings):
    """A form of the filter. The defaults are the mended one."""

    max_fading: float = Field(default=2.0, ge=1, le=1e300)
    """Most that the factor of (9) may be. As printed it has no limit: 1e300. 1 does without it."""
    noise: Literal["sage_husa", "positive", "fixed"] = "positive"
    """Of Q and R. `sage_husa` takes the predicted part off the innovations' squares ([2]_), and what is left
    may be negative; `positive` takes residuals after the update, to which it adds that part ([3]_), and keeps
    R diagonal: errors of two ranges have nothing in common."""
    sage_forgetting: float = Field(default=0.95, gt=0, lt=1)
    """b of the weights (1 - b) / (1 - b^(k + 1)) that new squares get."""
    neighbor_covariance: bool = True
    """Distributed: whether a neighbour's own uncertainty, tr(P_j) / 2, is added to R; as printed it is taken
    for a beacon."""
    stop: Literal["step", "norms"] = "step"
    """`step` ends when no position moves by more than `tolerance_m`; `norms` is the printed root of
    x_k^2 - (x_k^-)^2, the difference of two squared lengths, which may be negative and then ends it too."""
    tolerance_m: float = Field(default=0.01, gt=0, le=1e3)
    """Delta of the stop rule."""
    max_steps: int = Field(default=60, ge=1, le=10_000)
    initial_sd_m: float = Field(default=5.0, gt=0, le=1e6)
    """Of each component of a starting position; [1]_ does not state it, nor the next two."""
    range_sd_m: float = Field(default=0.1, gt=0, le=1e6)
    """R at the start, its root."""
    process_sd_m: float = Field(default=0.1, ge=0, le=1e6)
    """Q at the start, the root of its diagonal; nodes stand still, so this is what linearisation leaves."""


PUBLISHED = FadingEkf(max_fading=1e300, noise="sage_husa", neighbor_covariance=False, stop="norms")
"""The filter as [1]_ prints it."""


@dataclass(frozen=True)
class Filter:
    """A batch of filters between two steps."""

    x: Array
    """(..., n) m."""
    P: Array
    """(..., n, n) m^2."""
    Q: Array
    """(..., n, n) m^2."""
    R: Array
    """(..., m, m) m^2."""
    fading: Array
    """(...) lambda of the step before."""
    steps: int = 0


def initial(x: Array, ranges: int, settings: FadingEkf) -> Filter:
    """The filter at the start x (..., n), with so many ranges."""
    lead, eye = (*x.shape[:-1], 1, 1), np.eye(x.shape[-1])
    return Filter(
        x=x,
        P=np.tile(settings.initial_sd_m**2 * eye, lead),
        Q=np.tile(settings.process_sd_m**2 * eye, lead),
        R=np.tile(settings.range_sd_m**2 * np.eye(ranges), lead),
        fading=np.ones(x.shape[:-1]),
    )


def step(
    f: Filter,
    innovation: Array,
    H: Array,
    settings: FadingEkf,
    heard: Booleans,
    extra: Array | float = 0.0,
) -> Filter:
    """Equations (8) to (13) and (16) to (20), and Q and R for the next step.

    Parameters
    ----------
    innovation : (..., m) m, v_k of (13): ranges less distances at the state; zero where not ``heard``.
    H : (..., m, n) derivatives of the distances; zero where not ``heard``.
    heard : (..., m) ranges that there are.
    extra : (..., m) m^2, variances that R lacks: of neighbours that are taken for beacons.

    (20) is worked out in Joseph's form, which is the same for the gain of (18) and keeps P symmetric.
    """
    k = f.steps + 1
    R = f.R + _diagonal(np.broadcast_to(extra, innovation.shape))
    lam = fading_factor(f, innovation, H, R, heard, settings.max_fading)
    P = lam[..., None, None] * f.P + f.Q  # (8), (17); by (16) the state stays
    try:
        after = kalman_update(f.x, P, innovation, H, R)  # (18) to (20)
    except np.linalg.LinAlgError:
        # Of a filter that diverges rounding leaves a singular matrix: it may be lost, the batch is not.
        size = 1e-9 * np.abs(H @ P @ transposed(H) + R).max(axis=(-1, -2))
        after = kalman_update(
            f.x, P, innovation, H, R + _diagonal(np.broadcast_to(size[..., None], innovation.shape))
        )
    Q, own_R = f.Q, f.R
    if settings.noise != "fixed":
        share = sage_share(k, settings.sage_forgetting)
        moved = apply(after.gain, innovation)
        if settings.noise == "sage_husa":
            new_R = _outer(innovation) - H @ P @ transposed(H)
            new_Q = _outer(moved) + after.P - f.P
        else:
            left = innovation - apply(H, moved)
            new_R = (_outer(left) + H @ after.P @ transposed(H)) * np.eye(H.shape[-2])
            new_Q = _outer(moved)
        both = heard[..., :, None] & heard[..., None, :]
        Q, own_R = (1 - share) * Q + share * new_Q, np.where(both, (1 - share) * f.R + share * new_R, f.R)
    return Filter(after.x, after.P, Q, own_R, lam, k)


def fading_factor(f: Filter, innovation: Array, H: Array, R: Array, heard: Booleans, most: float) -> Array:
    """lambda_k (...) by (9) to (12), at most ``most``; of C, M and N the traces are needed alone."""
    M = np.sum((H @ f.P) * H, axis=(-1, -2))  # (10)
    share = np.where(f.steps > 0, f.fading / (1 + f.fading), 0.5)
    C = share * np.sum(innovation**2, axis=-1)  # (12)
    N = C - np.sum((H @ f.Q) * H, axis=(-1, -2)) - _trace(R * heard[..., None])  # (11)
    ratio = np.divide(N, M, out=np.ones_like(M), where=M > 0)
    return np.clip(ratio, 1.0, most)  # (9)


def sage_share(k: int, forgetting: float) -> float:
    """Weight of the k-th squares, from 1, in Q and R ([2]_)."""
    return (1 - forgetting) / (1 - forgetting ** (k + 1))


def stopped(x: Array, before: Array, settings: FadingEkf) -> bool:
    """Whether the steps end, of positions (n, d) after and before the last one."""
    if settings.stop == "norms":
        return bool(np.sum(x**2) - np.sum(before**2) <= settings.tolerance_m**2)
    return bool(np.linalg.norm(x - before, axis=-1).max(initial=0.0) <= settings.tolerance_m)


def _trace(matrix: Array) -> Array:
    return np.trace(matrix, axis1=-2, axis2=-1)


def _outer(vector: Array) -> Array:
    return vector[..., :, None] * vector[..., None, :]


def _diagonal(values: Array) -> Array:
    return values[..., None] * np.eye(values.shape[-1])

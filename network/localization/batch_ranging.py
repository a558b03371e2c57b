"""Elements of a plane network by all ranges of all cycles at once: what repeated fixes are held against."""

import numpy as np

from ...sins.gaussian import transposed
from .plane import Located, distances, gauss_newton
from .problem import Array


def batch(references: Array, ranges: Array, range_sd: Array, x0: Array, huber: float = np.inf) -> Located:
    """Weighted least squares (..., e, 2) of all ranges (..., n, e, m) to ``references`` (m, 2) in n cycles.

    Their covariance is scaled by what residuals tell of the noise, one scale for all e elements, so that
    deviations ``range_sd`` (..., n, e, m) need be known in proportion only; for Huber's loss by the
    asymptotic factor of an M-estimator. Without residuals, in the first cycle of two references, it is as
    stated.
    """
    n, e, m = ranges.shape[-3:]
    z, sd = (np.moveaxis(a, -3, -2).reshape(*a.shape[:-3], e, n * m) for a in (ranges, range_sd))
    anchors = np.tile(references, (n, 1))
    found = gauss_newton(anchors, z, sd, x0, huber=huber)
    d, u = distances(found.x, anchors)
    r = (z - d) / sd
    cov = np.linalg.pinv(transposed(u) @ (u * sd[..., None] ** -2), hermitian=True).astype(np.float64)
    spare = e * (n * m - references.shape[-1])
    if spare > 0:
        inside = np.mean(np.abs(r) <= huber, axis=(-2, -1))
        noise = np.sum(np.clip(r, -huber, huber) ** 2, axis=(-2, -1)) / spare / inside**2
        cov = cov * noise[..., None, None, None]
    return Located(found.x, cov, found.converged)

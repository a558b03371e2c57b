"""The rangefinder of Uryvsky et al.: an element of a plane network by its ranges to two known ones.

Local frame of their Fig. 1: element 1 at the origin, element 2 on the x axis. Two ranges fit two places,
mirrored in that axis: elements are taken to lie at y > 0.

References
----------
.. [1] L. O. Uryvsky, E. A. Yakornov, O. F. Tsukanov, "Increasing the accuracy of determining the coordinates
       of elements of wireless sensor networks".
"""

import numpy as np

from ...sins.gaussian import transposed
from .plane import Located, check_ranges, distances, gauss_newton, information, lateration
from .problem import Array, LocalizationError

_SAME_PLACE_M = 1e-6


def rangefinder(references: Array, ranges: Array, range_sd: Array) -> Located:
    """Positions (..., 2) from ranges (..., 2) to two ``references`` (2, 2), by eqs. (1) and (2) of [1]_.

    As printed, phi in (2) is a reciprocal; mended, it has the two distances of (1). Least squares weighs both
    ranges alike, as printed: with as many ranges as unknowns no weight moves its solution. The covariance is
    (3) as mended, ``(A^T Sigma^-1 A)^-1``, with ``range_sd`` (..., 2) the stated standard deviations.

    Where the circles of the two ranges do not meet, the place is the foot of their common chord, on the x
    axis, with the base's length for its standard deviation across, and ``converged`` is False.
    Raises `LocalizationError` for references in one place or out of their frame, and for ranges and
    deviations that are not positive.
    """
    base = float(references[1, 0])
    if np.any(np.abs(references[0]) > _SAME_PLACE_M) or abs(references[1, 1]) > _SAME_PLACE_M:
        raise LocalizationError("the first reference must be at (0, 0), the second on the x axis")
    if not base > _SAME_PLACE_M:
        raise LocalizationError(f"the second reference is at x = {base:g} m: it must be above 0")
    check_ranges(ranges, np.asarray(range_sd))
    foot = lateration(references, ranges)
    square = ranges[..., 0] ** 2 - foot[..., 0] ** 2
    start = np.stack([foot[..., 0], np.sqrt(np.maximum(square, (0.1 * base) ** 2))], axis=-1)
    found = gauss_newton(references, ranges, np.ones(2), start)
    meet = found.converged & (square > 0)
    x = np.where(meet[..., None], np.abs(found.x) * [0, 1] + found.x * [1, 0], foot * [1, 0])
    cov = np.linalg.pinv(information(x, references, range_sd), hermitian=True).astype(np.float64)
    cov[..., 1, 1] += np.where(meet, 0.0, base**2)
    return Located(x, cov, meet)


def covariance_as_printed(x: Array, references: Array, range_sd: Array) -> Array:
    """(3) of [1]_ as printed, ``(A^T A)^-1 sigma_d`` (..., 2, 2) with the variances of the two ranges.

    For equal variances it is right. For others it is not symmetric, and takes the variance of a range for
    that of a coordinate.
    """
    _, A = distances(x, references)
    variances = np.broadcast_to(np.asarray(range_sd, float) ** 2, A.shape[:-1])
    shape = np.linalg.pinv(transposed(A) @ A, hermitian=True).astype(np.float64)
    return shape * variances[..., None, :]

"""Measurement updates of Gaussian estimates, shared by all recursive estimators, over whole batches.

All arrays may have leading axes, one estimate for each element: x (..., n), P (..., n, n), innovations
(..., m). `network` and `align` both stand on this, and neither may import the other.

References
----------
.. [1] I. Arasaratnam, S. Haykin, "Cubature Kalman Filters", IEEE Transactions on Automatic Control 54 (2009).
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed.,
       section 3.2.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Of any precision: what comes out has that of what went in."""


class Updated(NamedTuple):
    """An estimate after a measurement."""

    x: Array
    """(..., n)."""
    P: Array
    """(..., n, n) covariance, or its lower square root where the update is a square-root one."""
    gain: Array
    """(..., n, m)."""
    innovation_cov: Array
    """(..., m, m), likewise a lower square root where the update is a square-root one."""


def kalman_update(x: Array, P: Array, innovation: Array, H: Array, R: Array) -> Updated:
    """The linear update with Joseph's form of the covariance, which stays positive for any gain ([2]_ 3.58).

    H (..., m, n), R (..., m, m).
    """
    HP = H @ P
    S = HP @ transposed(H) + R
    gain = transposed(np.linalg.solve(S, HP))
    return Updated(x + apply(gain, innovation), joseph(P, gain, H, R), gain, S)


def joseph(P: Array, gain: Array, H: Array, R: Array) -> Array:
    """Covariance after an update with any gain (..., n, m), optimal or not."""
    kept = np.eye(P.shape[-1], dtype=P.dtype) - gain @ H
    return kept @ P @ transposed(kept) + gain @ R @ transposed(gain)


def cubature_points(x: Array, S: Array) -> Array:
    """The 2n points (..., 2n, n) of the third-degree rule, for the lower square root S of P ([1]_ eq. 12)."""
    spread = transposed(S) * np.asarray(np.sqrt(x.shape[-1]), S.dtype)
    return x[..., None, :] + np.concatenate([spread, -spread], axis=-2)


def cubature_update(x: Array, P: Array, points: Array, images: Array, z: Array, R: Array) -> Updated:
    """The update of the cubature Kalman filter ([1]_ eqs. 38 to 47).

    ``points`` (..., 2n, n) are `cubature_points` of x and P, ``images`` (..., 2n, m) what the measurement
    would be at each, z (..., m) what it is.
    """
    centred, deviation, predicted = _centred(x, points, images)
    S = transposed(deviation) @ deviation + R
    gain = transposed(np.linalg.solve(S, transposed(deviation) @ centred))
    P = P - gain @ S @ transposed(gain)
    return Updated(x + apply(gain, z - predicted), (P + transposed(P)) / 2, gain, S)


def square_root_cubature_update(x: Array, points: Array, images: Array, z: Array, root_R: Array) -> Updated:
    """The same with square roots alone, which QR keeps true: the covariance cannot lose its positiveness.

    [1]_ appendix B; ``root_R`` (..., m, m) is the lower square root of R, that of P is in the points.
    """
    centred, deviation, predicted = _centred(x, points, images)
    n, m = centred.shape[-1], deviation.shape[-1]
    root_R = np.broadcast_to(root_R, (*deviation.shape[:-2], m, m))
    zeros = np.zeros((*centred.shape[:-2], m, n), centred.dtype)
    # One triangle of the joint square root of innovation and state has all three: S, the gain's, and P's.
    above = np.concatenate([deviation, centred], axis=-1)
    below = np.concatenate([transposed(root_R), zeros], axis=-1)
    joint = lower_root(np.concatenate([above, below], axis=-2))
    S, cross, P = joint[..., :m, :m], joint[..., m:, :m], joint[..., m:, m:]
    gain = transposed(np.linalg.solve(transposed(S), transposed(cross)))
    return Updated(x + apply(gain, z - predicted), P, gain, S)


def lower_root(rows: Array) -> Array:
    """Lower square root (..., n, n), its diagonal positive, of ``rows^T rows``; rows (..., k, n), k >= n."""
    upper: Array = np.linalg.qr(rows, mode="r")  # pyright: ignore[reportAssignmentType]
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1, 1).astype(rows.dtype)
    return transposed(upper * sign[..., :, None])


def apply(matrix: Array, vector: Array) -> Array:
    """Product (..., n) of a matrix (..., n, m) and a vector (..., m)."""
    return (matrix @ vector[..., None])[..., 0]


def transposed(matrix: Array) -> Array:
    """The last two axes exchanged."""
    return np.swapaxes(matrix, -1, -2)


def _centred(x: Array, points: Array, images: Array) -> tuple[Array, Array, Array]:
    """Deviations of points and of images over the root of their number, and the predicted measurement."""
    weight = np.asarray(points.shape[-2] ** -0.5, points.dtype)
    predicted = images.mean(axis=-2)
    return (points - x[..., None, :]) * weight, (images - predicted[..., None, :]) * weight, predicted

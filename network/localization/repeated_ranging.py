"""The filters of Uryvsky et al.: one fix after another, each with its covariance, made into a better one.

An update takes the estimate x (..., d) with covariance K (..., d, d), extrapolated to the time of a new fix
x_n (..., d) with covariance Q_n, and the ``limit`` of its discrepancy ``x_n - x`` (10): mean squares beyond
that many times what K + Q_n stands for are taken for something other than noise. `UPDATES` names those that
hold; what the paper prints stands beside them.

As printed, (7) is ``x = X_n + H (X_n - X^e)``, which goes beyond the fix instead of back from it, and
``K - K H``, which is no covariance unless K and Q commute. Mended: ``x = X^e + H (X_n - X^e)`` with
Joseph's covariance, of which ``K - H K`` is the short form.

Mended, all four are a Kalman filter that differs in what it takes for the noise of the fix:

- `kalman`, (5) to (7): what is stated.
- `regularized`, (9) to (11): alpha times that. Printed, alpha is in [0, 1], which raises the gain where the
  discrepancy is large: an outlier is followed. Mended, alpha >= 1 is the least that keeps the discrepancy.
- `adaptive`, (12) to (14): the squared discrepancy in the place of each eigenvalue of K + Q that is less.
  Printed, (12) inverts the squares of single coordinates, which are no eigenvalues, and for all or none.
- `regularized_adaptive`: the same from the discrepancy's limit on, so that ordinary noise is left alone.
  Printed, (9) takes the place of (13), where Lambda <= Delta: there (11) holds already, and alpha is 1, for
  any limit of at least what noise makes.

References
----------
.. [1] L. O. Uryvsky, E. A. Yakornov, O. F. Tsukanov, "Increasing the accuracy of determining the coordinates
       of elements of wireless sensor networks".
"""

from collections.abc import Callable

import numpy as np

from ...sins.gaussian import Updated, apply, joseph, kalman_update, transposed
from .problem import Array

DISCREPANCY_LIMIT = 3.0
"""Mean square, over what K + Q stands for, that noise alone exceeds in a twelfth of single coordinates."""

Update = Callable[[Array, Array, Array, Array, float], Updated]
"""(x, K, x_n, Q_n, limit) to the refined estimate, with the gain that was used."""
_Rule = Callable[[Array, Array, Array, float], Array]
"""(discrepancy, K, Q, limit) to a noise covariance or a gain."""

_STEPS = 12


def _stated(d: Array, K: Array, Q: Array, limit: float) -> Array:
    """The noise as it is stated, of (6)."""
    return Q


def _regularized(d: Array, K: Array, Q: Array, limit: float) -> Array:
    """``alpha Q`` of (9), with the least alpha >= 1 for which ``d^T (K + alpha Q)^-1 d <= limit dim``."""
    root = np.linalg.cholesky(Q)
    white = np.linalg.solve(root, transposed(np.linalg.solve(root, K)))
    values, axes = np.linalg.eigh((white + transposed(white)) / 2)
    squares = apply(transposed(axes), np.linalg.solve(root, d[..., None])[..., 0]) ** 2
    p = limit * d.shape[-1]
    alpha = np.ones(d.shape[:-1])
    for _ in range(_STEPS):
        # The reciprocal of the sum is concave in alpha: Newton comes from below, and never passes.
        spread = values + alpha[..., None]
        f = np.sum(squares / spread, axis=-1)
        slope = np.sum(squares / spread**2, axis=-1)
        alpha += np.maximum(f / p - 1, 0) * f / np.maximum(slope, 1e-300)
    return alpha[..., None, None] * Q


def _axiswise(d: Array, K: Array, Q: Array, limit: float) -> Array:
    """Noise with which each eigenvalue of K + Q is at least the squared discrepancy over the limit, (14).

    The axes are those of the matrix scaled to a unit diagonal, so that a state may have metres and metres
    per second in it.
    """
    S = K + Q
    scale = np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))
    values, axes = np.linalg.eigh(S / scale[..., None] / scale[..., None, :])
    along = apply(transposed(axes), d / scale)
    excess = np.maximum(along**2 / limit - values, 0)
    axes = scale[..., None] * axes
    return Q + (axes * excess[..., None, :]) @ transposed(axes)


def _adaptive(d: Array, K: Array, Q: Array, limit: float) -> Array:
    return _axiswise(d, K, Q, 1.0)


def _filter(noise: _Rule) -> Update:
    def update(x: Array, K: Array, x_n: Array, Q_n: Array, limit: float = DISCREPANCY_LIMIT) -> Updated:
        d = x_n - x
        return kalman_update(x, K, d, np.eye(d.shape[-1]), noise(d, K, Q_n, limit))

    return update


UPDATES: dict[str, Update] = {
    "kalman": _filter(_stated),
    "regularized": _filter(_regularized),
    "adaptive": _filter(_adaptive),
    "regularized_adaptive": _filter(_axiswise),
}
"""The filters as mended."""


def _gain(K: Array, S: Array) -> Array:
    """``K S^-1``; S need not be symmetric."""
    return transposed(np.linalg.solve(transposed(S), transposed(K)))


def _printed_kalman(d: Array, K: Array, Q: Array, limit: float) -> Array:
    """(6)."""
    return _gain(K, K + Q)


def _printed_regularized(d: Array, K: Array, Q: Array, limit: float) -> Array:
    """(9), with the largest alpha in [0, 1] for which ``alpha sum d^2 <= p``.

    (11) has no alpha in it, and p is not given: this reading, and p as the limit times the trace of K + Q,
    are ours.
    """
    p = limit * np.trace(K + Q, axis1=-2, axis2=-1)
    alpha = np.minimum(1.0, p / np.maximum(np.sum(d**2, axis=-1), 1e-300))
    return _gain(K, K + alpha[..., None, None] * Q)


def _printed_adaptive(otherwise: _Rule) -> _Rule:
    """(12) where all squared discrepancies Lambda exceed the singular values Delta of (14), both in order of
    size: coordinates have none in common with singular values, and x and y may change places."""

    def gain(d: Array, K: Array, Q: Array, limit: float) -> Array:
        squares = np.maximum(d**2, 1e-300)
        beyond = np.all(np.sort(squares)[..., ::-1] > np.linalg.svd(K + Q, compute_uv=False), axis=-1)
        return np.where(beyond[..., None, None], K / squares[..., None, :], otherwise(d, K, Q, limit))

    return gain


_PRINTED_GAINS: dict[str, _Rule] = {
    "kalman": _printed_kalman,
    "regularized": _printed_regularized,
    "adaptive": _printed_adaptive(_printed_kalman),
    "regularized_adaptive": _printed_adaptive(_printed_regularized),
}


def _as_printed(gain: _Rule) -> Update:
    def update(x: Array, K: Array, x_n: Array, Q_n: Array, limit: float = DISCREPANCY_LIMIT) -> Updated:
        d = x_n - x
        H = gain(d, K, Q_n, limit)
        return Updated(x_n + apply(H, d), K - K @ H, H, K + Q_n)

    return update


def _printed_gain(gain: _Rule) -> Update:
    def update(x: Array, K: Array, x_n: Array, Q_n: Array, limit: float = DISCREPANCY_LIMIT) -> Updated:
        d = x_n - x
        H = gain(d, K, Q_n, limit)
        return Updated(x + apply(H, d), joseph(K, H, np.eye(d.shape[-1]), Q_n), H, K + Q_n)

    return update


AS_PRINTED: dict[str, Update] = {name: _as_printed(gain) for name, gain in _PRINTED_GAINS.items()}
"""Gains and (7) as printed."""
PRINTED_GAIN: dict[str, Update] = {name: _printed_gain(gain) for name, gain in _PRINTED_GAINS.items()}
"""Gains as printed, (7) mended, with Joseph's covariance for the noise that is stated."""

"""Least-squares support vector machine for regression with an RBF kernel: Xu et al. 2012, (3.1) to (3.9).

Formulas of the paper are lost in print; they are the standard ones [1]_:

- (3.1), (3.8): y(x) = w' phi(x) + b = sum_i a_i K(x, x_i) + b;
- (3.3): minimise w'w / 2 + gamma / 2 sum_i e_i^2, subject to y_i = w' phi(x_i) + b + e_i;
- (3.6): the conditions of Karush, Kuhn and Tucker leave a linear system in b and the multipliers a_i = gamma
  e_i, ``[0, 1'; 1, K + I / gamma] [b; a] = [0; y]``;
- (3.9): K(x, x_i) = exp(-|x - x_i|^2 / (2 sigma^2)).

References
----------
.. [1] J. A. K. Suykens, J. Vandewalle, "Least Squares Support Vector Machine Classifiers", Neural Processing
       Letters 9 (1999).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..estimate import Array

GAMMAS: Array = np.logspace(-2, 5, 8)
"""Regularisation parameters that are tried: "some empirical combinations" of the paper."""
WIDTHS: Array = np.logspace(-1, 5, 7, base=2.0)
"""Kernel widths sigma that are tried, in standard deviations of the inputs."""
FOLDS = 5
SHORTLISTED = 0.25
"""Share of the combinations that the validation half leaves to the verification half."""


@dataclass(frozen=True)
class LsSvm:
    """A trained machine: support (k, d), multipliers (k, p), bias (p,), and its parameters."""

    support: Array
    multipliers: Array
    bias: Array
    gamma: float
    width: float
    verification_rms: float = np.nan
    """RMS error over the verification half of the machine that the validation half trained; of standardised
    outputs where these are."""

    def predict(self, x: ArrayLike) -> Array:
        """(3.8): outputs (j, p) for inputs (j, d)."""
        return rbf(np.asarray(x, float), self.support, self.width) @ self.multipliers + self.bias


def rbf(x: Array, support: Array, width: float) -> Array:
    """(3.9): kernel (j, k)."""
    squares = np.sum((x[:, None, :] - support) ** 2, axis=2)
    return np.exp(-squares / (2 * width**2))


def train(x: Array, y: Array, gamma: float, width: float) -> LsSvm:
    """Solve (3.6) for x (k, d) and y (k, p)."""
    multipliers, bias = _solved(rbf(x, x, width), y, np.array([gamma]))
    return LsSvm(x, multipliers[0], bias[0], gamma, width)


def fit(x: Array, y: Array) -> LsSvm:
    """Train with parameters chosen on the record itself, as section 3.1 of the paper has it.

    The first half of the rows is the validation subset: combinations are trained and judged on it, by
    five-fold cross-validation, and the best quarter of them is kept. The other half is the verification
    subset: of these, the machine that forecasts it best has the final parameters, with which all rows are
    trained.
    """
    half = len(x) // 2
    inside = np.array([_validation_error(x[:half], y[:half], width) for width in WIDTHS])
    kept = inside <= np.quantile(inside, SHORTLISTED)
    ahead = np.full(inside.shape, np.inf)
    for i in np.flatnonzero(kept.any(axis=1)):
        ahead[i] = _forecast_error(x[:half], y[:half], x[half:], y[half:], WIDTHS[i])
    best = np.unravel_index(np.argmin(np.where(kept, ahead, np.inf)), ahead.shape)
    chosen = train(x, y, float(GAMMAS[best[1]]), float(WIDTHS[best[0]]))
    return LsSvm(**{**vars(chosen), "verification_rms": float(np.sqrt(ahead[best]))})


def _validation_error(x: Array, y: Array, width: float) -> Array:
    """Mean squared error of cross-validation for each of `GAMMAS`; folds are blocks of time."""
    error = np.zeros(len(GAMMAS))
    for fold in np.array_split(np.arange(len(x)), min(FOLDS, len(x))):
        others = np.delete(np.arange(len(x)), fold)
        error += len(fold) * _forecast_error(x[others], y[others], x[fold], y[fold], width)
    return error / len(x)


def _forecast_error(x: Array, y: Array, x_other: Array, y_other: Array, width: float) -> Array:
    """Mean squared error on other rows for each of `GAMMAS`."""
    multipliers, bias = _solved(rbf(x, x, width), y, GAMMAS)
    predicted = rbf(x_other, x, width) @ multipliers + bias[:, None, :]
    return np.mean((predicted - y_other) ** 2, axis=(1, 2))


def _solved(kernel: Array, y: Array, gammas: Array) -> tuple[Array, Array]:
    """Multipliers (g, k, p) and biases (g, p) of (3.6), for each gamma by one eigendecomposition."""
    values, vectors = np.linalg.eigh(kernel)
    inverse = 1 / (np.maximum(values, 0.0) + 1 / gammas[:, None])
    of_y, of_one = vectors.T @ y, vectors.sum(axis=0)
    bias = (inverse * of_one) @ of_y / (inverse @ of_one**2)[:, None]
    right = of_y - of_one[:, None] * bias[:, None, :]
    return vectors @ (inverse[:, :, None] * right), bias

"""Consistency: whether a filter's covariance is that of its errors.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", section 5.4.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

Array = NDArray[np.float64]


def chi_square_quantile(probability: ArrayLike, dimension: float) -> Array:
    """Value that a chi-square variable of that dimension stays below with a probability, shape (...,).

    Spares the import of scipy.stats, which takes longer than reading a scenario.
    """
    return 2 * gammaincinv(dimension / 2, np.asarray(probability, float))


def nees(error: ArrayLike, covariance: ArrayLike) -> Array:
    """Normalised estimation error squared, shape (...,), of errors (..., d) with covariances (..., d, d)."""
    error = np.asarray(error, float)
    solved = np.linalg.solve(np.asarray(covariance, float), error[..., None])[..., 0]
    return np.sum(error * solved, axis=-1)


def mean_band(dimension: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Bounds that the mean of ``samples`` independent NEES or NIS keeps with ``probability`` ([1]_ 5.4.2)."""
    tail = (1 - probability) / 2
    low, high = chi_square_quantile([tail, 1 - tail], dimension * samples) / samples
    return float(low), float(high)

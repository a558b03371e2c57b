"""Allan deviation, the usual view of an inertial sensor's noise.

References
----------
.. [1] IEEE Std 952-1997, annex C.
.. [2] W. J. Riley, "Handbook of Frequency Stability Analysis", NIST SP 1065 (2008), section 5.2.4.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def allan_deviation(
    increments: ArrayLike, dt: float, clusters: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Overlapping Allan deviation ([2]_ eq. 10) of increments taken ``dt`` seconds apart.

    Parameters: ``increments`` (n,) or (n, axes), the integral of the signal over each interval (for
    a rate: rate times ``dt``); ``clusters``, lengths in samples, by default some 20 a decade up to n/3.

    Returns ``tau`` (k,), s, and the deviation (k,) or (k, axes) in increments' unit over s. White noise
    of root PSD N shows as ``N / sqrt(tau)``.

    Raises ValueError for a cluster that is shorter than one sample or longer than half the data.
    """
    increments = np.asarray(increments, float)
    n = len(increments)
    if clusters is None:
        clusters = np.unique(np.geomspace(1, max(n // 3, 1), int(20 * np.log10(n)) + 1).astype(int))
    m = np.atleast_1d(np.asarray(clusters, int))
    if n < 2 or m.min() < 1 or 2 * m.max() > n:
        raise ValueError(f"clusters must be 1 to {n // 2} samples long; got {m.min()} to {m.max()}")
    integral = np.concatenate([np.zeros_like(increments[:1]), np.cumsum(increments, axis=0)])
    second_differences = (integral[2 * k :] - 2 * integral[k:-k] + integral[: -2 * k] for k in m)
    tau = m * dt
    mean_squares = np.array([np.mean(d**2, axis=0) for d in second_differences])
    return tau, np.sqrt((0.5 * mean_squares.T / tau**2).T)

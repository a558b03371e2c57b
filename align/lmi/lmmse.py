"""The best linear filter against white noise, by a Riccati equation: what the H2 inequality must come to."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import matrix_balance, solve_discrete_are, solve_discrete_lyapunov

from .plant import Array, Augmented, Filter, Plant

LEAST_NOISE = 1e-12
"""Share of an output's variance that counts as noise, where it has none."""


@dataclass(frozen=True)
class Lmmse:
    """Stationary linear least-squares filter.

    ``filter``, of full order; ``P`` (N, N), covariance of the predicted error of xi, and ``M``, of xi itself;
    ``S`` (m, m), of the innovation; ``error`` (p, p), of the filtered error of z.
    """

    filter: Filter
    P: Array
    M: Array
    S: Array
    error: Array

    @property
    def rms(self) -> float:
        """Root of the trace of ``error``."""
        return float(np.sqrt(max(np.trace(self.error), 0.0)))


def lmmse(plant: Plant) -> Lmmse:
    """The filter where its Riccati recursion stands.

    The multiplicative noise acts like white noise of the variance that the whole state gives it, not its
    error alone. For rho = 1 this is the Kalman filter. Raises ValueError if A is not Schur stable.
    """
    if plant.spectral_radius >= 1:
        raise ValueError(f"spectral radius of A = {plant.spectral_radius:.6g}: must be below 1")
    a = Augmented.of(plant)
    balanced, (unit, _) = matrix_balance(a.A, permute=False, separate=True)
    B = a.B / unit[:, None]
    M = solve_discrete_lyapunov(balanced, B @ B.T) * np.outer(unit, unit)
    R = a.D0 @ a.D0.T + a.s**2 * (a.C1 @ M @ a.C1.T + a.D1 @ a.D1.T)
    P, S = predicted(a.A, a.B, a.C0, a.D0, R)
    K = np.linalg.solve(S, a.C0 @ P).T
    L = np.linalg.solve(S, a.C0 @ P @ a.A.T + a.D0 @ a.B.T).T
    best = Filter(a.A - L @ a.C0, L, a.H @ (np.eye(len(P)) - K @ a.C0), a.H @ K)
    return Lmmse(best, P, M, S, a.H @ (P - K @ S @ K.T) @ a.H.T)


def predicted(A: Array, B: Array, C: Array, D: Array, R: Array) -> tuple[Array, Array]:
    """Covariances of the prediction and of the innovation of the stationary Kalman filter.

    ``R``, covariance of the output's noise: D D' and whatever else there is. Raises ValueError where there is
    no such filter.
    """
    least = LEAST_NOISE * (np.diag(C @ B @ B.T @ C.T) + np.diag(R) + np.finfo(float).tiny)
    R = R + np.diag(least)
    # In units of the outputs' deviations: the solver looks at the conditioning of R.
    unit = np.sqrt(np.diag(R))
    try:
        P = solve_discrete_are(
            A.T, (C / unit[:, None]).T, B @ B.T, R / np.outer(unit, unit), s=B @ (D / unit[:, None]).T
        )
    except np.linalg.LinAlgError as error:
        raise ValueError(f"no stationary Kalman filter: {error}") from error
    return P, C @ P @ C.T + R

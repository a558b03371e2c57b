"""The best linear filter against white noise, by a Riccati recursion: what the H2 inequality must come to."""

from dataclasses import dataclass

import numpy as np

from .plant import Array, Augmented, Filter, Plant

LEAST_CHANGE = 1e-13
MOST_STEPS = 200_000


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
    """Iterate the recursion until it stands.

    The multiplicative noise acts like white noise of the variance that the whole state gives it, not its
    error alone. For rho = 1 this is the Kalman filter. Raises ValueError if A is not Schur stable.
    """
    if plant.spectral_radius >= 1:
        raise ValueError(f"spectral radius of A = {plant.spectral_radius:.6g}: must be below 1")
    a = Augmented.of(plant)
    Q = a.B @ a.B.T
    P, M = np.zeros_like(a.A), np.zeros_like(a.A)
    for _ in range(MOST_STEPS):
        S, _, L = _gains(a, P, M)
        P_next = a.A @ P @ a.A.T + Q - L @ S @ L.T
        P_next = (P_next + P_next.T) / 2
        M_next = a.A @ M @ a.A.T + Q
        change = np.abs(P_next - P).max() + np.abs(M_next - M).max()
        P, M = P_next, M_next
        if change <= LEAST_CHANGE * np.abs(M).max():
            break
    S, K, L = _gains(a, P, M)
    best = Filter(a.A - L @ a.C0, L, a.H @ (np.eye(len(P)) - K @ a.C0), a.H @ K)
    return Lmmse(best, P, M, S, a.H @ (P - K @ S @ K.T) @ a.H.T)


def _gains(a: Augmented, P: Array, M: Array) -> tuple[Array, Array, Array]:
    """Covariance of the innovation, and the gains of the filtered and of the predicted state."""
    R = a.D0 @ a.D0.T + a.s**2 * (a.C1 @ M @ a.C1.T + a.D1 @ a.D1.T)
    S = a.C0 @ P @ a.C0.T + R
    inverse = np.linalg.pinv(S, hermitian=True)
    return S, P @ a.C0.T @ inverse, (a.A @ P @ a.C0.T + a.B @ a.D0.T) @ inverse

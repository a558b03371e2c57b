"""The energy-to-peak inequality over a finite horizon, for a plant that changes with time and nothing late.

It must come to the Riccati recursion (`kalman_gains`): it is here to check both derivations against each
other, not to filter with. Two things make it solvable. The filter starts at zero, so the first step's P has
no block for it: with one the inverse of a covariance of zero would be an unknown. And each step's state is
measured in the recursion's own deviations, so that the optimal P is near one. In SI units a tilt weighs 1e-6
where a position weighs 1e4, and the solver ends short of the optimum or gives up, the sooner the longer the
horizon.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from .design import DesignError, Outcome, solve
from .inequality import positive, solved
from .plant import Array, Filter, Plant

WITHIN = 1e-3
"""Part by which the sum of squared gains may exceed the recursion's, or fall short of what is reached."""


@dataclass(frozen=True)
class Horizon:
    """``filters``, one for each step, from a state of zero; ``gains`` (K,), what they are sure to keep."""

    filters: tuple[Filter, ...]
    gains: Array
    status: str


def kalman_gains(plants: Sequence[Plant], P0: Array) -> tuple[Array, list[Array]]:
    """Peak gains (K,) of the Kalman filter, and its predicted covariances, K of (n, n).

    The gain at step k is the root of lambda_max(H P H') with the filtered P: no causal filter has less.
    """
    gains, predicted, P = [], [], np.asarray(P0, float)
    for plant in plants:
        predicted.append(P)
        S = plant.C @ P @ plant.C.T + plant.D @ plant.D.T
        K = np.linalg.solve(S, plant.C @ P).T
        gains.append(np.sqrt(np.linalg.eigvalsh(plant.H @ (P - K @ S @ K.T) @ plant.H.T)[-1]))
        L = np.linalg.solve(S, (plant.A @ P @ plant.C.T + plant.B @ plant.D.T).T).T
        P = plant.A @ P @ plant.A.T + plant.B @ plant.B.T - L @ S @ L.T
        P = (P + P.T) / 2
    return np.array(gains), predicted


def reached_gains(plants: Sequence[Plant], filters: Sequence[Filter], P0: Array) -> Array:
    """Exact peak gains (K,) of given filters, from the initial error and w together."""
    n = len(P0)
    P, gains = np.asarray(P0, float), []
    for plant, f in zip(plants, filters, strict=True):
        state = len(P) - n
        c = np.hstack([plant.H - f.Df @ plant.C, -f.Cf[:, :state]])
        d = -f.Df @ plant.D
        gains.append(np.sqrt(np.linalg.eigvalsh(c @ P @ c.T + d @ d.T)[-1]))
        A = np.block([[plant.A, np.zeros((n, state))], [f.Bf @ plant.C, f.Af[:, :state]]])
        B = np.vstack([plant.B, f.Bf @ plant.D])
        P = A @ P @ A.T + B @ B.T
    return np.array(gains)


def design_over(plants: Sequence[Plant], P0: Array, whitened: bool = True) -> Horizon:
    """Filters that minimise the sum of the squared peak gains at all steps, by one inequality.

    Parameters: ``plants``, one for each step, rho = 1; ``P0`` (n, n), positive definite: the initial error
    counts as energy x0' P0^-1 x0. ``whitened``: solve in the units of the recursion's covariance.

    Raises `DesignError`: INACCURATE if the solver gives up or ends above the recursion's optimum,
    NOT_CONFIRMED if its filters do not keep the gains. ValueError for plants with late outputs.
    """
    if any(plant.rho != 1 for plant in plants):
        raise ValueError("rho: must be 1 at every step")
    optimal, predicted = kalman_gains(plants, P0)
    roots = [np.linalg.cholesky(P) if whitened else np.eye(len(P0)) for P in predicted]
    n, K = len(P0), len(plants)
    X = [cp.Variable((n, n), symmetric=True) for _ in range(K)]
    Z = [cp.Variable((n, n), symmetric=True) for _ in range(K)]
    g = cp.Variable(K, nonneg=True)
    constraints: list[cp.Constraint] = [X[0] << roots[0].T @ np.linalg.solve(P0, roots[0])]
    unknowns = []
    for k, plant in enumerate(plants):
        _, width, m, p = plant.shape
        C, H = plant.C @ roots[k], plant.H @ roots[k] / optimal[k]
        Bh, Ah = cp.Variable((n, m)), cp.Variable((n, n))
        Df, Ch = cp.Variable((p, m)), cp.Variable((p, n))
        unknowns.append((Ah, Bh, Ch, Df))
        # The filter starts at zero: at the first step there is nothing but x.
        P = cp.bmat([[X[k], Z[k]], [Z[k], Z[k]]]) if k else X[0]
        c = cp.hstack([H - Df @ C, -Ch]) if k else H - Df @ C
        energy = [P, np.eye(width)]
        constraints.append(positive([g[k] * np.eye(p)], [[c, -Df @ plant.D]], energy))
        if k + 1 < K:
            A, B = (np.linalg.solve(roots[k + 1], part) for part in (plant.A @ roots[k], plant.B))
            rows = [[Y @ A + Bh @ C, Ah] if k else [Y @ A + Bh @ C] for Y in (X[k + 1], Z[k + 1])]
            J = cp.vstack([Y @ B + Bh @ plant.D for Y in (X[k + 1], Z[k + 1])])
            following = cp.bmat([[X[k + 1], Z[k + 1]], [Z[k + 1], Z[k + 1]]])
            constraints.append(positive([following], [[cp.bmat(rows), J]], energy))
    status = solve(cp.Problem(cp.Minimize(cp.sum(g)), constraints))
    filters = []
    for k, (Ah, Bh, Ch, Df) in enumerate(unknowns):
        Y = solved(Z[k + 1]) if k + 1 < K else np.eye(n)
        Af, Bf = (np.linalg.solve(Y, solved(part)) for part in (Ah, Bh))
        filters.append(Filter(Af, Bf, optimal[k] * solved(Ch), optimal[k] * solved(Df)))
    gains = optimal * np.sqrt(solved(g))
    found = Horizon(tuple(filters), gains, status)
    _check(found, optimal, reached_gains(plants, filters, P0))
    return found


def _check(found: Horizon, optimal: Array, reached: Array) -> None:
    worst = float((reached / found.gains).max())
    if not worst <= 1 + WITHIN:
        raise DesignError(
            Outcome.NOT_CONFIRMED, f"{worst:.6g} times the gain at some step, solver {found.status}"
        )
    excess = float((found.gains / optimal).max())
    if not excess <= 1 + WITHIN:
        raise DesignError(
            Outcome.INACCURATE, f"{excess:.6g} times the recursion's gain at some step, solver {found.status}"
        )

"""The stochastic H-infinity filter of Xu et al. 2012, Theorem 2.3, for a sampling period with a random error.

    x(k+1) = (A + q(k) A_s) x(k) + B v(k),   y(k) = C x(k) + D v(k),   z(k) = L x(k)        (2.8)

q is white, of zero mean and unit variance. The theorem's formulas are lost in print; what follows is worked
out anew from its lemmas. The filter (2.9) is x^(k+1) = A_f x^(k) + K y(k) with A_f = A + q A_s - K C, of
which the mean A - K C is used. Then the error system (2.11) is e(k+1) = (A - K C + q A_s) e + (B - K D) v,
which is exact where the navigator is corrected at once, so that x^ = 0 and x = e.

Lemma 2.1, the bounded real lemma with state-multiplicative noise: the system e(k+1) = (F + q F_s) e + G v,
z = L e is stable in mean square and has an energy gain below gamma if and only if there is X > 0 with

    F'XF + F_s'XF_s - X + L'L + F'XG (gamma^2 I - G'XG)^-1 G'XF < 0,   gamma^2 I - G'XG > 0.

By Schur's complement (Lemma 2.2), taken for X in the places of F, F_s and L, with Y = X K it is linear:

    [ X     .     .    X F    X G     ]
    [ .     X     .    X F_s  .       ]
    [ .     .     I    L      .       ]  > 0,     X F = X A - Y C,   X F_s = X A_s,   X G = X B - Y D.
    [ .     .     .    X      .       ]
    [ sym.  .     .    .      gamma^2 ]

The least gamma^2 over X and Y is the optimisation (2.23), and K = X^-1 Y. Nothing is lost: for this structure
the inequality is necessary as well.

The plant itself need not be stable, and here is not: a position error integrates a velocity error. On [x; e]
the inequality has no solution at all; on e alone it has one wherever K can hold the error.

References
----------
.. [1] Y. Xu, X. Chen, Q. Li, "INS/WSN-Integrated Navigation Utilizing LS-SVM and H-infinity Filtering",
       Mathematical Problems in Engineering 2012, 707326.
.. [2] E. Gershon, U. Shaked, I. Yaesh, "Robust H-infinity estimation of stationary discrete-time linear
       processes with stochastic uncertainties", Systems and Control Letters 45 (2002).
"""

from dataclasses import dataclass, fields
from enum import StrEnum

import cvxpy as cp
import numpy as np

from . import analysis, hinf
from .analysis import ClosedLoop
from .design import CONFIRMED_WITHIN, DesignError, Outcome, solve
from .inequality import ClosedForm, solved
from .plant import Array


class Form(StrEnum):
    """When the filter has its estimate of x(k)."""

    PREDICTED = "predicted"
    """Before y(k): (2.9) as printed."""
    FILTERED = "filtered"
    """With y(k), as the Kalman filter beside it: F = (I - K C) A, F_s = (I - K C) A_s, G = (I - K C) B - K D.

    Takes noises of process and measurement that have no part in common: B D' = 0.
    """


@dataclass(frozen=True)
class NoisyPlant:
    """Matrices of (2.8): A, A_s (n, n), B (n, l), C (m, n), D (m, l), L (p, n).

    Raises ValueError, one line, for matrices that are not finite or do not fit.
    """

    A: Array
    A_s: Array
    B: Array
    C: Array
    D: Array
    L: Array

    def __post_init__(self) -> None:
        for field in fields(self):
            matrix = np.array(getattr(self, field.name), float)
            if matrix.ndim != 2 or 0 in matrix.shape or not np.isfinite(matrix).all():
                raise ValueError(f"{field.name}: must be a matrix of finite numbers, with rows and columns")
            object.__setattr__(self, field.name, matrix)
        n, (m, width) = len(self.A), self.D.shape
        wanted = {"A": (n, n), "A_s": (n, n), "B": (n, width), "C": (m, n), "L": (len(self.L), n)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                found = " by ".join(map(str, getattr(self, name).shape))
                raise ValueError(f"{name} is {found}: must be {shape[0]} by {shape[1]}")

    def scaled(self, state: Array, wanted: float) -> "NoisyPlant":
        """In other units: x = ``state`` x', z = ``wanted`` z'; the gain is then ``state``^-1 K."""
        left = np.linalg.inv(state)
        return NoisyPlant(
            left @ self.A @ state,
            left @ self.A_s @ state,
            left @ self.B,
            self.C @ state,
            self.D,
            self.L @ state / wanted,
        )


@dataclass(frozen=True)
class RobustGain:
    """A gain that the analysis confirms.

    ``K`` (n, m). ``gamma``: the bound that the inequality gives. ``energy_gain``: what the closed loop has,
    by the game of `analysis` and no solver. ``spectral_radius``: of its covariance's recursion.
    ``white_sd`` (n,): standard deviations of e under white v of unit variance.
    """

    K: Array
    gamma: float
    energy_gain: float
    spectral_radius: float
    white_sd: Array


def closed_loop(plant: NoisyPlant, K: Array, form: Form) -> ClosedLoop:
    """The error system (2.11) with a gain."""
    if form is Form.PREDICTED:
        F, F_s, G = plant.A - K @ plant.C, plant.A_s, plant.B - K @ plant.D
    else:
        kept = np.eye(len(plant.A)) - K @ plant.C
        F, F_s, G = kept @ plant.A, kept @ plant.A_s, kept @ plant.B - K @ plant.D
    none = np.zeros((len(plant.L), G.shape[1]))
    return ClosedLoop(F, F_s, G, np.zeros_like(G), plant.L, np.zeros_like(plant.L), none, none, 1.0)


def design(plant: NoisyPlant, form: Form = Form.PREDICTED, gamma: float | None = None) -> RobustGain:
    """The gain with the least energy gain; with ``gamma``, of all that keep to it, one of little variance.

    ``gamma`` : no more than this is asked of the energy gain, and E|z|^2 under white v of unit variance is
    made small instead: the X of the inequality bounds both (a mixed design, not in the paper).

    Raises `design.DesignError` if there is none, or the analysis does not confirm it.
    """
    state, wanted = _units(plant)
    inner = plant.scaled(state, wanted)
    n, (m, width) = len(plant.A), plant.D.shape
    X, Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, m))
    ahead = np.eye(n) if form is Form.PREDICTED else inner.A
    noisy = np.zeros((n, n)) if form is Form.PREDICTED else inner.A_s
    seen = inner.D if form is Form.PREDICTED else inner.C @ inner.B + inner.D
    C = inner.C @ ahead
    F = [X @ inner.A - Y @ C, X @ inner.A_s - Y @ inner.C @ noisy]
    G = X @ inner.B - Y @ seen
    J, none = [G, np.zeros((n, width))], np.zeros_like
    c, d = [inner.L, none(inner.L)], [np.zeros((len(inner.L), width))] * 2
    closed = ClosedForm(X, X, F, J, c, d, np.eye(width), np.eye(len(inner.L)))
    if gamma is None:
        g = cp.Variable(nonneg=True)
        problem = cp.Problem(cp.Minimize(g), hinf.constraints(closed, g))
    else:
        # trace(G' X G) bounds E|z|^2, since X is at least the observability Gramian.
        cost = cp.Variable((width, width), symmetric=True)
        bounded = cp.bmat([[cost, G.T], [G, X]])
        g = (gamma / wanted) ** 2
        parts = [*hinf.constraints(closed, g), (bounded + bounded.T) / 2 >> 0]
        problem = cp.Problem(cp.Minimize(cp.trace(cost)), parts)
    solve(problem)
    K = state @ np.linalg.solve(solved(X), solved(Y))
    bound = wanted * float(np.sqrt(solved(g))) if gamma is None else gamma
    return confirmed(plant, K, form, bound)


def confirmed(plant: NoisyPlant, K: Array, form: Form, gamma: float) -> RobustGain:
    """The gain, if an analysis that knows nothing of the solver finds gamma kept; else raises
    `design.DesignError`."""
    if not np.isfinite(K).all():
        raise DesignError(Outcome.NOT_CONFIRMED, "the gain is not finite")
    loop = closed_loop(plant, K, form)
    if not loop.spectral_radius < 1:
        raise DesignError(Outcome.NOT_CONFIRMED, f"spectral radius {loop.spectral_radius:.6g} in mean square")
    gain = analysis.energy_gain(loop, adapted=True)
    if not analysis.holds(loop, gamma * (1 + CONFIRMED_WITHIN), adapted=True, energy=True):
        raise DesignError(Outcome.NOT_CONFIRMED, f"gain {gain:.6g} for gamma = {gamma:.6g}")
    return RobustGain(K, gamma, gain, loop.spectral_radius, np.sqrt(np.diag(loop.gramian)))


def _units(plant: NoisyPlant) -> tuple[Array, float]:
    """Units of x and of z in which the inequality's numbers are near one: those of the best linear filter."""
    P = np.eye(len(plant.A))
    R = plant.D @ plant.D.T
    for _ in range(10_000):
        S = plant.C @ P @ plant.C.T + R
        filtered = P - P @ plant.C.T @ np.linalg.solve(S, plant.C @ P)
        after = plant.A @ filtered @ plant.A.T + plant.A_s @ filtered @ plant.A_s.T + plant.B @ plant.B.T
        settled = np.allclose(after, P, rtol=1e-9, atol=0)
        P = after
        if settled:
            break
        if not np.trace(P) < 1e12:
            raise DesignError(Outcome.UNDETECTABLE, "the covariance of the best linear filter grows forever")
    wanted = float(np.sqrt(np.linalg.eigvalsh(plant.L @ P @ plant.L.T)[-1]))
    return np.linalg.cholesky(P + 1e-9 * np.trace(P) * np.eye(len(P))), wanted

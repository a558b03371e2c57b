"""What the three inequalities share: the filter's unknowns, and the closed loop that is linear in them.

The unknowns of Theorem 2 of Gao et al. stand in G = [V1, E V2; V3, V2], E = [I; 0], with
Ah = V2 Af and Bh = V2 Bf. Multiplying the closed loop by G makes it linear in them, and G + G' - P stands
for P wherever the inequality has the inverse of what G multiplies: one P for each vertex, one G for all.
With one vertex and a filter of full order nothing is lost by G = P = [X, Z; Z, Z] (the lossless form).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from .plant import Array, Augmented, Filter

STRICT = 1e-7
"""What a matrix must exceed to count as positive definite, in the units of `design.units`."""
Expression = Any
"""An expression of cvxpy; its stubs do not tell matrices from scalars."""


class Unknowns:
    """Unknowns of a design: those of the filter, and of Theorem 2's or the lossless form."""

    def __init__(self, like: Augmented, order: int, lossless: bool) -> None:
        N, m, p = len(like.A), len(like.C0), len(like.H)
        self.lossless = lossless
        self.Ah, self.Bh = cp.Variable((order, order)), cp.Variable((order, m))
        self.Ch, self.Df = cp.Variable((p, order)), cp.Variable((p, m))
        self.E = np.eye(N, order)
        if lossless:
            self.V1 = cp.Variable((N, N), symmetric=True)
            self.V2 = self.V3 = cp.Variable((N, N), symmetric=True)
        else:
            self.V1, self.V2 = cp.Variable((N, N)), cp.Variable((order, order))
            self.V3 = cp.Variable((order, N))

    def closed(self, plant: Augmented) -> "ClosedForm":
        """The closed loop at one vertex, multiplied by G."""
        order, width = self.Ah.shape[0], plant.B.shape[1]
        G = cp.bmat([[self.V1, self.E @ self.V2], [self.V3, self.V2]])
        P = G if self.lossless else cp.Variable(G.shape, symmetric=True)
        none, outputs = np.zeros, len(plant.H)

        def column(into: Expression, received: Expression) -> tuple[Expression, Expression]:
            return self.V1 @ into + self.E @ self.Bh @ received, self.V3 @ into + self.Bh @ received

        upper, lower = column(plant.A, plant.C0)
        F = [cp.bmat([[upper, self.E @ self.Ah], [lower, self.Ah]])]
        J = [cp.vstack(column(plant.B, plant.D0))]
        c = [cp.hstack([plant.H - self.Df @ plant.C0, -self.Ch])]
        d = [-self.Df @ plant.D0]
        if plant.s > 0:
            upper, lower = (plant.s * part for part in (self.E @ self.Bh, self.Bh))
            N = len(plant.A)
            right = [none((N, order)), none((order, order))]
            F.append(cp.bmat([[upper @ plant.C1, right[0]], [lower @ plant.C1, right[1]]]))
            J.append(cp.vstack([upper @ plant.D1, lower @ plant.D1]))
            c.append(cp.hstack([-plant.s * self.Df @ plant.C1, none((outputs, order))]))
            d.append(-plant.s * self.Df @ plant.D1)
        slack = G if self.lossless else G + G.T - P
        return ClosedForm(P, slack, F, J, c, d, np.eye(width), np.eye(outputs))

    def filter(self) -> Filter:
        """The filter of the solution."""
        V2 = solved(self.V2)
        return Filter(
            np.linalg.solve(V2, solved(self.Ah)),
            np.linalg.solve(V2, solved(self.Bh)),
            solved(self.Ch),
            solved(self.Df),
        )


class FedBack:
    """Unknowns of a gain L whose product with what is received is taken out of the plant's state at once.

    The closed loop is x(k+1) = A x + B w - L y^, e = H x; linear in Bh = V2 L, with G = [V2, Va; 0, Vb]. The
    plant's own stability does not matter, and late outputs are those of a state that is kept small.
    """

    def __init__(self, like: Augmented, n: int) -> None:
        N, m = len(like.A), len(like.C0)
        self.V2, self.Bh = cp.Variable((n, n)), cp.Variable((n, m))
        self.E = np.eye(N, n)
        self.G: Expression = self.V2
        if n < N:
            lower = [np.zeros((N - n, n)), cp.Variable((N - n, N - n))]
            self.G = cp.bmat([[self.V2, cp.Variable((n, N - n))], lower])

    def closed(self, plant: Augmented) -> "ClosedForm":
        """The closed loop, multiplied by G."""
        P = cp.Variable(plant.A.shape, symmetric=True)
        taken = -self.E @ self.Bh
        F, J = [self.G @ plant.A + taken @ plant.C0], [self.G @ plant.B + taken @ plant.D0]
        c, d = [plant.H], [np.zeros((len(plant.H), plant.B.shape[1]))]
        if plant.s > 0:
            F.append(plant.s * taken @ plant.C1)
            J.append(plant.s * taken @ plant.D1)
        return ClosedForm(
            P, self.G + self.G.T - P, F, J, c, d, np.eye(plant.B.shape[1]), np.eye(len(plant.H))
        )

    @property
    def gain(self) -> Array:
        """L of the solution, (n, m)."""
        return np.linalg.solve(solved(self.V2), solved(self.Bh))


def solved(variable: Expression) -> Array:
    """Value of an unknown in the solution; zero if the inequality does not hold it."""
    return np.zeros(variable.shape) if variable.value is None else np.asarray(variable.value)


@dataclass(frozen=True)
class ClosedForm:
    """One vertex. Lists have an entry for the mean and, if rho < 1, one for the random part.

    G eta(k+1) = F eta + J w and e = c eta + d w, with eta = [xi; x^]; ``unit_w``, ``unit_e``: identities.
    """

    P: Expression
    slack: Expression
    F: list[Expression]
    J: list[Expression]
    c: list[Expression]
    d: list[Expression]
    unit_w: Expression
    unit_e: Expression


def positive(
    upper: Sequence[Expression],
    M: Sequence[Sequence[Expression]],
    lower: Sequence[Expression],
    by: float = STRICT,
) -> Any:
    """The constraint [diag(upper), M; M', diag(lower)] > ``by``, with M a grid of blocks."""
    grid = cp.bmat([list(row) for row in M])
    whole = cp.bmat([[_diagonal(upper), grid], [grid.T, _diagonal(lower)]])
    return (whole + whole.T) / 2 >> by * np.eye(whole.shape[0])


def settling(closed: ClosedForm) -> Any:
    """What all inequalities ask first: a closed loop that settles. It has no scale, hence the margin of 1."""
    return positive([closed.slack] * len(closed.F), [[F] for F in closed.F], [closed.P], by=1.0)


def _diagonal(blocks: Sequence[Expression]) -> Expression:
    sizes = [block.shape[0] for block in blocks]
    return cp.bmat(
        [
            [block if i == j else np.zeros((sizes[i], sizes[j])) for j in range(len(blocks))]
            for i, block in enumerate(blocks)
        ]
    )

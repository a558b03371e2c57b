"""The plant of Gao et al., eq. (10), and its exact form without the delayed output.

    x(k+1) = A x(k) + B w(k),   z(k) = H x(k),   y(k) = C x(k) + D w(k)
    received: r(k) y(k) + (1 - r(k)) y(k-1),     r Bernoulli, P(r = 1) = rho

With xi = [x; y(k-1)] and q = r - rho, of zero mean and variance rho (1 - rho), what is received is
``(C0 + q C1) xi + (D0 + q D1) w``: linear, with multiplicative noise in the output alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sins.text import shortened

Array = NDArray[Any]

MOST_STATES, MOST_VERTICES = 40, 64
"""What a matrix inequality of them is still solved for in memory that there is."""


@dataclass(frozen=True)
class Plant:
    """Matrices of eq. (10): A (n, n), B (n, l), C (m, n), D (m, l), H (p, n); rho in (0, 1].

    Raises ValueError, one line, for matrices that are not finite or do not fit, and for another rho.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    H: Array
    rho: float = 1.0

    def __post_init__(self) -> None:
        for name in MATRICES:
            object.__setattr__(self, name, _matrix(name, getattr(self, name)))
        n, (m, width) = len(self.A), self.D.shape
        wanted = {"A": (n, n), "B": (n, width), "C": (m, n), "H": (len(self.H), n)}
        for name, (rows, columns) in wanted.items():
            found = getattr(self, name).shape
            if found != (rows, columns):
                raise ValueError(
                    f"{name} is {found[0]} by {found[1]}: must be {rows} by {columns},"
                    f" where A has {n} rows and D is {m} by {width}"
                )
        rho = self.rho
        if isinstance(rho, bool) or not isinstance(rho, int | float) or not 0 < rho <= 1:
            raise ValueError(f"rho = {shortened(repr(rho))}: allowed is (0, 1]")

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Numbers of states, disturbances, outputs and wanted signals."""
        return *self.B.shape, len(self.C), len(self.H)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of an eigenvalue of A; the designs need it below 1."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @property
    def full_order(self) -> int:
        """Number of states of xi, and of a filter that loses nothing."""
        n, _, m, _ = self.shape
        return n if self.rho == 1 else n + m

    def hidden_mode(self) -> complex | None:
        """An eigenvalue on or outside the unit circle whose mode the output does not see, or None."""
        scale = np.linalg.norm(self.A) + np.linalg.norm(self.C)
        for value in np.linalg.eigvals(self.A):
            if abs(value) >= 1:
                pencil = np.vstack([self.A - value * np.eye(len(self.A)), self.C])
                if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9 * scale:
                    return complex(value)
        return None


MATRICES = tuple(field.name for field in fields(Plant) if field.name != "rho")


def _matrix(name: str, given: object) -> Array:
    try:
        matrix = np.array(given, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: not a matrix of numbers, with rows of one length") from None
    if matrix.ndim != 2 or 0 in matrix.shape:
        raise ValueError(f"{name}: must have rows and columns, not the shape {matrix.shape}")
    if max(matrix.shape) > MOST_STATES:
        raise ValueError(f"{name}: rows and columns are {matrix.shape}: allowed are {MOST_STATES}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: holds a number that is not finite")
    matrix.flags.writeable = False
    return matrix


def checked_polytope(vertices: Sequence[Plant]) -> tuple[Plant, ...]:
    """The vertices of one polytope. Raises ValueError for none, other shapes, or another rho among them."""
    vertices = tuple(vertices)
    if not 1 <= len(vertices) <= MOST_VERTICES:
        raise ValueError(
            f"a polytope has at least one vertex and at most {MOST_VERTICES}; here are {len(vertices)}"
        )
    first = vertices[0]
    for number, plant in enumerate(vertices[1:], 2):
        if plant.shape != first.shape or plant.rho != first.rho:
            raise ValueError(
                f"vertex {number} has states, disturbances, outputs, wanted signals {plant.shape} and rho"
                f" {plant.rho:g}: must have those of vertex 1, {first.shape} and {first.rho:g}"
            )
    return vertices


def mixture(vertices: Sequence[Plant], weights: Sequence[float] | None = None) -> Plant:
    """A plant inside the polytope; its centre by default."""
    share = np.full(len(vertices), 1 / len(vertices)) if weights is None else np.asarray(weights, float)
    matrices = {name: np.tensordot(share, [getattr(p, name) for p in vertices], 1) for name in MATRICES}
    return Plant(**matrices, rho=vertices[0].rho)


@dataclass(frozen=True)
class Augmented:
    """The plant in xi = [x; y(k-1)], (N,) with N = n + m, without delay but with multiplicative noise.

    For rho = 1 nothing is late, and xi = x. A (N, N), B (N, l), C0 and C1 (m, N), D0 and D1 (m, l), H (p, N).
    """

    A: Array
    B: Array
    C0: Array
    C1: Array
    D0: Array
    D1: Array
    H: Array
    rho: float

    @property
    def s(self) -> float:
        """Standard deviation of q."""
        return float(np.sqrt(self.rho * (1 - self.rho)))

    @classmethod
    def of(cls, plant: Plant) -> "Augmented":
        """The augmentation; exact."""
        n, _, m, p = plant.shape
        rho = plant.rho
        if rho == 1:
            none = np.zeros_like
            return cls(plant.A, plant.B, plant.C, none(plant.C), plant.D, none(plant.D), plant.H, 1.0)
        return cls(
            A=np.block([[plant.A, np.zeros((n, m))], [plant.C, np.zeros((m, m))]]),
            B=np.vstack([plant.B, plant.D]),
            C0=np.hstack([rho * plant.C, (1 - rho) * np.eye(m)]),
            C1=np.hstack([plant.C, -np.eye(m)]),
            D0=rho * plant.D,
            D1=plant.D,
            H=np.hstack([plant.H, np.zeros((p, m))]),
            rho=rho,
        )

    def scaled(self, state: Array, output: Array, wanted: float) -> "Augmented":
        """In other units: xi = ``state`` xi', received = ``output`` received', z = ``wanted`` z'."""
        solve = np.linalg.solve
        return Augmented(
            A=solve(state, self.A @ state),
            B=solve(state, self.B),
            C0=solve(output, self.C0 @ state),
            C1=solve(output, self.C1 @ state),
            D0=solve(output, self.D0),
            D1=solve(output, self.D1),
            H=self.H @ state / wanted,
            rho=self.rho,
        )


@dataclass(frozen=True)
class Filter:
    """Gao et al., eq. (11): x^(k+1) = Af x^ + Bf y^, z^ = Cf x^ + Df y^; y^ is what is received."""

    Af: Array
    Bf: Array
    Cf: Array
    Df: Array

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.Af)

"""Design a filter by a matrix inequality, and let it pass only if an independent analysis confirms it."""

import threading
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import Enum, StrEnum
from importlib.metadata import version
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import block_diag

from . import analysis, cache, h2, hinf, l2linf
from .analysis import Analysis, ClosedLoop
from .inequality import FedBack, Unknowns, settling, solved
from .lmmse import lmmse, predicted
from .plant import Array, Augmented, Filter, Plant, checked_polytope, mixture

CONFIRMED_WITHIN = 1e-4
"""Part by which the analysis may exceed gamma: what the solver's tolerance makes of it."""


class Kind(StrEnum):
    """What a design minimises, and by which form of the inequality."""

    L2LINF = "l2linf"
    """Peak gain, lossless form."""
    HINF = "hinf"
    """Energy gain, lossless form."""
    H2 = "h2"
    """RMS under white noise, lossless form."""
    THEOREM2 = "theorem2"
    """Peak gain, in the form of Theorem 2 of Gao et al.: any order, several vertices."""
    FEEDBACK = "feedback"
    """Peak gain of e = H x where L y^ is taken out of the plant's state at once: x(k+1) = A x + B w - L y^.

    The plant need not be stable, only detectable. The design's `Filter` has L in the place of Bf, A - L C of
    Af and H of Cf.
    """


class Outcome(Enum):
    """How a design ended."""

    CONFIRMED = "the analysis of the closed loop confirms gamma"
    INFEASIBLE = "the inequality has no solution"
    UNBOUNDED = "the inequality bounds nothing"
    INACCURATE = "the solver found no accurate solution"
    NOT_CONFIRMED = "the analysis of the closed loop does not confirm gamma"
    UNSTABLE = "the plant is not Schur stable"
    UNDETECTABLE = "the plant has a mode that neither fades nor shows in the output"


class DesignError(RuntimeError):
    """There is no filter; `outcome` says why, the message with numbers."""

    def __init__(self, outcome: Outcome, numbers: str) -> None:
        super().__init__(f"{outcome.name}: {outcome.value}: {numbers}")
        self.outcome = outcome


@dataclass(frozen=True)
class Design:
    """A filter whose gain is confirmed.

    ``gamma`` : the bound that the inequality gives, for every plant of the polytope: peak gain, energy gain,
        or RMS under white noise. ``solver``, ``status`` : who solved it, and what it said.
    ``analyses`` : of the closed loop at each vertex, and at the polytope's centre if there are several.
    """

    kind: Kind
    filter: Filter
    gamma: float
    solver: str
    status: str
    analyses: tuple[Analysis, ...]
    outcome: Outcome = Outcome.CONFIRMED


def design(
    plants: Plant | Sequence[Plant],
    kind: Kind = Kind.L2LINF,
    order: int | None = None,
    use_cache: bool = True,
) -> Design:
    """The filter with the least gamma for a plant or for all of a polytope, from its vertices.

    Parameters: ``order``, number of states of the filter, for `Kind.THEOREM2` alone: by default as many as
    xi = [x; y(k-1)] has (x alone for rho = 1); with fewer, V1 couples them to the first states of xi.

    Raises ValueError for plants that do not fit together and an order that is not in [1, `Plant.full_order`];
    `DesignError` if there is no filter or the analysis does not confirm it.
    """
    vertices = checked_polytope([plants] if isinstance(plants, Plant) else plants)
    full = len(vertices[0].A) if kind is Kind.FEEDBACK else vertices[0].full_order
    if order is not None and not 1 <= order <= full:
        raise ValueError(f"order = {order}: allowed is [1, {full}]")
    if kind is not Kind.THEOREM2 and (len(vertices) > 1 or order not in (None, full)):
        raise ValueError(f"kind = {kind.value}: one vertex and full order; others by kind = theorem2")
    for plant in vertices:
        _refuse_unstable(plant, settled=kind is not Kind.FEEDBACK)
    order = order or full
    key = cache.design_key(vertices, kind.value, order)
    found = cache.read(key) if use_cache else None
    if found is not None:
        return _decoded(found)
    made = _designed(vertices, kind, order)
    if use_cache:
        cache.write(key, encoded(made))
    return made


def encoded(made: Design) -> dict[str, Any]:
    """The design in plain numbers, lists and names."""
    content = asdict(made)
    content["filter"] = {name: matrix.tolist() for name, matrix in content["filter"].items()}
    return {**content, "kind": made.kind.value, "outcome": made.outcome.name}


def _decoded(content: dict[str, Any]) -> Design:
    matrices = {name: np.array(matrix) for name, matrix in content["filter"].items()}
    own = {
        "kind": Kind(content["kind"]),
        "filter": Filter(**matrices),
        "analyses": tuple(Analysis(**each) for each in content["analyses"]),
        "outcome": Outcome[content["outcome"]],
    }
    return Design(**{**content, **own})


def _refuse_unstable(plant: Plant, settled: bool) -> None:
    radius = plant.spectral_radius
    if radius < 1:
        return
    hidden = plant.hidden_mode()
    if hidden is not None:
        raise DesignError(Outcome.UNDETECTABLE, f"eigenvalue {hidden:.6g} of A; a leak in it would do")
    if settled:
        raise DesignError(
            Outcome.UNSTABLE,
            f"spectral radius of A = {radius:.6g}, must be below 1: a leak would do, or kind"
            " feedback for states that are corrected",
        )


def _designed(vertices: tuple[Plant, ...], kind: Kind, order: int) -> Design:
    fed_back = kind is Kind.FEEDBACK
    state, output, wanted = _prompt_units(vertices[0]) if fed_back else units(vertices)
    models = [Augmented.of(plant).scaled(state, output, wanted) for plant in vertices]
    unknowns = (
        FedBack(models[0], order) if fed_back else Unknowns(models[0], order, kind is not Kind.THEOREM2)
    )
    g = cp.Variable(nonneg=True)
    inequality = {Kind.HINF: hinf.constraints, Kind.H2: h2.constraints}.get(kind, l2linf.constraints)
    closed = [unknowns.closed(model) for model in models]
    try:
        status = solve(cp.Problem(cp.Minimize(g), [part for form in closed for part in inequality(form, g)]))
    except DesignError as error:
        if len(vertices) == 1 and error.outcome is Outcome.INFEASIBLE:
            told = "CLARABEL says infeasible, but one vertex always has a solution"
            raise DesignError(Outcome.INACCURATE, told) from error
        if len(vertices) > 1 and error.outcome is Outcome.INACCURATE:
            # At a margin of STRICT the solver may not see that there is no solution; at one of 1 it does.
            solve(cp.Problem(cp.Minimize(0), [settling(form) for form in closed]))
        raise
    gamma = wanted * float(np.sqrt(solved(g)))
    if isinstance(unknowns, FedBack):
        L = state[:order, :order] @ np.linalg.solve(output.T, unknowns.gain.T).T
        return confirmed(vertices, kind, _with_gain(vertices[0], L), gamma, status)
    f = unknowns.filter()
    B = np.linalg.solve(output.T, f.Bf.T).T
    D = wanted * np.linalg.solve(output.T, f.Df.T).T
    return confirmed(vertices, kind, Filter(f.Af, B, wanted * f.Cf, D), gamma, status)


def units(vertices: Sequence[Plant]) -> tuple[Array, Array, float]:
    """Units of xi, of the received output and of z in which the inequality's numbers are near one.

    The first two are Cholesky factors of the best linear filter's covariances, mean over the vertices. A
    triangular one leaves the first states first, so that a reduced order means the same.
    """
    best = [lmmse(plant) for plant in vertices]
    state = _root(np.mean([each.P for each in best], axis=0), np.mean([each.M for each in best], axis=0))
    S = np.mean([each.S for each in best], axis=0)
    output = _root(S, S)
    size = max(float(np.linalg.eigvalsh(each.error)[-1]) for each in best)
    return state, output, float(np.sqrt(size)) if size > 0 else 1.0


def _with_gain(plant: Plant, L: Array) -> Filter:
    return Filter(plant.A - L @ plant.C, L, plant.H, np.zeros((len(plant.H), L.shape[1])))


def _prompt_units(plant: Plant) -> tuple[Array, Array, float]:
    """The same for a state that is fed back: covariances of the Kalman filter, as if nothing were late."""
    try:
        P, S = predicted(plant.A, plant.B, plant.C, plant.D, plant.D @ plant.D.T)
        state, output = _root(P, P), _root(S, S)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise DesignError(Outcome.INACCURATE, f"no units to solve in: {error}") from error
    wanted = float(np.sqrt(np.linalg.eigvalsh(plant.H @ P @ plant.H.T)[-1])) or 1.0
    return np.asarray(state if plant.rho == 1 else block_diag(state, output)), output, wanted


def _root(P: Array, M: Array) -> Array:
    """Cholesky factor of the covariance P, with a little of M in directions that have hardly any."""
    diagonal = np.diag(M)
    return np.linalg.cholesky(P + 1e-6 * np.diag(np.where(diagonal > 0, diagonal, 1.0)))


_SOLVING = threading.Lock()


def solve(problem: cp.Problem) -> str:
    """Solve, and return the solver's status: ``optimal`` or ``optimal_inaccurate``.

    Raises `DesignError` for every other end.
    """
    # Warnings are of the whole process: one thread at a time.
    with _SOLVING, warnings.catch_warnings():
        # "Solution may be inaccurate": the status says so as well, and the analysis decides.
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError as error:
            raise DesignError(Outcome.INACCURATE, "the solver gave up") from error
    status = str(problem.status)
    if problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        return status
    named = {
        cp.INFEASIBLE: Outcome.INFEASIBLE,
        cp.INFEASIBLE_INACCURATE: Outcome.INFEASIBLE,
        cp.UNBOUNDED: Outcome.UNBOUNDED,
        cp.UNBOUNDED_INACCURATE: Outcome.UNBOUNDED,
    }
    raise DesignError(named.get(status, Outcome.INACCURATE), f"CLARABEL says {status}")


def confirmed(
    vertices: Sequence[Plant], kind: Kind, filter_: Filter, gamma: float, status: str = "given"
) -> Design:
    """The design, if the analysis of every closed loop confirms it; else raises `DesignError`."""
    plants = [*vertices, mixture(vertices)] if len(vertices) > 1 else list(vertices)
    analyses = []
    for number, plant in enumerate(plants, 1):
        where = "" if len(plants) == 1 else f"vertex {number}: " if number < len(plants) else "centre: "
        if not all(np.isfinite(matrix).all() for matrix in vars(filter_).values()):
            raise DesignError(Outcome.NOT_CONFIRMED, f"the filter is not finite, solver {status}")
        fed_back = kind is Kind.FEEDBACK
        loop = ClosedLoop.fed_back(plant, filter_.Bf) if fed_back else ClosedLoop.of(plant, filter_)
        if not loop.spectral_radius < 1:
            raise DesignError(
                Outcome.NOT_CONFIRMED,
                f"{where}spectral radius {loop.spectral_radius:.6g} in mean square, solver {status}",
            )
        found = analysis.analyze(plant, filter_, fed_back, energy=kind is Kind.HINF)
        gain = found.white_rms if kind is Kind.H2 else found.peak_adapted
        allowed = gamma * (1 + CONFIRMED_WITHIN)
        kept = gain <= allowed
        if found.energy_adapted is not None:  # itself known to a thousandth only
            gain, kept = found.energy_adapted, analysis.holds(loop, allowed, adapted=True, energy=True)
        if not kept or not found.simulation_agrees:
            raise DesignError(
                Outcome.NOT_CONFIRMED,
                f"{where}gain {gain:.6g} for gamma = {gamma:.6g}, simulated RMS {found.simulated_rms:.4g}"
                f" for {found.expected_rms:.4g}, solver {status}",
            )
        analyses.append(found)
    return Design(kind, filter_, gamma, f"CLARABEL {version('clarabel')}", status, tuple(analyses))

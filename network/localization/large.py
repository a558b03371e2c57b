"""Localisation of a thousand to a million nodes from ranges in three dimensions, and a study of it.

Time and memory are in proportion to the links: ranges are held by rows in Morton order, normal equations are
never formed.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq
from scipy.spatial import KDTree

from . import _relocate, _sparse
from ._cold_start import LOOSE, cold_start, misfits
from ._newton import Newton, Solution
from ._rows import Rows, by_rows
from .problem import Array, Booleans, LocalizationError, NodeOutcome, Positions, RangeProblem

LINK_RADIUS_M = 15e3
RANGE_SD_M = 50.0
TOLERANCE = 1e-7
MOST_STEPS = 50
COVARIANCE_DRAWS = 8
MIRROR_MARGIN = 4.5
"""Loss: a mirror image that costs less than this more is not told apart at three standard deviations."""
FIRM_LINKS = 9
"""Of a node that is held where it is without a look at what its neighbours hang on."""
REFITS = 12
"""Times at most that nodes whose ranges do not fit are left out, and the others refined without them."""


def draw_large(
    nodes: int,
    rng: np.random.Generator,
    degree: float = 16.0,
    anchor_share: float = 0.1,
    range_sd_m: float = RANGE_SD_M,
) -> tuple[Array, RangeProblem]:
    """True positions, (n, 3) m, uniform in a cube, and ranges between all within `LINK_RADIUS_M`.

    The cube is of the size at which a node has ``degree`` neighbours in the mean, its faces allowed for.
    Raises `LocalizationError` where there are too few nodes for that many neighbours, or no anchors.
    """
    if not 0 < degree < nodes - 1:
        raise LocalizationError(f"degree = {degree:g} must be above 0 and below nodes - 1 = {nodes - 1}")
    share = brentq(lambda r: _share_within(r) - degree / (nodes - 1), 0.0, 1.0)
    side = LINK_RADIUS_M / float(share)  # pyright: ignore[reportArgumentType]
    truth = rng.uniform(-side / 2, side / 2, (nodes, 3))
    anchor = np.zeros(nodes, np.bool_)
    anchor[rng.permutation(nodes)[: round(anchor_share * nodes)]] = True
    links = KDTree(truth).query_pairs(LINK_RADIUS_M, output_type="ndarray").astype(np.int64, copy=False)
    ranges = np.linalg.norm(truth[links[:, 0]] - truth[links[:, 1]], axis=1)
    ranges += range_sd_m * rng.standard_normal(len(links))
    anchor_x = np.where(anchor[:, None], truth, np.nan)
    return truth, RangeProblem(links, ranges, np.full(len(links), range_sd_m), anchor, anchor_x)


def _share_within(r: float) -> float:
    """Probability that two points of a unit cube are at most ``r`` <= 1 apart."""
    return 4 * np.pi / 3 * r**3 - 3 * np.pi / 2 * r**4 + 8 / 5 * r**5 - r**6 / 6


def localize_large(
    problem: RangeProblem,
    x0: Array | None = None,
    progress: Callable[[float, float], None] | None = None,
    covariance_draws: int = COVARIANCE_DRAWS,
    tolerance: float = TOLERANCE,
) -> Positions:
    """Positions of least squared, weighted residuals, from ``x0``, (n, 3) m, or from nothing.

    Nodes that ranges cannot locate have no position, with their reason in ``outcome``: too few neighbours
    that are located themselves, a standard deviation beyond half of what linear errors hold for, a mirror
    image that fits as well, ranges that fit nowhere. ``suspect`` are the last, and neighbours whom they
    cannot be told from. ``cost`` is over the links of nodes with enough neighbours that hold them and whose
    ranges fit. ``cov`` is estimated from draws (`Newton.covariance`): unbiased, each variance with a
    relative standard deviation of ``sqrt(2 / covariance_draws)``; NaN with no draws, and then only nodes
    that their own ranges do not hold are found. Steps end with the one that promises to lower the cost by
    less than ``tolerance`` of it. The result does not depend on the number of cores.

    Raises `LocalizationError` for what only the dense solver takes: heights, clocks, anchors in doubt; and
    for a start that is not finite.
    """
    if problem.height is not None or problem.clocks or problem.anchor_sd > 0:
        raise LocalizationError(
            "a large network is located from ranges alone: no heights, clocks or anchor_sd"
        )
    if x0 is not None and (x0.shape != (problem.nodes, 3) or not np.isfinite(x0[~problem.anchor]).all()):
        raise LocalizationError(f"x0 must have shape {(problem.nodes, 3)} and be finite")

    def report(done: float) -> None:
        if progress:
            progress(done, 1.0)

    if x0 is not None:
        x0 = np.where(problem.anchor[:, None], problem.anchor_x, x0)
    with by_rows(problem, x0) as rows:
        newton = Newton(rows)
        begin = 0.0
        if x0 is None:
            begin = 0.7
            x = cold_start(rows, newton, problem.anchor_x[rows.order], lambda done: report(begin * done))
        else:
            x = x0[rows.order]
        solution, suspect = _refine(
            rows, newton, x, tolerance, lambda done: report(begin + (0.8 - begin) * done)
        )
        cov = _judge(rows, newton, solution, covariance_draws)
        report(1.0)
        located = (rows.outcome == NodeOutcome.LOCATED) | rows.anchor
        x, outcome = np.empty_like(solution.x), np.empty_like(rows.outcome)
        covariance, whose = np.empty_like(cov), np.empty_like(suspect)
        x[rows.order] = np.where(located[:, None], solution.x, np.nan)
        covariance[rows.order] = np.where(located[:, None, None], cov, np.nan)
        outcome[rows.order], whose[rows.order] = rows.outcome, suspect
    return Positions(x, covariance, outcome, solution.cost, solution.iterations, whose)


def _refine(
    rows: Rows, newton: Newton, x: Array, tolerance: float, progress: Callable[[float], None]
) -> tuple[Solution, Booleans]:
    """The least cost near ``x`` without nodes that ranges do not hold or fit; those that they do not fit."""
    suspect, wanted, steps = np.zeros(len(x), np.bool_), max(LOOSE, tolerance), 0
    rows.leave_out(_weak(rows, newton.own_variance(x)), NodeOutcome.SINGULAR)
    solution = Solution(x, np.inf, 0, False)
    for k in range(REFITS):
        solution = newton.solve(solution.x, wanted, MOST_STEPS)
        steps += solution.iterations
        progress((k + 1) / REFITS)
        doubted = misfits(rows, solution.x)
        if doubted.any():
            suspect |= doubted
            rows.leave_out(doubted, NodeOutcome.INCONSISTENT)
        elif wanted == tolerance:
            break
        else:
            wanted = tolerance
    return replace(solution, iterations=steps), suspect


def _weak(rows: Rows, variance: Array) -> Booleans:
    """Nodes of whose position two standard deviations are more than linear errors hold for."""
    reach = np.zeros(len(variance))
    rows.each(_sparse.linear_reach, rows.start, rows.ranges, rows.root_weight, rows.fixed, reach)
    return ~rows.fixed & (4 * variance > reach)


def _judge(rows: Rows, newton: Newton, solution: Solution, draws: int) -> Array:
    """Covariances, (n, 3, 3) m^2 by rows; outcomes of nodes that the ranges do not hold are set."""
    still = np.zeros(len(solution.x), np.bool_)
    if not solution.converged:
        limit = 0.1 * np.median(1 / rows.root_weight[rows.root_weight > 0])
        still = ~rows.fixed & (np.linalg.norm(newton.last_step, axis=1) > limit)
    cov = newton.covariance(draws) if draws else np.full((len(still), 3, 3), np.nan)
    cov[rows.anchor] = 0.0
    ambiguous = _ambiguous(rows, solution.x)
    rows.leave_out(still, NodeOutcome.NOT_CONVERGED)
    if draws:
        rows.leave_out(_weak(rows, np.trace(cov, axis1=1, axis2=2)), NodeOutcome.SINGULAR)
    rows.leave_out(~rows.fixed & ambiguous, NodeOutcome.AMBIGUOUS)
    return cov


def _ambiguous(rows: Rows, x: Array) -> Booleans:
    """Nodes that may as well be elsewhere: by their mirror image, or together with others as weakly held.

    Nodes of few links are relied on when anchors and nodes already relied on hold them.
    """
    asked, held = ~rows.fixed, np.zeros(len(x), np.bool_)
    rows.each(_relocate.confirm, *rows.links, asked, ~asked & ~rows.anchor, x, MIRROR_MARGIN, held)
    weighted = np.add.reduceat(np.append(rows.root_weight > 0, False), rows.start[:-1], dtype=np.int64)
    doubted = asked & ~(held & (weighted >= FIRM_LINKS))
    while sum(rows.each(_relocate.confirm, *rows.links, doubted, doubted, x, MIRROR_MARGIN, held)):
        doubted = doubted & ~held
    return doubted


def large_study(
    nodes: int, seed: int, progress: Callable[[float, float], None] | None = None
) -> dict[str, float]:
    """Draw a network, locate it from nothing and from near the truth, and say how well and how fast.

    Times are wall times. A node is bad that counts as located and is off by more than 5 standard deviations
    of a range, and of its own. Errors are in standard deviations of a range.
    """

    def part(first: float, last: float) -> Callable[[float, float], None]:
        def report(done: float, total: float) -> None:
            if progress:
                progress(first + (last - first) * done / total, 1.0)

        return report

    # Compiles, or reads what is compiled, outside the time taken.
    localize_large(draw_large(300, np.random.default_rng(0))[1])
    rng = np.random.default_rng(seed)
    truth, problem = draw_large(nodes, rng)
    start = time.perf_counter()
    cold = localize_large(problem, progress=part(0.1, 0.8))
    middle = time.perf_counter()
    near = localize_large(problem, truth + RANGE_SD_M * rng.standard_normal(truth.shape), part(0.8, 1.0), 0)
    end = time.perf_counter()
    free = ~problem.anchor
    located = cold.outcome == NodeOutcome.LOCATED
    error = np.linalg.norm(cold.x - truth, axis=1)[located] / RANGE_SD_M
    own = np.sqrt(np.trace(cold.cov[located], axis1=1, axis2=2)) / RANGE_SD_M
    reasons = {outcome.name.lower(): float(np.sum(cold.outcome == outcome)) for outcome in NodeOutcome}
    return {
        "nodes": nodes,
        "links": len(problem.links),
        "mean_degree": 2 * len(problem.links) / nodes,
        "anchors": float(problem.anchor.sum()),
        "cold_s": middle - start,
        "near_s": end - middle,
        "median_error_sd": float(np.median(error)),
        "p95_error_sd": float(np.quantile(error, 0.95)),
        "located_share": float(located[free].mean()),
        "bad_share": float(np.sum((error > 5) & (error > 5 * own)) / free.sum()),
        "median_error_own_sd": float(np.median(error / own)),
        "cost": cold.cost,
        "cost_over_near": cold.cost / near.cost,
        "peak_memory_mb": _peak_memory_mb(),
        **reasons,
    }


def _peak_memory_mb() -> float:
    """Most memory that this process has held; NaN where the system does not say."""
    try:
        import resource
    except ImportError:
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6

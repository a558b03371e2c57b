"""From ranges to positions, cold, with a verdict on every node: never a wrong position that is called
located."""

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.sparse import coo_matrix

from ...sins.settings import Settings
from .ambiguity import far, mirror_ambiguous, mirror_test
from .dv_distance import dv_distance
from .dwmds import dwmds
from .least_squares import Loss, Refined, refine
from .problem import Array, Booleans, NodeOutcome, Positions, RangeProblem
from .quarantine import QuarantineSettings
from .sdp import MOST_NODES, sdp_start
from .spherical import locate_successively

_BETTER = 1.0
"""Decrease of the cost from which on a solution is another, better one."""
_TOLERANCE = 1e-3
"""Last step, in standard deviations of all unknowns together."""
_SETTLED = 0.01
"""Squared move over a whole solution more, in standard deviations, above which a position is not settled."""
_CUT = 3.0
"""Standard deviations at which residuals are cut off where they are to show a bias."""
_UNTOLD = 0.05
"""Share of a bias that a move of the node must leave, for residuals to show it."""
_MEDIAN, _MEDIAN_SD = 0.6745, 0.786
"""Median size of a standard normal deviate; standard deviation of the median of k of them, times root k."""


class LocalizationSettings(Settings):
    """How the nodes of a network are located."""

    loss: Literal["squared", "huber", "one_sided"] = "one_sided"
    """`one_sided` doubts long ranges alone: what is not in line of sight can only be too long."""
    loss_threshold: float = Field(default=1.5, gt=0, le=100)
    """Standard deviations up to which a residual counts by its square."""
    min_neighbors: int = Field(default=4, ge=4, le=1000)
    """Usable neighbours that a node needs: anchors, and nodes that have enough themselves."""
    max_position_sd_m: float = Field(default=300.0, gt=0, le=1e5)
    """Root of the trace of a position's covariance beyond which its geometry counts as singular."""
    min_mirror_margin: float = Field(default=20.0, ge=0, le=1e4)
    """Increase of the sum of squared residuals, in variances, at the next other solution, from which on a
    position is unique: a likelihood ratio of exp(margin / 2)."""
    suspect_sd: float = Field(default=6.0, ge=3, le=100)
    """Standard deviations by which the median residual of a node's ranges may exceed that of noise."""
    use_sdp: bool = False
    """Start anew by semidefinite programming when positions stay uncertain; seconds of work, up to 50
    nodes."""
    max_iterations: int = Field(default=50, ge=1, le=1000)
    tracker: Literal["epoch", "kalman", "regularized", "adaptive", "regularized_adaptive"] = "epoch"
    """How epochs in a row go together: `epoch`, each by itself; else by a filter of `repeated_ranging`."""
    maneuver_acceleration_mps2: float = Field(default=6.0, ge=0, le=1000)
    """Standard deviation of each component of a node's acceleration, as its tracker takes it."""
    discrepancy_limit: float = Field(default=3.0, ge=1, le=1000)
    """Mean squared discrepancy of an epoch from what its tracker predicts, over its variance, that is taken
    for noise; `regularized` and `regularized_adaptive` doubt what is beyond."""
    solver: Literal["central", "distributed"] = "central"
    """`distributed`: once started, each node estimates itself from what its neighbours broadcast."""
    sweeps: int = Field(default=2, ge=1, le=100)
    """Broadcasts of each node an epoch with the distributed solver, one a frame."""
    quarantine: QuarantineSettings | None = None
    """Leaves out nodes that contradict the others from epoch to epoch; by default nobody looks."""

    @model_validator(mode="after")
    def _one_at_a_time(self) -> Self:
        if self.solver == "distributed" and self.tracker != "epoch":
            raise ValueError(
                f'solver = "distributed" with tracker = "{self.tracker}": a distributed solver follows its'
                ' nodes itself; allowed is tracker = "epoch"'
            )
        if self.solver == "distributed" and self.quarantine is not None:
            raise ValueError('quarantine with solver = "distributed": nobody sees all; allowed is "central"')
        return self


def usable_nodes(problem: RangeProblem, min_neighbors: int = 4) -> Booleans:
    """(n,) anchors, and the largest set of other nodes that each have enough neighbours in it or among
    anchors."""
    n = problem.nodes
    i, j = problem.links.T
    joined = coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
    joined = joined + joined.T
    usable = np.ones(n, np.bool_)
    while True:
        fewer = usable & (problem.anchor | (joined @ usable.astype(float) >= min_neighbors))
        if (fewer == usable).all():
            return usable
        usable = fewer


def localize(problem: RangeProblem, settings: LocalizationSettings | None = None) -> Positions:
    """Positions of all nodes from nothing but the problem.

    Spherical location, DV-distance and dwMDS for nodes that it does not reach, then least squares over all
    nodes. From the anchors on, one node after another is then held against the mirror image of its position
    in the plane of neighbours that have passed, and moved if that fits better; nodes that no such sequence
    reaches are started anew from other places. Nodes whose ranges contradict the others are left out, as
    suspects.

    Positions and covariances of located nodes come from least squares over located nodes alone. Ambiguous
    nodes have the position that fits best; other nodes that are not located have none. Anchors keep their
    position unless ``anchor_sd`` lets ranges improve it.
    """
    settings = settings or LocalizationSettings()
    suspect = np.zeros(problem.nodes, np.bool_)
    trusted, found = problem, _search(problem, settings)
    while (worst := _contradicted(trusted, found, settings.suspect_sd)) is not None:
        without = suspect | (np.arange(problem.nodes) == worst)
        kept = ~without[problem.links].any(axis=1)
        rest = replace(
            problem, links=problem.links[kept], ranges=problem.ranges[kept], range_sd=problem.range_sd[kept]
        )
        again = _search(rest, settings)
        # In a group of doubt, any node may be in the wrong place, unless all is clear without this one.
        if found.doubtful[worst] and not again.certain:
            break
        suspect, trusted, found = without, rest, again
    return _judged(trusted, settings, found, suspect)


@dataclass(frozen=True)
class _Found:
    """Best positions of the usable nodes, and which fit elsewhere as well, or not well here."""

    solution: Refined
    usable: Booleans
    ambiguous: Booleans
    doubtful: Booleans
    certain: bool
    """Whether one sequence from the anchors on fixes every node that is sharp."""


def _refined(
    problem: RangeProblem, settings: LocalizationSettings, x0: Array, clock0: Array | None, before: int = 0
) -> Refined:
    result = refine(
        problem,
        x0,
        loss=Loss(kind=settings.loss, threshold=settings.loss_threshold),
        clock0=None if clock0 is None else np.nan_to_num(clock0),
        max_iterations=settings.max_iterations,
        tolerance=_TOLERANCE,
    )
    return replace(result, iterations=before + result.iterations)


def _search(problem: RangeProblem, settings: LocalizationSettings) -> _Found:
    """The best solution that the starts lead to, and what is known of others."""
    loss = Loss(kind=settings.loss, threshold=settings.loss_threshold)
    margin = settings.min_mirror_margin
    usable = usable_nodes(problem, settings.min_neighbors)
    first = locate_successively(problem, loss=loss, usable=usable, min_margin=margin)
    x0 = first.x
    missing = usable & ~first.located
    if missing.any():
        x0 = np.where(missing[:, None], dv_distance(problem), x0)
        x0 = dwmds(problem, x0, usable=usable)
    best = _refined(problem, settings, x0, first.clock)
    untried = settings.use_sdp and problem.nodes <= MOST_NODES
    while True:
        passed = mirror_test(problem, best, loss, usable, margin)
        unique = passed.located & ~far(passed.x, best.x, passed.cov)
        ambiguous = doubtful = np.zeros(problem.nodes, np.bool_)
        certain = bool((unique | ~_sharp(best.cov, settings)).all())
        if certain:
            break
        x0 = np.where(passed.located[:, None], passed.x, np.nan)
        again = locate_successively(problem, loss=loss, usable=usable, x0=x0, clock0=passed.clock)
        x0 = np.where(again.located[:, None], again.x, best.x)
        other = _refined(problem, settings, x0, again.clock, best.iterations)
        if other.cost > best.cost - _BETTER:
            x0, ambiguous, doubtful = mirror_ambiguous(problem, best, unique, loss, margin)
            other = _refined(problem, settings, x0, best.clock, best.iterations)
        if other.cost > best.cost - _BETTER and untried:
            untried = False
            x0 = np.where(usable[:, None], sdp_start(problem), np.nan)
            other = _refined(problem, settings, x0, None, best.iterations)
        if other.cost > best.cost - _BETTER:
            break
        best = other
    return _Found(best, usable, ambiguous, doubtful, certain)


def _contradicted(problem: RangeProblem, found: _Found, suspect_sd: float) -> int | None:
    """The node whose own ranges contradict the rest most, if any do.

    Either half of them are too far off, or all of them are longer or shorter by more than moving the node
    explains: a bias of its transponder. The median, and residuals cut off, are deaf to a few ranges that are
    not in line of sight, or that lead to another bad node.
    """
    i, j = problem.links.T
    x, clock = found.solution.x, found.solution.clock
    apart = x[i] - x[j]
    distances = np.linalg.norm(apart, axis=1)
    residuals = problem.ranges - distances
    if clock is not None:
        residuals -= clock[i] - clock[j]
    residuals /= problem.range_sd
    worst, largest = None, suspect_sd
    for node in range(problem.nodes):
        own = np.flatnonzero(((i == node) | (j == node)) & np.isfinite(residuals))
        if not len(own):
            continue
        excess = (np.median(np.abs(residuals[own])) - _MEDIAN) / (_MEDIAN_SD / np.sqrt(len(own)))
        sides = np.where(i[own] == node, 1.0, -1.0)[:, None]
        moves = np.zeros((len(own), 0))
        if not problem.anchor[node]:
            moves = sides * apart[own] / np.maximum(distances[own, None], 1.0)
            moves = np.column_stack([moves, sides]) if problem.clocks else moves
        basis = np.linalg.qr(moves / problem.range_sd[own, None])[0]
        bias = 1 / problem.range_sd[own]
        left = bias - basis @ (basis.T @ bias)
        if np.linalg.norm(left) > _UNTOLD * np.linalg.norm(bias):
            excess = max(excess, abs(left @ residuals[own].clip(-_CUT, _CUT)) / np.linalg.norm(left))
        if excess > largest:
            worst, largest = node, excess
    return worst


def _sharp(cov: Array, settings: LocalizationSettings) -> Booleans:
    """(n,) nodes with a position that is well determined; not those without one."""
    return np.trace(np.nan_to_num(cov, nan=np.inf), axis1=1, axis2=2) <= settings.max_position_sd_m**2


def _judged(
    problem: RangeProblem, settings: LocalizationSettings, found: _Found, suspect: Booleans
) -> Positions:
    """The verdict on every node, and the positions of located nodes by themselves."""
    n, best = problem.nodes, found.solution
    placed = np.isfinite(best.x.sum(axis=1))
    sharp = _sharp(best.cov, settings)
    located = placed & sharp & ~found.ambiguous & ~found.doubtful | problem.anchor
    joined = located[problem.links].all(axis=1)
    among = replace(
        problem, links=problem.links[joined], ranges=problem.ranges[joined], range_sd=problem.range_sd[joined]
    )
    enough = located & usable_nodes(among, settings.min_neighbors)
    final = best
    if not (enough | ~placed).all():
        x0 = np.where(enough[:, None], best.x, np.nan)
        final = _refined(among, settings, x0, best.clock, best.iterations)
    good = enough & _sharp(final.cov, settings)
    outcome = np.full(n, NodeOutcome.SINGULAR, np.int64)
    outcome[found.ambiguous & sharp] = NodeOutcome.AMBIGUOUS
    outcome[found.doubtful & sharp] = NodeOutcome.INCONSISTENT
    outcome[~found.usable | located & ~enough] = NodeOutcome.TOO_FEW_NEIGHBOURS
    outcome[good] = NodeOutcome.LOCATED
    if not final.converged:
        # Two nodes nearer to each other than ranges are sharp may creep on; that need not concern others.
        after = _refined(among, settings, final.x, final.clock, final.iterations)
        outcome[good & far(after.x, final.x, final.cov, _SETTLED)] = NodeOutcome.NOT_CONVERGED
    outcome[suspect] = NodeOutcome.INCONSISTENT
    outcome[problem.anchor] = NodeOutcome.ANCHOR
    x, cov, clock = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    for source, rows in ((best, outcome == NodeOutcome.AMBIGUOUS), (final, good | problem.anchor)):
        x[rows], cov[rows] = source.x[rows], source.cov[rows]
        if source.clock is not None:
            clock[rows] = source.clock[rows]
    return Positions(
        x, cov, outcome, final.cost, final.iterations, suspect, clock if problem.clocks else None
    )

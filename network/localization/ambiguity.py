"""Whether ranges leave more than one place for a node: mirror images of nodes, and of groups of them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from .bound import fisher_information
from .least_squares import Loss, Refined, refine
from .problem import Array, Booleans, Integers, RangeProblem
from .spherical import Located, locate_successively

_SAME = 16.0
"""Squared distance of two positions, in standard deviations, below which they are one."""
_MODES = 10
_RANDOM_STARTS = 8
_FLAPS = 16
_LARGEST_FLAP = 6
_RESTARTS = 3
_CHANCE = 1e-4
"""Probability that noise alone makes a group's cost too large."""


def mirror_test(
    problem: RangeProblem,
    solution: Refined,
    loss: Loss | None = None,
    usable: Booleans | None = None,
    min_margin: float = 20.0,
) -> Located:
    """The nodes whose place is the only one, told by one sequence from the anchors on.

    A node is held against its mirror image in the plane that best fits its neighbours that have passed:
    refined alone from both sides, it passes if one is better by ``min_margin`` in the sum of squared
    residuals. ``x`` is then the better one, which need not be the one in ``solution``.
    """
    return locate_successively(
        problem,
        loss=loss,
        usable=np.isfinite(solution.x.sum(axis=1)) if usable is None else usable,
        x0=solution.x,
        clock0=solution.clock,
        min_margin=min_margin,
        ambiguous_too=False,
    )


def far(x: Array, reference: Array, cov: Array, square: float = _SAME) -> Booleans:
    """(n,) whether positions differ by more than the root of ``square`` standard deviations."""
    result = np.zeros(len(x), np.bool_)
    rows = np.isfinite(x.sum(axis=1)) & np.isfinite(reference.sum(axis=1)) & np.isfinite(cov).all(axis=(1, 2))
    rows &= np.trace(cov, axis1=1, axis2=2) > 0
    step = (x - reference)[rows]
    size = np.einsum("ka,ka->k", step, np.linalg.solve(cov[rows], step[:, :, None])[:, :, 0])
    result[rows] = size > square
    return result


def mirror_ambiguous(
    problem: RangeProblem,
    solution: Refined,
    unique: Booleans,
    loss: Loss | None = None,
    min_margin: float = 20.0,
) -> tuple[Array, Booleans, Booleans]:
    """Search other solutions for the nodes that are not ``unique``, with those that are held in place.

    Groups of nodes that hang together are started from beyond their softest modes, from their mirror image,
    and from successive location that takes the worse side of one ambiguous node, or of a random half of
    them. Returns (n, 3) m, the best positions; (n,) the nodes that are elsewhere in a solution that costs
    less than ``min_margin`` more; (n,) those of groups whose cost is more than the noise explains. Ranges
    to unique nodes carry those nodes' uncertainty.
    """
    known = problem.anchor | unique
    x = solution.x.copy()
    left = ~known & np.isfinite(x.sum(axis=1))
    ambiguous, doubtful = np.zeros(problem.nodes, np.bool_), np.zeros(problem.nodes, np.bool_)
    held = _hold(problem, solution, known)
    i, j = held.links.T
    inside = left[i] & left[j]
    graph = coo_matrix((np.ones(inside.sum()), (i[inside], j[inside])), shape=(problem.nodes,) * 2)
    _, label = connected_components(graph, directed=False)
    for group in np.unique(label[left]):
        members = left & (label == group)
        touching = members[held.links].any(axis=1)
        part = replace(
            held,
            links=held.links[touching],
            ranges=held.ranges[touching],
            range_sd=held.range_sd[touching],
        )
        here = refine(part, x, loss=loss, usable=members)
        best, others = _search_group(part, here, members, loss, min_margin)
        freedom = max(int(touching.sum()) - 3 * int(members.sum()), 1)
        doubtful |= members & (2 * here.cost > chdtri(freedom, _CHANCE))
        for other in others:
            if 2 * (other.cost - best.cost) < min_margin:
                ambiguous |= members & far(other.x, solution.x, solution.cov)
        x[members] = best.x[members]
    return x, ambiguous, doubtful


def _search_group(
    problem: RangeProblem, best: Refined, members: Booleans, loss: Loss | None, min_margin: float
) -> tuple[Refined, list[Refined]]:
    """The best of the solutions that can be found for a group, and all of them."""
    found: list[Refined] = [best]
    for _ in range(_RESTARTS):
        here = best
        for start in _starts(problem, here.x, members, loss, min_margin):
            other = refine(problem, start, loss=loss, usable=members)
            found.append(other)
            if other.cost < best.cost:
                best = other
        if best.cost > here.cost - 1:
            break
    return best, found


def _hold(problem: RangeProblem, solution: Refined, known: Booleans) -> RangeProblem:
    """The problem with the known nodes for anchors."""
    i, j = problem.links.T
    apart = solution.x[i] - solution.x[j]
    d = np.linalg.norm(apart, axis=1, keepdims=True)
    u = np.divide(apart, d, out=np.zeros_like(apart), where=d > 0)
    cov = np.where(known[:, None, None], solution.cov, 0.0)
    variance = problem.range_sd**2 + np.einsum("ka,kab,kb->k", u, cov[i] + cov[j], u)
    clock = np.zeros(problem.nodes) if solution.clock is None else np.where(known, solution.clock, 0.0)
    used = np.isfinite(solution.x.sum(axis=1))[problem.links].all(axis=1)
    return replace(
        problem,
        links=problem.links[used],
        ranges=(problem.ranges - clock[i] + clock[j])[used],
        range_sd=np.sqrt(variance[used]),
        anchor=known,
        anchor_x=solution.x,
        anchor_sd=0.0,
    )


def _starts(
    problem: RangeProblem, x: Array, members: Booleans, loss: Loss | None, min_margin: float
) -> Iterator[Array]:
    """Other places for a group to start from."""
    nodes = np.flatnonzero(members)
    yield from _beyond_soft_modes(problem, x, nodes)
    yield from _flaps(problem, x, nodes)
    edge = np.setdiff1d(problem.links, nodes)
    if len(edge):
        whole = x.copy()
        whole[nodes] = _mirrored(x[nodes], x[edge])
        yield whole

    def grown(other_side: Booleans) -> Located:
        return locate_successively(
            problem, loss=loss, usable=members, min_margin=min_margin, other_side=other_side
        )

    plain = grown(np.zeros(len(x), np.bool_))
    yield np.where(plain.located[:, None], plain.x, x)
    rng = np.random.default_rng(0)
    sides = [np.arange(len(x)) == node for node in np.flatnonzero(plain.margin < min_margin)]
    sides += list(rng.random((_RANDOM_STARTS, len(x))) < 0.5)
    for side in sides:
        start = grown(side)
        yield np.where(start.located[:, None], start.x, x)


def _beyond_soft_modes(problem: RangeProblem, x: Array, nodes: Integers) -> list[Array]:
    """Starts at the other end of the motions that ranges resist least.

    Along a mode, squared distances change by ``2 p t + q t^2``; of the sum of the squares of that, weighted
    for ranges, each start is the minimum other than t = 0, or where there all but is one.
    """
    J, block = fisher_information(problem, np.nan_to_num(x))
    B = 4 if problem.clocks else 3
    rows = (block[nodes][:, None] * B + np.arange(3)).ravel()
    modes = np.linalg.eigh(J[rows[:, None], rows]).eigenvectors[:, :_MODES]
    i, j = problem.links.T
    apart = x[i] - x[j]
    a = 1 / (problem.range_sd**2 * (np.einsum("ka,ka->k", apart, apart) + 1))
    starts = []
    for mode in modes.T:
        motion = np.zeros_like(x)
        motion[nodes] = mode.reshape(-1, 3)
        change = motion[i] - motion[j]
        p, q = np.einsum("ka,ka->k", apart, change), np.einsum("ka,ka->k", change, change)
        pp, pq, qq = a @ (p * p), a @ (p * q), a @ (q * q)
        root = np.sqrt(max(9 * pq * pq - 8 * pp * qq, 0.0))
        starts.append(x - (3 * pq + np.copysign(root, pq)) / (2 * qq) * motion)
    return starts


def _flaps(problem: RangeProblem, x: Array, nodes: Integers) -> list[Array]:
    """Starts with a few nodes folded over together, where that changes the lengths of links least.

    From every node on, the group takes in the neighbour with which its mirror image, in the plane that best
    fits all neighbours of the group, changes lengths least.
    """
    n, members = len(x), set(nodes.tolist())
    around: list[set[int]] = [set() for _ in range(n)]
    for i, j in problem.links.tolist():
        around[i].add(j)
        around[j].add(i)
    typical = float(np.median(problem.range_sd))

    def folded(group: frozenset[int]) -> tuple[float, Array]:
        inner = np.array(sorted(group))
        outer = np.array(sorted(set().union(*(around[i] for i in group)) - group))
        if not len(outer):
            return np.inf, x[inner]
        image = _mirrored(x[inner], x[outer])
        before = np.linalg.norm(x[inner, None] - x[outer], axis=2)
        after = np.linalg.norm(image[:, None] - x[outer], axis=2)
        linked = np.array([[k in around[i] for k in outer] for i in inner])
        return float((((after - before) / typical)[linked] ** 2).sum()), image

    found: dict[frozenset[int], tuple[float, Array]] = {}
    for node in nodes.tolist():
        group = frozenset([node])
        found[group] = folded(group)
        for _ in range(_LARGEST_FLAP - 1):
            near = (set().union(*(around[i] for i in group)) & members) - group
            larger = [group | {k} for k in near]
            if not larger:
                break
            for each in larger:
                if each not in found:
                    found[each] = folded(each)
            group = min(larger, key=lambda each: found[each][0])
    starts = []
    for group in sorted(found, key=lambda each: found[each][0])[:_FLAPS]:
        start = x.copy()
        start[sorted(group)] = found[group][1]
        starts.append(start)
    return starts


def _mirrored(x: Array, points: Array) -> Array:
    """Images of ``x`` (k, 3) in the plane that best fits ``points``, moved off it where they lie in it."""
    centre = points.mean(axis=0)
    values, axes = np.linalg.eigh((points - centre).T @ (points - centre) / len(points))
    off = (x - centre) @ axes[:, 0]
    least = 0.02 * np.sqrt(values[2]) + 1.0
    image = -np.where(off >= 0, 1.0, -1.0) * np.maximum(np.abs(off), least)
    return x + (image - off)[:, None] * axes[:, 0]

"""Distributed refinement of Wan, Wu and Feng: each node a filter of its own, its neighbours taken as known.

As printed (their section 2.2.2): a node of unknown position takes every neighbour for a beacon, beacons and
nodes alike, steps its filter on its own ranges, and when all have done so they broadcast where they are. As
mended, a neighbour's uncertainty counts in R. A sweep is one broadcast of every node of unknown position.
"""

from dataclasses import dataclass

import numpy as np

from . import _fading
from .fading_ekf import FadingEkf, Filter, initial, sage_share, step, stopped
from .plane import distances
from .plane_network import plane_network
from .problem import Array, Booleans, RangeProblem
from .spherical import Neighbors, neighbors


@dataclass(frozen=True)
class RefinedPlane:
    """What a refinement in the plane makes of a start."""

    x: Array
    """(n, 2) m; NaN for nodes without a start."""
    P: Array
    """(n, 2, 2) m^2, what each node states for itself; zero for beacons."""
    steps: int
    stopped: bool
    """Whether the stop rule ended it, and not the number of steps."""
    diverged: Booleans
    """(n,) nodes whose filter was lost (`_fading.LOST_M`); they stand where they were before."""


def refine_distributed(problem: RangeProblem, x0: Array, settings: FadingEkf | None = None) -> RefinedPlane:
    """Sweeps over all nodes of a network in the plane (`plane.in_plane`) from a start x0 (n, 2) m.

    Nodes whose start is NaN take no part, and nobody hears them; rows of beacons are not looked at. Raises
    `LocalizationError` for a start of another shape.
    """
    settings = settings or FadingEkf()
    net = plane_network(problem, x0)
    x, part, free, links = net.x, net.part, net.free, neighbors(problem)
    if settings.noise == "sage_husa":
        return _by_matrices(problem, x, part, free, links, settings)
    sds = settings.initial_sd_m, settings.process_sd_m
    P, Q = (np.tile(sd**2 * np.eye(2), (problem.nodes, 1, 1)) for sd in sds)
    P[problem.anchor] = 0.0
    R = np.full(len(links.other), settings.range_sd_m**2)
    ranges, fading, moving = problem.ranges[links.link], np.ones(problem.nodes), free.copy()
    done = 0
    ended = False
    while done < settings.max_steps and not ended:
        before = x.copy()
        share = sage_share(done + 1, settings.sage_forgetting)
        _fading.sweep(
            links.first, links.other, ranges, part, moving, x, P, Q, R, fading,
            done, settings.max_fading, share, settings.noise == "positive", settings.neighbor_covariance,
        )  # fmt: skip
        done += 1
        ended = stopped(x[free], before[free], settings)
    return RefinedPlane(np.where(part[:, None], x, np.nan), P, done, ended, free & ~moving)


def _by_matrices(
    problem: RangeProblem, x: Array, part: Booleans, free: Booleans, links: Neighbors, settings: FadingEkf
) -> RefinedPlane:
    """The same with the whole matrices of `fading_ekf.step`, a batch of all nodes at once."""
    node = np.repeat(np.arange(problem.nodes), np.diff(links.first))
    slots = np.flatnonzero(free[node] & part[links.other])
    at = np.flatnonzero(free)
    row = np.searchsorted(at, node[slots])
    column = np.arange(len(slots)) - np.searchsorted(row, row)
    heard = np.zeros((len(at), int(column.max(initial=0)) + 1), np.bool_)
    heard[row, column] = True
    other, ranges = np.zeros(heard.shape, np.int64), np.zeros(heard.shape)
    other[row, column], ranges[row, column] = links.other[slots], problem.ranges[links.link[slots]]
    f = initial(x[at], heard.shape[1], settings)
    P = np.zeros((problem.nodes, 2, 2))
    P[at] = f.P
    moving, ended = np.ones(len(at), np.bool_), False
    while f.steps < settings.max_steps and not ended:
        d, H = distances(x[at], x[other])
        innovation, H = np.where(heard, ranges - d, 0.0), np.where(heard[..., None], H, 0.0)
        spread = 0.5 * np.trace(P, axis1=1, axis2=2)[other] * heard if settings.neighbor_covariance else 0.0
        with np.errstate(all="ignore"):
            after = step(f, innovation, H, settings, heard, spread)
        sizes = [np.abs(values).reshape(len(at), -1).max(axis=1) for values in (after.P, after.Q, after.R)]
        good = (np.abs(after.x).max(axis=1) < _fading.LOST_M) & (np.max(sizes, axis=0) < _fading.LOST_M**2)
        moving &= good
        f = _held(f, after, moving)
        before = x[at]
        x[at], P[at] = f.x, f.P
        ended = stopped(f.x, before, settings)
    diverged = np.zeros(problem.nodes, np.bool_)
    diverged[at] = ~moving
    return RefinedPlane(np.where(part[:, None], x, np.nan), P, f.steps, ended, diverged)


def _held(before: Filter, after: Filter, moving: Booleans) -> Filter:
    """The step of filters that are still moving; the others stay."""

    def kept(old: Array, new: Array) -> Array:
        return np.where(moving.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return Filter(
        x=kept(before.x, after.x),
        P=kept(before.P, after.P),
        Q=kept(before.Q, after.Q),
        R=kept(before.R, after.R),
        fading=kept(before.fading, after.fading),
        steps=after.steps,
    )

"""What Gao et al. print of still fleets, done again: the equations 2 to 9, and Fig. 2."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from ..network.fleet import FleetSettings
from ..network.fleet_network import FleetNetwork
from ..network.localization.bound import Bound, cramer_rao
from ..network.localization.chain import LocalizationSettings, localize, usable_nodes
from ..network.localization.dv_distance import dv_distance
from ..network.localization.dwmds import dwmds
from ..network.localization.least_squares import Loss, refine
from ..network.localization.problem import Array, NodeOutcome, RangeProblem
from ..network.localization.spherical import locate_successively
from ..network.radio import RadioSettings
from .parallel import in_order
from .run import generator
from .still import PROTOCOLS, Drawn, StillFleet, draw_still, judge, pooled, restricted

SQUARED = Loss(kind="squared")
TABLE_1 = FleetSettings(nodes=50, anchor_share=0.2, anchor_position_sd_m=0.0)
"""The paper's fleet; that 10 of its nodes are anchors, and know their place, is ours."""

RADII_M = (5e3, 10e3, 20e3, 50e3)
"""The paper's r_c and 2 r_c, the fleet's radius, and TTNT's reach."""
RANGING_ERRORS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40)

EQUATIONS_RADIUS_M = 15e3
RANGE_SD_M = 50.0
NLOS_SHARE = 0.1
NLOS_EVERY = 2
"""Draws of the equations' table that are done again without line of sight on some links: every second."""
SWEEPS = 300

_STEPS = 25
"""Of least squares with ranging errors beyond what linear ones stand for: more of them change little."""


def _spherical(problem: RangeProblem) -> Array:
    """Theorem 1 alone, (n, 3)."""
    return locate_successively(problem, loss=SQUARED, usable=usable_nodes(problem)).x


def _production(problem: RangeProblem, loss: str = "one_sided") -> Array:
    """The chain, (n, 3), with the nodes that it calls located."""
    found = localize(problem, LocalizationSettings.model_validate({"loss": loss}))
    x = found.x.copy()
    x[found.outcome > NodeOutcome.LOCATED] = np.nan
    return x


def _least_squares(problem: RangeProblem) -> Array:
    """Least squares from a cold start, (n, 3), without tests for mirror images or spread.

    They would refuse most of Fig. 2's nodes: its ranging errors are as large as the fleet is high.
    """
    x0 = _spherical(problem)
    missing = np.isnan(x0)
    if missing.any():
        x0 = dwmds(problem, np.where(missing, dv_distance(problem), x0))
    return refine(problem, x0, loss=SQUARED, max_iterations=_STEPS).x


# Sight: by the paper's equations and by ours, from the same ranges. NLOS: a tenth of the links is too long.
_SIGHT = {
    "production chain": lambda problem, _: _production(problem),
    "spherical start alone (Theorem 1)": lambda _, start: start,
    "DV-distance alone": lambda problem, _: dv_distance(problem),
    "mended (2)-(4), unit weights": lambda problem, start: dwmds(problem, start, sweeps=SWEEPS),
    "mended (2)-(4), weights (5)-(9)": (
        lambda problem, start: dwmds(problem, start, weights="adaptive", sweeps=SWEEPS)
    ),
    "printed (3)-(4), weights (5)-(9)": (
        lambda problem, start: dwmds(problem, start, update="printed", weights="adaptive")
    ),
}
_NLOS = {
    "production chain": lambda problem, _: _production(problem),
    "chain with Huber's loss": lambda problem, _: _production(problem, "huber"),
    "chain with squared loss": lambda problem, _: _production(problem, "squared"),
    "mended (2)-(4), weights (5)-(9)": (
        lambda problem, start: dwmds(problem, start, weights="adaptive", sweeps=SWEEPS)
    ),
}


def equations(seed: int, draws: int) -> Iterator[list[tuple[str, Drawn]]]:
    """For each draw, estimates by each method, the same ranges for all; `equations_table` sums them up."""
    radio = RadioSettings(link_radius_m=EQUATIONS_RADIUS_M, range_sd_m=RANGE_SD_M, loss_probability=0)
    sight = FleetNetwork(fleet=TABLE_1, radio=radio)
    nlos = FleetNetwork(fleet=TABLE_1, radio=radio.model_copy(update={"nlos_share": NLOS_SHARE}))

    def work(i: int) -> list[tuple[str, Drawn]]:
        rows = []
        both = [(sight, _SIGHT, ""), (nlos, _NLOS, ", NLOS")]
        for network, methods, suffix in both[: 2 if i % NLOS_EVERY == 0 else 1]:
            still = draw_still(network, partial(generator, seed, i))
            problem = still.problem("dmdg")
            bound, start = cramer_rao(problem, still.x), _spherical(problem)
            for name, method in methods.items():
                rows.append((name + suffix, judge(method(problem, start), still, problem, bound)))
        return rows

    return in_order(work, range(draws))


def equations_table(draws: list[list[tuple[str, Drawn]]]) -> list[dict[str, Any]]:
    """One row for each method of `equations`."""
    by_method: dict[str, list[Drawn]] = {}
    for name, drawn in chain.from_iterable(draws):
        by_method.setdefault(name, []).append(drawn)
    return [{"method": name, **pooled(drawn)} for name, drawn in by_method.items()]


@dataclass(frozen=True)
class Figure2:
    """Means over draws, for each protocol (radii, ranging errors)."""

    coverage: dict[str, Array]
    """Share of the nodes without a known position that have four usable neighbours and a geometry that
    leaves no direction open."""
    error: dict[str, Array]
    """m, mean distance from the truth of nodes that are covered; NaN where none are."""
    relative: dict[str, Array]
    """``error`` over the mean length of the links."""


def figure_2(seed: int, draws: int) -> Iterator[list[Drawn]]:
    """For each draw an estimate for every radius, ranging error and protocol; `figure_2_of` sums them up.

    The error of a range is uniform within plus and minus its share of the distance; a link counts if the
    distance and the measured range are both within the radius.
    """
    reach = RadioSettings(link_radius_m=1e6, range_sd_m=1e-3, range_uniform_share=1.0, loss_probability=0)
    network = FleetNetwork.model_construct(fleet=TABLE_1, radio=reach)

    def work(i: int) -> list[Drawn]:
        still = draw_still(network, partial(generator, seed, i))
        a, b = still.seen.pairs.T
        distance = np.linalg.norm(still.x[a] - still.x[b], axis=1)
        noise = still.seen.ranges[0] - distance  # within plus and minus the distance
        found = []
        for radius in RADII_M:
            for share in RANGING_ERRORS:
                ranges = distance + share * noise
                seen = replace(
                    still.seen,
                    ranges=ranges[None],
                    # At least a metre, so that the weights of near pairs stay finite.
                    range_sd=np.maximum(share / np.sqrt(3) * ranges, 1.0)[None],
                    heard=((distance <= radius) & (ranges <= radius))[None],
                )
                now = replace(still, seen=seen)
                found += [_covered(now, now.problem(kind)) for kind in PROTOCOLS]
        return found

    return in_order(work, range(draws))


def _covered(still: StillFleet, problem: RangeProblem) -> Drawn:
    """Least squares among the usable nodes; the others have neither estimate nor bound."""
    kept = np.flatnonzero(usable_nodes(problem))
    held = restricted(problem, kept)
    bound = cramer_rao(held, still.x[kept])
    x, cov = np.full((problem.nodes, 3), np.nan), np.full((problem.nodes, 3, 3), np.nan)
    x[kept], cov[kept] = _least_squares(held), bound.cov
    localizable = np.zeros(problem.nodes, bool)
    localizable[kept] = bound.localizable
    return judge(x, still, problem, Bound(cov, localizable))


def figure_2_of(draws: list[list[Drawn]]) -> Figure2:
    """The curves of `figure_2`'s draws."""
    cells = [pooled(drawn) for drawn in zip(*draws, strict=True)]
    shape = len(RADII_M), len(RANGING_ERRORS), len(PROTOCOLS)

    def by_protocol(name: str) -> dict[str, Array]:
        values = np.array([cell[name] for cell in cells], float).reshape(shape)
        return {kind: values[..., p] for p, kind in enumerate(PROTOCOLS)}

    return Figure2(
        by_protocol("coverage"), by_protocol("position_error_m"), by_protocol("position_error_over_range")
    )

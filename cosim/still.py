"""A fleet at one instant, and what can be made of its ranges: the draws of `localize`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator

from ..network import leach
from ..network.fleet import OWN_SHIP, draw_formation
from ..network.fleet_network import FleetNetwork
from ..network.localization.bound import Bound, flipped
from ..network.localization.problem import Array, Booleans, Integers, RangeProblem
from ..network.observations import Observations
from ..network.radio import Radio

PROTOCOLS = ("dmdg", "leach")


@dataclass(frozen=True)
class StillFleet:
    """n nodes in the level frame of the cylinder, flat, and their m measurements of each other."""

    x: Array
    """(n, 3) m, NED from the centre of the cylinder's base."""
    anchor: Booleans
    """(n,)"""
    anchor_x: Array
    """(n, 3) m, where anchors take themselves to be."""
    anchor_sd: float
    """m"""
    head: Booleans
    """(n,) LEACH's cluster heads of the instant."""
    seen: Observations
    altitude_sd: float
    """m"""
    clocks: bool
    """Whether ranges hold clock offsets."""

    def problem(self, kind: str) -> RangeProblem:
        """What there is to locate the nodes by under DMDG or LEACH (``"dmdg"``, ``"leach"``)."""
        used = self.seen.heard[0].copy()
        i, j = self.seen.pairs.T
        if kind == "leach":
            used &= self.head[i] | self.head[j]
        heights = self.seen.altitude
        return RangeProblem(
            links=self.seen.pairs[used],
            ranges=self.seen.ranges[0, used],
            range_sd=self.seen.range_sd[0, used],
            anchor=self.anchor,
            anchor_x=self.anchor_x,
            anchor_sd=self.anchor_sd,
            height=None if heights is None else heights[0],
            height_sd=self.altitude_sd if heights is not None else 1.0,
            clocks=self.clocks,
        )


def draw_still(network: FleetNetwork, generator: Callable[[str], Generator]) -> StillFleet:
    """One draw; ``generator`` gives the random numbers of "fleet", "radio" and "protocol"."""
    formation = draw_formation(network.fleet, generator("fleet"))
    x, n = formation.home, network.fleet.nodes
    radio = Radio(network.radio, n, generator("radio"), formation.anchor)
    seen = radio.observe(np.zeros(1), x[None], np.zeros((1, n, 3)), -x[None, :, 2])
    heads_rng = generator("protocol").spawn(1)[0]
    return StillFleet(
        x=x,
        anchor=formation.anchor,
        anchor_x=x + formation.anchor_position_error,
        anchor_sd=network.fleet.anchor_position_sd_m,
        head=leach.elect_heads(n, 1, network.protocol.heads, heads_rng)[0],
        seen=seen,
        altitude_sd=network.radio.assumed_altitude_sd_m,
        clocks=network.radio.ranging == "one_way",
    )


def restricted(problem: RangeProblem, kept: Integers) -> RangeProblem:
    """The same among the nodes ``kept`` (k,) alone, which are numbered anew in their order."""
    place = np.full(problem.nodes, -1)
    place[kept] = np.arange(len(kept))
    both = (place[problem.links] >= 0).all(axis=1)
    return replace(
        problem,
        links=place[problem.links[both]],
        ranges=problem.ranges[both],
        range_sd=problem.range_sd[both],
        anchor=problem.anchor[kept],
        anchor_x=problem.anchor_x[kept],
        height=None if problem.height is None else problem.height[kept],
    )


@dataclass(frozen=True)
class Drawn:
    """One estimate of the nodes of one draw that are no anchors, b of them."""

    error: Array
    """(b,) m, distance from the truth; NaN for nodes without an estimate."""
    bound: Array
    """(b,) m, root of the trace of the Cramer-Rao bound; NaN for nodes that cannot be located."""
    flipped: Booleans
    """(b,) estimates that noise does not explain."""
    range: float
    """m, mean length of the links."""
    own_variance: Array
    """(3,) m^2, NED, the bound of the own ship; NaN where it cannot be located."""


def judge(x: Array, still: StillFleet, problem: RangeProblem, bound: Bound) -> Drawn:
    """Estimated positions (n, 3), NaN where there are none, against the truth and the bound."""
    blind = ~still.anchor
    lengths = np.linalg.norm(np.diff(still.x[problem.links], axis=1), axis=2)
    return Drawn(
        error=np.linalg.norm(x - still.x, axis=1)[blind],
        bound=bound.sd[blind],
        flipped=flipped(x, still.x, bound.cov)[blind],
        range=float(lengths.mean()) if len(lengths) else np.nan,
        own_variance=np.diag(bound.cov[OWN_SHIP]).copy(),
    )


def pooled(draws: Iterable[Drawn]) -> dict[str, Any]:
    """Figures of an estimator over draws.

    ``rmse_over_crlb`` is the root of the summed squared errors over the summed bounds, of nodes that have
    both, with its standard deviation over draws; ``node_over_crlb`` the root mean square of each error in
    its own bound, in which weak nodes count as much as others. ``coverage``: estimated and localisable.
    """
    rows, range_m, own = [], [], []
    for drawn in draws:
        both = np.isfinite(drawn.error) & np.isfinite(drawn.bound)
        error, bound = drawn.error[both], drawn.bound[both]
        counts = len(error), len(drawn.error), np.isfinite(drawn.bound).sum(), (drawn.flipped & both).sum()
        sums = np.sum(error**2), np.sum(bound**2), np.sum((error / bound) ** 2), np.sum(error)
        rows.append([*counts, *sums])
        range_m.append(drawn.range)
        own.append(drawn.own_variance)
    table = np.array(rows, float)
    located, blind, localizable, astray, square, bound_square, ratio_square, size = table.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(square / bound_square)
        # Delta method on the ratio of two sums over independent draws.
        spread = np.sqrt(np.sum((table[:, 4] - ratio**2 * table[:, 5]) ** 2)) / bound_square / (2 * ratio)
        return {
            "draws": len(table),
            "coverage": located / blind,
            "localizable": localizable / blind,
            "position_error_m": size / located,
            "position_error_over_range": size / located / mean_known(range_m),
            "position_rmse_m": np.sqrt(square / located),
            "own_ship_crlb_m": np.sqrt(mean_known(own)),
            "crlb_m": np.sqrt(bound_square / located),
            "rmse_over_crlb": ratio,
            "rmse_over_crlb_sd": spread,
            "node_over_crlb": np.sqrt(ratio_square / located),
            "flipped": astray / located,
        }


def mean_known(rows: Sequence[Any] | Array) -> Array:
    """Mean over rows, of what is finite; NaN where nothing is."""
    values = np.array(rows, float)
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0)

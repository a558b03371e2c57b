"""Nodes on the ground, located by the aircraft that flies past, over many draws of nodes and ranges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..aircraft.flight import Flight
from ..network.ground import GroundSettings, Leg, Overheard, fly_past, overhear
from ..network.localization import overflight
from ..network.localization.cubature import Filter
from ..network.localization.overflight import Fix, Passed
from ..network.localization.problem import LocalizationError
from ..network.record import Array, Booleans
from .parallel import in_order
from .run import generator

Progress = Callable[[float, float], None]
PREFIXES = 16
"""Times at which least squares is done with what has been heard by then."""
_BLOCK = 50
"""Draws that are worked on at once."""


@dataclass(frozen=True)
class GroundFixes:
    """What an estimator makes of the nodes, (draws, n, ...)."""

    x: Array
    """(..., 3) m NED in the leg's frame; NaN for nodes that hear too little."""
    cov: Array
    """(..., 3, 3) m^2"""
    ambiguous: Booleans


@dataclass(frozen=True)
class Ground:
    """Draws of nodes, (draws, n, ...), and what comes of them."""

    leg: Leg
    x: Array
    """(..., 3) m, true places."""
    bound: Array
    """(..., 3, 3) m^2"""
    fixes: dict[str, GroundFixes]
    """By estimator."""
    early_bound: Array
    """(draws, n, p) m^2, traces, with what has been heard by the times of `prefixes`."""
    early_squares: Array
    """(draws, n, p) m^2, squared error of the likelier side by least squares."""
    early_ambiguous: Booleans
    """(draws, n, p)"""


def prefixes(leg: Leg) -> Array:
    """Times (p,), s from brake release, evenly from where there are beacons enough to the end of the leg."""
    first = leg.time[min(overflight.LEAST_BEACONS, len(leg.time) - 1)]
    return np.linspace(first, leg.time[-1], PREFIXES)


def locate_ground(
    flight: Flight, settings: GroundSettings, draws: int, seed: int, progress: Progress | None = None
) -> Ground:
    """Draw nodes and ranges, and locate them by each estimator. Whatever the cores, the result is the same.

    Raises `LocalizationError` where no node hears enough, ValueError for a flight that does not hold the leg.
    """
    leg = fly_past(flight, settings)
    sources = ("ground nodes", "ground ranges", "ground own position")
    runs = [
        overhear(leg, settings, *(generator(seed, draw, source) for source in sources))
        for draw in range(draws)
    ]
    blocks = [runs[i : i + _BLOCK] for i in range(0, draws, _BLOCK)]
    parts: list[Ground] = []
    for part in in_order(partial(_located, leg, settings), blocks):
        parts.append(part)
        if progress:
            progress(len(parts), len(blocks))

    def joined(of: Callable[[Ground], Any]) -> Any:
        return np.concatenate([of(part) for part in parts])

    fixes = {
        name: GroundFixes(
            joined(lambda part, name=name: part.fixes[name].x),
            joined(lambda part, name=name: part.fixes[name].cov),
            joined(lambda part, name=name: part.fixes[name].ambiguous).astype(bool),
        )
        for name in settings.estimators
    }
    found = Ground(
        leg=leg,
        x=joined(lambda part: part.x),
        bound=joined(lambda part: part.bound),
        fixes=fixes,
        early_bound=joined(lambda part: part.early_bound),
        early_squares=joined(lambda part: part.early_squares),
        early_ambiguous=joined(lambda part: part.early_ambiguous).astype(bool),
    )
    if not np.isfinite(found.bound).any():
        raise LocalizationError(
            f"ground.link_radius_m = {settings.link_radius_m:g} m: no node hears"
            f" {overflight.LEAST_BEACONS} beacons"
        )
    return found


def _located(leg: Leg, settings: GroundSettings, runs: Sequence[Overheard]) -> Ground:
    own_sd = settings.own_position_sd_m
    own = np.stack([run.own_error for run in runs])[:, None]
    x = np.stack([run.x for run in runs])
    passed = Passed(
        anchors=np.broadcast_to((leg.beacons + own)[:, None], (*x.shape[:2], *leg.beacons.shape)),
        ranges=np.stack([run.ranges for run in runs]),
        heard=np.stack([run.heard for run in runs]),
        noise=settings.noise,
        earth_centre=leg.earth_centre,
        earth_radius=leg.earth_radius,
        height_sd=float(np.hypot(settings.height_sd_m, own_sd)),
    )

    def least(what: Passed) -> Array:
        there = Fix(x + own, overflight.bound(what, x + own), np.zeros(x.shape[:2], bool))
        return overflight.on_the_ground(there, what, own_sd).cov

    early: list[tuple[Array, Array, Booleans]] = []
    for last_s in prefixes(leg):
        so_far = passed.among(leg.time <= last_s + 1e-6)
        fix = overflight.on_the_ground(overflight.least_squares(so_far), so_far, own_sd)
        variance = np.trace(least(so_far), axis1=-2, axis2=-1)
        early.append((variance, np.sum((fix.x - x) ** 2, axis=-1), fix.ambiguous))
    start, fixes = overflight.begun(passed), {}
    for name in settings.estimators:
        fix = overflight.least_squares(passed) if name == "nls" else overflight.filtered(start, Filter(name))
        fixes[name] = GroundFixes(*overflight.on_the_ground(fix, passed, own_sd))
    early_bound, early_squares, early_ambiguous = (
        np.stack(column, axis=-1) for column in zip(*early, strict=True)
    )
    return Ground(leg, x, least(passed), fixes, early_bound, early_squares, early_ambiguous.astype(bool))

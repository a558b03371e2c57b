"""The draws of the moving anchor's experiment, and each method on them."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...align.consistency import nees
from ...network.localization.beacons import (
    Heard,
    least_squares,
    linear,
    linear_weighted,
    listening,
    quasi_likelihood,
)
from ...network.localization.bounded import posterior_mean
from ...network.localization.cubature import Filter, Rules, State, Threshold, track_beacons
from ...network.localization.plane import distances, range_bound
from ...network.localization.ranging import PathLossErrors, RangeNoise, UniformErrors
from ..run import generator
from .results import Array
from .xu2019_settings import MovingAnchor

Random = Callable[[int, str], np.random.Generator]
"""Of a draw and a source."""
EVERY = 4
"""Of what a node hears, one range in so many makes the start of the filters as mended."""
SHOWN = ("ckf_wide", "srckf_wide", "srckf_printed", "srckf")
"""Filters of the figures."""
BOX = 8.0
"""Standard deviations of a least-squares solution around it in which the rings' common part is looked for."""


@dataclass(frozen=True)
class Sample:
    """Nodes of some draws, one after another, and what they hear."""

    x: Array
    """(k, 2) m."""
    height: Array
    """(k,) m."""
    seen: Heard
    noise: RangeNoise
    bound: Array
    """(k, 2, 2) m^2, Cramer-Rao, of Gaussian errors of this variance at the true distance."""


@dataclass(frozen=True)
class Outcome:
    """What a method makes of a sample."""

    error: Array
    """(k, 2) m."""
    nees: Array | None = None
    """(k,)"""
    used: Array | None = None
    """(k,) share of the ranges taken in."""

    @property
    def squares(self) -> Array:
        """(k,) m^2"""
        return np.sum(self.error**2, axis=-1)


def sample(
    settings: MovingAnchor,
    radius: float,
    errors: UniformErrors | PathLossErrors,
    draws: Sequence[int],
    places: Callable[[int], np.random.Generator],
    ranges: Callable[[int], np.random.Generator],
) -> Sample:
    """The nodes of ``draws`` with the errors of the ranges they hear, by generators of each draw."""
    beacons, n = settings.beacons(), settings.nodes
    unit = np.concatenate([places(draw).random((n, 3)) for draw in draws])
    x, height = unit[:, :2] * [settings.width_m, settings.depth_m], unit[:, 2] * settings.terrain_m
    rise = np.broadcast_to((settings.altitude_m - height)[:, None], (len(x), len(beacons)))
    d, _ = distances(x, beacons, rise)
    measured = [errors.draw(d[i * n : (i + 1) * n], ranges(draw)) for i, draw in enumerate(draws)]
    seen = listening(beacons, np.concatenate(measured), d <= radius, rise)
    sd = seen.sd(errors.noise, distances(x, seen.anchors, seen.rise)[0])
    return Sample(x, height, seen, errors.noise, range_bound(x, seen.anchors, sd, seen.rise))


def field_sample(
    settings: MovingAnchor,
    radius: float,
    draws: Sequence[int],
    random: Random,
    errors: UniformErrors | PathLossErrors | None = None,
) -> Sample:
    """A deployment for each draw."""
    errors = errors or settings.errors
    places, ranges = (lambda draw: random(draw, "deployment")), (lambda draw: random(draw, "ranges"))
    return sample(settings, radius, errors, draws, places, ranges)


@dataclass(frozen=True)
class Shown:
    """The Monte Carlo runs of the figures: one deployment, ranges drawn anew for each run."""

    x: Array
    """(nodes, 2) m."""
    errors: dict[str, Array]
    """(runs, nodes, 2) m, by method."""


def shown(settings: MovingAnchor, radius: float, seed: int) -> Shown:
    """All methods on the deployment of draw 0."""
    runs = range(settings.monte_carlo_runs)

    def place(_: int) -> np.random.Generator:
        return generator(seed, 0, "deployment")

    def ranges(run: int) -> np.random.Generator:
        return generator(seed, run, "monte carlo")

    s = sample(settings, radius, settings.errors, runs, place, ranges)
    found = methods(settings, s, SHOWN)
    errors = {key: outcome.error.reshape(len(runs), -1, 2) for key, outcome in found.items()}
    return Shown(s.x[: settings.nodes], errors)


def pooled(settings: MovingAnchor, parts: Sequence[dict[str, Outcome]]) -> dict[str, Outcome]:
    """Outcomes of several blocks as one, their arrays (draws, nodes, ...)."""

    def joined(arrays: Sequence[Array | None]) -> Array | None:
        known = [a for a in arrays if a is not None]
        if not known:
            return None
        whole = np.concatenate(known)
        return whole.reshape(-1, settings.nodes, *whole.shape[1:])

    together: dict[str, Outcome] = {}
    for key in parts[0]:
        error = joined([part[key].error for part in parts])
        assert error is not None
        told, used = joined([part[key].nees for part in parts]), joined([part[key].used for part in parts])
        together[key] = Outcome(error, told, used)
    return together


def methods(settings: MovingAnchor, s: Sample, only: tuple[str, ...] | None = None) -> dict[str, Outcome]:
    """The methods of the tables of radii, by key; all filters, or some."""
    seen, noise = s.seen, s.noise
    start = linear(seen)
    slant, by_length = (least_squares(h, noise, start) for h in (replace(seen, rise=0.0), seen))
    quasi = quasi_likelihood(seen, noise, start)
    half = BOX * np.sqrt(np.trace(quasi.cov, axis1=1, axis2=2))
    exact = posterior_mean(seen, settings.range_error_share, quasi.x, half)
    found = {
        "linear": Outcome(start - s.x),
        "linear_weighted": Outcome(linear_weighted(seen, noise) - s.x),
        "slant": _told(s, slant.x, slant.cov),
        "least_squares": _told(s, by_length.x, by_length.cov),
        "quasi": _told(s, quasi.x, quasi.cov),
        "exact": _told(s, exact.x, exact.cov),
    }
    return found | {key: _filtered(s, state) for key, state in filters(settings, s, only).items()}


def filters(settings: MovingAnchor, s: Sample, only: tuple[str, ...] | None = None) -> dict[str, State]:
    """The filters' last states, by key: as published from the linear solution of all ranges, as mended from
    a start that takes some of the ranges, and leaves the others to the filter."""
    printed, size = Threshold.PRINTED, Threshold.SIZE
    wide = linear(s.seen), np.tile(settings.initial_sd_m**2 * np.eye(2), (len(s.x), 1, 1))
    first, rest = shared_out(s.seen)
    start = quasi_likelihood(first, s.noise, linear_weighted(first, s.noise))
    own = start.x, start.cov
    root, alpha, share = Filter.SQUARE_ROOT, settings.threshold_m, settings.threshold_share
    informative = Rules(threshold=Threshold.INFORMATION, alpha=share)
    asked = {
        "ckf_wide": (Filter.CUBATURE, wide, s.seen, Rules()),
        "srckf_wide": (root, wide, s.seen, Rules()),
        "srckf_printed": (root, wide, s.seen, Rules(threshold=printed, alpha=alpha)),
        "srckf_noise": (root, wide, s.seen, Rules(process_noise_is_R=True)),
        "srckf_size": (root, own, rest, Rules(threshold=size, alpha=alpha)),
        "srckf_information": (root, own, rest, informative),
        "ekf": (Filter.EXTENDED, own, rest, Rules()),
        "ckf": (Filter.CUBATURE, own, rest, Rules()),
        "srckf": (root, own, rest, Rules()),
    }
    return {
        key: last_state(kind, *begin, seen, s.noise, rules)
        for key, (kind, begin, seen, rules) in asked.items()
        if only is None or key in only
    }


def last_state(
    kind: Filter, x0: Array, P0: Array, seen: Heard, noise: RangeNoise, rules: Rules | None = None
) -> State:
    """What a filter comes to after all beacons."""
    states = track_beacons(kind, x0, P0, seen.anchors, seen.ranges, noise, seen.heard, seen.rise, rules)
    return deque(states, maxlen=1)[0]


def shared_out(seen: Heard) -> tuple[Heard, Heard]:
    """Every fourth of the ranges that a node hears, and the others: none is used twice."""
    first = seen.heard & (np.cumsum(seen.heard, axis=-1) % EVERY == 0)
    return replace(seen, heard=first), replace(seen, heard=seen.heard & ~first)


def _filtered(s: Sample, state: State) -> Outcome:
    told = _told(s, state.x, state.P)
    return replace(told, used=state.used / s.seen.heard.sum(axis=-1))


def _told(s: Sample, x: Array, cov: Array) -> Outcome:
    # A covariance that a threshold has brought to nothing, or that is none, has no consistency to speak of.
    cov = np.where(np.isfinite(cov).all(axis=(1, 2), keepdims=True), cov, 0.0)
    regular = np.linalg.det(cov) > 1e-12 * np.linalg.det(s.bound)
    safe = np.where(regular[:, None, None], cov, np.eye(2))
    return Outcome(x - s.x, np.where(regular, nees(x - s.x, safe), np.inf))

"""The radio: which nodes hear each other, and what they measure of each other."""

import math
from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field

from ..sins.settings import Settings
from ._geometry import distances_and_rates
from ._held import Held
from .clock import SPEED_OF_LIGHT, Clocks, ClockSettings
from .disturbances import Disturbances
from .observations import Observations, node_pairs

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

_REFERENCE_M = 1_000.0
_NEAREST_M = 1.0

# One child generator each, in this order: a new effect joins at the end, so that old draws stay.
_EFFECTS = (
    "range",
    "range_uniform",
    "range_rate",
    "loss",
    "link_bias",
    "shadowing",
    "nlos",
    "nlos_excess",
    "biased",
    "altitude",
    "altitude_bias",
    "clock",
    "blocked",
)


_Draw = Callable[[Generator, tuple[int, ...]], Array]
_NORMAL: _Draw = Generator.standard_normal
_UNIFORM: _Draw = Generator.random
_EXCESS: _Draw = Generator.standard_exponential


class RadioSettings(Settings):
    """Links and measurements of a pair of nodes. Draws of different pairs, nodes and epochs are independent.

    Gao et al. give a message radius r_c of 5 km, neighbours at up to 2 r_c, and 50 km for TTNT. Of 50 nodes
    in a cylinder of 20 km by 5 km one has 2.3, 9.4 and 49 others in reach at these. 5 km leaves four of five
    nodes without the four neighbours that a position takes, and every fleet in pieces; 10 km leaves one of
    25 without; from 15 km on (30 nodes: from 20 km on) all but one in 10,000 have them.
    """

    link_radius_m: float = Field(default=50_000.0, ge=1, le=1e7)
    """Distance at which the received power falls to the receiver's sensitivity, without shadowing."""
    path_loss_exponent: float = Field(default=2.0, ge=1, le=8)
    """2 in free space: 6 dB a doubling of the distance."""
    tx_power_dbm: float = Field(default=53.0, ge=-50, le=100)
    """53 dBm is 200 W, a data-link terminal's."""
    carrier_mhz: float = Field(default=1_500.0, ge=1, le=1e5)
    """The loss up to 1 km is that of free space at this frequency."""
    shadowing_sd_db: float = Field(default=0.0, ge=0, le=30)
    """Log-normal shadowing of each link, constant over a run."""
    loss_probability: float = Field(default=0.02, ge=0, le=1)
    """Of a packet, and so of a pair's ranging at an epoch."""

    range_sd_m: float = Field(default=50.0, ge=1e-3, le=1e5)
    """White Gaussian noise of a range (Gao et al., Table 2 and Fig. 3: 50 m)."""
    range_sd_share: float = Field(default=0.0, ge=0, le=1)
    """White Gaussian noise as a share of the distance, beside `range_sd_m`."""
    range_uniform_share: float = Field(default=0.0, ge=0, le=1)
    """White noise uniform within +- this share of the distance, beside the others (Gao et al., Fig. 2)."""
    range_bias_sd_m: float = Field(default=0.0, ge=0, le=1e5)
    """Bias of each link, constant over a run."""
    range_rate_sd_mps: float = Field(default=0.03, ge=1e-4, le=1e3)
    """White noise of a range rate; 0.03 m/s is a relative stability of 1e-10 (Gao et al., section 2.1)."""
    ranging: Literal["two_way", "one_way"] = "two_way"
    """Two-way: the clocks cancel. One-way: the difference of two clocks stands in ranges and range rates."""
    clock: ClockSettings = ClockSettings()

    biased_nodes: float = Field(default=0.0, ge=0, le=1)
    """Share of nodes whose transponder errs by `node_bias_m` in each range that it takes part in."""
    node_bias_m: float = Field(default=300.0, ge=-1e5, le=1e5)
    nlos_share: float = Field(default=0.0, ge=0, le=1)
    """Share of links without line of sight: the signal makes a detour."""
    nlos_mean_m: float = Field(default=150.0, gt=0, le=1e5)
    """Mean of the detour, exponentially distributed."""
    nlos_coherence_s: float = Field(default=10.0, ge=0.01, le=1e5)
    """Interval at which the links without line of sight, and their detours, are drawn anew."""

    altitude_sd_m: Annotated[float, Field(strict=True, ge=1e-3, le=1e5)] | None = None
    """White noise of a node's barometric altitude; without it nodes know none."""
    altitude_bias_sd_m: float = Field(default=0.0, ge=0, le=1e5)
    """Bias of each node's altitude, constant over a run."""

    @property
    def sensitivity_dbm(self) -> float:
        """Power received over `link_radius_m` without shadowing, the least that carries a packet."""
        reference_db = 20 * math.log10(4 * math.pi * _REFERENCE_M * self.carrier_mhz * 1e6 / SPEED_OF_LIGHT)
        beyond_db = 10 * self.path_loss_exponent * math.log10(self.link_radius_m / _REFERENCE_M)
        return self.tx_power_dbm - reference_db - beyond_db

    @property
    def assumed_altitude_sd_m(self) -> float:
        """Standard deviation of a measured altitude, its bias included; NaN without an altimeter."""
        return (
            math.nan
            if self.altitude_sd_m is None
            else math.hypot(self.altitude_sd_m, self.altitude_bias_sd_m)
        )

    def power_dbm(self, distance_m: Array | float, shadowing_db: Array | float = 0.0) -> Array:
        """Received power at distances: log-distance path loss, isotropic antennas."""
        return self.sensitivity_dbm + self.link_margin_db(distance_m, shadowing_db)

    def link_margin_db(self, distance_m: Array | float, shadowing_db: Array | float = 0.0) -> Array:
        """Received power above the sensitivity, flat nearer than 1 m; not negative where a link exists."""
        decades = np.log10(np.maximum(distance_m, _NEAREST_M) / self.link_radius_m)
        return shadowing_db - 10 * self.path_loss_exponent * decades

    def assumed_range_sd(self, range_m: Array) -> Array:
        """Standard deviation, m, that a receiver states of a measured range: noise and link bias.

        Nobody tells it of detours and of biased transponders.
        """
        constant = self.range_sd_m**2 + self.range_bias_sd_m**2
        share = self.range_sd_share**2 + self.range_uniform_share**2 / 3
        return np.sqrt(constant + share * range_m**2)


class Radio:
    """The radios of a fleet.

    ``rng`` is spawned once for each effect, and each effect's child once for each node; pair (i, j), j < i,
    draws from node i's. So neither a further node nor an effect that is switched on changes other draws.
    ``anchor`` (n,) marks the nodes whose clocks keep network time; without it none does.
    """

    def __init__(
        self,
        settings: RadioSettings,
        nodes: int,
        rng: Generator,
        anchor: Booleans | None = None,
        disturbed: Disturbances | None = None,
    ) -> None:
        self.settings, self._disturbed = settings, disturbed
        self.pairs = node_pairs(nodes)
        children: dict[str, Generator] = dict(zip(_EFFECTS, rng.spawn(len(_EFFECTS)), strict=True))
        anchor = np.zeros(nodes, bool) if anchor is None else anchor
        self._clocks = Clocks(settings.clock, anchor, children.pop("clock"))
        self._children, self._nodes = children, nodes
        self._rngs: dict[str, list[Generator]] = {}

        def constant(sd: float, of: Callable[[str, _Draw, int], Array], effect: str) -> Array | float:
            return sd * of(effect, _NORMAL, 1)[0] if sd else 0.0

        link_bias = constant(settings.range_bias_sd_m, self._of_pairs, "link_bias")
        self._shadowing = constant(settings.shadowing_sd_db, self._of_pairs, "shadowing")
        self._altitude_bias = constant(settings.altitude_bias_sd_m, self._of_nodes, "altitude_bias")
        self.biased: Booleans = np.zeros(nodes, bool)
        biased = round(settings.biased_nodes * nodes)
        if biased:
            key = self._of_nodes("biased", _UNIFORM, 1)[0]
            self.biased[np.argsort(key, kind="stable")[:biased]] = True
        bias = settings.node_bias_m * self.biased
        self._range_bias: Array = link_bias + bias[self.pairs[:, 0]] + bias[self.pairs[:, 1]]
        self._detours = Held(settings.nlos_coherence_s, self._draw_detours)
        self._blocked = Held(
            settings.nlos_coherence_s,
            lambda rows: settings.nlos_mean_m * self._of_pairs("blocked", _EXCESS, rows),
        )

    def linked(self, distance: Array, lost_decades: Array | float = 0.0) -> Booleans:
        """Which pairs hear each other at distances (..., n, n), m, with the link radius so many decades less;
        nobody is linked to itself."""
        n = distance.shape[-1]
        shadowing = np.zeros((n, n))
        i, j = self.pairs.T
        shadowing[i, j] = shadowing[j, i] = self._shadowing
        margin = self.settings.link_margin_db(distance, shadowing) - self._power_lost_db(lost_decades)
        return (margin >= 0) & ~np.eye(n, dtype=bool)

    def lost_decades(self, t: Array, x: Array) -> Array | float:
        """(s, n, n) decades by which pairs' link radius falls at times ``t`` (s,), at ``x`` (s, n, 3)."""
        if self._disturbed is None:
            return 0.0
        lost = self._disturbed.lost_decades(t, x)
        return np.maximum(lost[:, :, None], lost[:, None])

    def observe(self, t: Array, x: Array, v: Array, height: Array) -> Observations:
        """What is measured at epochs ``t`` (k,), s, of nodes at ``x`` (k, n, 3), m, moving at ``v``, m/s.

        Any Cartesian frame serves that x and v share, if disturbed the earth's; ``height`` (k, n) m, for the
        altimeters. Epochs come in ascending order, each once, in chunks of any length k > 0: the draws carry
        on from chunk to chunk.
        """
        settings, k = self.settings, len(t)
        distance, rates = distances_and_rates(np.ascontiguousarray(x), np.ascontiguousarray(v))
        margin = settings.link_margin_db(distance, self._shadowing)
        disturbed = self._disturbed
        if disturbed is not None:
            margin -= self._power_lost_db(disturbed.pairs_lost_decades(t, x))
        linked = margin >= 0
        heard = linked & (self._of_pairs("loss", _UNIFORM, k) >= settings.loss_probability)

        ranges = self._of_pairs("range", _NORMAL, k)
        share = settings.range_sd_share
        ranges *= np.hypot(settings.range_sd_m, share * distance) if share else settings.range_sd_m
        ranges += distance
        ranges += self._range_bias
        if settings.range_uniform_share:
            uniform = 2 * self._of_pairs("range_uniform", _UNIFORM, k) - 1
            ranges += settings.range_uniform_share * distance * uniform
        nlos = np.zeros(ranges.shape, bool)
        if settings.nlos_share:
            detour = self._detours.at(t)[0]
            ranges += detour
            nlos = detour > 0
        if disturbed is not None:
            blocked = disturbed.blocked(t, x)
            nlos |= blocked
            ranges += blocked * self._blocked.at(t)[0] + disturbed.false_ranges(t)
        rates += settings.range_rate_sd_mps * self._of_pairs("range_rate", _NORMAL, k)

        offset, frequency = self._clocks.at(t)
        if disturbed is not None:
            offset = offset + disturbed.clocks_ahead(t)
        if settings.ranging == "one_way":
            i, j = self.pairs.T
            ranges += SPEED_OF_LIGHT * (offset[:, i] - offset[:, j])
            rates += SPEED_OF_LIGHT * (frequency[:, i] - frequency[:, j])

        altitude = None
        if settings.altitude_sd_m is not None:
            noise = settings.altitude_sd_m * self._of_nodes("altitude", _NORMAL, k)
            altitude = height + self._altitude_bias + noise
        return Observations(
            t=t,
            pairs=self.pairs,
            ranges=ranges,
            range_rates=rates,
            range_sd=settings.assumed_range_sd(ranges),
            range_rate_sd=settings.range_rate_sd_mps,
            linked=linked,
            heard=heard,
            power_dbm=settings.sensitivity_dbm + margin,
            nlos=nlos,
            biased=self.biased,
            altitude=altitude,
            clock_offset=offset,
            clock_frequency=frequency,
        )

    def _power_lost_db(self, decades: Array | float) -> Array | float:
        """What takes so many decades from the link radius."""
        return 10 * self.settings.path_loss_exponent * decades

    def _draw_detours(self, rows: int) -> Array:
        """Detours (rows, m) m of all pairs: zero for those in line of sight."""
        blocked = self._of_pairs("nlos", _UNIFORM, rows) < self.settings.nlos_share
        return np.where(
            blocked, self.settings.nlos_mean_m * self._of_pairs("nlos_excess", _EXCESS, rows), 0.0
        )

    def _generators(self, effect: str) -> list[Generator]:
        """An effect's generators, one for each node. To make them takes long: only those that are needed."""
        if effect not in self._rngs:
            self._rngs[effect] = self._children[effect].spawn(self._nodes)
        return self._rngs[effect]

    def _of_pairs(self, effect: str, draw: _Draw, rows: int) -> Array:
        """An effect's next ``rows`` draws of all pairs, (rows, m)."""
        drawn = np.empty((rows, len(self.pairs)))
        for i, rng in enumerate(self._generators(effect)):
            drawn[:, i * (i - 1) // 2 : i * (i + 1) // 2] = draw(rng, (rows, i))
        return drawn

    def _of_nodes(self, effect: str, draw: _Draw, rows: int) -> Array:
        """An effect's next ``rows`` draws of all nodes, (rows, n)."""
        return np.stack([draw(rng, (rows,)) for rng in self._generators(effect)], axis=-1)

"""Nodes on the ground that range to the aircraft which flies past: where they are, and what they measure.

The aircraft is the moving anchor: it broadcasts its own position, which its navigation takes for true. All is
in one level frame, north, east and down, whose origin is on the ground below the middle of the leg.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.random import Generator
from pydantic import Field, model_validator

from ..sins import earth
from ..sins.settings import Settings
from ..sins.units import DEG
from .localization.problem import Array, Booleans
from .localization.ranging import RangeNoise
from .truth import Truth

Estimator = Literal["nls", "ekf", "ckf", "srckf"]


class AreaSettings(Settings):
    """A disc around a stated point."""

    latitude_deg: float = Field(ge=-89, le=89)
    longitude_deg: float = Field(ge=-180, le=180)
    radius_m: float = Field(default=5000.0, gt=0, le=1e5)


class GroundSettings(Settings):
    """Nodes on the ground, and the part of the flight in which they hear the aircraft."""

    nodes: int = Field(default=10, ge=1, le=1000)
    area: AreaSettings | None = None
    """By default nodes lie along the ground track of the leg, to both sides of it."""
    nearest_m: float = Field(default=500.0, ge=0, le=1e5)
    farthest_m: float = Field(default=5000.0, gt=0, le=1e5)
    """From the ground track, to either side, where no area is stated."""
    ground_height_m: float = Field(default=0.0, ge=-500, le=9000)
    """Mean height of the ground above the ellipsoid."""
    height_sd_m: float = Field(default=30.0, gt=0, le=3000)
    """Of the nodes' true heights about it, and all that is known of them."""
    start_s: float = Field(default=460.0, ge=0, le=1e5)
    """Of the leg, from brake release."""
    duration_s: float = Field(default=80.0, ge=1, le=3600)
    beacon_rate_hz: float = Field(default=1.0, gt=0, le=100)
    link_radius_m: float = Field(default=15_000.0, gt=0, le=1e6)
    range_sd_m: float = Field(default=5.0, ge=0, le=1e4)
    range_error_share: float = Field(default=0.0, ge=0, le=0.5)
    """Standard deviation that grows with the distance, in its share."""
    own_position_sd_m: float = Field(default=3.0, ge=0, le=1e4)
    """Of each component (NED) of the aircraft's own error, which is constant over the leg of a run."""
    estimators: tuple[Estimator, ...] = Field(default=("nls", "ekf", "ckf", "srckf"), min_length=1)

    @property
    def noise(self) -> RangeNoise:
        """Of ranges."""
        return RangeNoise(self.range_sd_m, self.range_error_share)

    @property
    def end_s(self) -> float:
        """Of the leg, from brake release."""
        return self.start_s + self.duration_s

    @model_validator(mode="after")
    def _some_error_and_some_width(self) -> Self:
        if self.range_sd_m == 0 and self.range_error_share == 0:
            raise ValueError("range_sd_m = 0 m with range_error_share = 0: one of them must be above zero")
        if self.nearest_m >= self.farthest_m:
            raise ValueError(
                f"nearest_m = {self.nearest_m:g} m: must be below farthest_m = {self.farthest_m:g} m"
            )
        if self.duration_s * self.beacon_rate_hz < 8:
            raise ValueError(
                f"beacon_rate_hz = {self.beacon_rate_hz:g} Hz: makes fewer than 8 beacons in duration_s ="
                f" {self.duration_s:g} s"
            )
        return self


@dataclass(frozen=True)
class Leg:
    """The part of a flight in which beacons are sent."""

    time: Array
    """(m,) s"""
    lla: Array
    """(m, 3) of the aircraft."""
    course: Array
    """(m,) rad, from north over east."""
    beacons: Array
    """(m, 3) m, the aircraft's true positions in the frame."""
    origin_e: Array
    """(3,) m, of the frame."""
    C_en: Array
    """(3, 3)"""
    ground_height: float
    """m, of the origin above the ellipsoid."""
    earth_radius: float
    """m, mean radius of curvature at the origin's height."""

    def in_frame(self, lla: Array) -> Array:
        """Positions (..., 3) m in the frame."""
        return (earth.ecef_from_lla(lla) - self.origin_e) @ self.C_en

    @property
    def earth_centre(self) -> Array:
        """(3,) m. A height is a range to it: what is at height h above the origin's is ``earth_radius + h``
        away, to first order in the earth's flattening."""
        return np.array([0.0, 0.0, self.earth_radius])


@dataclass(frozen=True)
class Overheard:
    """What the nodes of one run measure, and what they are told."""

    x: Array
    """(n, 3) m, true positions in the frame."""
    ranges: Array
    """(n, m) m"""
    heard: Booleans
    """(n, m)"""
    own_error: Array
    """(3,) m, believed less true position of the aircraft."""


def fly_past(truth: Truth, settings: GroundSettings) -> Leg:
    """The leg of a flight. Raises ValueError where the flight does not hold it."""
    count = int(np.floor(settings.duration_s * settings.beacon_rate_hz + 1e-9)) + 1
    time = settings.start_s + np.arange(count) / settings.beacon_rate_hz
    lla, v_n, _ = truth.at(time)
    origin = lla[count // 2] * [1.0, 1.0, 0.0] + [0.0, 0.0, settings.ground_height_m]
    R_N, R_E = earth.radii_of_curvature(origin[0])
    leg = Leg(
        time=time,
        lla=lla,
        course=np.arctan2(v_n[:, 1], v_n[:, 0]),
        beacons=np.empty(0),
        origin_e=earth.ecef_from_lla(origin),
        C_en=earth.C_en(origin[0], origin[1]),
        ground_height=settings.ground_height_m,
        earth_radius=float(np.sqrt(R_N * R_E)) + settings.ground_height_m,
    )
    return Leg(**{**vars(leg), "beacons": leg.in_frame(lla)})


def overhear(
    leg: Leg, settings: GroundSettings, nodes: Generator, ranges: Generator, own: Generator
) -> Overheard:
    """Nodes at random, and what they hear of a leg, each effect by its own generator."""
    x = leg.in_frame(_places(leg, settings, nodes))
    d = np.linalg.norm(x[:, None] - leg.beacons, axis=-1)
    measured = d + settings.noise.at(d) * ranges.standard_normal(d.shape)
    heard = (d <= settings.link_radius_m) & (measured > 0)
    return Overheard(x, measured, heard, settings.own_position_sd_m * own.standard_normal(3))


def _places(leg: Leg, settings: GroundSettings, rng: Generator) -> Array:
    """``lla`` (n, 3) of nodes."""
    n = settings.nodes
    along, across, side = rng.random((3, n))
    height = settings.ground_height_m + settings.height_sd_m * rng.standard_normal(n)
    if settings.area:
        at = np.tile([settings.area.latitude_deg * DEG, settings.area.longitude_deg * DEG, 0.0], (n, 1))
        distance, azimuth = settings.area.radius_m * np.sqrt(across), 2 * np.pi * along
    else:
        k = np.minimum((along * len(leg.time)).astype(int), len(leg.time) - 1)
        at, azimuth = leg.lla[k] * [1.0, 1.0, 0.0], leg.course[k] + np.pi / 2
        width = settings.farthest_m - settings.nearest_m
        distance = np.where(side < 0.5, 1.0, -1.0) * (settings.nearest_m + width * across)
    step = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.zeros(n)], axis=-1)
    placed = earth.displaced(at, step)
    placed[:, 2] = height
    return placed

"""What the scenario of Xu, Wang and Chen may state."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ...network.localization.ranging import PathLossErrors, UniformErrors
from ...sins.settings import Settings
from .results import Array

Radius = Annotated[float, Field(gt=0, le=1e5)]
Shadowing = Annotated[float, Field(gt=0, le=20)]


class MovingAnchor(Settings):
    """A UAV over a field, broadcasting beacons to nodes on the ground (section 3.2)."""

    kind: Literal["moving_anchor"]
    width_m: float = Field(default=90.0, gt=0, le=1e5)
    depth_m: float = Field(default=70.0, gt=0, le=1e5)
    nodes: int = Field(default=8, ge=1, le=100)
    terrain_m: float = Field(default=3.0, ge=0, le=1e4)
    """Heights of nodes are uniform from 0 to this."""
    altitude_m: float = Field(default=10.0, gt=0, le=1e4)
    """Of the UAV, above height 0."""
    speed_mps: float = Field(default=1.0, gt=0, le=300)
    beacon_period_s: float = Field(default=1.0, gt=0, le=1e3)
    lane_spacing_m: float = Field(default=14.0, gt=0, le=1e4)
    """Between lanes along the width, at most: they share the depth evenly."""
    radii_m: tuple[Radius, ...] = Field(default=(25.0, 50.0), min_length=1, max_length=5)
    """Communication radii: a node hears the beacons of which the slant range is no longer."""
    range_error_share: float = Field(default=0.15, gt=0, lt=1)
    """s: errors of ranges are uniform within this share of the distance."""
    shadowing_db: tuple[Shadowing, ...] = Field(default=(1.0, 4.0), max_length=5)
    """Standard deviations of W in (1), for the table of ranges by path loss."""
    path_loss_exponent: float = Field(default=2.5, ge=1, le=8)
    initial_sd_m: float = Field(default=3.0, gt=0, le=1e4)
    """Of each component of the linear solution, for the filters as published."""
    threshold_m: float = Field(default=0.1, ge=0, le=100)
    """alpha of section 2.2, for deviations of the position."""
    threshold_share: float = Field(default=0.1, ge=0, le=10)
    """The same for the predicted deviation of a range, of its noise."""
    monte_carlo_runs: int = Field(default=55, ge=1, le=10_000)
    """Of the figures, over one deployment; tables are over as many deployments as there are draws."""

    @model_validator(mode="after")
    def _every_node_hears_two_lanes(self) -> Self:
        if self.terrain_m >= self.altitude_m:
            raise ValueError(
                f"terrain_m = {self.terrain_m:g} m: must be below altitude_m = {self.altitude_m:g} m"
            )
        lanes, step = self._lanes(), self.speed_mps * self.beacon_period_s
        spacing = self.depth_m / lanes
        for radius in self.radii_m:
            reach = math.sqrt(max(radius**2 - self.altitude_m**2, 0.0))
            # A node in a corner is half a spacing from the first lane, and hears the beacons ahead alone.
            if lanes < 2 or reach**2 < (1.5 * spacing) ** 2 + (2 * step) ** 2:
                raise ValueError(
                    f"radii_m = {radius:g} m: a node in a corner hears one lane alone, or less than two"
                    f" beacons of the next ({lanes} lanes {spacing:.3g} m apart, beacons {step:g} m apart,"
                    f" {reach:.3g} m of reach on the ground): what is mirrored in a lane fits as well"
                )
        return self

    @property
    def errors(self) -> UniformErrors:
        """Of ranges, as the paper states them."""
        return UniformErrors(share=self.range_error_share)

    def path_loss(self, shadowing_db: float) -> PathLossErrors:
        """Of ranges, by (1)."""
        return PathLossErrors(
            kind="path_loss", shadowing_db=shadowing_db, path_loss_exponent=self.path_loss_exponent
        )

    def beacons(self) -> Array:
        """(m, 2) m, along lanes there and back, one a period."""
        lanes = self._lanes()
        y = (np.arange(lanes) + 0.5) * self.depth_m / lanes
        ends = np.array([[0.0, self.width_m][:: 1 if i % 2 == 0 else -1] for i in range(lanes)])
        corners = np.column_stack([ends.ravel(), np.repeat(y, 2)])
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        at = np.arange(0.0, way[-1] + 1e-9, self.speed_mps * self.beacon_period_s)
        return np.column_stack([np.interp(at, way, corners[:, k]) for k in range(2)])

    def _lanes(self) -> int:
        return math.ceil(self.depth_m / self.lane_spacing_m - 1e-9)

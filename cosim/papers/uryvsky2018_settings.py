"""Parameters of the experiment of Uryvsky et al., and what of them cannot be located."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ...network.localization.plane import distances, range_bound
from ...sins.settings import Settings

FOUR = 4
"""Cycles after which the paper states its gain."""
_CLEAR_SD = 6.0
"""Standard deviations of its y that an element must be away from the line of the mirror."""
_SHORTEST = 0.2
"""Greatest standard deviation of a range over the shortest one, so that no range comes out negative."""

_Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]


class RepeatedRanging(Settings):
    """A plane network in the local frame of the paper's Fig. 1, and how its ranges err."""

    kind: Literal["repeated_ranging"]
    elements_m: tuple[tuple[_Coordinate, _Coordinate], ...] = (
        (0.0, 0.0),
        (100.0, 0.0),
        (30.0, 45.0),
        (85.0, 60.0),
        (-25.0, 70.0),
        (140.0, 80.0),
        (10.0, 110.0),
        (60.0, 95.0),
    )
    """x and y of elements 1 to M. Element 1 is at the origin, 2 on the x axis; both know where they are. The
    others are at y > 0, which is how they are told from their mirror images."""
    range_sd_m: float = Field(default=1.0, gt=0, le=1e4)
    """Root of the paper's rho: standard deviation of a range."""
    cycles: int = Field(default=20, ge=FOUR, le=1000)
    """N, sets of ranges."""
    unequal_ratio: float = Field(default=3.0, ge=1, le=100)
    """Unequal noise: each range's standard deviation is up to that many times higher or lower."""
    misstated_ratio: float = Field(default=2.0, gt=1, le=100)
    """Mis-stated noise: the filters are told that many times less, or more, than the true deviation."""
    outlier_share: float = Field(default=0.1, ge=0, le=0.5)
    outlier_ratio: float = Field(default=8.0, ge=1, le=100)
    """Standard deviation of outliers over that of other ranges."""
    discrepancy_limit: float = Field(default=3.0, ge=1, le=1000)
    """p of (10) and (11), over what noise alone makes of it."""
    huber_threshold: float = Field(default=1.5, gt=0, le=100)
    """Standard deviations from which on Huber's loss grows by the first power only."""
    shown_element: int = Field(default=3, ge=3, le=1000)
    """Whose coordinate is drawn in Fig. 2."""

    @model_validator(mode="after")
    def _can_be_located(self) -> Self:
        x = np.array(self.elements_m)
        if len(x) < 3:
            raise ValueError(f"elements_m: {len(x)} elements; at least 3, as 1 and 2 know where they are")
        if x[0].any() or x[1, 1] != 0 or not x[1, 0] > 0:
            raise ValueError("elements_m: element 1 must be at (0, 0) m, and 2 at (x, 0) m with x above 0")
        if self.shown_element > len(x):
            raise ValueError(f"shown_element = {self.shown_element}: elements 3 to {len(x)} can be shown")
        apart = np.linalg.norm(x[:, None] - x, axis=-1) + np.diag(np.full(len(x), np.inf))
        i, j = np.unravel_index(np.argmin(apart), apart.shape)
        if apart[i, j] < 1e-6:
            raise ValueError(f"elements_m: elements {i + 1} and {j + 1} are in the same place")
        reach = distances(x[2:], x[:2])[0].min()
        worst = self.range_sd_m * self.unequal_ratio
        if worst > _SHORTEST * reach:
            raise ValueError(
                f"range_sd_m = {self.range_sd_m:g} m: makes up to {worst:g} m with unequal noise, and the"
                f" shortest range is {reach:g} m; at most {_SHORTEST:g} of that is allowed, or ranges come"
                " out zero or negative"
            )
        for k, element in enumerate(x[2:], start=3):
            told = f"elements_m: element {k} at ({element[0]:g}, {element[1]:g}) m"
            if element[1] <= 0:
                raise ValueError(f"{told}: y must be above 0, where its mirror image in the x axis is not")
            spread = np.sqrt(range_bound(element, x[:2], np.full(2, self.range_sd_m))[1, 1])
            if element[1] < _CLEAR_SD * spread:
                raise ValueError(
                    f"{told}: too near the line through 1 and 2; its y has a standard deviation of"
                    f" {spread:.2g} m, and must be {_CLEAR_SD:g} times that to be told from its mirror image"
                )
        return self

"""What a network has measured at one epoch, and what localisation makes of it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class LocalizationError(ValueError):
    """Measurements that do not make up a localisation problem; one line."""


class NodeOutcome(IntEnum):
    """What became of a node."""

    ANCHOR = 0
    """It knew its position before; the estimate is at least as good."""
    LOCATED = 1
    TOO_FEW_NEIGHBOURS = 2
    """Fewer than the least number of usable neighbours: anchors, and nodes that have enough themselves."""
    SINGULAR = 3
    """The geometry leaves a direction of its position unknown."""
    AMBIGUOUS = 4
    """A mirror image fits the ranges as well."""
    INCONSISTENT = 5
    """The residuals of its ranges are larger than their noise allows."""
    NOT_CONVERGED = 6
    QUARANTINED = 7
    """Its ranges were found to be false (`quarantine`)."""


@dataclass(frozen=True)
class RangeProblem:
    """Ranges between nodes, positions of anchors, and heights, at one epoch.

    Raises `LocalizationError` for wrong shapes, no anchors, links of a node to itself or to no node, and
    ranges and standard deviations that are not finite or, these, not positive.
    """

    links: Integers
    """(m, 2), each link once."""
    ranges: Array
    """(m,) m. With `clocks`, of link (i, j): distance plus clock offset of i less that of j, in metres."""
    range_sd: Array
    """(m,) m."""
    anchor: Booleans
    """(n,) nodes that know their position."""
    anchor_x: Array
    """(n, 3) m, the positions that anchors take for theirs; the rows of other nodes are not looked at."""
    anchor_sd: float = 0.0
    """m, of each component of an anchor's position; 0 for anchors that stay where they say."""
    height: Array | None = None
    """(n,) m above the level plane through the origin, along the earth's curve; NaN where a node has none."""
    height_sd: float = 1.0
    """m."""
    curvature: float = 0.0
    """1/m, of the surface of equal height: ``height = -down + curvature (north^2 + east^2) / 2``."""
    clocks: bool = False
    """Whether clock offsets of nodes are unknown as well; those of anchors are known."""

    def __post_init__(self) -> None:
        n, m = len(self.anchor), len(self.links)
        shapes = {"links": (m, 2), "ranges": (m,), "range_sd": (m,), "anchor": (n,), "anchor_x": (n, 3)}
        if self.height is not None:
            shapes["height"] = (n,)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise LocalizationError(f"{name} must have shape {shape}; got {getattr(self, name).shape}")
        if not self.anchor.any():
            raise LocalizationError("no anchors: positions are known but for a rigid motion of them all")
        if not np.isfinite(self.anchor_x[self.anchor]).all():
            raise LocalizationError("positions of anchors must be finite")
        if m and (np.min(self.links) < 0 or np.max(self.links) >= n):
            raise LocalizationError(f"links must join nodes 0 to {n - 1}")
        if (self.links[:, 0] == self.links[:, 1]).any():
            raise LocalizationError("a link must join two nodes")
        if not np.isfinite(self.ranges).all():
            raise LocalizationError("ranges must be finite")
        if not (np.isfinite(self.range_sd) & (self.range_sd > 0)).all():
            raise LocalizationError("range_sd must be finite and positive")

    @property
    def nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.anchor)


@dataclass(frozen=True)
class Positions:
    """Estimated positions of all nodes; NaN for those that have none."""

    x: Array
    """(n, 3) m."""
    cov: Array
    """(n, 3, 3) m^2, each node's own covariance."""
    outcome: Integers
    """(n,) `NodeOutcome`."""
    cost: float
    """Half the sum of squared, weighted residuals."""
    iterations: int
    suspect: Booleans
    """(n,) nodes whose own ranges contradict the rest: a biased transponder, say."""
    clock: Array | None = None
    """(n,) m, clock offsets times the speed of light, where they were unknown."""

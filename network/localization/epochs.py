"""What a fleet knows at consecutive epochs, and what a tracker makes of it."""

from dataclasses import dataclass, replace

from .contradictions import Evidence
from .problem import Array, Booleans, Integers


@dataclass(frozen=True)
class Epochs:
    """What a fleet knows at k consecutive epochs, each in its own frame (`localization`)."""

    t: Array
    """(k,) s."""
    pairs: Integers
    """(m, 2) all pairs of nodes."""
    ranges: Array
    """(k, m) m, as `RangeProblem` has them; not looked at where not heard."""
    range_sd: Array
    """(k, m) m."""
    rates: Array
    """(k, m) m/s; one-way, the clock drift of the first node less that of the second is in them."""
    rate_sd: float
    """m/s."""
    heard: Booleans
    """(k, m) pairs that ranged each other."""
    belief_x: Array
    """(k, n, 3) m, where anchors take themselves to be; other rows are not looked at."""
    belief_v: Array
    """(k, n, 3) m/s, likewise."""
    height: Array | None
    """(k, n) m above the level plane through the origin, as `RangeProblem` has it."""
    curvature: float
    """1/m, likewise."""
    lost: Booleans | None = None
    """(k, sweeps, n) broadcasts that nobody received, of the distributed solver; none by default."""

    def __getitem__(self, rows: slice) -> "Epochs":
        """Some of the epochs."""
        names = ("t", "ranges", "range_sd", "rates", "heard", "belief_x", "belief_v", "height", "lost")
        values = {name: getattr(self, name) for name in names}
        return replace(self, **{name: value[rows] for name, value in values.items() if value is not None})


@dataclass(frozen=True)
class Track:
    """Estimates of k epochs, each in its own frame; NaN where there are none."""

    x: Array
    """(k, n, 3) m, of nodes that are `LOCATED`, and of anchors."""
    v: Array
    """(k, n, 3) m/s relative to the earth."""
    own_cov: Array
    """(k, 6, 6) of the own ship's position and velocity."""
    sd: Array
    """(n, 6) of each node's position and velocity, at the first of the epochs; NaN for nodes without."""
    outcome: Integers
    """(k, n) `NodeOutcome`."""
    cov: Array
    """(n, 6, 6) of each node's position and velocity, at the first of the epochs; NaN likewise."""
    shared: Array
    """(n, 6, 6) the part of ``cov`` that is of the anchors' errors, the same at all epochs; (0, 6, 6) where
    each epoch stands by itself (`LocalizationSettings.tracker`)."""
    seen: Evidence | None = None
    """For a `quarantine.Monitor`."""

"""What radios measure of each other, as localisation gets it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


def node_pairs(nodes: int) -> Integers:
    """All pairs (i, j), j < i, shape (m, 2): (1, 0), (2, 0), (2, 1), (3, 0) and so on."""
    return np.stack(np.tril_indices(nodes, -1), axis=-1).astype(np.int64)


@dataclass(frozen=True)
class Observations:
    """What the radios measure at k epochs: m pairs of n nodes, whether or not they hear each other.

    Only what `heard` marks has been measured: the ranges and range rates of other pairs have to be masked.
    """

    t: Array
    """(k,) s."""
    pairs: Integers
    """(m, 2), as of `node_pairs`."""
    ranges: Array
    """(k, m) m. Of nodes at one place noise makes them negative; they are not cut off, which would bias them.
    One-way: of pair (i, j) with the clock offset of i less that of j."""
    range_rates: Array
    """(k, m) m/s, of one-way pairs with the frequency error of i less that of j."""
    range_sd: Array
    """(k, m) m, what the receiver takes for the standard deviation; it knows the measured range alone."""
    range_rate_sd: float
    """m/s."""
    linked: Booleans
    """(k, m) pairs whose power reaches the sensitivity."""
    heard: Booleans
    """(k, m) linked pairs whose ranging was not lost at that epoch."""
    power_dbm: Array
    """(k, m) received power."""
    nlos: Booleans
    """(k, m) truth, for scores: pairs without line of sight."""
    biased: Booleans
    """(n,) truth, for scores: nodes with a biased transponder."""
    altitude: Array | None
    """(k, n) measured heights, m; None without altimeters."""
    clock_offset: Array
    """(k, n) truth, s: each clock ahead of network time."""
    clock_frequency: Array
    """(k, n) truth: frequency errors of the clocks."""

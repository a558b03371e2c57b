"""Draws that stay as they are for a while and are then made anew."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Held:
    """A row of draws for every interval of ``hold_s`` that epochs fall into, from the first epoch on.

    ``draw`` yields a stated number of rows, of any kind. Epochs come in ascending order, in chunks of any
    length: their values do not depend on where the chunks are cut.
    """

    def __init__(self, hold_s: float, draw: Callable[[int], Array]) -> None:
        self._hold_s = hold_s
        self._draw = draw
        self._origin = 0.0
        self._interval = -1
        self._last: Array | None = None

    def at(self, t: Array) -> tuple[Array, Array]:
        """The rows (k, ...) at epochs ``t`` (k,), k > 0, and the time (k,) s since each one was drawn."""
        if self._last is None:
            self._origin = float(t[0])
            self._last = self._draw(0)
        # Epochs that begin an interval but for rounding belong to it.
        interval = np.floor((t - self._origin) / self._hold_s + 1e-9).astype(np.int64)
        begins = np.diff(interval, prepend=self._interval) != 0
        known = len(self._last)
        rows = np.concatenate([self._last, self._draw(int(begins.sum()))])
        self._interval, self._last = int(interval[-1]), rows[-1:]
        since = np.maximum(t - self._origin - interval * self._hold_s, 0.0)
        return rows[known - 1 + np.cumsum(begins)], since

"""Puts arrays into a Rerun recording, whole columns at a time."""

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from ..align.estimate import Array
from .palette import rgb

TIMELINE = "sim_time"
PIXELS = -1.0
"""Rerun takes negative radii for sizes on the screen."""


class Columns:
    """A recording as a destination of columns over `TIMELINE`, s."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording

    def static(self, path: str, *what: rr.AsComponents) -> None:
        """What holds at all times."""
        self._recording.log(path, *what, static=True)

    def send(self, path: str, time: ArrayLike, column: rr.ComponentColumnList) -> None:
        """One row for each time."""
        time = np.asarray(time, float)
        if len(time):
            self._recording.send_columns(path, [rr.TimeColumn(TIMELINE, duration=time)], column)

    def line(
        self, path: str, time: ArrayLike, values: ArrayLike, color: str, name: str, width: float = 1.5
    ) -> None:
        """A curve, or several that look alike: ``values`` (m,) or (m, curves)."""
        values = np.asarray(values, float)
        curves = 1 if values.ndim == 1 else values.shape[1]
        look = rr.SeriesLines(colors=[rgb(color)] * curves, widths=[width] * curves, names=[name] * curves)
        self.static(path, look)
        column = rr.Scalars.columns(scalars=values.ravel())
        self.send(path, time, column.partition([curves] * len(values)) if curves > 1 else column)

    def three_sigma(
        self, path: str, time: Array, center: Array | float, sd: Array, color: str, name: str
    ) -> None:
        """Thin lines three standard deviations above and below ``center``."""
        lines = np.column_stack([center + 3 * sd, center - 3 * sd])
        self.line(f"{path}/three_sigma", time, lines, color, f"{name} ±3 sigma", width=0.6)

    def points(
        self, path: str, time: ArrayLike, values: ArrayLike, color: str, name: str, size: float
    ) -> None:
        """Marks without a line."""
        self.static(path, rr.SeriesPoints(colors=[rgb(color)], names=[name], marker_sizes=[size]))
        self.send(path, time, rr.Scalars.columns(scalars=np.asarray(values, float)))

"""Colours that mean the same in the recording and in the report."""

from ..align.estimate import FixOutcome
from ..align.methods import METHODS
from ..network.record import FixFate

# Distinct for colour-blind readers (after Okabe and Ito), and visible on white and on black.
_FILTER_COLORS = ("#D55E00", "#3D8FD1", "#009E73", "#CC79A7", "#B59A00", "#7F6BD6", "#8A5A3B")

PATH = "#FFFFFF"
TRUTH = "#8C8C8C"
BOUND = "#8C8C8C"
AIRCRAFT = "#FFD24A"
ALIGNMENT = "#FFD24A"
"""The part of the flight in which filters align."""

OUTCOME_COLORS = {
    FixOutcome.PENDING: "#BBBBBB",
    FixOutcome.FUSED: "#3D8FD1",
    FixOutcome.INITIALIZED: "#009E73",
    FixOutcome.GATED: "#D55E00",
    FixOutcome.DUPLICATE: "#B59A00",
    FixOutcome.LATE: "#CC79A7",
    FixOutcome.NOT_FINITE: "#A00000",
    FixOutcome.FUTURE: "#7F6BD6",
    FixOutcome.INVALID: "#8A5A3B",
}

NODE = "#3D8FD1"
ANCHOR = "#009E73"
CLUSTER_HEAD = "#D55E00"
LINK = "#8C8C8C"
FAINT = "#3C3C3C"
"""On black: links of which there are many."""
UNLOCATED = "#CC79A7"
"""A node without an estimate."""
FATE_COLORS = {
    FixFate.DELIVERED: "#3D8FD1",
    FixFate.TOO_FEW_NEIGHBOURS: "#CC79A7",
    FixFate.UNLOCALIZABLE: "#7F6BD6",
    FixFate.AMBIGUOUS: "#B59A00",
    FixFate.INCONSISTENT: "#8A5A3B",
    FixFate.NOT_CONVERGED: "#BBBBBB",
    FixFate.NO_ROUTE: "#009E73",
    FixFate.LOST: "#D55E00",
    FixFate.STILL_QUEUED: "#FFD24A",
}


def filter_color(name: str) -> str:
    """``#RRGGBB`` of a filter, the same whichever others stand beside it. Raises KeyError for no filter."""
    return dict(zip(METHODS, _FILTER_COLORS, strict=False))[name]


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of ``#RRGGBB``."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)

"""Colours that mean the same in the recording and in the report."""

from ..align.estimate import FixOutcome, NavStatus
from ..align.methods import METHODS
from ..network.record import FixFate

# Distinct for colour-blind readers (after Okabe and Ito), and visible on white and on black.
VERMILION, BLUE, GREEN, PINK = "#D55E00", "#3D8FD1", "#009E73", "#CC79A7"
OLIVE, VIOLET, BROWN = "#B59A00", "#7F6BD6", "#8A5A3B"
GREY, LIGHT_GREY, YELLOW = "#8C8C8C", "#BBBBBB", "#FFD24A"
TEAL, CRIMSON, NAVY, ORANGE = "#2FB5AC", "#A00000", "#5267C9", "#F0A030"
_FILTER_COLORS = (VERMILION, BLUE, GREEN, PINK, OLIVE, VIOLET, BROWN, TEAL, CRIMSON, NAVY, ORANGE)

PATH = "#FFFFFF"
TRUTH = GREY
BOUND = GREY
AIRCRAFT = YELLOW
ALIGNMENT = YELLOW
"""The part of the flight in which filters align."""

OUTCOME_COLORS = {
    FixOutcome.PENDING: LIGHT_GREY,
    FixOutcome.FUSED: BLUE,
    FixOutcome.INITIALIZED: GREEN,
    FixOutcome.GATED: VERMILION,
    FixOutcome.DUPLICATE: OLIVE,
    FixOutcome.LATE: PINK,
    FixOutcome.NOT_FINITE: CRIMSON,
    FixOutcome.FUTURE: VIOLET,
    FixOutcome.INVALID: BROWN,
    FixOutcome.UNAUTHENTIC: ORANGE,
}

STATUS_COLORS = {
    NavStatus.NOT_STARTED: LIGHT_GREY,
    NavStatus.AIDED: BLUE,
    NavStatus.DEAD_RECKONING: VERMILION,
    NavStatus.STOPPED: CRIMSON,
}

NODE = BLUE
ANCHOR = GREEN
CLUSTER_HEAD = VERMILION
LINK = GREY
FAINT = "#3C3C3C"
"""On black: links of which there are many."""
UNLOCATED = PINK
"""A node without an estimate."""
QUARANTINED = CRIMSON
"""A node that was found out to lie."""
FATE_COLORS = {
    FixFate.DELIVERED: BLUE,
    FixFate.TOO_FEW_NEIGHBOURS: PINK,
    FixFate.UNLOCALIZABLE: VIOLET,
    FixFate.AMBIGUOUS: OLIVE,
    FixFate.INCONSISTENT: BROWN,
    FixFate.NOT_CONVERGED: LIGHT_GREY,
    FixFate.NO_ROUTE: GREEN,
    FixFate.LOST: VERMILION,
    FixFate.STILL_QUEUED: YELLOW,
}


def filter_color(name: str) -> str:
    """``#RRGGBB`` of a filter, the same whichever others stand beside it. Raises KeyError for no filter."""
    return dict(zip(METHODS, _FILTER_COLORS, strict=True))[name]


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of ``#RRGGBB``."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)

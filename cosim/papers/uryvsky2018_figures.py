"""Fig. 2 of Uryvsky et al.: coordinate, error and gain against the number of measurements."""

from typing import Literal

import numpy as np

from . import statistics
from .results import Array, Curve, Panel, PaperFigure
from .uryvsky2018_runs import DRAWN, Outcome
from .uryvsky2018_settings import RepeatedRanging

Look = Literal["line", "dashed", "dotted"]
_CURVES: dict[str, tuple[str, Look]] = {
    "regularized_gain": ("regularised", "dashed"),
    "adaptive_gain": ("adaptive", "dotted"),
    "regularized_adaptive_gain": ("regularised-adaptive", "line"),
    "regularized_adaptive": ("the same, mended", "line"),
    "kalman": ("Kalman", "line"),
    "huber": ("all ranges, Huber", "line"),
    "bound": ("bound", "dashed"),
}
_BANDED = ("regularized_adaptive_gain", "kalman", "huber")
_GREY = "#808080"


def figure_2(settings: RepeatedRanging, found: dict[str, dict[str, Outcome]]) -> PaperFigure:
    """Panels side by side: equal noise, and outliers. Coordinate of one draw, RMSE, and gain."""
    n = np.arange(1.0, settings.cycles + 1)
    truth = settings.elements_m[settings.shown_element - 1][0]
    rows: list[list[Panel]] = [[], [], []]
    for case in DRAWN:
        outcomes = found[case]
        title = {"nominal": "equal noise", "outliers": "with outliers"}[case]
        exact = Curve("truth", n, np.full(len(n), truth), look="dashed", color=_GREY)
        ways = [_curve(n, key, outcomes[key].x) for key in _CURVES]
        label = f"x of element {settings.shown_element}, m"
        rows[0].append(Panel("", label, tuple(w for w in ways if w) + (exact,), title=title))
        rows[1].append(
            Panel("", "RMS error, m", tuple(_error(n, key, outcomes[key]) for key in _CURVES), log_y=True)
        )
        gains = [_gain(n, key, outcomes[key].gain) for key in _CURVES]
        rows[2].append(Panel("measurements n", "gain", tuple(g for g in gains if g), log_y=True))
    return PaperFigure(
        name="figure_2",
        caption=f"Fig. 2 drawn again: x of element {settings.shown_element} in the first draw, as printed"
        " there; and, over all draws and elements, RMS error and mean diagonal of the gain H. The filters"
        " have the gains as printed with (7) mended, but where it says mended. Bands: 95 % interval of the"
        " RMS error; of gains the middle 95 % of draws.",
        panels=tuple(tuple(row) for row in rows),
        height_in=8.4,
    )


def _curve(n: Array, key: str, y: Array | None) -> Curve | None:
    label, look = _CURVES[key]
    return None if y is None else Curve(label, n, y, look=look)


def _error(n: Array, key: str, outcome: Outcome) -> Curve:
    label, look = _CURVES[key]
    values = [statistics.rms(column) for column in outcome.squares.T] if key in _BANDED else None
    rms = np.sqrt(outcome.squares.mean(axis=0))
    if values is None:
        return Curve(label, n, rms, look=look)
    low, high = (np.array([getattr(v, end) for v in values]) for end in ("low", "high"))
    return Curve(label, n, rms, low, high, look=look)


def _gain(n: Array, key: str, gain: Array | None) -> Curve | None:
    if gain is None:
        return None
    label, look = _CURVES[key]
    band = np.quantile(gain, [0.025, 0.975], axis=0) if key in _BANDED else (None, None)
    return Curve(label, n, gain.mean(axis=0), *band, look=look)

"""Fig. 3 (a) to (d) and Fig. 5 of Wan et al."""

from typing import Literal

import numpy as np

from . import statistics
from .results import Array, Curve, Panel, PaperFigure
from .wan2008_runs import BOUND, ERROR, Cell, sweep_cell
from .wan2008_settings import Refinement

Look = Literal["line", "dashed", "dotted", "points", "crosses", "stars"]
_CURVES: dict[str, tuple[str, Look]] = {
    "dv": ("DV-distance", "dashed"),
    "distributed": ("refined, distributed", "line"),
    "central": ("refined, central", "crosses"),
    "ours": ("ours", "stars"),
    "central_long": ("refined, central, to the end", "points"),
}
_Y = "mean error, % of the radius"


def figures(settings: Refinement, found: dict[Cell, dict[str, Array]]) -> tuple[PaperFigure, ...]:
    """Both, on the axes of the paper: beacon share, or ranging error, in per cent."""
    panels = [
        Panel(
            "beacons, %",
            _Y if i % 2 == 0 else "",
            _curves([(share, found[Cell(degree, share)]) for share in settings.beacon_shares]),
            title=f"({'abcdefgh'[i]}) connectivity {degree:g}",
        )
        for i, degree in enumerate(settings.connectivities)
    ]
    rows = tuple(tuple(panels[i : i + 2]) for i in range(0, len(panels), 2))
    sweep = [(e, found[sweep_cell(settings, e)]) for e in settings.range_error_shares]
    judged = found[sweep_cell(settings, settings.judged_error_share)]["ours"][:, BOUND]
    root = 100 * np.sqrt(np.nanmean(judged)) / settings.sweep_radius_m / settings.judged_error_share
    x = 100 * np.array(settings.range_error_shares)
    bound = Curve("bound of nodes that ranges hold", x, x / 100 * root, look="dotted")
    return (
        PaperFigure(
            "figure_3",
            "Fig. 3 drawn again: mean error of DV-distance and as refined, exact ranges, with 95 %"
            " intervals. Crosses, points and stars: the central form and ours, where they were run.",
            rows,
            height_in=3.2 * len(rows),
        ),
        PaperFigure(
            "figure_5",
            "Fig. 5 drawn again: mean error against the standard deviation of a range, with 95 %"
            " intervals. The bound is of the nodes that ranges hold to a quarter of a radius, the means are"
            " of all nodes.",
            ((Panel("ranging error, % of the radius", _Y, (*_curves(sweep), bound)),),),
        ),
    )


def _curves(points: list[tuple[float, dict[str, Array]]]) -> tuple[Curve, ...]:
    curves: list[Curve] = []
    for key, (label, look) in _CURVES.items():
        known = [(100 * x, statistics.mean(100 * at[key][:, ERROR])) for x, at in points if key in at]
        if known:
            x, y = np.array([k[0] for k in known]), np.array([k[1].value for k in known])
            low, high = (np.array([getattr(k[1], end) for k in known]) for end in ("low", "high"))
            banded = look in ("line", "dashed") and bool(np.isfinite(low).all())
            curves.append(Curve(label, x, y, low if banded else None, high if banded else None, look))
    return tuple(curves)

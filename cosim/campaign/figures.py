"""The figures of a campaign's report, as SVG text."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...align.estimate import Array
from ..drawing import STYLE, legend, log_scale, panels, svg
from ..palette import filter_color
from .summary import CampaignSummary, PointScore

UNITS = {"level": "arcsec", "heading": "arcmin", "velocity": "m/s"}
_MOST_LINES = 6
"""Of one filter along an axis."""
_MOST_CURVES = 40
"""Points whose convergence is drawn: more of them would be a blot."""
_MOST_NAMED = 8
"""Points whose numbers stand at the ends of their lines."""
ALIKE = "Lines join the points that are alike on the other axes, whose values stand at their ends."
MEDIANS = "Lines join medians over the points of one value, which differ on the other axes."
APART = "No line joins the points: hardly two have the same value, and all differ on the other axes, too."


def draw_campaign(summary: CampaignSummary) -> dict[str, str]:
    """SVG elements: one for each axis by its number, ``axis_0`` ..., and ``convergence``, ``nees``."""
    axes = list(summary.plan["settings"]["axes"])
    with mpl.rc_context(STYLE):
        figures = {f"axis_{i}": svg(_along(summary, name)) for i, name in enumerate(axes)}
        return figures | {"convergence": svg(_convergence(summary)), "nees": svg(_nees(summary))}


def _along(summary: CampaignSummary, axis: str) -> Figure:
    """RMS over one axis: a dot with its interval for each point, and lines as `joined` has it."""
    figure, (row,) = panels(1, len(UNITS), 3.4)
    coordinates = summary.plan["coordinates"]
    values = [point[axis] for point in coordinates]
    ordered = not any(isinstance(value, str | bool) for value in values)
    names = sorted({str(value) for value in values})
    place = np.array([float(v) if ordered else float(names.index(str(v))) for v in values])
    log = bool(summary.plan["settings"]["axes"][axis].get("log"))
    others, how = _others(coordinates, axis), joined(coordinates, axis)
    filters = _by_filter(summary)
    for ax, (group, unit) in zip(row, UNITS.items(), strict=True):
        for number, (name, scores) in enumerate(filters.items()):
            points = [s.point for s in scores]
            x = _aside(place, number - (len(filters) - 1) / 2, log)[points]
            y, low, high = np.array([s.rms[group] for s in scores]).T
            reach = np.nan_to_num(np.vstack([y - low, high - y]))
            look: dict[str, Any] = {
                "linestyle": "none",
                "marker": "o",
                "markersize": 3.5,
                "color": filter_color(name),
            }
            ax.errorbar(x, y, yerr=np.maximum(reach, 0), elinewidth=0.8, **look)
            key = look if how == APART else {"color": filter_color(name), "linewidth": 1.2}
            ax.plot([], label=name, **key)
            if how == ALIKE:
                for line in dict.fromkeys(others):
                    mine = np.array([others[point] == line for point in points])
                    order = np.argsort(x[mine])
                    at, rms = x[mine][order], y[mine][order]
                    ax.plot(at, rms, color=filter_color(name), linewidth=0.9, alpha=0.8)
                    if number == 0 and line and len(at) and np.isfinite(rms[-1]):
                        ax.annotate(line, (at[-1], rms[-1]), (4, 4), textcoords="offset points", fontsize=7)
            elif how == MEDIANS:
                centres = sorted(set(x))
                known = [y[(x == c) & np.isfinite(y)] for c in centres]
                medians = [np.median(some) if len(some) else np.nan for some in known]
                ax.plot(centres, medians, color=filter_color(name), linewidth=1.2)
        ax.set(xlabel=axis, ylabel=f"{group}, {unit}")
        if log:
            ax.set_xscale("log")
        if not ordered:
            ax.set_xticks(range(len(names)), names)
        log_scale(ax)
    legend(figure, row[0])
    return figure


def joined(coordinates: Sequence[Mapping[str, Any]], axis: str) -> str:
    """Which points lines join along an axis: `ALIKE`, `MEDIANS`, or `APART` where a line would be no trend,
    since from each point to the next all other axes change."""
    if len(set(_others(coordinates, axis))) <= min(_MOST_LINES, max(len(coordinates) // 2, 1)):
        return ALIKE
    return MEDIANS if len({point[axis] for point in coordinates}) <= len(coordinates) // 2 else APART


def _others(coordinates: Sequence[Mapping[str, Any]], axis: str) -> list[str]:
    """Of each point its values on the other axes."""
    return [", ".join(short(value) for name, value in point.items() if name != axis) for point in coordinates]


def _aside(place: Array, by: float, log: bool) -> Array:
    """Places a little aside, so that one filter's dots do not hide another's."""
    span = np.log(place) if log else place
    moved = span + 0.012 * by * (np.ptp(span) or 1.0)
    return np.exp(moved) if log else moved


def short(value: Any) -> str:
    """A coordinate as a reader needs it."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _convergence(summary: CampaignSummary) -> Figure:
    """RMS over the time from the start, a thin line for each point."""
    figure, (row,) = panels(1, 2, 3.4)
    for ax, key, label in zip(
        row, ("level_rms_arcsec", "heading_rms_arcmin"), ("level, arcsec", "heading, arcmin"), strict=True
    ):
        for name, scores in _by_filter(summary).items():
            for number, score in enumerate(scores[:_MOST_CURVES]):
                look: dict[str, Any] = {"color": filter_color(name), "linewidth": 0.8, "alpha": 0.7}
                rms = np.asarray(getattr(score, key))
                ax.plot(score.time_s, rms, label=name if number == 0 else "_", **look)
                if len(scores) <= _MOST_NAMED and len(rms) and np.isfinite(rms[-1]):
                    end, aside = (score.time_s[-1], rms[-1]), {"textcoords": "offset points", "fontsize": 7}
                    ax.annotate(str(score.point), end, (4, -2), **aside)
        ax.set(xlabel="time from the start of the alignment, s", ylabel=label)
        log_scale(ax)
    legend(figure, row[0])
    return figure


def _nees(summary: CampaignSummary) -> Figure:
    """Mean NEES of each point against its 95 % band."""
    figure, ((ax,),) = panels(1, 1, 3.0)
    for name, scores in _by_filter(summary).items():
        x = [s.point for s in scores]
        ax.plot(x, [s.nees for s in scores], "o", markersize=3.5, color=filter_color(name), label=name)
        _band(ax, scores)
    ax.axhline(3.0, color="black", linewidth=0.8)
    ax.set(xlabel="point", ylabel="NEES, of 3")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    log_scale(ax)
    legend(figure, ax)
    return figure


def _band(ax: Axes, scores: list[PointScore]) -> None:
    banded = [(s.point, *s.nees_band) for s in scores if s.nees_band]
    if not banded:
        return
    points, low, high = np.array(banded).T
    ax.fill_between(points, low, high, color="#CCCCCC", alpha=0.3, linewidth=0)


def _by_filter(summary: CampaignSummary) -> dict[str, list[PointScore]]:
    found: dict[str, list[PointScore]] = {}
    for score in summary.scores:
        found.setdefault(score.filter, []).append(score)
    return found

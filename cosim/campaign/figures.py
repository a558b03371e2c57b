"""The figures of a campaign's report, as SVG text."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..drawing import STYLE, legend, log_scale, panels, svg
from ..palette import filter_color
from .summary import CampaignSummary, PointScore

UNITS = {"level": "arcsec", "heading": "arcmin", "velocity": "m/s"}
_MOST_CURVES = 40
"""Points whose convergence is drawn: more of them would be a blot."""


def draw_campaign(summary: CampaignSummary) -> dict[str, str]:
    """SVG elements: one for each axis by its number, ``axis_0`` ..., and ``convergence``, ``nees``."""
    axes = list(summary.plan["settings"]["axes"])
    with mpl.rc_context(STYLE):
        figures = {f"axis_{i}": svg(_along(summary, name)) for i, name in enumerate(axes)}
        return figures | {"convergence": svg(_convergence(summary)), "nees": svg(_nees(summary))}


def _along(summary: CampaignSummary, axis: str) -> Figure:
    """RMS over one axis: a dot with its interval for each point, a line through medians of equal values."""
    figure, (row,) = panels(1, len(UNITS), 3.4)
    values = [point[axis] for point in summary.plan["coordinates"]]
    ordered = not any(isinstance(value, str | bool) for value in values)
    names = sorted({str(value) for value in values})
    place = {p: float(v) if ordered else float(names.index(str(v))) for p, v in enumerate(values)}
    for ax, (group, unit) in zip(row, UNITS.items(), strict=True):
        for name, scores in _by_filter(summary).items():
            x = np.array([place[s.point] for s in scores])
            y, low, high = np.array([s.rms[group] for s in scores]).T
            reach = np.nan_to_num(np.vstack([y - low, high - y]))
            look = {"linestyle": "none", "marker": "o", "markersize": 3.5, "color": filter_color(name)}
            ax.errorbar(x, y, yerr=np.maximum(reach, 0), elinewidth=0.8, **look)
            centres = sorted(set(x))
            medians = [np.nanmedian(y[x == c]) if np.isfinite(y[x == c]).any() else np.nan for c in centres]
            ax.plot(centres, medians, color=filter_color(name), linewidth=1.2, label=name)
        ax.set(xlabel=axis, ylabel=f"{group}, {unit}")
        if not ordered:
            ax.set_xticks(range(len(names)), names)
        log_scale(ax)
    legend(figure, row[0])
    return figure


def _convergence(summary: CampaignSummary) -> Figure:
    """RMS over the time from the start, a thin line for each point."""
    figure, (row,) = panels(1, 2, 3.4)
    for ax, key, label in zip(
        row, ("level_rms_arcsec", "heading_rms_arcmin"), ("level, arcsec", "heading, arcmin"), strict=True
    ):
        for name, scores in _by_filter(summary).items():
            for number, score in enumerate(scores[:_MOST_CURVES]):
                look: dict[str, Any] = {"color": filter_color(name), "linewidth": 0.8, "alpha": 0.7}
                ax.plot(score.time_s, getattr(score, key), label=name if number == 0 else "_", **look)
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

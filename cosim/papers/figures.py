"""The papers' figures, drawn again from an experiment's results, as SVG text."""

import math
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..drawing import STYLE, WIDTH_IN, log_scale, svg
from ..palette import BLUE, BROWN, GREEN, GREY, LIGHT_GREY, OLIVE, PINK, VERMILION, VIOLET
from .results import Curve, Panel, PaperFigure

_COLORS = (VERMILION, BLUE, GREEN, PINK, OLIVE, VIOLET, BROWN, "#00573F", "#74B6EC", "black")
_LOOKS: dict[str, dict[str, Any]] = {
    "line": {},
    "dashed": {"linestyle": "--"},
    "dotted": {"linestyle": ":"},
    "points": {"linestyle": "none", "marker": "o", "markersize": 4},
    "crosses": {"linestyle": "none", "marker": "x", "markersize": 5},
    "stars": {"linestyle": "none", "marker": "*", "markersize": 9, "markeredgecolor": "black"},
}
_PER_ROW = 5
"""Entries of the legend side by side."""


def draw_figures(figures: tuple[PaperFigure, ...]) -> dict[str, str]:
    """SVG elements by name."""
    with mpl.rc_context(STYLE):
        return {figure.name: svg(_drawn(figure)) for figure in figures}


def _drawn(figure: PaperFigure) -> Figure:
    labels = dict.fromkeys(c.label for row in figure.panels for panel in row for c in panel.curves if c.label)
    colors = dict(zip(labels, (_COLORS[i % len(_COLORS)] for i in range(len(labels))), strict=True))
    rows, columns = len(figure.panels), max(len(row) for row in figure.panels)
    top_in = 0.25 + 0.2 * math.ceil(len(labels) / _PER_ROW) + (0.15 if figure.panels[0][0].title else 0.0)
    drawn = Figure(figsize=(WIDTH_IN, figure.height_in))
    axes = drawn.subplots(rows, columns, squeeze=False)
    drawn.subplots_adjust(
        left=0.75 / WIDTH_IN,
        right=0.99,
        bottom=0.5 / figure.height_in,
        top=1 - top_in / figure.height_in,
        wspace=0.24,
        hspace=0.35,
    )
    for row, panels in zip(axes, figure.panels, strict=True):
        for ax in row[len(panels) :]:
            ax.set_visible(False)
        for ax, panel in zip(row, panels, strict=False):
            _fill(ax, panel, colors)
    entries: dict[str, Any] = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0), "ncols": min(len(entries), _PER_ROW)}
        drawn.legend(list(entries.values()), list(entries), **place)
    return drawn


def _fill(ax: Axes, panel: Panel, colors: dict[str, str]) -> None:
    for low, high in panel.shaded:
        ax.axvspan(low, high, color=LIGHT_GREY, alpha=0.35, linewidth=0)
    for curve in panel.curves:
        _plot(ax, curve, curve.color or colors.get(curve.label, GREY))
    ax.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.title:
        ax.set_title(panel.title)
    if all(np.equal(np.mod(curve.x, 1), 0).all() for curve in panel.curves):
        ax.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
    if panel.log_y:
        log_scale(ax)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")


def _plot(ax: Axes, curve: Curve, color: str) -> None:
    # A label that begins with an underscore has no entry in the legend: an empty one counts as such.
    label = curve.label or "_"
    ax.plot(curve.x, curve.y, color=color, label=label, linewidth=1.4, **_LOOKS[curve.look])
    if curve.low is not None and curve.high is not None:
        known = np.isfinite(curve.low) & np.isfinite(curve.high)
        ax.fill_between(curve.x, curve.low, curve.high, where=known, color=color, alpha=0.18, linewidth=0)

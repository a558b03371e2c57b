"""What the figures of all reports share: their style, their panels, and their way into SVG text."""

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

STYLE: Any = {
    "svg.fonttype": "none",  # text stays text, in the reader's font
    "svg.hashsalt": "fleetalign",  # equal figures have equal text
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}
WIDTH_IN = 11.0


def svg(figure: Figure) -> str:
    """The ``<svg>`` element of a figure, without the XML prologue."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def panels(
    rows: int, columns: int, height_in: float, hspace: float = 0.15, top_in: float = 0.42
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of the page's width and its axes (rows, columns), with ``top_in`` above them for `legend`."""
    figure = Figure(figsize=(WIDTH_IN, height_in))
    axes = figure.subplots(rows, columns, squeeze=False)
    left, wspace = 0.75 / WIDTH_IN, 0.24
    bottom, top = 0.5 / height_in, 1 - top_in / height_in
    figure.subplots_adjust(left=left, right=0.99, bottom=bottom, top=top, wspace=wspace, hspace=hspace)
    return figure, axes


def legend(figure: Figure, *axes: Axes) -> None:
    """One legend for all panels, above them."""
    entries = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="upper center",
        ncols=len(entries),
        bbox_to_anchor=(0.5, 1.0),
    )


def log_scale(ax: Axes, bottom: float | None = None) -> None:
    """Logarithmic, with plain numbers at the decades, and at twos and fives where there are few decades."""
    if not np.isfinite(ax.dataLim.minposy):
        return  # nothing to show
    ax.set_yscale("log")
    ax.set_ylim(bottom=bottom)
    low, high = ax.get_ylim()
    steps = (1.0,) if high > 300 * low else (1.0, 2.0, 5.0)
    ax.yaxis.set_major_locator(LogLocator(subs=steps))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    ax.yaxis.set_minor_locator(NullLocator())

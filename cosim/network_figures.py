"""The figures of the report's network page, as SVG text."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy.stats import norm

from ..network.indicators import BASE_LINE_S
from ..network.localization.problem import NodeOutcome
from ..network.record import Array, Booleans, NetworkRecord
from ..sins.units import MILLISECOND
from .drawing import STYLE, WIDTH_IN, legend, panels, svg
from .network_scenery import fleet_ned
from .network_score import NetworkScore
from .palette import AIRCRAFT, ANCHOR, BLUE, CLUSTER_HEAD, LINK, NODE, UNLOCATED, VERMILION

_OWN, _FLEET = VERMILION, BLUE
_MAX_POINTS = 800
_MAX_DELAY_MS = 200.0


def draw_network(record: NetworkRecord, score: NetworkScore) -> dict[str, str]:
    """SVG elements by name: ``topology`` of one run; ``delay`` and ``fix`` of all, where there are any."""
    with mpl.rc_context(STYLE):
        figures = {"topology": svg(_topology(record))}
        if len(score.own_delay) or len(score.fleet_delay):
            figures["network_delay"] = svg(_delay(score))
        if len(score.own_error):
            figures["fix"] = svg(_own_fix(score))
    return figures


def _topology(record: NetworkRecord) -> Figure:
    """The fleet at the middle of the record, from above and from the south."""
    link_row = len(record.link_time) // 2
    row = int(np.argmin(np.abs(record.time - record.link_time[link_row])))
    ned = fleet_ned(record.lla[row]) / 1000
    east, north, height = ned[:, 1], ned[:, 0], -ned[:, 2]
    linked = record.linked[link_row]

    figure = Figure(figsize=(WIDTH_IN, 5.6))
    plan = figure.add_axes((0.065, 0.09, 0.45, 0.84))
    side = figure.add_axes((0.575, 0.42, 0.415, 0.46))
    for ax, upward in ((plan, north), (side, height)):
        if ax is plan:
            _lines(ax, east, upward, np.tril(linked), color=LINK, linewidth=0.4, alpha=0.45, label="links")
        own = np.zeros_like(linked)
        own[0] = linked[0]
        color = "#B8860B"
        _lines(ax, east, upward, own, color=color, linewidth=1.0, label="links of the own ship")
        _nodes(ax, east, upward, record, row, record.head[link_row])
    plan.set(xlabel="east of the fleet's centre, km", ylabel="north of the fleet's centre, km")
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_title(f"{record.time[row]:.1f} s, from above")
    side.set(xlabel="east of the fleet's centre, km", ylabel="height, km", title="from the south")
    handles, labels = plan.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower left", bbox_to_anchor=(0.56, 0.06), ncols=2)
    return figure


def _lines(ax: Axes, x: Array, y: Array, linked: Booleans, **look: Any) -> None:
    """A line for each True of (n, n), all in one path."""
    i, j = np.nonzero(linked)
    gaps = np.full(len(i), np.nan)
    ax.plot(*(np.stack([v[i], v[j], gaps], axis=1).ravel() for v in (x, y)), **look)


def _nodes(ax: Axes, x: Array, y: Array, record: NetworkRecord, row: int, head: Booleans) -> None:
    """Nodes by what they are: one mark each, heads ringed."""
    own = np.arange(len(x)) == 0
    located = np.isin(record.outcome[row], (NodeOutcome.ANCHOR, NodeOutcome.LOCATED))
    kinds = (
        ("node, located", NODE, "o", 28, ~record.anchor & located & ~own),
        ("node, not located", UNLOCATED, "X", 36, ~located & ~own),
        ("anchor", ANCHOR, "^", 42, record.anchor & ~own),
        ("own ship", AIRCRAFT, "*", 190, own),
    )
    if head.any():
        ring = {"facecolors": "none", "edgecolors": CLUSTER_HEAD, "linewidths": 1.6}
        ax.scatter(x[head], y[head], s=120, zorder=3, label="cluster head", **ring)
    for label, color, marker, size, chosen in kinds:
        if chosen.any():
            look = {"c": color, "marker": marker, "s": size, "edgecolors": "black", "linewidths": 0.6}
            ax.scatter(x[chosen], y[chosen], zorder=4, label=label, **look)


def _delay(score: NetworkScore) -> Figure:
    """How delays are distributed, and how many exceed what."""
    figure, ((histogram, tail),) = panels(1, 2, 3.4)
    limit_ms = BASE_LINE_S / MILLISECOND
    sets = (
        ("all packets of the fleet", _FLEET, score.fleet_delay),
        ("the own ship's fixes", _OWN, score.own_delay),
    )
    sets = [(label, color, delay / MILLISECOND) for label, color, delay in sets if len(delay)]
    # A longest wait far out would leave the rest no room.
    end = min(max(1.2 * limit_ms, *(np.percentile(delay, 99.7) for _, _, delay in sets)), _MAX_DELAY_MS)
    edges = np.linspace(0, end, 61)
    for label, color, delay in sets:
        weights = np.full(len(delay), 100 / len(delay))
        histogram.hist(delay, edges, weights=weights, color=color, alpha=0.2)
        histogram.hist(
            delay, edges, weights=weights, histtype="step", color=color, linewidth=1.4, label=label
        )
        probability = np.linspace(0, 1, 400) ** 0.25
        tail.plot(np.quantile(delay, probability), 1 - probability + 1e-12, color=color, linewidth=1.6)
    _, color, delay = sets[-1]
    for percentile, style in ((50, "-"), (95, "--"), (99, ":")):
        value = np.percentile(delay, percentile)
        histogram.axvline(
            value, color=color, linestyle=style, linewidth=1, label=f"{percentile} %: {value:.1f} ms"
        )
    for ax in (histogram, tail):
        ax.axvline(limit_ms, color="black", linewidth=1.2, label=f"{limit_ms:g} ms")
        ax.set(xlim=(0, end), xlabel="delay, ms")
    histogram.set(ylabel=f"share per {edges[1]:.1f} ms, %")
    tail.set(ylabel="share with a longer delay", yscale="log", ylim=(3e-4, 1.1))
    legend(figure, histogram)
    return figure


def _own_fix(score: NetworkScore) -> Figure:
    """Errors of the own ship's fixes with the ellipse that their mean covariance states."""
    figure, axes = panels(1, 3, 4.0)
    plan, vertical, velocity = axes[0]
    every = max(1, len(score.own_error) // _MAX_POINTS)
    size = 2.0 if len(score.own_error) > 400 else 5.0
    for ax, rows, unit, what in ((plan, [0, 1], "m", "error"), (velocity, [3, 4], "m/s", "velocity error")):
        error = score.own_error[::every, rows]
        cov = score.own_cov[np.ix_(rows, rows)]
        ax.plot(error[:, 1], error[:, 0], ".", color=_FLEET, markersize=size, alpha=0.5)
        _ellipses(ax, cov)
        ax.set(xlabel=f"{what} east, {unit}", ylabel=f"{what} north, {unit}")
        reach = max(1.05 * np.percentile(np.abs(error), 99.8), 2.2 * np.sqrt(cov.diagonal().max()))
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach))
        ax.set_aspect("equal", adjustable="box")
    down, sd = score.own_error[:, 2], float(np.sqrt(score.own_cov[2, 2]))
    reach = max(4 * sd, float(np.percentile(np.abs(down), 99.8)))
    edges = np.linspace(-reach, reach, 51)
    vertical.hist(down, edges, density=True, color=_FLEET, alpha=0.45)
    x = np.linspace(-reach, reach, 300)
    vertical.plot(x, norm.pdf(x, scale=sd), color="black", linewidth=1.2, label="stated")
    for sigma, style in ((1, "-"), (2, "--")):
        for side in (-1, 1):
            vertical.axvline(side * sigma * sd, color="black", linestyle=style, linewidth=0.7)
    vertical.set(xlabel="error down, m", ylabel="density, 1/m", yticks=[])
    plan.plot([], [], ".", color=_FLEET, markersize=7, label="fixes")
    legend(figure, plan)
    return figure


def _ellipses(ax: Axes, cov: Array) -> None:
    """1- and 2-sigma ellipses of a covariance (2, 2) of north and east, east to the right."""
    values, vectors = np.linalg.eigh(cov)
    angle = float(np.degrees(np.arctan2(vectors[0, 1], vectors[1, 1])))
    for sigma, style in ((1, "-"), (2, "--")):
        share = 100 * (1 - np.exp(-(sigma**2) / 2))
        width, height = 2 * sigma * np.sqrt(values[::-1])
        look = {"fill": False, "edgecolor": "black", "linestyle": style, "linewidth": 1.2, "zorder": 3}
        label = f"{sigma} sigma, mean of what fixes state ({share:.0f} % inside)"
        ax.add_patch(Ellipse((0, 0), width, height, angle=angle, label=label, **look))

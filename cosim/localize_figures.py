"""The figures of `localize`, as SVG text."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ..network.indicators import BASE_LINE_S
from ..network.record import Array
from ..sins.units import MILLISECOND
from .drawing import STYLE, legend, log_scale, panels, svg
from .localize import LocalizeResults
from .localize_flight import Figure3
from .localize_paper import RADII_M, RANGING_ERRORS, Figure2
from .localize_verdicts import COVERAGE_AT_40, ERROR_AT_5, TABLE_2
from .network_figures import draw_network
from .network_score import NetworkScore
from .palette import BLUE, VERMILION
from .still import PROTOCOLS, mean_known

COLORS = {"dmdg": BLUE, "leach": VERMILION}
NAMES = {"dmdg": "DMDG", "leach": "LEACH"}
# Where two curves coincide, the thin one stands on the wide one.
_PROTOCOL_LOOKS: dict[str, Any] = {
    "dmdg": {"linewidth": 3.5, "marker": "o", "markersize": 6},
    "leach": {"linewidth": 1.2, "marker": "s", "markersize": 2.5},
}
_FLIGHT_LOOKS: dict[str, Any] = {
    "ranges alone": {"color": "#A8A8A8", "linewidth": 4.0},
    "ranges and altitude": {"color": VERMILION, "linewidth": 1.3},
    "ranges and range rates": {"color": "#74B6EC", "linewidth": 4.0},
    "ranges, range rates, altitude": {"color": "#00573F", "linewidth": 1.3},
}
RUNNING_S = 20.0
"""Span of the running mean in the figure of the fleet's RMSE: less noise, so that its curves come apart."""


def draw_localize(results: LocalizeResults) -> dict[str, str]:
    """SVG elements by name.

    These are ``delays``, ``figure_2``, ``figure_3``, ``fleet``, and of each protocol those of `draw_network`.
    """
    figures = {
        f"{kind}_{name}": figure
        for kind in PROTOCOLS
        for name, figure in draw_network(results.records[kind], results.scores[kind]).items()
    }
    with mpl.rc_context(STYLE):
        figures["delays"] = svg(draw_delays(results.scores))
        figures["figure_2"] = svg(_figure_2(results.figure_2))
        figures["figure_3"] = svg(_figure_3(results.figure_3))
        figures["fleet"] = svg(_fleet(results.figure_3))
    return figures


def draw_delays(scores: dict[str, NetworkScore]) -> Figure:
    """How many packets of the fleet exceed what delay. Those that never arrive are later than any."""
    figure, ((ax,),) = panels(1, 1, 3.4)
    last = max((float(s.fleet_delay.max()) for s in scores.values() if len(s.fleet_delay)), default=0.1)
    edge = max(3 * last / MILLISECOND, 200.0)
    for kind, score in scores.items():
        color, sent = COLORS[kind], max(score.sent, 1)
        delay = np.concatenate([[0.0], np.sort(score.fleet_delay) / MILLISECOND])
        share = 1 - np.arange(len(delay)) / sent
        kept = np.unique(np.linspace(0, len(delay) - 1, 600).astype(int))
        label = f"{NAMES[kind]}: {_percent(score.delivered / sent)} delivered"
        ax.plot(delay[kept], share[kept], color=color, linewidth=1.6, label=label)
        if score.delivered < score.sent:
            lost = score.sent - score.delivered - score.queued
            ax.plot([delay[-1], edge], [share[-1]] * 2, color=color, linewidth=1.6, linestyle=":")
            ax.plot(delay[-1], share[-1], color=color, marker="o", markersize=5)
            never = (
                f"{NAMES[kind]}'s others never arrive: {_percent(score.queued / sent)} in queues when time"
            )
            text = f"{never} ends, {_percent(lost / sent)} lost"
            place = {"xytext": (0, -6), "textcoords": "offset points", "ha": "right", "va": "top"}
            ax.annotate(text, (edge, share[-1]), color=color, **place)
    label = f"{BASE_LINE_S / MILLISECOND:g} ms"
    ax.axvline(BASE_LINE_S / MILLISECOND, color="black", linewidth=1.2, label=label)
    ax.set(xscale="log", xlim=(1, edge), ylim=(0, 1.02))
    ax.set(xlabel="delay, ms", ylabel="share of packets that take longer")
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    legend(figure, ax)
    return figure


def _figure_2(found: Figure2) -> Figure:
    """Coverage and error against ranging error, a column for each radius, with what the paper prints."""
    figure, axes = panels(2, len(RADII_M), 5.0, hspace=0.12)
    percent = 100 * np.array(RANGING_ERRORS)
    for column, radius in enumerate(RADII_M):
        coverage, error = axes[0][column], axes[1][column]
        for kind in PROTOCOLS:
            look = {"color": COLORS[kind], "label": NAMES[kind], **_PROTOCOL_LOOKS[kind]}
            coverage.plot(percent, 100 * found.coverage[kind][column], **look)
            error.plot(percent, 100 * found.relative[kind][column], **look)
        look = {"linestyle": "none", "marker": "*", "markersize": 11, "markeredgecolor": "black"}
        printed = "printed: {} ".format
        coverage.plot(40, 100 * COVERAGE_AT_40, color=COLORS["leach"], label=printed("LEACH"), **look)
        error.plot(5, 100 * ERROR_AT_5, color=COLORS["dmdg"], label=printed("DMDG"), **look)
        coverage.set(ylim=(-4, 106), xlim=(2, 43))
        coverage.text(0.5, 0.5, f"radius {radius / 1000:g} km", transform=coverage.transAxes, ha="center")
        coverage.tick_params(labelbottom=False)
        error.set(xlabel="ranging error, % of the distance", xlim=(2, 43))
        log_scale(error)
        error.set_ylim(0.8, 100)
    axes[0][0].set_ylabel("coverage, %")
    axes[1][0].set_ylabel("error, % of the mean link")
    legend(figure, axes[0][0], axes[1][0])
    return figure


def _figure_3(found: Figure3) -> Figure:
    """The own ship's error, a column for each set of measurements, with the bound of ranges alone."""
    figure, axes = panels(3, len(found.error), 5.6, hspace=0.12, top_in=0.62)
    for row, axis in enumerate(("east", "north", "up")):
        reach = 1.1 * max(float(np.nanmax(np.abs(e[:, row]), initial=1.0)) for e in found.error.values())
        for ax, (name, error) in zip(axes[row], found.error.items(), strict=True):
            ax.plot(found.time, error[:, row], color=_FLIGHT_LOOKS[name]["color"], linewidth=0.8)
            label = "bound of ranges alone, one sigma"
            for side in (-1, 1):
                height = side * found.bound[row]
                ax.axhline(height, color="black", linestyle="--", linewidth=0.9, label=label)
            ax.set(xlim=(0, found.time[-1]), ylim=(-reach, reach))
            ax.tick_params(labelbottom=row == 2)
            if row == 0:
                ax.set_title(name)
            if row == 2:
                ax.set_xlabel("time from the start, s")
        axes[row][0].set_ylabel(f"error {axis}, m")
    legend(figure, axes[0][0])
    return figure


def _fleet(found: Figure3) -> Figure:
    """The fleet's RMSE. Two curves may coincide: a thin one stands on a wide one of the other colour."""
    figure, (axes,) = panels(1, 3, 3.2)
    for column, (ax, axis) in enumerate(zip(axes, ("east", "north", "up"), strict=True)):
        for name, rmse in found.fleet_rmse.items():
            ax.plot(found.time, _running(rmse[:, column], found.time), label=name, **_FLIGHT_LOOKS[name])
        printed = TABLE_2["rmse_m"][column]
        ax.axhline(printed, color="black", linestyle=":", linewidth=1.3, label="Table 2, own ship")
        log_scale(ax)
        ax.set(xlabel="time from the start, s", xlim=(0, found.time[-1]), ylabel=f"RMSE {axis}, m")
    legend(figure, axes[0])
    return figure


def _running(rmse: Array, time: Array) -> Array:
    """Root of the mean square within `RUNNING_S` around each instant, of what is known."""
    near = np.abs(time[:, None] - time) <= RUNNING_S / 2
    return np.sqrt([mean_known(rmse[among] ** 2) for among in near])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"

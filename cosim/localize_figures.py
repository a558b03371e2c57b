"""The figures of `localize`, as SVG text."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ..network.indicators import BASE_LINE_S
from ..sins.units import MILLISECOND
from .drawing import STYLE, legend, log_scale, panels, svg
from .localize import LocalizeResults
from .localize_flight import Figure3
from .localize_paper import RADII_M, RANGING_ERRORS, Figure2
from .localize_verdicts import COVERAGE_AT_40, ERROR_AT_5, TABLE_2
from .network_figures import draw_network
from .network_score import NetworkScore
from .still import PROTOCOLS

COLORS = {"dmdg": "#3D8FD1", "leach": "#D55E00"}
NAMES = {"dmdg": "DMDG", "leach": "LEACH"}
_FLIGHT_COLORS = ("#9A9A9A", "#E69F00", "#3D8FD1", "#009E73")


def draw_localize(results: LocalizeResults) -> dict[str, str]:
    """SVG elements by name: ``delays``, ``figure_2``, ``figure_3``, and of each protocol `draw_network`'s."""
    figures = {
        f"{kind}_{name}": figure
        for kind in PROTOCOLS
        for name, figure in draw_network(results.records[kind], results.scores[kind]).items()
    }
    with mpl.rc_context(STYLE):
        figures["delays"] = svg(_delays(results.scores))
        figures["figure_2"] = svg(_figure_2(results.figure_2))
        figures["figure_3"] = svg(_figure_3(results.figure_3))
    return figures


def _delays(scores: dict[str, NetworkScore]) -> Figure:
    """How many packets of the fleet exceed what delay."""
    figure, ((ax,),) = panels(1, 1, 3.0)
    for kind, score in scores.items():
        delay = np.sort(score.fleet_delay) / MILLISECOND
        # Packets that never arrive are later than any.
        share = 1 - np.arange(1, len(delay) + 1) / score.sent
        kept = np.unique(np.linspace(0, len(delay) - 1, 600).astype(int))
        label = f"{NAMES[kind]}: {score.delivered / score.sent:.1%} delivered".replace("%", " %")
        ax.plot(delay[kept], share[kept], color=COLORS[kind], linewidth=1.6, label=label)
    ax.axvline(
        BASE_LINE_S / MILLISECOND, color="black", linewidth=1.2, label=f"{BASE_LINE_S / MILLISECOND:g} ms"
    )
    ax.set(xscale="log", xlim=(1, None), ylim=(0, 1))
    ax.set(xlabel="delay, ms", ylabel="share of all packets sent that take longer")
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
            look = {"color": COLORS[kind], "marker": "o", "markersize": 3, "label": NAMES[kind]}
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
    """Left the own ship's error, right the RMSE of the fleet, with the bound of ranges alone."""
    figure, axes = panels(3, 2, 6.4, hspace=0.12)
    for row, axis in enumerate(("east", "north", "up")):
        own, fleet = axes[row]
        for color, (name, error) in zip(_FLIGHT_COLORS, found.error.items(), strict=True):
            own.plot(found.time, error[:, row], color=color, linewidth=0.8, label=name)
            fleet.plot(found.time, found.fleet_rmse[name][:, row], color=color, linewidth=1.0, label=name)
        for side in (-1, 1):
            own.axhline(side * found.bound[row], color="black", linestyle="--", linewidth=0.9)
        label = "bound of ranges alone"
        own.plot([], [], color="black", linestyle="--", linewidth=0.9, label=label)
        printed = TABLE_2["rmse_m"][row]
        fleet.axhline(printed, color="black", linestyle=":", linewidth=1.1, label="RMSE in Table 2")
        own.set_ylabel(f"own ship's error {axis}, m")
        fleet.set_ylabel(f"RMSE of the fleet {axis}, m")
        log_scale(fleet)
        for ax in (own, fleet):
            ax.tick_params(labelbottom=row == 2)
            ax.set_xlim(0, found.time[-1])
            if row == 2:
                ax.set_xlabel("time from the start, s")
    legend(figure, axes[0][0], axes[0][1])
    return figure

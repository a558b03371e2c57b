"""The report's figures, as SVG text.

Filters keep the colours of `palette`; the bounds are black, dashed with stamps known, dotted without,
dash-dotted smoothed. A band spans the 5th to the 95th percentile of the runs.
"""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from ..aircraft.flight import Flight
from ..align.bound import Knowledge
from ..align.consistency import mean_band
from ..align.estimate import Array, NavStatus
from ..sins import attitude
from ..sins.units import DEG, MILLISECOND
from .clock import Clock, Outages, clock_of
from .drawing import STYLE, WIDTH_IN, legend, log_scale, panels, svg
from .palette import ALIGNMENT, filter_color
from .scenery import local_ned, told
from .score import COLUMNS, FilterScore

Scores = Mapping[str, FilterScore]


_LABELS = {
    "roll_arcsec": "roll error, arcsec",
    "pitch_arcsec": "pitch error, arcsec",
    "heading_arcmin": "heading error, arcmin",
    "v_east_mps": "velocity error east, m/s",
    "v_north_mps": "velocity error north, m/s",
}
BOUND_NAMES = {
    Knowledge.STAMPED: "bound, stamps known",
    Knowledge.DELAY_UNKNOWN: "bound, delay unknown",
    Knowledge.SMOOTHED: "bound, smoothed",
}
_MAX_POINTS = 1500


def draw_all(
    flight: Flight,
    window: Flight,
    scores: Scores,
    bounds: Mapping[str, Array],
    delay_mean_s: float,
    with_bands: bool = True,
    outages: Outages = (),
) -> dict[str, str]:
    """All figures as SVG elements by name; ``delay`` is there if a filter estimates one.

    ``bounds`` by name, each (m, 5), as `score.standard_deviations` gives them; ``delay_mean_s`` is that of
    the fixes; ``with_bands`` shows what independent runs of a consistent filter keep to; ``outages`` of the
    fixes, s of the simulation clock.
    """
    clock = clock_of(flight, window, outages)
    estimating = {name: score for name, score in scores.items() if np.any(score.delay > 0)}
    with mpl.rc_context(STYLE):
        figures = {
            "attitude": svg(_errors(clock, scores, bounds, COLUMNS[:3])),
            "velocity": svg(_errors(clock, scores, bounds, COLUMNS[3:], with_position=True)),
            "consistency": svg(_consistency(clock, scores, with_bands)),
            "flight": svg(_flight(flight, window)),
        }
        if estimating:
            figures["delay"] = svg(_delay(clock, estimating, delay_mean_s))
    return figures


def _spread(values: Array, quantiles: tuple[float, ...]) -> list[Array]:
    """Order statistics over runs, (m,) for each quantile, of (runs, m); NaN where no run has a value."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    last = np.isfinite(values).sum(axis=0) - 1
    columns = np.arange(values.shape[1])
    return [ordered[np.rint(q * last).astype(int), columns] for q in quantiles]


def _widths(scores: Scores) -> dict[str, float]:
    """Earlier filters are drawn broader, so that curves that coincide stay visible."""
    return {name: 1.3 + 0.8 * (len(scores) - 1 - i) for i, name in enumerate(scores)}


def _errors(
    clock: Clock,
    scores: Scores,
    bounds: Mapping[str, Array],
    columns: tuple[str, ...],
    with_position: bool = False,
) -> Figure:
    figure, axes = panels(1, 3, 3.6)
    for ax, column in zip(axes[0], columns, strict=False):
        i = COLUMNS.index(column)
        for name, score in scores.items():
            _rms_with_spread(
                ax, name, score.time + clock.offset, np.abs(score.errors[:, :, i]), _widths(scores)[name]
            )
        time = next(iter(scores.values())).time + clock.offset
        for (key, bound), style in zip(bounds.items(), ("--", ":", "-."), strict=False):
            ax.plot(
                time,
                bound[:, i],
                color="black",
                linestyle=style,
                linewidth=1,
                label=BOUND_NAMES[Knowledge(key)],
            )
        ax.set(ylabel=_LABELS[column], xlabel=clock.label)
        # Single runs come as near to zero as chance has it.
        floor = bounds[Knowledge.STAMPED][:, i]
        known = floor[np.isfinite(floor)]
        log_scale(ax, bottom=0.2 * float(known.min()) if len(known) else None)
    for ax in axes[0]:
        clock.shade(ax)
        for begin, name in clock.phases:
            ax.axvline(begin, color="#999999", linewidth=0.6, linestyle=":")
            ax.text(
                begin, 0.99, f" {name}", transform=ax.get_xaxis_transform(), va="top", color="#555555", size=7
            )
    if with_position:
        ax = axes[0][2]
        for name, score in scores.items():
            distance = np.linalg.norm(score.position_errors, axis=2)
            _rms_with_spread(ax, name, score.time + clock.offset, distance, _widths(scores)[name])
        ax.set(ylabel="position error, m", xlabel=clock.label)
        log_scale(ax)
        _mark_dead_reckoning(ax, clock, scores)
    legend(figure, axes[0][0])
    return figure


def _mark_dead_reckoning(ax: Axes, clock: Clock, scores: Scores) -> None:
    """A strip along the bottom for each filter, where half of its runs navigate without fixes."""
    for row, (name, score) in enumerate(scores.items()):
        alone = np.median(score.status == NavStatus.DEAD_RECKONING, axis=0) >= 0.5
        if alone.any():
            low = 0.012 * (2 * row + 1)
            ax.fill_between(
                score.time + clock.offset,
                low,
                low + 0.016,
                where=alone,
                transform=ax.get_xaxis_transform(),
                color=filter_color(name),
                linewidth=0,
            )


def _rms_with_spread(ax: Axes, name: str, time: Array, magnitude: Array, width: float) -> None:
    """RMS over runs of (runs, m), and the band of the runs."""
    color = filter_color(name)
    low, high = _spread(magnitude, (0.05, 0.95))
    ax.fill_between(time, low, high, color=color, alpha=0.15, linewidth=0)
    count = np.isfinite(magnitude).sum(axis=0)
    total = np.sum(np.where(np.isfinite(magnitude), magnitude, 0.0) ** 2, axis=0)
    rms = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    ax.plot(time, rms, color=color, linewidth=width, label=name)


def _consistency(clock: Clock, scores: Scores, with_bands: bool) -> Figure:
    figure, ((over_time, histogram),) = panels(1, 2, 3.4)
    for name, score in scores.items():
        over_time.plot(
            score.time + clock.offset,
            score.mean_nees,
            color=filter_color(name),
            linewidth=_widths(scores)[name],
            label=name,
        )
    runs = max(int(np.isfinite(score.nees[:, -1]).sum()) for score in scores.values())
    if with_bands and runs:
        over_time.axhspan(*mean_band(3, runs), color="#DDDDDD", label="95 % band if consistent")
    over_time.axhline(3, color="black", linewidth=0.6)
    over_time.set(ylabel="NEES (3), mean over the runs", xlabel=clock.label)
    log_scale(over_time)
    clock.shade(over_time)

    means = {name: score.nis[np.isfinite(score.nis)] for name, score in scores.items()}
    fixes = max(int(np.median(np.concatenate([score.fused for score in scores.values()]))), 1)
    pooled = np.concatenate([*means.values(), mean_band(6, fixes, 0.999)])
    edges = np.linspace(pooled.min() - 0.1, pooled.max() + 0.1, 41)
    for name, values in means.items():
        histogram.hist(values, edges, histtype="stepfilled", color=filter_color(name), alpha=0.2)
        histogram.hist(
            values, edges, histtype="step", color=filter_color(name), linewidth=_widths(scores)[name]
        )
    if with_bands and runs:
        mean = np.linspace(edges[0], edges[-1], 300)
        expected = runs * (edges[1] - edges[0]) * fixes * chi2.pdf(mean * fixes, 6 * fixes)
        label = f"expected of {fixes} fixes a run"
        histogram.plot(mean, expected, color="black", linestyle="--", linewidth=1, label=label)
    histogram.set(xlabel="NIS (6), mean over the fixes of a run", ylabel="runs")
    legend(figure, over_time, histogram)
    return figure


def _delay(clock: Clock, scores: Scores, delay_mean_s: float) -> Figure:
    figure, ((ax,),) = panels(1, 1, 2.6)
    for name, score in scores.items():
        low, middle, high = _spread(score.delay / MILLISECOND, (0.05, 0.5, 0.95))
        ax.fill_between(
            score.time + clock.offset, low, high, color=filter_color(name), alpha=0.2, linewidth=0
        )
        ax.plot(
            score.time + clock.offset, middle, color=filter_color(name), label=f"{name}: median of the runs"
        )
    ax.axhline(
        delay_mean_s / MILLISECOND,
        color="black",
        linestyle="--",
        linewidth=1,
        label="mean delay of the fixes",
    )
    ax.set(ylabel="estimated mean delay, ms", xlabel=clock.label)
    legend(figure, ax)
    return figure


def _flight(flight: Flight, window: Flight) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, 4.6))
    grid = figure.add_gridspec(
        3, 2, width_ratios=[3, 2], left=0.07, right=0.99, bottom=0.11, top=0.93, hspace=0.18, wspace=0.16
    )
    rows = slice(None, None, max(1, len(flight.time) // _MAX_POINTS))
    channels = {
        "altitude, m": flight.lla[rows, 2],
        "speed, m/s": np.linalg.norm(flight.v_n[rows], axis=1),
        "bank, deg": flight.bank[rows] / DEG,
    }
    first: Axes | None = None
    for i, (label, values) in enumerate(channels.items()):
        ax = figure.add_subplot(grid[i, 0], sharex=first)
        first = first or ax
        ax.axvspan(window.time[0], window.time[-1], color=ALIGNMENT, alpha=0.35, linewidth=0)
        ax.plot(flight.time[rows], values, color="#333333", linewidth=1.2)
        for phase in flight.phases[1:]:
            ax.axvline(phase.start_s, color="#999999", linewidth=0.6, linestyle=":")
        ax.set(ylabel=label, xlim=(flight.time[0], flight.time[-1]))
        ax.tick_params(labelbottom=i == 2)
        if i == 2:
            ax.set_xlabel("time from brake release, s (yellow: alignment)")
    assert first is not None
    _name_phases(first, flight)
    _ground_track(figure.add_subplot(grid[:, 1]), flight, window, rows)
    return figure


def _name_phases(ax: Axes, flight: Flight) -> None:
    """Names of the phases above a panel, those that are long enough to have room."""
    duration = float(flight.time[-1] - flight.time[0])
    for phase in flight.phases:
        name = told(phase.name)
        if (phase.end_s - phase.start_s) / duration > 0.011 * len(name):
            middle = 0.5 * (phase.start_s + phase.end_s)
            ax.text(
                middle, 1.04, name, transform=ax.get_xaxis_transform(), ha="center", color="#555555", size=8
            )


def _ground_track(ax: Axes, flight: Flight, window: Flight, rows: slice) -> None:
    """The whole track, and the alignment's with its sideways motion enlarged."""
    ned = local_ned(flight.lla, flight.lla[0]) / 1000
    aligned = local_ned(window.lla, flight.lla[0]) / 1000
    ax.plot(ned[rows, 1], ned[rows, 0], color="#333333", linewidth=1.2)
    ax.plot(aligned[:, 1], aligned[:, 0], color=ALIGNMENT, linewidth=4, alpha=0.8)
    ax.plot(ned[0, 1], ned[0, 0], marker="o", color="#333333")
    ax.set(xlabel="east of the start, km", ylabel="north of the start, km")
    ax.set_aspect("equal", adjustable="datalim")

    heading = float(attitude.to_euler(window.q_nb[0])[2])
    along, across = (
        np.array([np.cos(heading), np.sin(heading)]),
        np.array([-np.sin(heading), np.cos(heading)]),
    )
    track = (aligned - aligned[0])[:, :2][:: max(1, len(aligned) // 400)]
    inset = ax.inset_axes((0.55, 0.12, 0.42, 0.3))
    inset.plot(track @ along, 1000 * track @ across, color="#B8860B", linewidth=1.5)
    inset.set_title("alignment", size=8)
    inset.tick_params(labelsize=7)
    inset.set_xlabel("along, km", size=7, labelpad=1)
    inset.set_ylabel("across, m", size=7, labelpad=1)

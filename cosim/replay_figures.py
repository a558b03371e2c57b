"""Figures of a replay's report, as SVG text: there is no truth, so filters stand beside their own sigmas."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..align.consistency import mean_band
from ..align.estimate import Array, Estimate, FixOutcome
from ..sins import attitude
from ..sins.error_model import ACCEL, GYRO
from ..sins.units import DEG, DEG_PER_HOUR, MICRO_G, MILLISECOND
from .drawing import STYLE, legend, log_scale, panels, svg
from .palette import OUTCOME_COLORS, filter_color
from .replay import Replay, attitude_sd
from .scenery import local_ned, told

_TIME = "time from the start of the recording, s"
_MAX_POINTS, _MAX_MARKS = 1500, 300
_NIS_MEAN_OF = 50
_INNOVATIONS = ("north, m", "east, m", "down, m", "north, m/s", "east, m/s", "down, m/s")


def draw_replay(done: Replay) -> dict[str, str]:
    """All figures as SVG elements by name; ``delay`` if it is estimated.

    ``innovations_<filter>`` of each, but one alone for filters whose innovations are the same.
    """
    with mpl.rc_context(STYLE):
        figures = {"track": svg(_track(done))}
        if not done.started:
            return figures
        figures |= {
            "nis": svg(_nis(done)),
            "attitude": svg(_attitude(done)),
            "biases": svg(_biases(done)),
        }
        for names in _alike(done):
            figures[f"innovations_{names[0]}"] = svg(_innovations(done, names))
        estimating = {name: e for name, e in done.started.items() if e.sd[-1, GYRO.stop] > 0}
        if estimating:
            figures["delay"] = svg(_delay(done, estimating))
    return figures


def _thin(length: int, most: int = _MAX_POINTS) -> slice:
    return slice(None, None, max(1, length // most))


def _widths(done: Replay) -> dict[str, float]:
    """Earlier filters are drawn broader, so that curves that coincide stay visible."""
    return {name: 1.3 + 0.9 * (len(done.started) - 1 - i) for i, name in enumerate(done.started)}


def _settled_limit(time: Array, values: Array, sd: Array) -> float:
    """Limit of an axis that shows what is left after the first tenth."""
    settled = time > time[0] + 0.1 * (time[-1] - time[0])
    return float(max(1.3 * np.quantile(np.abs(values[settled]), 0.998), 3 * np.median(sd[settled]), 1e-9))


def _alike(done: Replay) -> list[list[str]]:
    """Filters in groups with the same innovations; those without sigmas left out."""
    groups: list[list[str]] = []
    for name, estimate in done.started.items():
        if not np.isfinite(done.innovation_sd[name]).any():
            continue
        for group in groups:
            first = done.estimates[group[0]]
            if np.array_equal(first.innovation, estimate.innovation, equal_nan=True):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _innovations(done: Replay, names: list[str]) -> Figure:
    name = names[0]
    estimate, sd, start = done.estimates[name], done.innovation_sd[name], done.imu.time[0]
    known = np.isfinite(estimate.innovation).all(axis=1) & np.isfinite(sd).all(axis=1)
    known = np.flatnonzero(known)[np.argsort(estimate.fix_time[known], kind="stable")]
    figure, axes = panels(2, 3, 4.6, hspace=0.12)
    time = estimate.fix_time[known] - start
    every: list[Any] = list(axes.flat)
    for i, (ax, label) in enumerate(zip(every, _INNOVATIONS, strict=True)):
        values, two_sigma = estimate.innovation[known, i], 2 * sd[known, i]
        rows = _thin(len(time))
        ax.plot(time[rows], two_sigma[rows], color="black", linewidth=0.9, label="±2 sigma")
        ax.plot(time[rows], -two_sigma[rows], color="black", linewidth=0.9)
        gated = estimate.fix_outcome[known] == FixOutcome.GATED
        ax.plot(time[rows], values[rows], linewidth=0.7, color=filter_color(name), label=" and ".join(names))
        if gated.any():
            color = OUTCOME_COLORS[FixOutcome.GATED]
            ax.plot(time[gated], values[gated], "x", markersize=4, color=color, label="gated")
        if len(known):
            limit = _settled_limit(time, values, sd[known, i])
            ax.set_ylim(-limit, limit)
        ax.set_ylabel(label)
        ax.locator_params(nbins=5)
        ax.tick_params(labelbottom=i > 2)
        if i > 2:
            ax.set_xlabel(_TIME)
    legend(figure, *every)
    return figure


def _nis(done: Replay) -> Figure:
    figure, ((ax,),) = panels(1, 1, 2.9)
    ax.axhspan(*mean_band(6, _NIS_MEAN_OF), color="#DDDDDD", label=f"95 % band of a mean of {_NIS_MEAN_OF}")
    ax.axhline(6, color="black", linewidth=0.6)
    for name, e in done.started.items():
        fused = np.flatnonzero(e.fused)
        fused = fused[np.argsort(e.fix_time[fused], kind="stable")]
        time, nis = e.fix_time[fused] - done.imu.time[0], e.nis[fused]
        few = _thin(len(nis), _MAX_MARKS)
        ax.plot(time[few], nis[few], ".", markersize=2, color=filter_color(name), alpha=0.5)
        if len(nis) >= _NIS_MEAN_OF:
            mean = np.convolve(nis, np.full(_NIS_MEAN_OF, 1 / _NIS_MEAN_OF), "valid")
            rows = _thin(len(mean))
            ax.plot(
                time[_NIS_MEAN_OF - 1 :][rows],
                mean[rows],
                color=filter_color(name),
                linewidth=_widths(done)[name],
                label=f"{name}, mean of {_NIS_MEAN_OF}",
            )
    ax.set(ylabel="NIS (6)", xlabel=_TIME)
    log_scale(ax)
    legend(figure, ax)
    return figure


def _attitude(done: Replay) -> Figure:
    figure, axes = panels(2, 3, 4.6, hspace=0.12)
    for name, e in done.started.items():
        rows = _thin(len(e.time))
        time, color = e.time[rows] - done.imu.time[0], filter_color(name)
        angles = attitude.to_euler(e.q_nb)
        angles[:, 2] = _unwrapped(angles[:, 2])
        for i, (value, sd) in enumerate(zip((angles / DEG).T, (attitude_sd(e) / DEG).T, strict=True)):
            style = {"color": color, "linewidth": _widths(done)[name], "label": name}
            axes[0][i].plot(time, value[rows], **style)
            axes[1][i].plot(time, sd[rows], **style)
    for i, angle in enumerate(("roll", "pitch", "heading")):
        axes[0][i].set_ylabel(f"{angle}, deg")
        axes[0][i].tick_params(labelbottom=False)
        axes[1][i].set(ylabel=f"sigma of {angle}, deg", xlabel=_TIME)
        log_scale(axes[1][i])
    legend(figure, axes[0][0])
    return figure


def _unwrapped(angle: Array) -> Array:
    """Without jumps at the turn of the circle, NaN left in place."""
    known = np.isfinite(angle)
    angle = angle.copy()
    angle[known] = np.unwrap(angle[known])
    return angle


def _biases(done: Replay) -> Figure:
    figure, axes = panels(2, 3, 4.6, hspace=0.12)
    for name, e in done.started.items():
        rows, width = _thin(len(e.time), _MAX_MARKS), _widths(done)[name]
        time = e.time[rows] - done.imu.time[0]
        for line, unit, bias, part in (
            (axes[0], 1e3 * MICRO_G, e.accel_bias, ACCEL),
            (axes[1], DEG_PER_HOUR, e.gyro_bias, GYRO),
        ):
            for ax, value, sd in zip(line, bias[rows].T / unit, e.sd[rows, part].T / unit, strict=True):
                _band(ax, time, value, sd, name, width)
    for i, axis in enumerate("xyz"):
        axes[0][i].set_ylabel(f"accelerometer bias {axis}, mg")
        axes[0][i].tick_params(labelbottom=False)
        axes[1][i].set(ylabel=f"gyro bias {axis}, deg/h", xlabel=_TIME)
    legend(figure, axes[0][0])
    return figure


def _band(ax: Axes, time: Array, value: Array, sd: Array, name: str, width: float) -> None:
    """A curve and two sigmas about it."""
    color = filter_color(name)
    ax.fill_between(time, value - 2 * sd, value + 2 * sd, color=color, alpha=0.13, linewidth=0)
    ax.plot(time, value, color=color, linewidth=width, label=name)


def _delay(done: Replay, estimating: dict[str, Estimate]) -> Figure:
    figure, ((ax,),) = panels(1, 1, 2.4)
    for name, e in estimating.items():
        rows = _thin(len(e.time))
        sd = e.sd[rows, GYRO.stop] / MILLISECOND
        _band(ax, e.time[rows] - done.imu.time[0], e.delay[rows] / MILLISECOND, sd, name, 1.3)
    ax.set(ylabel="estimated mean delay, ms", xlabel=_TIME)
    legend(figure, ax)
    return figure


def _track(done: Replay) -> Figure:
    figure, ((ground, height),) = panels(1, 2, 4.2)
    seen = np.isfinite(done.fixes.lla).all(axis=1)
    origin = done.fixes.lla[seen][0]
    shown = next(iter(done.estimates.values())).fix_outcome[seen]
    fixes, arrival = local_ned(done.fixes.lla[seen], origin), done.fixes.t_stamp[seen] - done.imu.time[0]
    for outcome in FixOutcome:
        rows = np.flatnonzero(shown == outcome)[_thin(int(np.count_nonzero(shown == outcome)), _MAX_MARKS)]
        if len(rows):
            style = {"marker": ".", "markersize": 3, "linestyle": "", "color": OUTCOME_COLORS[outcome]}
            ground.plot(fixes[rows, 1], fixes[rows, 0], **style, label=f"fix, {told(outcome.name)}")
            height.plot(arrival[rows], -fixes[rows, 2] + origin[2], **style)
    for name, e in done.started.items():
        started = np.isfinite(e.lla).all(axis=1)
        rows, style = _thin(len(e.time)), {"color": filter_color(name), "linewidth": 1.0, "label": name}
        ned = local_ned(e.lla[started][rows], origin)
        ground.plot(ned[:, 1], ned[:, 0], **style)
        height.plot(e.time[started][rows] - done.imu.time[0], e.lla[started][rows, 2], **style)
    ground.set(xlabel="east of the first fix, m", ylabel="north of the first fix, m")
    ground.set_aspect("equal", adjustable="datalim")
    height.set(xlabel=_TIME, ylabel="height above the ellipsoid, m")
    legend(figure, ground)
    return figure

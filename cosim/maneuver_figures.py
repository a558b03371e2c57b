"""The figures of the report of `maneuver`, as SVG text: blue the scenario's S, orange the best manoeuvre."""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ..sins.units import DEG
from .drawing import STYLE, legend, log_scale, panels, svg
from .maneuver import Flown, ManeuverStudy
from .scenery import local_ned
from .score import COLUMNS

COLORS = {"s": "#3D8FD1", "best": "#D55E00"}
_LINES = {"ekf_stamped": "-", "l2linf": ":"}
"""Filters that are drawn; one that ignores delays leaves the panel."""
_LABELS = {"s": "S", "best": "best"}
_SINCE = "time from the start of the manoeuvre, s"


def draw_maneuver(study: ManeuverStudy) -> dict[str, str]:
    """All figures as SVG elements by name."""
    with mpl.rc_context(STYLE):
        return {"bound": svg(_bound(study)), "flown": svg(_flown(study)), "grid": svg(_grid(study))}


def _pairs(study: ManeuverStudy) -> dict[str, Flown]:
    return {"s": study.s, "best": study.best}


def _bound(study: ManeuverStudy) -> Figure:
    figure, ((levels, headings),) = panels(1, 2, 4.0)
    for key, flown in _pairs(study).items():
        color, label = COLORS[key], _LABELS[key]
        time = flown.bound.time - flown.window.time[0]
        level = np.sqrt(np.mean(flown.bound_sd[:, :2] ** 2, axis=1))
        levels.plot(time, level, color=color, linestyle="--", linewidth=1.2, label=f"{label}: bound")
        headings.plot(time, flown.bound_sd[:, 2], color=color, linestyle="--", linewidth=1.2)
        for name, score in flown.scores.items():
            if name in _LINES:
                rms = score.rms
                style = {"color": color, "linestyle": _LINES[name], "linewidth": 1.6}
                level = np.sqrt(np.mean(rms[:, :2] ** 2, axis=1))
                levels.plot(score.time, level, label=f"{label}: {name}", **style)
                headings.plot(score.time, rms[:, COLUMNS.index("heading_arcmin")], **style)
    profile = study.maneuver.profile
    levels.plot(
        profile.time[1:], profile.level_arcsec[1:], color="black", linewidth=0.7, label="best, as designed"
    )
    headings.plot(profile.time[1:], profile.heading_arcmin[1:], color="black", linewidth=0.7)
    for ax, label in ((levels, "level, arcsec"), (headings, "heading, arcmin")):
        ax.set(ylabel=label, xlabel=_SINCE)
        log_scale(ax)
    legend(figure, levels)
    return figure


def _flown(study: ManeuverStudy) -> Figure:
    figure, ((banks, courses, track),) = panels(1, 3, 3.8)
    for key, flown in _pairs(study).items():
        color, time = COLORS[key], flown.window.time - flown.window.time[0]
        banks.plot(time, flown.asked_bank / DEG, color="black", linewidth=0.6, linestyle="--")
        banks.plot(time, flown.window.bank / DEG, color=color, label=_LABELS[key])
        courses.plot(time, flown.course / DEG, color=color)
        _track(track, flown, color)
    banks.set(ylabel="bank, deg (dashed: asked for)", xlabel=_SINCE)
    courses.set(ylabel="heading from the course, deg", xlabel=_SINCE)
    track.set(xlabel="to the right of the course, km", ylabel="along the course, km")
    track.set_aspect("equal", adjustable="datalim")
    legend(figure, banks)
    return figure


def _track(ax: Axes, flown: Flown, color: str) -> None:
    """The manoeuvre, and thin the flight on to its end, from above, with the first course upwards."""
    start = flown.window.lla[0]
    after = flown.flight.window(flown.window.time[-1], flown.flight.time[-1])
    heading = np.arctan2(flown.window.v_n[0, 1], flown.window.v_n[0, 0])
    for lla, width in ((flown.window.lla, 2.0), (after.lla, 0.7)):
        ned = local_ned(lla, start)[:: max(1, len(lla) // 400)] / 1000
        along = ned[:, 0] * np.cos(heading) + ned[:, 1] * np.sin(heading)
        across = ned[:, 1] * np.cos(heading) - ned[:, 0] * np.sin(heading)
        ax.plot(across, along, color=color, linewidth=width)


def _grid(study: ManeuverStudy) -> Figure:
    figure, ((ax,),) = panels(1, 1, 4.4)
    points = np.array([(point.heading_arcmin, point.level_arcsec) for point in study.grid]).reshape(-1, 2)
    ax.plot(*points.T, ".", color="#8C8C8C", label="S families within the limits")
    reached = np.array(
        [(a.profile.heading_arcmin[-1], a.profile.level_arcsec[-1]) for a in study.maneuver.attempts]
    )
    ax.plot(*reached.T, "x", color="black", label="ends of the starts")
    for key, flown in _pairs(study).items():
        level = np.sqrt(np.mean(flown.bound_sd[-1, :2] ** 2))
        ax.plot(flown.bound_sd[-1, 2], level, "o", color=COLORS[key], label=f"{_LABELS[key]}, as flown")
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set(xlabel="bound on heading at the end, arcmin", ylabel="bound on level at the end, arcsec")
    log_scale(ax)
    legend(figure, ax)
    return figure

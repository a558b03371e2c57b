"""What `localize` tells of nodes on the ground: summary, tables, and a page."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ..align.consistency import mean_band, nees
from ..network.ground import GroundSettings
from ..network.localization.bound import flipped
from ..network.record import Array, Booleans, Integers
from .ground import Ground, GroundFixes, prefixes
from .network_score import plain
from .pages import number, percent, write_page
from .papers import statistics
from .papers.figures import draw_figures
from .papers.results import Curve, Panel, PaperFigure, Value

NAMES = {"nls": "least squares", "ekf": "EKF", "ckf": "CKF", "srckf": "SR-CKF"}
_AXES = {"horizontal_m": slice(0, 2), "vertical_m": slice(2, 3), "position_m": slice(0, 3)}


def summarize_ground(settings: GroundSettings, found: Ground) -> dict[str, Any]:
    """What of `localize.json` is of the ground."""
    enough = np.isfinite(found.bound[..., 0, 0])
    with np.errstate(invalid="ignore"):
        early = {
            "time_s": prefixes(found.leg),
            "bound_m": _root_mean(found.early_bound),
            "rmse_m": _root_mean(found.early_squares),
            "ambiguous": _mean(np.where(np.isfinite(found.early_bound), found.early_ambiguous, np.nan)),
        }
    return plain(
        {
            "draws": len(found.x),
            "nodes": settings.nodes,
            "beacons": len(found.leg.time),
            "start_s": settings.start_s,
            "end_s": settings.end_s,
            "hear_enough": float(enough.mean()),
            "bound": _by_axes(np.diagonal(found.bound, axis1=-2, axis2=-1), enough),
            "estimators": {name: _score(found, fixes) for name, fixes in found.fixes.items()},
            "over_time": early,
        }
    )


def _score(found: Ground, fixes: GroundFixes) -> dict[str, Any]:
    error = fixes.x - found.x
    enough = np.isfinite(error[..., 0])
    located = enough & ~fixes.ambiguous
    band = None
    of_draw, one_each = _first_of_each(located)
    if len(of_draw) > 1:
        band = list(mean_band(3, len(of_draw)))
    over = statistics.rms_ratio(
        _of_draws(np.sum(error**2, axis=-1), located),
        _of_draws(np.trace(found.bound, axis1=-2, axis2=-1), located),
    )
    safe = np.where(located[..., None, None], fixes.cov, np.eye(3))
    consistency = np.where(located, nees(np.where(located[..., None], error, 0.0), safe), np.nan)
    gone = np.array(
        [flipped(x, truth, cov) for x, truth, cov in zip(fixes.x, found.x, found.bound, strict=True)]
    )
    return {
        "located": _share(located, np.ones_like(located)),
        "ambiguous": _share(fixes.ambiguous, enough),
        "flipped": _share(gone & located, located),
        "rmse": _by_axes(error**2, located),
        "over_bound": over.value,
        "over_bound_ci95": _interval(over),
        "nees": float(consistency[of_draw, one_each].mean()) if len(of_draw) else None,
        "nees_band95": band,
        "nees_all_nodes": float(np.nanmean(consistency)) if located.any() else None,
    }


def _first_of_each(located: Booleans) -> tuple[Integers, Integers]:
    """Draws that locate a node, and the first node each does: errors of one draw have the aircraft's in
    common."""
    draws = np.flatnonzero(np.any(located, axis=1))
    return draws, np.argmax(located[draws], axis=1)


def _of_draws(squares: Array, located: Booleans) -> Array:
    """(draws,) means over the located nodes of each; NaN for a draw that has none."""
    count = located.sum(axis=1)
    total = np.where(located, squares, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _by_axes(squares: Array, located: Booleans) -> dict[str, float | None]:
    return {
        name: float(np.sqrt(squares[located][:, axes].sum(axis=-1).mean())) if located.any() else None
        for name, axes in _AXES.items()
    }


def _share(part: Booleans, whole: Booleans) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None


def _interval(value: Value) -> list[float] | None:
    return [value.low, value.high] if np.isfinite(value.low) else None


def _mean(values: Array) -> Array:
    """(p,) over draws and nodes (draws, n, p), NaN left out."""
    known = np.isfinite(values)
    count = known.sum(axis=(0, 1))
    return np.where(known, values, 0.0).sum(axis=(0, 1)) / np.where(count > 0, count, np.nan)


def _root_mean(squares: Array) -> Array:
    return np.sqrt(_mean(squares))


def ground_table(summary: dict[str, Any]) -> Table:
    """Estimators for the terminal."""
    table = Table(
        title=Text(
            f"{summary['nodes']} nodes on the ground, {summary['beacons']} beacons from"
            f" {summary['start_s']:g} to {summary['end_s']:g} s; {summary['draws']} draws"
        ),
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    headings, rows = ground_rows(summary)
    table.caption = Text(told) if (told := without_figures(summary)) else None
    table.add_column("")
    for heading in headings:
        table.add_column(heading, justify="right")
    for name, cells in rows:
        table.add_row(name, *cells)
    return table


def ground_rows(summary: dict[str, Any]) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Headings, and name and cells of each estimator and of the bound."""
    headings = ["located", "ambiguous", "flipped", "RMSE, m:\nhor., vert.", "RMSE / bound", "NEES of 3"]
    rows: list[tuple[str, list[str]]] = []
    for name, score in summary["estimators"].items():
        shares = [percent(score[key], 1) for key in ("located", "ambiguous", "flipped")]
        over = _with_range(score["over_bound"], score["over_bound_ci95"], 3)
        consistency = _with_range(score["nees"], score["nees_band95"], 2)
        rows.append((NAMES[name], [*shares, _components(score["rmse"]), over, consistency]))
    bound = [percent(summary["hear_enough"], 1), "", "", _components(summary["bound"]), "", ""]
    return headings, [*rows, ("bound", bound)]


def without_figures(summary: dict[str, Any]) -> str:
    """Why estimators have no errors to tell of; nothing where they have."""
    none = [NAMES[name] for name, score in summary["estimators"].items() if score["over_bound"] is None]
    if not none:
        return ""
    return (
        f"All ambiguous: {', '.join(none)}. No node's mirror image in the vertical plane of the track is"
        " ruled out, so there is no error, ratio or NEES. A leg that turns tells the side."
    )


def _components(rmse: dict[str, float | None]) -> str:
    return ", ".join(number(rmse[key], 1) for key in ("horizontal_m", "vertical_m"))


def _with_range(value: float | None, ends: list[float] | None, digits: int) -> str:
    told = number(value, digits)
    return f"{told}\n{number(ends[0], digits)} to {number(ends[1], digits)}" if ends else told


def write_ground(path: Path, title: str, found: Ground, summary: dict[str, Any], command: str) -> None:
    """Write the page, whole or not at all. Raises OSError."""
    headings, rows = ground_rows(summary)
    figures = draw_figures((_figure(found, summary),))
    write_page(
        path,
        "ground.html.j2",
        figures,
        title=title,
        summary=summary,
        headings=headings,
        rows=rows,
        told=without_figures(summary),
        command=command,
    )


def _figure(found: Ground, summary: dict[str, Any]) -> PaperFigure:
    time, early = np.array(summary["over_time"]["time_s"]), summary["over_time"]

    def curve(label: str, key: str, scale: float = 1.0, **look: Any) -> Curve:
        values = np.array([np.nan if v is None else scale * v for v in early[key]])
        return Curve(label, time, values, **look)

    north, east = found.leg.beacons[:, 0] / 1000, found.leg.beacons[:, 1] / 1000
    nodes = found.x[0] / 1000
    scene = (
        Curve("ground track", east, north),
        Curve("nodes of the first draw", nodes[:, 1], nodes[:, 0], look="points"),
    )
    errors = (
        curve("RMSE of the likelier side, least squares", "rmse_m"),
        curve("bound of the true side", "bound_m", look="dashed", color="#000000"),
    )
    return PaperFigure(
        "ground",
        "",
        (
            (
                Panel("east, km", "north, km", scene, equal=True),
                Panel("time, s", "position, m", errors, log_y=True),
                Panel("time, s", "ambiguous, %", (curve("ambiguous nodes", "ambiguous", 100.0),)),
            ),
        ),
    )

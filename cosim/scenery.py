"""A recording's space and map: the flight, the tracks of the filters, the fixes."""

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from ..aircraft.flight import Flight
from ..align.estimate import Array, Estimate, FixOutcome
from ..network.fixes import Fixes
from ..sins import attitude, earth
from ..sins.error_model import POSITION
from ..sins.units import DEG
from ._rerun import PIXELS, Columns
from .palette import AIRCRAFT, ALIGNMENT, OUTCOME_COLORS, PATH, TRUTH, filter_color, rgb

HEIGHT_EXAGGERATION = 10.0
"""Of the view of the whole flight, which is a hundred times as long as it is high."""
_WING_SPAN_M = 240.0
"""Of the wings drawn along the path and of the body axes: large, so that bank shows from afar."""
_WINGS_EVERY_S = 0.5
_CURTAIN_EVERY_S = 4.0


def local_ned(lla: ArrayLike, origin: ArrayLike) -> Array:
    """North, east, down, m, shape (..., 3), for drawing.

    North and east in the plane that touches the earth at ``origin``, down the difference in height: over a
    long flight the earth falls away from the plane, and a level flight is to look level.
    """
    lla, origin = np.asarray(lla, float), np.asarray(origin, float)
    displacement_e = earth.ecef_from_lla(lla) - earth.ecef_from_lla(origin)
    ned = displacement_e @ earth.C_en(origin[0], origin[1])
    ned[..., 2] = origin[2] - lla[..., 2]
    return ned


def told(name: str) -> str:
    """A name of the code as a reader's words."""
    return name.lower().replace("s_maneuver", "S-manoeuvre").replace("_", " ")


def draw_flight(columns: Columns, flight: Flight, window: Flight, every: int) -> None:
    """The true path with wings that show the bank, and the aircraft with its body axes."""
    rows = slice(None, None, every)
    time, lla, q_nb = flight.time[rows], flight.lla[rows], flight.q_nb[rows]
    ned = local_ned(lla, flight.lla[0])
    columns.static("scene", rr.ViewCoordinates.FRD)
    columns.static("scene/flight/path", _strips([ned], TRUTH, 1.5))
    half = 0.5 * _WING_SPAN_M * attitude.rotate(q_nb, [0.0, 1.0, 0.0])
    wings = np.stack([ned - half, ned + half], axis=1)[:: _stride(time, _WINGS_EVERY_S)]
    columns.static("scene/flight/wings", _strips(list(wings), TRUTH, 0.7))
    columns.static(
        "scene/flight/aircraft",
        rr.TransformAxes3D(axis_length=_WING_SPAN_M),
        rr.Points3D([[0, 0, 0]], colors=[rgb(AIRCRAFT)], radii=[5 * PIXELS]),
    )
    scalar_last = np.roll(q_nb, -1, axis=1)
    columns.send(
        "scene/flight/aircraft", time, rr.Transform3D.columns(translation=ned, quaternion=scalar_last)
    )
    lat_lon = lla[:, :2] / DEG
    columns.static("map/flight/path", _map_line(lat_lon, TRUTH))
    columns.static(
        "map/flight/aircraft", rr.GeoPoints.from_fields(colors=[rgb(AIRCRAFT)], radii=[6 * PIXELS])
    )
    columns.send("map/flight/aircraft", time, rr.GeoPoints.columns(positions=lat_lon))
    _draw_profile(columns, flight, window, time, ned)


def _draw_profile(columns: Columns, flight: Flight, window: Flight, time: Array, ned: Array) -> None:
    """The whole flight over the ground with its heights exaggerated, its phases marked where they begin."""
    raised = ned * [1.0, 1.0, HEIGHT_EXAGGERATION]
    ground = raised * [1.0, 1.0, 0.0]
    aligning = (time >= window.time[0]) & (time <= window.time[-1])
    curtain = np.stack([raised, ground], axis=1)[:: _stride(time, _CURTAIN_EVERY_S)]
    columns.static("profile", rr.ViewCoordinates.FRD)
    columns.static("profile/path", _strips([raised], PATH, 2))
    columns.static("profile/alignment", _strips([raised[aligning]], ALIGNMENT, 4))
    columns.static("profile/height", _strips([ground, *curtain], TRUTH, 0.5))
    columns.static("profile/aircraft", rr.Points3D.from_fields(colors=[rgb(AIRCRAFT)], radii=[6 * PIXELS]))
    columns.send("profile/aircraft", time, rr.Points3D.columns(positions=raised))

    starts = [phase.start_s for phase in flight.phases]
    where = np.stack([np.interp(starts, time, axis) for axis in raised.T], axis=1)
    # A name that would cover the one before it is left out.
    apart = 0.08 * np.linalg.norm(raised[-1] - raised[0])
    kept: list[int] = []
    for i in range(len(starts)):
        if not kept or np.linalg.norm(where[i] - where[kept[-1]]) > apart:
            kept.append(i)
    labels = [f"{told(flight.phases[i].name)}, {starts[i]:.0f} s" for i in kept]
    marks = rr.Points3D(where[kept], labels=labels, colors=[rgb(PATH)], radii=[4 * PIXELS], show_labels=True)
    columns.static("profile/phases", marks)


def draw_track(columns: Columns, origin: Array, name: str, estimate: Estimate) -> None:
    """Where a filter took the vehicle to be, with its 3-sigma ellipsoid; ``origin``: lla of the scene."""
    started = np.isfinite(estimate.lla).all(axis=1)
    lla, color = estimate.lla[started], filter_color(name)
    ned = local_ned(lla, origin)
    ellipsoids = rr.Ellipsoids3D.columns(centers=ned, half_sizes=3 * estimate.sd[started, POSITION])
    columns.static(f"scene/filters/{name}/path", _strips([ned], color, 1.5))
    columns.static(f"scene/filters/{name}/three_sigma", rr.Ellipsoids3D.from_fields(colors=[rgb(color)]))
    columns.send(f"scene/filters/{name}/three_sigma", estimate.time[started], ellipsoids)
    columns.static(f"map/filters/{name}", _map_line(lla[:, :2] / DEG, color))


def draw_fixes(columns: Columns, origin: Array, name: str, estimate: Estimate, fixes: Fixes) -> None:
    """Fixes, in order of arrival, in the colours of what a filter made of them."""
    seen = np.isfinite(fixes.lla).all(axis=1)
    outcomes = [FixOutcome(outcome) for outcome in estimate.fix_outcome[seen]]
    if not outcomes:
        return
    colors = np.array([rgb(OUTCOME_COLORS[outcome]) for outcome in outcomes], np.uint8)
    points = rr.Points3D.columns(
        positions=local_ned(fixes.lla[seen], origin),
        colors=colors,
        radii=np.full(len(outcomes), 2 * PIXELS),
    )
    columns.send(f"scene/fixes/{name}", fixes.t_arrival[seen], points)
    on_map = rr.GeoPoints(lat_lon=fixes.lla[seen, :2] / DEG, colors=colors, radii=[2 * PIXELS])
    columns.static(f"map/fixes/{name}", on_map)


def _strips(strips: list[Array], color: str, pixels: float) -> rr.LineStrips3D:
    """Lines in space of one look."""
    return rr.LineStrips3D(
        [strip.astype(np.float32) for strip in strips], colors=[rgb(color)], radii=[pixels * PIXELS]
    )


def _map_line(lat_lon: Array, color: str) -> rr.GeoLineStrings:
    return rr.GeoLineStrings(lat_lon=[lat_lon], colors=[rgb(color)], radii=[2 * PIXELS])


def _stride(time: Array, every_s: float) -> int:
    return max(1, round(every_s / float(time[1] - time[0])))

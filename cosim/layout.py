"""What the viewer shows when it opens a recording."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..aircraft.flight import Flight
from ..align.estimate import Array
from ..network.record import NetworkRecord
from ._rerun import TIMELINE
from .network_scenery import ERROR_EXAGGERATION, FLEET_HEIGHT_EXAGGERATION, fleet_ned
from .run import Run
from .scenery import HEIGHT_EXAGGERATION, local_ned

Errors = dict[str, tuple[Array, Array, Array]]
"""Time, error and standard deviation by channel."""

_ERRORS = {
    "roll_arcsec": "Roll error, arcsec",
    "pitch_arcsec": "Pitch error, arcsec",
    "heading_arcmin": "Heading error, arcmin",
    "v_north_mps": "Velocity error north, m/s",
    "v_east_mps": "Velocity error east, m/s",
    "v_down_mps": "Velocity error down, m/s",
    "north_m": "Position error north, m",
    "east_m": "Position error east, m",
    "down_m": "Position error down, m",
}
BIASES = {
    "accel_bias_{}_ug": "Accelerometer bias {}, ug",
    "gyro_bias_{}_deg_h": "Gyro bias {}, deg/h",
}
_FLIGHT = {
    "altitude_m": "Altitude, m",
    "speed_mps": "Speed, m/s",
    "roll_deg": "Bank, deg",
    "load_factor_g": "Load factor, g",
    "heading_deg": "Heading, deg",
}


ALWAYS = rrb.VisibleTimeRanges(
    timeline=TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
)


def blueprint(flight: Flight, window: Flight, run: Run, errors: dict[str, Errors]) -> rrb.Blueprint:
    """Opens on the whole flight in space, the map and the attitude errors; the rest in tabs."""
    aligning, whole = whole_axis(window.time), whole_axis(flight.time)

    def error(channel: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"errors/{channel}",
            name=_ERRORS[channel],
            axis_x=aligning,
            axis_y=rrb.ScalarAxis(range=_span(errors, channel)),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftBottom, visible=channel == "roll_arcsec"),
        )

    def plot(origin: str, name: str, axis: rrb.TimeAxis, legend: bool) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=origin, name=name, axis_x=axis, plot_legend=rrb.PlotLegend(visible=legend)
        )

    attitude = ["roll_arcsec", "pitch_arcsec", "heading_arcmin"]
    velocity = ["v_north_mps", "v_east_mps", "v_down_mps"]
    position = ["north_m", "east_m", "down_m"]
    overview = rrb.Horizontal(
        rrb.Vertical(
            _profile(flight),
            rrb.Horizontal(
                _scene(flight, window, run), rrb.MapView(origin="map", name="Map", zoom=zoom(flight.lla))
            ),
        ),
        rrb.Vertical(*map(error, attitude)),
        name="Overview",
    )
    return rrb.Blueprint(
        rrb.Tabs(
            overview,
            rrb.Horizontal(
                rrb.Vertical(*map(error, velocity)),
                rrb.Vertical(*map(error, position)),
                name="Velocity and position",
            ),
            rrb.Grid(
                *(
                    plot(f"imu/{key.format(axis)}", name.format(axis), aligning, axis == "x")
                    for key, name in BIASES.items()
                    for axis in "xyz"
                ),
                grid_columns=3,
                name="Biases",
            ),
            rrb.Vertical(
                plot("nis", "NIS of each fix", aligning, True),
                plot("delay", "Delay, ms", aligning, True),
                rrb.StateTimelineView(origin="outcome", name="Outcome of fixes", time_view=aligning),
                rrb.TextLogView(origin="log", name="Fixes that were not fused"),
                row_shares=[3, 3, 2, 2],
                name="Fixes",
            ),
            rrb.Vertical(
                *(plot(f"flight/{key}", name, whole, False) for key, name in _FLIGHT.items()),
                rrb.StateTimelineView(origin="flight/phase", name="Phases", time_view=whole),
                name="Flight",
            ),
            *([] if run.network is None else [_network(run.network, aligning)]),
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused"),
        collapse_panels=True,
    )


def _profile(flight: Flight) -> rrb.Spatial3DView:
    """The whole flight from the side."""
    end = local_ned(flight.lla[-1], flight.lla[0])
    along, right, down = _along(end)
    middle, length = 0.5 * end, float(np.linalg.norm(end))
    return rrb.Spatial3DView(
        origin="profile",
        name=f"Flight, heights times {HEIGHT_EXAGGERATION:g}",
        eye_controls=rrb.EyeControls3D(
            position=middle + 0.55 * length * right - 0.15 * length * along - 0.25 * length * down,
            look_target=middle,
            eye_up=-down,
        ),
    )


def _scene(flight: Flight, window: Flight, run: Run) -> rrb.Spatial3DView:
    """The alignment from behind and above, true to scale."""
    start, middle, end = (local_ned(window.lla[i], flight.lla[0]) for i in (0, len(window.lla) // 2, -1))
    _, right, down = _along(end - start)
    length = float(np.linalg.norm(end - start))
    others = list(run.estimates)[:-1]
    return rrb.Spatial3DView(
        origin="scene",
        contents=["$origin/**", *(f"- scene/fixes/{name}/**" for name in others)],
        name="Alignment, true to scale",
        overrides={f"scene/fixes/{name}": ALWAYS for name in run.estimates},
        eye_controls=rrb.EyeControls3D(
            position=start + 0.12 * length * right - 0.1 * length * down,
            look_target=0.5 * (start + middle),
            eye_up=-down,
        ),
    )


def _network(record: NetworkRecord, axis: rrb.TimeAxis) -> rrb.Horizontal:
    """The whole fleet from above at a slant, and beside it what became of the own ship's fixes."""
    reach = float(np.abs(fleet_ned(record.lla[0])[:, :2]).max())
    height = FLEET_HEIGHT_EXAGGERATION * float(record.lla[0, :, 2].mean())
    space = rrb.Spatial3DView(
        origin="network",
        name=f"Fleet, heights times {FLEET_HEIGHT_EXAGGERATION:g}, errors times {ERROR_EXAGGERATION:g}",
        eye_controls=rrb.EyeControls3D(
            position=np.array([-1.9 * reach, 0.6 * reach, -1.3 * reach - height]),
            look_target=np.array([0.0, 0.0, -height]),
            eye_up=np.array([0.0, 0.0, -1.0]),
        ),
    )

    def plot(path: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=f"network_fixes/{path}", name=name, axis_x=axis)

    beside = rrb.Vertical(
        plot("error_m", "Error of the own ship's fix, m"),
        plot("delay_ms", "Delay of the own ship's fix, ms"),
        plot("nodes", "Nodes"),
        rrb.StateTimelineView(origin="network_fixes/fate", name="Fate of fixes", time_view=axis),
        rrb.TextLogView(origin="network_log", name="Fixes that did not arrive"),
        row_shares=[3, 3, 2, 1, 2],
    )
    return rrb.Horizontal(space, beside, column_shares=[3, 2], name="Network")


def _along(displacement: Array) -> tuple[Array, Array, Array]:
    """Unit vectors along a displacement over the ground, to the right of it, and down."""
    down = np.array([0.0, 0.0, 1.0])
    level = displacement * [1.0, 1.0, 0.0]
    along = level / max(float(np.linalg.norm(level)), 1e-9)
    return along, np.cross(down, along), down


def zoom(lla: Array) -> float:
    """Zoom of the web map (256 pixels for the world at zoom 0) that shows a whole path in 300 pixels."""
    lat, lon = lla[:, 0], lla[:, 1]
    extent = max(float(np.ptp(lon)), float(np.ptp(lat)) / np.cos(lat[0]), 1e-5)
    return float(np.clip(np.log2(300 / 256 * 2 * np.pi / extent), 0, 19))


def whole_axis(time: Array) -> rrb.TimeAxis:
    """The whole of a time, whatever the time cursor's place."""
    start, end = (rr.TimeRangeBoundary.absolute(seconds=float(time[i])) for i in (0, -1))
    return rrb.TimeAxis(link="independent", view_range=rr.TimeRange(start=start, end=end))


def _span(errors: dict[str, Errors], channel: str) -> tuple[float, float]:
    """Limits for what is left after the first third, during which the coarse errors would hide it.

    By medians over time: a filter that starts anew would hide it again.
    """
    reach = 1e-9
    for channels in errors.values():
        time, error, sd = channels[channel]
        settled = time >= time[0] + (time[-1] - time[0]) / 3
        reach = max(reach, 5 * np.median(np.abs(error[settled])), 6 * np.median(sd[settled]))
    return -reach, reach

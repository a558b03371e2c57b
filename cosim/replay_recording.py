"""The Rerun recording of a replay: tracks and fixes, innovations, attitude, biases, outcomes.

Times are those of the files, s. Entities as in `cosim.recording` (``scene``, ``map``, ``imu``, ``delay``,
``nis``, ``outcome``, ``log``), and:

``attitude/<channel>/<filter>``
    Estimated roll, pitch and heading, with 3 sigma; ``attitude_sigma/<channel>/<filter>`` the sigma alone.
``innovations/<component>/<filter>``
    Predicted minus received, with 3 sigma.
"""

import hashlib
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..sins import attitude
from ..sins.units import DEG
from . import layout
from ._rerun import TIMELINE, Columns
from .palette import filter_color
from .recording import plot_biases, plot_delay, plot_nis, tell_outcomes
from .replay import COMPONENTS, Replay, attitude_sd
from .scenery import draw_fixes, draw_track

_ANGLES = ("roll_deg", "pitch_deg", "heading_deg")


def write_replay_recording(path: Path, done: Replay) -> None:
    """Write an ``.rrd`` file; the same replay gives recordings that are equal. Raises OSError."""
    path.touch()  # Rerun reports a file that cannot be written from a thread of its own.
    identity = hashlib.sha256(done.settings.title.encode())
    for array in (done.imu.dv_b, *(e.q_nb for e in done.estimates.values())):
        identity.update(np.ascontiguousarray(array).tobytes())
    rec = rr.RecordingStream("fleetalign", recording_id=identity.hexdigest()[:32], send_properties=False)
    rec.save(path, default_blueprint=_blueprint(done))
    rec.send_recording_name(done.settings.title)
    columns = Columns(rec)
    columns.static("scene", rr.ViewCoordinates.FRD)
    origin = done.fixes.lla[np.isfinite(done.fixes.lla).all(axis=1)][0]
    for name, estimate in done.started.items():
        draw_track(columns, origin, name, estimate)
    for name, estimate in done.estimates.items():
        draw_fixes(columns, origin, name, estimate, done.fixes)
        tell_outcomes(columns, name, estimate, done.fixes)
    if done.started:
        plot_biases(columns, done.started)
        plot_nis(columns, done.started, done.fixes)
        plot_delay(columns, done.started, done.fixes)
    _plot_attitude(columns, done)
    _plot_innovations(columns, done)
    rec.flush()
    rec.disconnect()


def _plot_attitude(columns: Columns, done: Replay) -> None:
    for name, e in done.started.items():
        started = np.isfinite(e.lla).all(axis=1)
        time, color = e.time[started], filter_color(name)
        angles, sd = attitude.to_euler(e.q_nb[started]) / DEG, attitude_sd(e)[started] / DEG
        for i, channel in enumerate(_ANGLES):
            columns.line(f"attitude/{channel}/{name}", time, angles[:, i], color, name)
            columns.three_sigma(f"attitude/{channel}/{name}", time, angles[:, i], sd[:, i], color, name)
            columns.line(f"attitude_sigma/{channel}/{name}", time, sd[:, i], color, name)


def _plot_innovations(columns: Columns, done: Replay) -> None:
    for name, e in done.started.items():
        sd = done.innovation_sd[name]
        known = np.isfinite(e.innovation).all(axis=1) & np.isfinite(sd).all(axis=1)
        rows = np.flatnonzero(known)[np.argsort(e.fix_time[known], kind="stable")]
        time, color = e.fix_time[rows], filter_color(name)
        for i, component in enumerate(COMPONENTS):
            path = f"innovations/{component}/{name}"
            columns.points(path, time, e.innovation[rows, i], color, name, size=2.5)
            columns.three_sigma(path, time, 0.0, sd[rows, i], color, name)


def _blueprint(done: Replay) -> rrb.Blueprint:
    """Opens on the track, the map and the attitude; innovations, biases and fixes in tabs."""
    axis = layout.whole_axis(done.imu.time)
    others = list(done.estimates)[:-1]
    seen = np.isfinite(done.fixes.lla).all(axis=1)

    def plot(origin: str, name: str, legend: bool = False) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=origin, name=name, axis_x=axis, plot_legend=rrb.PlotLegend(visible=legend)
        )

    scene = rrb.Spatial3DView(
        origin="scene",
        contents=["$origin/**", *(f"- scene/fixes/{name}/**" for name in others)],
        name="Track, true to scale",
        overrides={f"scene/fixes/{name}": layout.ALWAYS for name in done.estimates},
    )
    on_map = rrb.MapView(origin="map", name="Map", zoom=layout.zoom(done.fixes.lla[seen]))
    names = dict(zip(_ANGLES, ("Roll, deg", "Pitch, deg", "Heading, deg"), strict=True))
    angles = [plot(f"attitude/{key}", name, key == _ANGLES[0]) for key, name in names.items()]
    sigmas = [plot(f"attitude_sigma/{key}", f"Sigma of {name.lower()}") for key, name in names.items()]
    biases = (
        plot(f"imu/{key.format(axis)}", name.format(axis), axis == "x")
        for key, name in layout.BIASES.items()
        for axis in "xyz"
    )
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Horizontal(
                rrb.Vertical(scene, on_map),
                rrb.Vertical(*angles),
                name="Overview",
            ),
            rrb.Grid(
                *(plot(f"innovations/{c}", f"Innovation {c}", c == COMPONENTS[0]) for c in COMPONENTS),
                grid_columns=3,
                name="Innovations",
            ),
            rrb.Vertical(*sigmas, name="Sigmas"),
            rrb.Grid(*biases, grid_columns=3, name="Biases"),
            rrb.Vertical(
                plot("nis", "NIS of each fix", True),
                plot("delay", "Delay, ms", True),
                rrb.StateTimelineView(origin="outcome", name="Outcome of fixes", time_view=axis),
                rrb.TextLogView(origin="log", name="Fixes that were not fused"),
                row_shares=[3, 3, 2, 2],
                name="Fixes",
            ),
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused"),
        collapse_panels=True,
    )

"""The Rerun recording of the first draw: a map with truth, INS, filters and outages; errors with 3 sigma.

``map/...``
    x and -y, m, for y of a picture goes down: track, reference nodes, and where each method takes the node
    to be.
``errors/<component>/<method>``
    Estimate minus truth; the bound's 3 sigma under ``errors/<component>/bound``.
``wsn``
    Whether there are fixes.
"""

import hashlib
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from .._rerun import PIXELS, TIMELINE, Columns
from ..layout import whole_axis
from ..palette import BLUE, BOUND, BROWN, GREEN, GREY, LIGHT_GREY, OLIVE, PINK, VERMILION, VIOLET, rgb
from .results import Array
from .xu2012 import AREAS, COMPONENTS, MATCHED, MENDED, PUBLISHED, WITH_BIAS, Trial
from .xu2012_figures import reference_nodes

_SHOWN = {
    "ins": LIGHT_GREY,
    MATCHED: BLUE,
    PUBLISHED: PINK,
    MENDED: VIOLET,
    "mlp": BROWN,
    "lssvm": OLIVE,
    "rates": VERMILION,
    WITH_BIAS: GREEN,
}
_HEADINGS = (
    "Position error in x, m",
    "Position error in y, m",
    "Velocity error in x, m/s",
    "Velocity error in y, m/s",
)


def write_recording(file: Path, done: Trial) -> None:
    """Write the first draw. Raises OSError."""
    file.touch()  # Rerun reports a file that cannot be written from a thread of its own.
    time, stretches = done.world.time, done.world.settings.stretches
    digest = hashlib.sha256()
    for method in done.methods.values():
        digest.update(np.ascontiguousarray(method.errors[0]).tobytes())
    rec = rr.RecordingStream("fleetalign", recording_id=digest.hexdigest()[:32], send_properties=False)
    rec.save(file, default_blueprint=_blueprint(time, done))
    rec.send_recording_name("INS/WSN, first draw")
    columns = Columns(rec)
    _draw_map(columns, done)
    for c, component in enumerate(COMPONENTS):
        sd = np.sqrt(done.bound[:, c])
        columns.three_sigma(f"errors/{component}/bound", time, 0.0, sd, BOUND, "bound")
        for key, color in _SHOWN.items():
            method, path = done.methods[key], f"errors/{component}/{key}"
            line = method.errors[0, :, c]
            whole = np.isfinite(line).all()
            for i, part in enumerate((slice(None),) if whole else stretches):
                # A line of its own for each outage, or they would be joined.
                if np.isfinite(line[part]).all():
                    entity = path if whole else f"{path}/{AREAS[i].replace(' ', '_')}"
                    columns.line(entity, time[part], line[part], color, method.name)
            if method.P is not None:
                own = np.sqrt(method.P[:, c, c])
                columns.three_sigma(path, time, 0.0, own, color, method.name)
    starts = [time[part.start] for part in stretches]
    columns.send("wsn", starts, rr.StateChange.columns(state=list(AREAS)))
    rec.flush()
    rec.disconnect()


def _picture(xy: Array) -> Array:
    return xy * [1.0, -1.0]


def _draw_map(columns: Columns, done: Trial) -> None:
    track, stretches = done.world.course[0], done.world.settings.stretches
    for i, part in enumerate(stretches):
        color, width = (GREEN, 6) if i % 2 == 0 else (VERMILION, 3)
        strip = rr.LineStrips2D(
            [_picture(track[part])], colors=[rgb(color)], radii=[width * PIXELS], labels=[AREAS[i]]
        )
        columns.static(f"map/track/{AREAS[i].replace(' ', '_')}", strip)
    nodes = np.concatenate([reference_nodes(done, area) for area in stretches[::2]])
    columns.static(
        "map/reference_nodes", rr.Points2D(_picture(nodes), colors=[rgb(GREY)], radii=[1.5 * PIXELS])
    )
    for key, color in {"truth": "#FFFFFF", **_SHOWN}.items():
        error = np.zeros_like(track) if key == "truth" else done.methods[key].errors[0, :, :2]
        known = np.isfinite(error[:, 0])
        shown = _picture(track + error)
        look = {"colors": [rgb(color)], "radii": [PIXELS]}
        # What a method has no part in is left out, and where it starts anew its line does.
        strips = [shown[part] for part in stretches if known[part].all()]
        columns.static(f"map/{key}", rr.LineStrips2D(strips, **look))
        columns.static(f"map/{key}/now", rr.Points2D.from_fields(colors=[rgb(color)], radii=[5 * PIXELS]))
        columns.send(f"map/{key}/now", done.world.time[known], rr.Points2D.columns(positions=shown[known]))


def _blueprint(time: Array, done: Trial) -> rrb.Blueprint:
    """Opens on the whole map beside the errors in position and velocity."""
    axis = whole_axis(time)
    track = done.world.course[0]
    (x_low, y_low), (x_high, y_high) = track.min(axis=0) - 30, track.max(axis=0) + 30
    view = rrb.VisualBounds2D(x_range=(x_low, x_high), y_range=(-y_high, -y_low))
    plots = [
        rrb.TimeSeriesView(
            origin=f"errors/{component}",
            name=heading,
            axis_x=axis,
            axis_y=rrb.ScalarAxis(range=_span(done, c)),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftBottom, visible=c == 0),
        )
        for c, (component, heading) in enumerate(zip(COMPONENTS, _HEADINGS, strict=True))
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin="map", name="Map, x and y, m", visual_bounds=view),
                rrb.StateTimelineView(origin="wsn", name="WSN", time_view=axis),
                row_shares=[5, 1],
            ),
            rrb.Vertical(*plots),
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused"),
        collapse_panels=True,
    )


def _span(done: Trial, c: int) -> tuple[float, float]:
    """Limits that show learnt corrections; the INS alone leaves them."""
    seen = [np.nanquantile(np.abs(done.methods[key].errors[0, :, c]), 0.9) for key in ("lssvm", MATCHED)]
    reach = float(max(seen))
    reach = max(reach, 3 * float(np.sqrt(done.bound[:, c].max())))
    return -1.5 * reach, 1.5 * reach

"""A recording's network: the fleet's nodes about their centre, links, errors, and what became of each fix."""

import numpy as np
import rerun as rr

from ..network.localization.problem import NodeOutcome
from ..network.record import Array, Booleans, FixFate, Integers, NetworkRecord
from ..sins import earth
from ..sins.units import MILLISECOND
from ._rerun import PIXELS, Columns
from .palette import (
    AIRCRAFT,
    ANCHOR,
    BLUE,
    CLUSTER_HEAD,
    FAINT,
    FATE_COLORS,
    GREEN,
    NODE,
    QUARANTINED,
    UNLOCATED,
    VERMILION,
    rgb,
)
from .scenery import told

FLEET_HEIGHT_EXAGGERATION = 3.0
"""Of the fleet, which is eight times as wide as it is high."""
ERROR_EXAGGERATION = 30.0
"""Of errors and their ellipsoids: tens of metres in a fleet of tens of kilometres."""
_RATE_HZ = 1.0
"""Of links and estimates."""
_AXES = {"north": VERMILION, "east": GREEN, "down": BLUE}


def fleet_ned(lla: Array) -> Array:
    """Positions (..., n, 3) about the fleet's centre, m, for drawing: north, east, and down from height 0.

    North and east in the plane that touches the earth at the centre, heights above the ellipsoid, so that
    nodes that fly level look level.
    """
    position_e = earth.ecef_from_lla(lla)
    center_e = position_e.mean(axis=-2, keepdims=True)
    center = earth.lla_from_ecef(center_e[..., 0, :])
    ned = (position_e - center_e) @ earth.C_en(center[..., 0], center[..., 1])
    ned[..., 2] = -lla[..., 2]
    return ned


def draw_network(columns: Columns, record: NetworkRecord, start_s: float) -> None:
    """Nodes, links and errors in space, and the own ship's fixes over time.

    From ``start_s`` to the record's first epoch the fleet is shown as it is then.
    """
    columns.static("network", rr.ViewCoordinates.FRD)
    step_s = float(np.mean(np.diff(record.time))) if len(record.time) > 1 else 1.0
    rows = np.arange(0, len(record.time), max(1, round(1 / (_RATE_HZ * step_s))))
    time = record.time[rows].copy()
    time[0] = min(start_s, time[0])
    ned = _raised(fleet_ned(record.lla[rows]))
    link_row = np.searchsorted(record.link_time, record.time[rows] + 1e-9, side="right") - 1
    link_row = np.maximum(link_row, 0)
    _draw_nodes(columns, time, ned, record, rows, record.head[link_row])
    _draw_links(columns, time, ned, record.linked[link_row])
    _draw_errors(columns, time, ned, record, rows)
    _plot_fixes(columns, record)
    _tell_fates(columns, record)


def _raised(ned: Array) -> Array:
    return ned * [1.0, 1.0, FLEET_HEIGHT_EXAGGERATION]


def _draw_nodes(
    columns: Columns, time: Array, ned: Array, record: NetworkRecord, rows: Integers, head: Booleans
) -> None:
    """Nodes in the colours of what they are; anchors and the own ship larger and labelled."""
    k, n = ned.shape[:2]
    located = np.isin(record.outcome[rows], (NodeOutcome.ANCHOR, NodeOutcome.LOCATED))
    colors = np.empty((k, n, 3), np.uint8)
    colors[:] = rgb(NODE)
    colors[~located] = rgb(UNLOCATED)
    colors[:, record.anchor] = rgb(ANCHOR)
    colors[head] = rgb(CLUSTER_HEAD)
    if record.faults is not None:
        colors[record.time[rows, None] >= record.faults.quarantined_s] = rgb(QUARANTINED)
        colors[:, record.faults.silenced] = rgb(QUARANTINED)
    colors[:, 0] = rgb(AIRCRAFT)
    radii = np.where(record.anchor, 6.0, 4.5) * np.ones((k, 1))
    radii[head] = 8.0
    radii[:, 0] = 9.0
    labels = np.array([f"anchor {i}" if anchor else f"node {i}" for i, anchor in enumerate(record.anchor)])
    labels = np.tile(labels, (k, 1)).astype(object)
    labels[head] = [f"head {i}" for i in np.nonzero(head)[1]]
    labels[:, record.maker] += ", makes the own ship's fixes"
    labels[:, 0] = "own ship"
    points = rr.Points3D.columns(
        positions=ned.reshape(-1, 3),
        colors=colors.reshape(-1, 3),
        radii=PIXELS * radii.ravel(),
        labels=list(labels.ravel()),
    )
    columns.static("network/nodes", rr.Points3D.from_fields(show_labels=n <= 60))
    columns.send("network/nodes", time, points.partition([n] * k))


def _draw_links(columns: Columns, time: Array, ned: Array, linked: Booleans) -> None:
    """The own ship's links and, faintly, all others."""
    own = np.zeros_like(linked)
    own[:, 0] = linked[:, 0]
    others = np.tril(linked)
    others[:, :, 0] = False
    for name, pairs, color, pixels in (
        ("own", own, rgb(AIRCRAFT), 1.2),
        ("others", others, rgb(FAINT), 0.5),
    ):
        row, i, j = np.nonzero(pairs)
        strips = np.stack([ned[row, i], ned[row, j]], axis=1).astype(np.float32)
        look = rr.LineStrips3D.from_fields(colors=[color], radii=[pixels * PIXELS])
        columns.static(f"network/links/{name}", look)
        lengths = pairs.sum(axis=(1, 2))
        columns.send(f"network/links/{name}", time, rr.LineStrips3D.columns(strips=strips).partition(lengths))


def _draw_errors(columns: Columns, time: Array, ned: Array, record: NetworkRecord, rows: Integers) -> None:
    """From each node to where it is taken to be, and the 1-sigma ellipsoid about the truth; enlarged."""
    error, sd = record.error_n[rows], record.sd_n[rows]
    shown = np.isfinite(error).all(axis=2) & ~record.anchor
    strips = np.stack([ned, ned + ERROR_EXAGGERATION * error], axis=2)[shown].astype(np.float32)
    look = rr.LineStrips3D.from_fields(colors=[rgb(CLUSTER_HEAD)], radii=[1.5 * PIXELS])
    columns.static("network/errors", look)
    lines = rr.LineStrips3D.columns(strips=strips)
    columns.send("network/errors", time, lines.partition(shown.sum(axis=1)))
    stated = shown & np.isfinite(sd).all(axis=2)
    look = rr.Ellipsoids3D.from_fields(colors=[(*rgb(NODE), 140)], line_radii=[0.5 * PIXELS])
    columns.static("network/one_sigma", look)
    ellipsoids = rr.Ellipsoids3D.columns(centers=ned[stated], half_sizes=ERROR_EXAGGERATION * sd[stated])
    columns.send("network/one_sigma", time, ellipsoids.partition(stated.sum(axis=1)))


def _plot_fixes(columns: Columns, record: NetworkRecord) -> None:
    """Delay of the own ship's fixes, their errors with 3 sigma, and how many nodes are near or located."""
    arrived = np.isfinite(record.delay)
    delay = record.delay[arrived] / MILLISECOND
    columns.points("network_fixes/delay_ms", record.time[arrived], delay, NODE, "own ship's fixes", size=2.5)
    made = np.isfinite(record.error_n[:, 0]).all(axis=1)
    for axis, (name, color) in enumerate(_AXES.items()):
        path, time = f"network_fixes/error_m/{name}", record.time[made]
        columns.line(path, time, record.error_n[made, 0, axis], color, name)
        columns.three_sigma(path, time, 0.0, record.sd_n[made, 0, axis], color, name)
    links = record.linked[:, 0].sum(axis=1)
    columns.line("network_fixes/nodes/linked", record.link_time, links, AIRCRAFT, "linked with the own ship")
    located = (record.outcome == NodeOutcome.LOCATED).sum(axis=1)
    columns.line("network_fixes/nodes/located", record.time, located, NODE, "located, no anchors")


def _tell_fates(columns: Columns, record: NetworkRecord) -> None:
    """A lane of fates, and a line of text for each fix that did not arrive."""
    words = {fate: told(fate.name) for fate in FixFate}
    lane = rr.StateConfiguration(
        values=list(words.values()),
        labels=list(words.values()),
        colors=[rgb(FATE_COLORS[fate]) for fate in words],
    )
    columns.static("network_fixes/fate", lane)
    states = [words[FixFate(fate)] for fate in record.fate]
    columns.send("network_fixes/fate", record.time, rr.StateChange.columns(state=states))
    lost = np.flatnonzero(record.fate != FixFate.DELIVERED)
    text = [f"no fix of {record.time[i]:.3f} s: {states[i]}" for i in lost]
    columns.send("network_log", record.time[lost], rr.TextLog.columns(text=text, level=["WARN"] * len(lost)))

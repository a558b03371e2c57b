"""The recording's network: nodes, links, errors and fates read back from the file."""

import numpy as np
import pytest
import rerun as rr
from fleetalign.cosim._rerun import Columns
from fleetalign.cosim.network_scenery import (
    ERROR_EXAGGERATION,
    FLEET_HEIGHT_EXAGGERATION,
    draw_network,
    fleet_ned,
)
from fleetalign.cosim.palette import AIRCRAFT, ANCHOR, CLUSTER_HEAD, NODE, UNLOCATED
from fleetalign.sins.units import DEG
from rerun.chunk import RrdReader

NODES, START_S = 10, 12.0
TIME = START_S + np.arange(51) / 10
ANCHORS = [1, 6]


@pytest.fixture(scope="module")
def record(a_network_record):
    rise = np.linspace(0, 500, len(TIME))
    own = np.column_stack([np.full(len(TIME), 30 * DEG), 120 * DEG + rise / 5e6, 1000 + rise])
    return a_network_record(TIME, own, NODES)


@pytest.fixture(scope="module")
def recorded(record, tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "network.rrd"
    recording = rr.RecordingStream("fleetalign", recording_id="a", send_properties=False)
    recording.save(path)
    draw_network(Columns(recording), record, start_s=0.0)
    recording.flush()
    recording.disconnect()
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if not chunk.is_static:
            time = np.array(batch["sim_time"].cast("int64")) / 1e9
            found |= {
                (chunk.entity_path, n): (time, batch[n].to_pylist()) for n in batch.schema.names if ":" in n
            }
    return found


def test_nodes_stand_about_the_fleets_centre_every_second(record, recorded):
    time, positions = recorded["/network/nodes", "Points3D:positions"]
    # From the beginning of the flight, so that the fleet shows whatever the time.
    np.testing.assert_allclose(time, [0.0, *(START_S + np.arange(1, 6))])
    expected = fleet_ned(record.lla[::10]) * [1, 1, FLEET_HEIGHT_EXAGGERATION]
    np.testing.assert_allclose(np.array(positions), expected, rtol=1e-5, atol=0.1)


def test_nodes_have_the_colours_of_what_they_are(recorded):
    colors = recorded["/network/nodes", "Points3D:colors"][1][-1]
    shown = [f"#{color >> 8:06X}" for color in colors]
    assert shown[0] == AIRCRAFT
    assert shown[2] == UNLOCATED
    assert shown[3] == CLUSTER_HEAD
    assert [shown[i] for i in ANCHORS] == [ANCHOR] * 2
    assert shown[4] == NODE
    labels = recorded["/network/nodes", "Points3D:labels"][1][-1]
    assert labels[:4] == ["own ship", "anchor 1", "node 2", "head 3"]


def test_links_are_the_records(record, recorded):
    linked = record.linked[0]
    _, own = recorded["/network/links/own", "LineStrips3D:strips"]
    _, others = recorded["/network/links/others", "LineStrips3D:strips"]
    assert len(own[0]) == linked[0].sum() > 0
    assert len(own[0]) + len(others[0]) == linked.sum() // 2
    ned = fleet_ned(record.lla[0]) * [1, 1, FLEET_HEIGHT_EXAGGERATION]
    neighbour = np.flatnonzero(linked[0])[0]
    np.testing.assert_allclose(own[0][0], ned[[0, neighbour]], rtol=1e-5, atol=0.1)


def test_errors_are_enlarged_from_the_truth(record, recorded):
    _, strips = recorded["/network/errors", "LineStrips3D:strips"]
    # Neither anchors nor the node that was not located have one.
    assert len(strips[0]) == NODES - len(ANCHORS) - 1
    error = np.diff(np.array(strips[0][0]), axis=0)[0]
    np.testing.assert_allclose(error, ERROR_EXAGGERATION * record.error_n[0, 0], rtol=1e-3, atol=0.1)
    _, sizes = recorded["/network/one_sigma", "Ellipsoids3D:half_sizes"]
    np.testing.assert_allclose(sizes[0][0], ERROR_EXAGGERATION * np.array([10, 12, 40]))


def test_fixes_have_their_delay_and_their_fate(record, recorded):
    time, delay = recorded["/network_fixes/delay_ms", "Scalars:scalars"]
    np.testing.assert_allclose(time, TIME[3:])
    np.testing.assert_allclose(np.ravel(delay), 1000 * record.delay[3:])
    time, states = recorded["/network_fixes/fate", "StateChange:state"]
    np.testing.assert_allclose(time, TIME)
    assert [row[0] for row in states[:4]] == ["too few neighbours"] * 2 + ["lost", "delivered"]
    _, text = recorded["/network_log", "TextLog:text"]
    assert [row[0] for row in text] == [
        "no fix of 12.000 s: too few neighbours",
        "no fix of 12.100 s: too few neighbours",
        "no fix of 12.200 s: lost",
    ]


def test_plots_tell_errors_and_neighbours(record, recorded):
    _, down = recorded["/network_fixes/error_m/down", "Scalars:scalars"]
    np.testing.assert_allclose(np.ravel(down), record.error_n[:, 0, 2])
    _, lines = recorded["/network_fixes/error_m/down/three_sigma", "Scalars:scalars"]
    np.testing.assert_allclose(lines[0], [120, -120])
    _, linked = recorded["/network_fixes/nodes/linked", "Scalars:scalars"]
    assert np.ravel(linked)[0] == record.linked[0, 0].sum()
    _, located = recorded["/network_fixes/nodes/located", "Scalars:scalars"]
    assert np.ravel(located)[0] == NODES - len(ANCHORS) - 1

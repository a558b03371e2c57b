"""The recording holds what the run held: entities, timeline and values read back from the file."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.aircraft.flight import Flight, Phase
from fleetalign.align.estimate import Estimate, FixOutcome, NavStatus, RunOutcome
from fleetalign.cosim.palette import filter_color
from fleetalign.cosim.recording import write_recording
from fleetalign.cosim.run import Run
from fleetalign.cosim.scenery import local_ned
from fleetalign.network.fixes import Fixes
from fleetalign.sins import attitude, earth
from fleetalign.sins.imu import DrawnImuErrors, Imu
from fleetalign.sins.units import ARCMIN, ARCSEC, DEG, MICRO_G, MILLISECOND
from rerun.chunk import RrdReader

START_S, END_S = 20.0, 30.0
VIBRATION_MPS = 0.01


def a_flight() -> Flight:
    """40 s at 200 m/s to the north-east, rolling from side to side."""
    time = np.arange(4001) / 100
    v_n = np.tile([140.0, 140.0, -1.0], (len(time), 1))
    lla = earth.displaced(np.array([30 * DEG, 120 * DEG, 1000.0]), v_n * time[:, None])
    q_nb = attitude.from_euler(0.3 * np.sin(time), 0.05, 45 * DEG)
    dv_b = np.tile([0.0, 0.0, -0.098], (len(time), 1))
    phases = (Phase("level", 0.0, START_S), Phase("s_maneuver", START_S, END_S), Phase("tail", END_S, 40.0))
    return Flight(time, lla, v_n, q_nb, np.zeros_like(v_n), dv_b, phases, "a1")


def an_estimate(window: Flight, fixes: Fixes, rng: np.random.Generator, delay_s: float) -> Estimate:
    """Truth with known errors, unknown for the first two rows."""
    time = window.time[10::10]
    lla, v_n, q_nb = window.at(time)
    m, k = len(time), len(fixes)
    sd = np.abs(rng.standard_normal((m, 16))) + 0.1
    sd[:, 15] *= delay_s
    outcome = np.full(k, FixOutcome.FUSED)
    outcome[0], outcome[7] = FixOutcome.INITIALIZED, FixOutcome.GATED
    nis = rng.chisquare(6, k)
    nis[0] = np.nan
    history = {
        "lla": earth.displaced(lla, rng.standard_normal((m, 3))),
        "v_n": v_n + 0.1 * rng.standard_normal((m, 3)),
        "q_nb": attitude.multiply(attitude.from_rotvec(1e-4 * rng.standard_normal((m, 3))), q_nb),
        "accel_bias": 1e-3 * rng.standard_normal((m, 3)),
        "gyro_bias": 1e-7 * rng.standard_normal((m, 3)),
        "delay": np.full(m, delay_s),
        "lever_arm_b": np.zeros((m, 3)),
        "sd": sd,
        "misalignment_cov": np.tile(np.diag([1e-8, 1e-8, 1e-6]), (m, 1, 1)),
    }
    for values in history.values():
        values[:2] = np.nan
    return Estimate(
        time=time,
        **history,
        innovation=rng.standard_normal((k, 6)),
        nis=nis,
        fix_time=fixes.t_arrival,
        fix_outcome=outcome.astype(np.int64),
        fix_jump=np.full(k, 0.5),
        status=np.where(np.arange(m) < 2, NavStatus.NOT_STARTED, NavStatus.AIDED),
        jump=np.full(m, 0.5),
        held_imu_samples=0,
        outcome=RunOutcome.ALIGNED,
    )


@pytest.fixture(scope="module")
def inputs() -> dict:
    rng = np.random.default_rng(1)
    flight = a_flight()
    window = flight.window(START_S, END_S)
    t_valid = START_S + np.arange(100) / 10
    lla, v_n, _ = window.at(t_valid)
    fixes = Fixes(
        t_valid=t_valid,
        t_stamp=t_valid,
        t_arrival=t_valid + rng.uniform(0, 0.05, 100),
        lla=earth.displaced(lla, 10 * rng.standard_normal((100, 3))),
        v_n=v_n,
        cov=np.tile(np.eye(6), (100, 1, 1)),
        source=np.zeros(100, np.int64),
        sequence=np.arange(100),
    )
    zeros = np.zeros((3, 3))
    drawn = DrawnImuErrors(
        np.full(3, 1e-7), np.array([1.0, 2.0, 3.0]) * MICRO_G, None, None, zeros, zeros, zeros, None
    )
    estimates = {
        "ekf": an_estimate(window, fixes, rng, 0.0),
        "l2linf": an_estimate(window, fixes, rng, 0.025),
    }
    run = Run(0, Imu(window.time, window.dtheta_b, window.dv_b, drawn), fixes, window.q_nb[0], estimates)
    bound = an_estimate(window, fixes, rng, 0.0)
    return {
        "title": "A title",
        "flight": flight,
        "window": window,
        "run": run,
        "bound": bound,
        "vibration_mps": VIBRATION_MPS,
    }


def read(path) -> tuple[dict, dict]:
    """Content of a recording: ``{(entity, component): values}``, static and ``(time, values)`` apart."""
    static, temporal = {}, {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times = [name for name in batch.schema.names if name == "sim_time"]
        assert chunk.is_static or times == ["sim_time"]
        for name in batch.schema.names:
            if ":" in name and chunk.is_static:
                static[chunk.entity_path, name] = [v for v in batch[name].to_pylist() if v is not None][-1]
            elif ":" in name:
                time = np.array(batch["sim_time"].cast("int64")) / 1e9
                temporal[chunk.entity_path, name] = time, batch[name].to_pylist()
    return static, temporal


@pytest.fixture(scope="module")
def recorded(inputs, tmp_path_factory) -> tuple[dict, dict]:
    path = tmp_path_factory.mktemp("recording") / "run.rrd"
    write_recording(path, **inputs)
    return read(path)


def scalars(recorded, path: str) -> tuple[np.ndarray, np.ndarray]:
    time, values = recorded[1][path, "Scalars:scalars"]
    return time, np.squeeze(np.array(values), axis=1) if len(values[0]) == 1 else np.array(values)


def test_holds_every_channel_of_every_filter(recorded):
    paths = {path for path, _ in recorded[1]}
    channels = ["roll_arcsec", "pitch_arcsec", "heading_arcmin", "v_east_mps", "v_north_mps", "v_down_mps"]
    channels += ["north_m", "east_m", "down_m"]
    for channel in channels:
        assert f"/errors/{channel}/bound/three_sigma" in paths
        for name in ("ekf", "l2linf"):
            assert {f"/errors/{channel}/{name}", f"/errors/{channel}/{name}/three_sigma"} <= paths
    for name in ("ekf", "l2linf"):
        assert {f"/nis/{name}", f"/outcome/{name}", f"/log/{name}", f"/scene/fixes/{name}"} <= paths
        assert {f"/imu/{s}_bias_{a}/{name}" for s, u in [("accel", "ug"), ("gyro", "deg_h")]
                for a in (f"x_{u}", f"y_{u}", f"z_{u}")} <= paths  # fmt: skip
    flight = {"altitude_m", "speed_mps", "roll_deg", "pitch_deg", "heading_deg", "load_factor_g", "phase"}
    assert {f"/flight/{channel}" for channel in flight} <= paths


def test_errors_are_estimate_minus_truth_from_the_first_fix_on(inputs, recorded):
    estimate, window = inputs["run"].estimates["ekf"], inputs["window"]
    rows = slice(2, None)
    lla, v_n, q_nb = window.at(estimate.time[rows])
    euler = attitude.attitude_error(estimate.q_nb[rows], q_nb)
    expected = {
        "roll_arcsec": euler[:, 0] / ARCSEC,
        "heading_arcmin": euler[:, 2] / ARCMIN,
        "v_east_mps": estimate.v_n[rows, 1] - v_n[:, 1],
        "v_down_mps": estimate.v_n[rows, 2] - v_n[:, 2],
        "north_m": earth.displacement_n(estimate.lla[rows], lla)[:, 0],
    }
    for channel, error in expected.items():
        time, values = scalars(recorded, f"/errors/{channel}/ekf")
        np.testing.assert_allclose(time, estimate.time[rows], atol=1e-8)
        np.testing.assert_allclose(values, error, rtol=1e-6, atol=1e-6)


def test_three_sigma_lines_are_those_of_the_covariance(inputs, recorded):
    bound = inputs["bound"]
    _, lines = scalars(recorded, "/errors/north_m/bound/three_sigma")
    np.testing.assert_allclose(lines, np.outer(bound.sd[2:, 0], [3, -3]))
    _, lines = scalars(recorded, "/errors/v_down_mps/ekf/three_sigma")
    sd = np.hypot(inputs["run"].estimates["ekf"].sd[2:, 5], VIBRATION_MPS)
    np.testing.assert_allclose(lines[:, 0], 3 * sd)
    _, lines = scalars(recorded, "/errors/heading_arcmin/ekf/three_sigma")
    # At a pitch of 0.05 rad the heading error is nearly the misalignment about the vertical.
    np.testing.assert_allclose(lines[:, 0], 3e-3 / ARCMIN, rtol=1e-3)


def test_truth_is_the_flight(inputs, recorded):
    flight = inputs["flight"]
    time, altitude = scalars(recorded, "/flight/altitude_m")
    np.testing.assert_allclose(time, flight.time[::10], atol=1e-8)
    np.testing.assert_allclose(altitude, flight.lla[::10, 2])
    _, translation = recorded[1]["/scene/flight/aircraft", "Transform3D:translation"]
    np.testing.assert_allclose(
        np.array(translation)[:, 0], local_ned(flight.lla[::10], flight.lla[0]), rtol=1e-6, atol=1e-3
    )
    _, quaternion = recorded[1]["/scene/flight/aircraft", "Transform3D:quaternion"]
    np.testing.assert_allclose(np.array(quaternion)[:, 0, 3], flight.q_nb[::10, 0], atol=1e-6)
    time, phases = recorded[1]["/flight/phase", "StateChange:state"]
    assert [p for row in phases for p in row] == ["level", "S-manoeuvre", "tail"]
    np.testing.assert_allclose(time, [0.0, START_S, END_S])


def test_biases_delay_and_fixes_are_those_of_the_run(inputs, recorded):
    run = inputs["run"]
    _, drawn = scalars(recorded, "/imu/accel_bias_y_ug/drawn")
    np.testing.assert_allclose(drawn, 2.0)
    _, bias = scalars(recorded, "/imu/accel_bias_y_ug/ekf")
    np.testing.assert_allclose(bias, run.estimates["ekf"].accel_bias[2:, 1] / MICRO_G)
    time, delay = scalars(recorded, "/delay/drawn")
    np.testing.assert_allclose(time, run.fixes.t_arrival, atol=1e-8)
    np.testing.assert_allclose(delay, (run.fixes.t_arrival - run.fixes.t_valid) / MILLISECOND)
    np.testing.assert_allclose(scalars(recorded, "/delay/l2linf")[1], 25.0)
    assert ("/delay/ekf", "Scalars:scalars") not in recorded[1], "it does not estimate the delay"
    time, nis = scalars(recorded, "/nis/ekf")
    np.testing.assert_allclose(time, run.fixes.t_arrival[1:], atol=1e-8)
    np.testing.assert_allclose(nis, run.estimates["ekf"].nis[1:])
    _, outcomes = recorded[1]["/outcome/ekf", "StateChange:state"]
    assert [row[0] for row in outcomes[:8]] == ["initialized", *["fused"] * 6, "gated"]
    _, text = recorded[1]["/log/ekf", "TextLog:text"]
    assert [row[0].rsplit(" ", 1)[1] for row in text] == ["initialized", "gated"]


def test_each_filter_keeps_its_own_colour(recorded):
    shown = {
        name: recorded[0][f"/errors/roll_arcsec/{name}", "SeriesLines:colors"] for name in ("ekf", "l2linf")
    }
    for name, colors in shown.items():
        assert f"#{colors[0] >> 8:06X}" == filter_color(name)


def test_equal_inputs_give_equal_recordings(inputs, tmp_path):
    write_recording(tmp_path / "a.rrd", **inputs)
    write_recording(tmp_path / "b.rrd", **inputs)
    changed = {**inputs, "bound": replace(inputs["bound"], sd=2 * inputs["bound"].sd)}
    write_recording(tmp_path / "c.rrd", **changed)
    (static_a, a), (static_b, b), (_, c) = (read(tmp_path / f"{x}.rrd") for x in "abc")
    assert static_a == static_b
    assert a.keys() == b.keys()
    for key, (time, values) in a.items():
        np.testing.assert_array_equal(time, b[key][0])
        assert values == b[key][1]
    assert (
        a["/errors/north_m/bound/three_sigma", "Scalars:scalars"][1]
        != (c["/errors/north_m/bound/three_sigma", "Scalars:scalars"][1])
    )
    identities = [RrdReader(tmp_path / f"{x}.rrd").recordings()[0].recording_id for x in "ab"]
    assert identities[0] == identities[1]


def test_a_filter_that_never_started_leaves_its_outcomes(inputs, tmp_path):
    run = inputs["run"]
    lost = replace(
        run.estimates["ekf"],
        lla=np.full_like(run.estimates["ekf"].lla, np.nan),
        nis=np.full(100, np.nan),
        fix_outcome=np.full(100, FixOutcome.LATE, np.int64),
        outcome=RunOutcome.NO_FIX,
    )
    run = replace(run, estimates={"ekf": lost, "l2linf": run.estimates["l2linf"]})
    write_recording(tmp_path / "run.rrd", **{**inputs, "run": run})
    _, temporal = read(tmp_path / "run.rrd")
    assert ("/errors/roll_arcsec/ekf", "Scalars:scalars") not in temporal
    assert {row[0] for row in temporal["/outcome/ekf", "StateChange:state"][1]} == {"late"}


def test_a_file_that_cannot_be_written_is_an_error(inputs, tmp_path):
    with pytest.raises(OSError, match="missing"):
        write_recording(tmp_path / "missing" / "run.rrd", **inputs)


def test_level_flight_looks_level_far_from_the_start():
    lla = np.array([[30.0 * DEG, 120.0 * DEG, 1000.0], [30.9 * DEG, 120.0 * DEG, 1000.0]])
    ned = local_ned(lla, lla[0])
    assert ned[1, 2] == 0.0
    np.testing.assert_allclose(ned[1, :2], [99_786.0, 0.0], rtol=1e-3, atol=1e-6)

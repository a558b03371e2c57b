"""A replay: one recording in two layouts, faults of its time base, wrong units, and what is left behind."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fleetalign.align.consistency import chi_square_quantile
from fleetalign.align.estimate import FixOutcome
from fleetalign.cosim.replay import attitude_sd, replay
from fleetalign.cosim.replay_map import TO_FRD, TO_NED, ReplayError, ReplayMap, load_map
from fleetalign.cosim.replay_outputs import summarize_replay
from fleetalign.cosim.replay_read import read_imu
from fleetalign.network.fixes import Fixes, write_fixes
from fleetalign.network.tables import TableError, read_columns, write_columns
from fleetalign.sins import attitude, earth
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.imu import ImuErrors, simulate_imu
from fleetalign.sins.mechanization import NavigationState, mechanize
from fleetalign.sins.units import DEG, G
from rerun.chunk import RrdReader

MAPS = Path(__file__).parents[1] / "docs" / "maps"
DATA = Path(os.environ.get("FLEETALIGN_RECORDING", Path(__file__).parents[2] / "shared/data/transfer_align"))
DT, N, START_S = 0.01, 4001, 1000.0
BUDGET = {
    "gyro_bias_deg_h": 50.0,
    "accel_bias_ug": 2000.0,
    "gyro_arw_deg_sqrt_h": 0.2,
    "accel_vrw_ug_sqrt_hz": 100.0,
    "vibration_mps": 0.0,
}
IMU_COLUMNS = ("dtheta_x_rad", "dtheta_y_rad", "dtheta_z_rad", "dv_x_mps", "dv_y_mps", "dv_z_mps")
COARSE = attitude.from_euler(0.01, 0.05, 1.1)
"""What the filters start from: about 2 deg off in level and 5 deg in heading."""
INITIAL = {"level_sd_deg": 2.0, "heading_sd_deg": 8.0}
QUIET = "--quiet", "--out"


def drive():
    """A vehicle that climbs, weaves and rolls: (time, dtheta, dv, history of states), mechanised exactly."""
    time = START_S + DT * np.arange(N)
    t = (time - START_S)[:, None]
    heading = 1.0 + 0.5 * np.sin(2 * np.pi * t[:, 0] / 13)
    euler = 0.25 * np.sin(2 * np.pi * t[:, 0] / 7), np.full(N, 0.05), heading
    q_nb = attitude.from_euler(*euler)
    speed = 15 + 2 * np.sin(2 * np.pi * t / 11)
    v_n = speed * np.column_stack([np.cos(heading), np.sin(heading), np.full(N, -0.2)])
    origin = np.array([50 * DEG, 10 * DEG, 300.0])
    g_north, g_down = earth.gravity(GravityModel.SOMIGLIANA, origin[0], origin[2])
    f_n = np.diff(v_n, axis=0) / DT - [g_north, 0.0, g_down]
    turned = attitude.to_rotvec(attitude.multiply(attitude.conjugate(q_nb[:-1]), q_nb[1:]))
    middle = attitude.multiply(q_nb[:-1], attitude.from_rotvec(0.5 * turned))
    dtheta, dv = np.zeros((2, N, 3))
    dtheta[1:] = turned
    dv[1:] = attitude.rotate(attitude.conjugate(middle), f_n) * DT
    start = NavigationState(origin, v_n[0], q_nb[0])
    return time, dtheta, dv, mechanize(time, dtheta, dv, start, GravityModel.SOMIGLIANA)


@pytest.fixture(scope="module")
def recording():
    """What an IMU and a receiver of stated errors make of the drive: (imu, fixes, truth)."""
    time, dtheta, dv, truth = drive()
    imu = simulate_imu(time, dtheta, dv, ImuErrors(**BUDGET), np.random.default_rng(5))
    rng, rows = np.random.default_rng(6), np.arange(0, N, 10)
    sd = np.array([0.5, 0.8, 1.0, 0.05, 0.05, 0.05])
    noise = sd * rng.standard_normal((len(rows), 6))
    fixes = Fixes(
        t_valid=time[rows],
        t_stamp=time[rows],
        t_arrival=time[rows] + 0.03,
        lla=earth.displaced(truth.lla[rows], noise[:, :3]),
        v_n=truth.v_n[rows] + noise[:, 3:],
        cov=np.tile(np.diag(sd**2), (len(rows), 1, 1)),
        source=np.zeros(len(rows), np.int64),
        sequence=np.arange(len(rows)),
    )
    return imu, fixes, truth


def a_map(**changes) -> ReplayMap:
    """The map of the own layout, with other values for some of its tables."""
    roll, pitch, heading = attitude.to_euler(COARSE) / DEG
    content = {
        "initial": {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": heading, **INITIAL},
        "imu": BUDGET,
        "alignment": {"filters": ["ekf_stamped"]},
    }
    return ReplayMap.model_validate(content | changes)


def imu_columns(imu):
    return {"time_s": imu.time} | dict(zip(IMU_COLUMNS, np.hstack([imu.dtheta_b, imu.dv_b]).T, strict=True))


@pytest.fixture(scope="module")
def files(recording, tmp_path_factory):
    """The recording in the own layout, which needs no map of columns."""
    folder = tmp_path_factory.mktemp("own")
    write_columns(imu_columns(recording[0]), folder / "imu.csv")
    write_fixes(recording[1], folder / "fixes.csv")
    return folder / "imu.csv", folder / "fixes.csv"


@pytest.fixture(scope="module")
def done(files):
    return replay(*files, a_map(alignment={"filters": ["ekf_stamped", "l2linf"]}), lambda *_: None)


def refused(files, recorded, **changes) -> str:
    """The one line that a replay of these files by this layout ends with."""
    with pytest.raises(ReplayError) as error:
        replay(*files, a_map(recorded=recorded, **changes), lambda *_: None)
    assert len(str(error.value).splitlines()) == 1
    return str(error.value)


def test_filters_find_the_attitude_within_their_sigmas(done, recording):
    truth = recording[2]
    for name, e in done.estimates.items():
        error = attitude.attitude_error(e.q_nb[-1], truth.q_nb[-1])
        sd = attitude_sd(e)[-1]
        assert (sd < np.array([0.2, 0.2, 0.6]) * DEG).all(), name
        # Four sigmas on three axes of two filters: one chance in 2600.
        assert (np.abs(error) < 4 * sd).all(), name
        bias = recording[0].errors.gyro_bias
        assert (np.abs(e.gyro_bias[-1] - bias) < 4 * e.sd[-1, 12:15]).all(), name


def test_no_attitude_is_needed_where_motion_tells_it(files, recording):
    """The coarse stage finds the heading, and the smoother knows the start as well as the end."""
    settings = {"coarse_stage": "in_motion"}
    stated = a_map(alignment={"filters": ["ekf_stamped", "smoother"], "settings": settings}, initial=None)
    found = replay(*files, stated, lambda *_: None)
    assert summarize_replay(found)["initial"] is None
    for name, rows in (("ekf_stamped", [-1]), ("smoother", [0, -1])):
        e = found.estimates[name]
        epoch = np.rint((e.time[rows] - START_S) / DT).astype(int)
        error = np.abs(attitude.attitude_error(e.q_nb[rows], recording[2].q_nb[epoch]))
        assert (error < 4 * attitude_sd(e)[rows]).all(), name
    assert np.isnan(found.innovation_sd["smoother"]).all()


def test_innovations_keep_to_their_sigmas(done):
    """With the noise that the filter is told: NIS in its band, innovations white and 95 % within 2 sigmas."""
    row = summarize_replay(done)["filters"]["ekf_stamped"]
    n = row["updates"]
    low, high = chi_square_quantile([5e-4, 1 - 5e-4], 6 * n) / n
    assert low < row["nis"] < high
    e, sd = done.estimates["ekf_stamped"], done.innovation_sd["ekf_stamped"]
    inside = np.abs(e.innovation[e.fused]) < 2 * sd[e.fused]
    # 0.9545 expected of 6 n; four standard deviations of such a count.
    assert abs(inside.mean() - 0.9545) < 4 * np.sqrt(0.9545 * 0.0455 / (6 * n))
    for component in row["innovations"].values():
        assert abs(component["correlation_of_next"]) < 4 / np.sqrt(n)


def test_estimates_come_at_the_output_rate_and_at_the_end(done):
    time = done.estimates["ekf_stamped"].time
    np.testing.assert_allclose(np.diff(time), 0.1, atol=1e-9)
    assert time[-1] == done.imu.time[-1]


def as_rates(recording, folder: Path) -> tuple[Path, Path]:
    """The recording as `rates_rfu_enu.toml` has it: deg/s, g, RFU, ms; ENU, rad, km/h."""
    imu, fixes, _ = recording
    dt = np.diff(imu.time, prepend=imu.time[0] - DT)[:, None]
    gyro, accel = imu.dtheta_b / dt / DEG @ TO_FRD["RFU"], imu.dv_b / dt / G @ TO_FRD["RFU"]
    columns = {"t_ms": imu.time * 1e3, "temperature": np.full(N, 20.0)}
    columns |= dict(zip(("gyro_right", "gyro_forward", "gyro_up"), gyro.T, strict=True))
    columns |= dict(zip(("accel_right", "accel_forward", "accel_up"), accel.T, strict=True))
    write_columns(columns, folder / "rates.csv")
    v_east, v_north, v_up = (fixes.v_n @ TO_NED["ENU"]).T * 3.6
    sd_north, sd_east, sd_up = np.sqrt(np.diagonal(fixes.cov, axis1=1, axis2=2))[:, :3].T
    columns = {"t_ms": fixes.t_stamp * 1e3, "received_ms": fixes.t_arrival * 1e3}
    columns |= dict(zip(("lat", "lon", "height"), fixes.lla.T, strict=True))
    columns |= {"v_east": v_east, "v_north": v_north, "v_up": v_up}
    columns |= {"sd_east": sd_east, "sd_north": sd_north, "sd_up": sd_up, "count": fixes.sequence}
    write_columns(columns, folder / "gnss.parquet")
    return folder / "rates.csv", folder / "gnss.parquet"


def test_other_axes_units_and_angles_give_the_same_estimates(recording, files, tmp_path):
    """The example map, and an attitude told in its convention."""
    rates = as_rates(recording, tmp_path)
    roll, pitch, heading = attitude.to_euler(COARSE) / DEG
    theirs = load_map(MAPS / "rates_rfu_enu.toml", f"{roll},{pitch},{-heading},2,8", None)
    ours = a_map(alignment=theirs.alignment.model_dump())
    assert theirs.convention == "RFU/ENU"
    a, b = (replay(*f, m, lambda *_: None) for f, m in ((rates, theirs), (files, ours)))
    assert set(a.estimates) == {"ekf_stamped", "l2linf"}
    for name, e in a.estimates.items():
        other = b.estimates[name]
        np.testing.assert_array_equal(e.fix_outcome, other.fix_outcome)
        # Times in ms and rates over their differences round at 1e-13 of 1000 s.
        np.testing.assert_allclose(attitude.misalignment(e.q_nb[-1], other.q_nb[-1]), 0, atol=1e-7)
        np.testing.assert_allclose(e.v_n[-1], other.v_n[-1], atol=1e-5)
        np.testing.assert_allclose(earth.displacement_n(e.lla[-1], other.lla[-1]), 0, atol=1e-4)
        np.testing.assert_allclose(e.sd[-1], other.sd[-1], rtol=1e-5, atol=1e-12)


def test_samples_are_taken_for_straight_lines(recording, tmp_path):
    """Of a rate that grows evenly the mean over an interval is that of its ends."""
    time = START_S + DT * np.arange(200)
    rate = 0.1 * (time - START_S)[:, None] * [1.0, -2.0, 3.0]
    columns = {"time_s": time} | dict(zip(IMU_COLUMNS, np.hstack([rate, rate - [0, 0, 9.8]]).T, strict=True))
    write_columns(columns, tmp_path / "imu.csv")
    layout = {"kind": "samples", "gyro_unit": "rad/s", "accel_unit": "m/s^2"}
    imu = read_imu(tmp_path / "imu.csv", a_map(recorded={"imu": layout}).recorded, None)
    np.testing.assert_allclose(imu.dtheta_b[1:], 0.5 * (rate[1:] + rate[:-1]) * DT, rtol=1e-9)
    assert (imu.dtheta_b[0] == 0).all()


@pytest.mark.parametrize(
    ("convention", "body", "navigation"),
    [("FRD/NED", "FRD", "NED"), ("RFU/ENU", "RFU", "ENU"), ("FLU/ENU", "FLU", "ENU")],
)
def test_angles_are_those_of_their_axes(convention, body, navigation):
    """From the definition: turn about the navigation's third axis, then the body's pitch and roll axes."""
    roll, pitch, yaw = 0.3, -0.2, 0.7
    axis = dict(zip(body, np.eye(3), strict=True))
    up = 1.0 if navigation == "ENU" else -1.0
    third = np.array([0, 0, 1.0])
    sideways = axis.get("R", axis.get("L"))
    q = attitude.from_rotvec(yaw * third)
    q = attitude.multiply(q, attitude.from_rotvec(pitch * sideways))
    q = attitude.multiply(q, attitude.from_rotvec(roll * axis["F"]))
    assert up * third[2] == (1 if navigation == "ENU" else -1)
    C_nb = TO_NED[navigation] @ attitude.to_dcm(q) @ TO_FRD[body].T
    initial = {"roll_deg": roll / DEG, "pitch_deg": pitch / DEG, "heading_deg": yaw / DEG}
    stated = a_map(initial=initial | {"convention": convention})
    np.testing.assert_allclose(attitude.to_dcm(attitude.from_euler(*stated.euler)), C_nb, atol=1e-12)
    assert "level_sd_deg" not in initial
    assert stated.settings.level_sd_deg == stated.alignment.settings.level_sd_deg


def changed(files, tmp_path, change) -> tuple[Path, Path]:
    """The files, with the rows of the IMU as ``change`` leaves them: (n, 7)."""
    columns = read_columns(files[0], ("time_s", *IMU_COLUMNS))
    rows = change(np.column_stack(list(columns.values())))
    write_columns(dict(zip(columns, rows.T, strict=True)), tmp_path / "imu.csv")
    return tmp_path / "imu.csv", files[1]


def without(rows, first, end):
    return np.delete(rows, np.s_[first:end], axis=0)


def with_nan(rows, *where):
    rows[list(where), 3] = np.nan
    return rows


def swapped(rows, i, j):
    rows[[i, j]] = rows[[j, i]]
    return rows


REPAIRED = {
    "gap": (lambda r: without(r, 1500, 1520), {"gaps": 1, "inserted_rows": 20, "longest_gap_s": 0.2}),
    "two gaps": (lambda r: without(without(r, 2000, 2001), 900, 905), {"gaps": 2, "inserted_rows": 6}),
    "repeat": (lambda r: np.insert(r, 1001, r[1000], axis=0), {"repeated_rows": 1, "rows": N + 1}),
    "packet again": (
        lambda r: np.insert(r, 1005, r[1000:1005], axis=0),
        {"repeated_rows": 5, "moved_rows": 4},
    ),
    "order": (lambda r: swapped(r, 700, 701), {"moved_rows": 1, "inserted_rows": 0}),
    "not finite": (lambda r: with_nan(r, 5, 800, 801), {"not_finite_rows": 3, "inserted_rows": 0}),
}


@pytest.mark.parametrize("fault", REPAIRED)
def test_faults_of_the_time_base_are_mended_and_counted(files, done, tmp_path, fault):
    change, counts = REPAIRED[fault]
    again = replay(*changed(files, tmp_path, change), a_map(), lambda *_: None)
    summary = summarize_replay(again)
    assert {key: summary["imu"][key] for key in counts} == pytest.approx(counts)
    untouched = set(REPAIRED["gap"][1]) | {"repeated_rows", "moved_rows", "not_finite_rows"}
    for key in untouched - set(counts) - {"longest_gap_s"}:
        assert summary["imu"][key] == 0, key
    # The time base is the whole one again, and the end nearly so: what a gap cost stands in the sigmas.
    np.testing.assert_allclose(again.imu.time, done.imu.time, atol=1e-9)
    a, b = again.estimates["ekf_stamped"], done.estimates["ekf_stamped"]
    lost = counts.get("inserted_rows", 0) + counts.get("not_finite_rows", 0)
    assert a.held_imu_samples == lost
    apart = np.abs(attitude.attitude_error(a.q_nb[-1], b.q_nb[-1]))
    assert (apart <= 2 * attitude_sd(a)[-1] if lost else apart == 0).all()


REFUSED = {
    "long gap": (lambda r: without(r, 1500, 1700), "no samples for 2.01 s from 1014.99 s; allowed is 1 s"),
    "long run of NaN": (lambda r: with_nan(r, *range(1500, 1650)), "no samples for 1.5 s from 1015 s"),
    "jump ahead": (
        lambda r: r + np.where(np.arange(N)[:, None] > 99, [1e9, *[0] * 6], 0),
        "no samples for 1e+09",
    ),
    "backward": (
        lambda r: r - np.where(np.arange(N)[:, None] > 1999, [5.0, *[0] * 6], 0),
        "row 2001: time goes back from 1019.99 s to 1015 s; allowed is 0.1 s",
    ),
    "other values": (
        lambda r: np.insert(r, 1001, r[1000] * [1, 2, 1, 1, 1, 1, 1], axis=0),
        "row 1002: a row at 1010 s, with other values",
    ),
    "too close": (
        lambda r: np.insert(r, 1001, r[1000] + [0.002, *[0] * 6], axis=0),
        "row 1002: a row at 1010.002 s, 0.002 s after the one before; allowed is 0.005 s or more",
    ),
    "few": (lambda r: r[:5], "5 rows; allowed is 10 or more"),
    "milliseconds": (lambda r: r * [1e3, *[1] * 6], "10 s between samples with time_unit = s"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_faults_beyond_the_limits_are_refused_with_their_place(files, tmp_path, fault):
    change, told = REFUSED[fault]
    line = refused(changed(files, tmp_path, change), {})
    assert line.startswith(str(tmp_path / "imu.csv"))
    assert told in line


def test_a_time_that_is_not_a_number_is_refused(files, tmp_path):
    def without_a_time(rows):
        rows[7, 0] = np.nan
        return rows

    line = refused(changed(files, tmp_path, without_a_time), {})
    assert "column time_s, row 8: an empty cell is not a finite number" in line


def test_limits_are_the_maps(files, tmp_path):
    gap = changed(files, tmp_path, lambda r: without(r, 1500, 1700))
    mended = replay(*gap, a_map(recorded={"gap_limit_s": 3.0}), lambda *_: None)
    assert mended.imu.base.inserted_rows == 200
    back = changed(files, tmp_path, lambda r: np.insert(r, 1040, r[1000:1040], axis=0))
    assert "recorded.backward_limit_s" in refused(back, {})
    assert (
        replay(*back, a_map(recorded={"backward_limit_s": 1.0}), lambda *_: None).imu.base.repeated_rows == 40
    )


def test_jitter_is_kept_and_told(files, tmp_path):
    def jittered(rows):
        rows[1::2, 0] += 0.002
        return rows

    again = replay(*changed(files, tmp_path, jittered), a_map(), lambda *_: None)
    assert again.imu.base.jitter_s == pytest.approx(0.002, abs=1e-4)
    assert again.imu.time[1] == pytest.approx(START_S + 0.012)


IMU_WRONG = {
    "g for m/s^2": (
        {"kind": "rates", "gyro_unit": "rad/s", "accel_unit": "m/s^2"},
        1 / DT / G,
        "accel_unit = g",
    ),
    "increments for rates": (
        {"kind": "rates", "gyro_unit": "rad/s", "accel_unit": "m/s^2"},
        1.0,
        "kind = increments",
    ),
    "rates for increments": ({}, 1 / DT, "kind = rates, accel_unit = m/s^2"),
    "m/s^2 for g": ({"kind": "rates", "gyro_unit": "rad/s", "accel_unit": "g"}, 1 / DT, "accel_unit = m/s^2"),
}


@pytest.mark.parametrize("fault", IMU_WRONG)
def test_wrong_units_of_the_accelerometers_are_seen_by_gravity(files, tmp_path, fault):
    layout, factor, told = IMU_WRONG[fault]
    line = refused(changed(files, tmp_path, lambda r: r * [1, 100, 100, 100, *[factor] * 3]), {"imu": layout})
    assert "specific force" in line
    assert told in line


@pytest.mark.parametrize(
    ("unit", "factor", "told"),
    [
        ("rad", 1 / DEG, "gyro_unit = deg"),
        ("deg", 1.0, "gyro_unit = rad"),
        ("arcsec", 1 / DEG, "gyro_unit = deg"),
        ("rad", 1e5, "allowed is 1e-06 to 10 rad/s"),
    ],
)
def test_wrong_units_of_the_gyros_are_seen_by_what_turns(files, tmp_path, unit, factor, told):
    turned = changed(files, tmp_path, lambda r: r * [1, *[factor] * 3, 1, 1, 1])
    assert told in refused(turned, {"imu": {"gyro_unit": unit}})


def test_gyros_against_the_course_alone(files, tmp_path):
    """Without the roll the specific force tells nothing, and the course must."""
    turned = changed(
        files, tmp_path, lambda r: np.column_stack([r[:, :1], 0 * r[:, 1:3], r[:, 3:] * [20, 1, 1, 1]])
    )
    assert "turn over change of course" in refused(turned, {})
    turned = changed(
        files, tmp_path, lambda r: np.column_stack([r[:, :1], 0 * r[:, 1:3], r[:, 3:] * [-1, 1, 1, 1]])
    )
    assert "the gyros turn against the change of course" in refused(turned, {})


def test_wrong_axes_of_the_body_are_seen_by_the_vertical(files):
    for axes in ("RFU", "FLU"):
        assert "deg from the vertical" in refused(files, {"imu": {"axes": axes}})


OWN_FIXES = {
    "time": "t_stamp_s",
    "arrival": "t_arrival_s",
    "position_sd": ["sd_north_m", "sd_east_m", "sd_down_m"],
    "velocity_sd": ["sd_v_north_mps", "sd_v_east_mps", "sd_v_down_mps"],
    "sequence": "sequence",
}


@pytest.mark.parametrize(
    ("layout", "told"),
    [
        ({"angle_unit": "rad"}, "column lat_deg, fix 1: 50.000005 rad: allowed is -1.5708 to 1.5708 rad"),
        ({"axes": "ENU"}, "they do with axes = NED"),
        ({"velocity_unit": "km/h"}, "they do with velocity_unit = m/s"),
        ({"velocity_unit": "kn"}, "they do with velocity_unit = m/s"),
        ({"time_unit": "ms"}, "0 fixes between 1000 and 1040 s"),
        ({"longitude": "lon"}, "no column lon;"),
    ],
)
def test_wrong_layouts_of_fixes_are_seen_by_their_way(files, layout, told):
    assert told in refused(files, {"fixes": OWN_FIXES | layout})


def with_fixes(files, recording, tmp_path, **changes) -> tuple[Path, Path]:
    write_fixes(replace(recording[1], **changes), tmp_path / "fixes.csv")
    return files[0], tmp_path / "fixes.csv"


def test_radians_for_degrees_and_heights_downwards_are_seen(files, recording, tmp_path):
    fixes = recording[1]
    small = with_fixes(files, recording, tmp_path, lla=fixes.lla * [DEG, DEG, 1.0])
    assert "they do with angle_unit = rad" in refused(small, {"fixes": OWN_FIXES})
    better = np.tile(np.diag([0.01**2] * 3 + [0.05**2] * 3), (len(fixes), 1, 1))
    lla = recording[2].lla[::10] * [1.0, 1.0, -1.0] + [0, 0, 1e3]
    below = with_fixes(files, recording, tmp_path, lla=lla, cov=better)
    assert "height changes -1 times as the vertical velocity says" in refused(below, {"fixes": OWN_FIXES})


def test_fixes_that_are_broken_are_counted(files, recording, tmp_path):
    columns = read_columns(files[1], pq_names(files[1]))
    rows = np.column_stack(list(columns.values()))
    rows = np.vstack([rows[:100], rows[99:], rows[-1:]])
    rows[50, list(columns).index("height_m")] = np.nan
    rows[[60, 61]] = rows[[61, 60]]
    write_columns(dict(zip(columns, rows.T, strict=True)), tmp_path / "fixes.csv")
    layout = {key: value for key, value in OWN_FIXES.items() if key != "sequence"}
    again = replay(files[0], tmp_path / "fixes.csv", a_map(recorded={"fixes": layout}), lambda *_: None)
    base, e = again.fix_base, again.estimates["ekf_stamped"]
    assert (base.repeated_rows, base.moved_rows, base.not_finite_rows) == (2, 1, 1)
    assert e.count(FixOutcome.NOT_FINITE) == 1
    assert len(again.fixes) == len(recording[1])


def pq_names(file: Path) -> list[str]:
    return file.read_text("utf-8").splitlines()[0].replace('"', "").split(",")


def test_what_is_before_the_initial_attitude_is_not_used(files, recording):
    roll, pitch, heading = attitude.to_euler(recording[2].q_nb[500]) / DEG
    initial = {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": heading, "time_s": START_S + 5, **INITIAL}
    later = replay(*files, a_map(initial=initial), lambda *_: None)
    assert later.imu.base.unused_rows == 500
    assert later.imu.time[0] == pytest.approx(START_S + 5)
    assert later.estimates["ekf_stamped"].count(FixOutcome.LATE) == 50
    assert "the file ends at 1040 s" in refused(files, {}, initial=initial | {"time_s": 2000.0})


def test_replay_writes_its_files_and_prints_json(command, files, tmp_path):
    arguments = (
        "replay",
        "--imu",
        files[0],
        "--fixes",
        files[1],
        "--initial",
        "0,3,60,2,8",
        "--json",
        "--out",
    )
    status, out, err = command(*arguments, tmp_path / "a")
    assert (status, err) == (0, "")
    folder = tmp_path / "a"
    names = {"summary.json", "estimates.parquet", "recording.rrd", "report.html", "manifest.json"}
    assert {path.name for path in folder.iterdir()} == names
    summary = json.loads(out)
    assert summary == json.loads((folder / "summary.json").read_text())
    assert set(summary["filters"]) == {"ekf", "ekf_stamped", "l2linf"}
    manifest = json.loads((folder / "manifest.json").read_text())
    assert len(manifest["files_sha256"]["imu.csv"]) == 64
    assert manifest["content"]["initial"]["heading_deg"] == 60

    table = pq.read_table(folder / "estimates.parquet").to_pydict()
    assert not [name for name in table if name.startswith("error_")]
    last = np.flatnonzero(np.array(table["filter"]) == "l2linf")[-1]
    final = summary["filters"]["l2linf"]["final"]
    for key in ("heading_deg", "gyro_bias_x_deg_h", "delay_ms"):
        assert table[key][last] == pytest.approx(final[key]["value"], rel=1e-5)
        assert table[f"sd_{key}"][last] == pytest.approx(final[key]["sd"], rel=1e-5)

    html = (folder / "report.html").read_text("utf-8")
    assert html.count("<svg") == 8
    assert "http" not in html.replace("http://www.w3.org/", "").split("<style>")[0]
    assert f"{summary['filters']['ekf']['nis']:.2f}" in html
    entities = {str(chunk.entity_path) for chunk in RrdReader(str(folder / "recording.rrd")).stream()}
    for path in ("innovations/v_down_mps/ekf", "attitude/heading_deg/l2linf", "imu/gyro_bias_z_deg_h/ekf"):
        assert any(entity.strip("/").startswith(path) for entity in entities), path

    status, out, _ = command(*arguments[:7], "--filter", "ekf", "--out", tmp_path / "b")
    assert status == 0
    again = json.loads((tmp_path / "b" / "summary.json").read_text())
    assert again["filters"] == {"ekf": summary["filters"]["ekf"]}
    assert "Nothing to mend" in out
    assert "ekf_stamped" not in out


@pytest.mark.parametrize(
    ("text", "options", "told"),
    [
        ("", (), "--initial: missing"),
        ("", ("--initial", "1,2"), "--initial 1,2: allowed is roll,pitch,heading"),
        ("", ("--initial", "1,2,nan"), "--initial 1,2,nan: allowed is"),
        (
            "",
            ("--initial", "1,2,3,4,90"),
            "option: initial.heading_sd_deg = 90.0 deg: allowed is (0, 60] deg",
        ),
        ("", ("--initial", "1,2,3", "--filter", "kalman"), "no filter 'kalman'"),
        (
            "[initial]\nroll_deg = 200\npitch_deg = 0\nheading_deg = 0",
            (),
            "initial.roll_deg = 200 deg: allowed is",
        ),
        ("[imu]\ngyro_bias_deg_h = -1", (), "imu.gyro_bias_deg_h = -1 deg/h: allowed is [0, 10000] deg/h"),
        (
            "[recorded.imu]\nkind = 'rates'",
            (),
            "gyro_unit = 'rad': allowed with rates is rad/s, deg/s, deg/h",
        ),
        ("[recorded.imu]\naxes = 'NED'", (), "recorded.imu.axes = 'NED'"),
        ("[recorded.fixes]\ntime = 't'", (), "one of position_sd (three columns) and position_sd_m"),
        ("[recorded]\ngaps = 1", (), "recorded.gaps: unknown field"),
        ("a = ", (), "not TOML"),
    ],
)
def test_mistakes_end_with_one_line_and_status_2(command, files, tmp_path, text, options, told):
    (tmp_path / "mine.toml").write_text(text, "utf-8")
    arguments = ("--imu", files[0], "--fixes", files[1], "--map", tmp_path / "mine.toml", *options)
    status, out, err = command("replay", *arguments, *QUIET, tmp_path / "out")
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert told in err
    assert not (tmp_path / "out").exists()


def test_files_that_are_not_there_end_with_one_line(command, files, tmp_path):
    for imu, fixes, map_ in (("no.csv", files[1], None), (files[0], "no.csv", None), (*files, "no.toml")):
        more = ("--map", map_) if map_ else ("--initial", "0,3,60")
        status, _, err = command("replay", "--imu", imu, "--fixes", fixes, *more, *QUIET, tmp_path)
        assert status == 2
        assert len(err.splitlines()) == 1
        assert "fleetalign: no." in err


def test_empty_cells_are_let_through_where_they_may_be(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y\n1,,inf\n2,3,4\n", "utf-8")
    columns = read_columns(tmp_path / "a.csv", ("t", "x", "y"), may_lack=("x", "y"))
    np.testing.assert_array_equal(columns["x"], [np.nan, 3])
    np.testing.assert_array_equal(columns["y"], [np.nan, 4])
    with pytest.raises(TableError, match="column x, row 1"):
        read_columns(tmp_path / "a.csv", ("t", "x"), may_lack=("y",))
    (tmp_path / "b.csv").write_text("t,x\n1,\n2,off\n", "utf-8")
    with pytest.raises(TableError, match="column x, row 2: 'off'"):
        read_columns(tmp_path / "b.csv", ("t", "x"), may_lack=("x",))


@pytest.mark.skipif(not DATA.is_dir(), reason="no real recording beside the repository")
def test_a_real_recording_aligns():
    """A car with a MEMS unit: the filters agree, from a heading that is 20 deg off as well."""
    files = DATA / "imu_increments.csv", DATA / "fixes.csv"
    stated = load_map(MAPS / "car_increments.toml", None, None)
    askew = load_map(MAPS / "car_increments.toml", "1.41,-3.13,21.3,3,25", ["ekf_stamped"])
    ends = [replay(*files, m, lambda *_: None).estimates for m in (stated, askew)]
    stamped = ends[0]["ekf_stamped"]
    sd = attitude_sd(stamped)[-1]
    assert sd[2] < 1 * DEG
    for e in (ends[0]["l2linf"], ends[1]["ekf_stamped"]):
        # Of one recording, so that they differ by less than what either is unsure of.
        assert (np.abs(attitude.attitude_error(e.q_nb[-1], stamped.q_nb[-1])) < 2 * sd).all()
        assert e.count(FixOutcome.GATED) < 10
    # The unit is a MEMS: some hundredths of a degree a second.
    assert 100 < np.linalg.norm(stamped.gyro_bias[-1]) / DEG * 3600 < 500

"""Nodes on the ground against an aircraft that flies past: both sides, the bound, and the command."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band, nees
from fleetalign.cosim.ground import locate_ground
from fleetalign.cosim.ground_report import ground_table, summarize_ground, without_figures
from fleetalign.cosim.scenario import ScenarioError, load_scenario, replaced
from fleetalign.network.ground import GroundSettings, fly_past, overhear
from fleetalign.network.localization import overflight
from fleetalign.network.localization.overflight import Fix, Passed
from fleetalign.network.localization.problem import LocalizationError
from fleetalign.network.localization.ranging import RangeNoise
from fleetalign.sins import earth
from pydantic import ValidationError
from rich.console import Console

START = np.array([0.52, 2.09, 1000.0])


@pytest.fixture
def two_times(monkeypatch):
    """The course over time is a matter of one test alone."""
    monkeypatch.setattr("fleetalign.cosim.ground.PREFIXES", 2)


class Weaving:
    """North-east at 200 m/s, straight up to 40 s, then an S of 120 m to both sides."""

    def __init__(self, amplitude_m=120.0):
        self._amplitude = amplitude_m

    def at(self, t):
        along, across = 200.0 * t, self._amplitude * np.sin(2 * np.pi * np.maximum(t - 40.0, 0.0) / 20)
        n, e = (along - across) / np.sqrt(2), (along + across) / np.sqrt(2)
        lla = earth.displaced(START, np.stack([n, e, np.zeros_like(t)], axis=-1))
        return lla, np.tile([141.0, 141.0, 0.0], (len(t), 1)), np.tile([1.0, 0, 0, 0], (len(t), 1))


SETTINGS = GroundSettings(start_s=0.0, duration_s=70.0)


@pytest.fixture(scope="module")
def found():
    return locate_ground(Weaving(), SETTINGS, 40, 5)


def test_a_leg_is_what_was_flown():
    leg = fly_past(Weaving(), SETTINGS)
    assert len(leg.time) == 71
    step = np.linalg.norm(np.diff(leg.beacons[:40], axis=0), axis=1)
    # In a frame of the ground, a kilometre below: lengths are those of the displacements to 0.1 %.
    np.testing.assert_allclose(step, 200.0, rtol=1e-3)
    height = np.linalg.norm(leg.earth_centre - leg.beacons, axis=1) - leg.earth_radius
    # 7 km from the origin, and 0.3 % of the earth's radius between its curvatures: 4 m^2 / m * 0.003.
    np.testing.assert_allclose(height, 1000.0, atol=0.05)


def test_nodes_are_beside_the_track_or_in_the_area():
    leg = fly_past(Weaving(0.0), SETTINGS)
    rngs = [np.random.default_rng(k) for k in range(3)]
    heard = overhear(leg, GroundSettings(nodes=400, duration_s=70.0, start_s=0.0), *rngs)
    way = (leg.beacons[-1] - leg.beacons[0])[:2] / np.linalg.norm((leg.beacons[-1] - leg.beacons[0])[:2])
    across = (heard.x[:, :2] - leg.beacons[0, :2]) @ np.array([-way[1], way[0]])
    assert np.abs(across).min() > 490
    assert np.abs(across).max() < 5050
    assert 0.4 < np.mean(across > 0) < 0.6
    d = np.linalg.norm(heard.x[:, None] - leg.beacons, axis=-1)
    assert (heard.heard == (d <= SETTINGS.link_radius_m)).all()
    assert ((heard.ranges - d) / 5.0).std() == pytest.approx(1.0, abs=0.02)
    lat, lon = np.degrees(START[:2])
    area = {"latitude_deg": lat, "longitude_deg": lon, "radius_m": 800.0}
    placed = overhear(leg, GroundSettings(nodes=400, area=area, start_s=0.0, duration_s=70.0), *rngs).x
    away = np.linalg.norm((placed - leg.in_frame(START * [1, 1, 0]))[:, :2], axis=1)
    assert 700 < away.max() < 801
    assert np.median(away) == pytest.approx(800 / np.sqrt(2), rel=0.1)


def test_all_estimators_reach_the_bound_once_the_s_has_told_the_side(found):
    summary = summarize_ground(SETTINGS, found)
    for name, score in summary["estimators"].items():
        assert score["located"] == 1.0, name
        assert score["ambiguous"] == 0.0
        assert score["flipped"] == 0.0
        # 400 nodes in 40 draws: the ratio is known to 2 or 3 %, one sigma.
        assert 0.92 < score["over_bound"] < 1.08, name
        # Own errors of 3 m are a small part of these: nodes are nearly independent.
        low, high = mean_band(3, 400, 0.999)
        assert low < score["nees_all_nodes"] < high, name
    early = summary["over_time"]
    before = np.array(early["time_s"]) < 40
    assert min(np.array(early["ambiguous"])[before]) > 0.9
    assert early["ambiguous"][-1] == 0.0
    assert min(np.array(early["rmse_m"])[before]) > 1000
    plain, rooted = (found.fixes[name] for name in ("ckf", "srckf"))
    np.testing.assert_allclose(rooted.x, plain.x, atol=1e-4)


@pytest.mark.usefixtures("two_times")
def test_without_an_s_the_side_stays_open():
    settings = replace_settings(estimators=("nls", "srckf"))
    found = locate_ground(Weaving(0.0), settings, 10, 5)
    for fixes in found.fixes.values():
        assert fixes.ambiguous.mean() > 0.95
    for score in summarize_ground(settings, found)["estimators"].values():
        assert score["located"] + score["ambiguous"] == pytest.approx(1.0)


def replace_settings(**changes):
    return GroundSettings.model_validate({**SETTINGS.model_dump(), **changes})


@pytest.mark.usefixtures("two_times")
def test_the_same_draws_give_the_same_numbers_and_further_draws_leave_them(found):
    fewer = locate_ground(Weaving(), SETTINGS, 7, 5)
    np.testing.assert_array_equal(fewer.x, found.x[:7])
    for name, fixes in fewer.fixes.items():
        np.testing.assert_allclose(fixes.x, found.fixes[name].x[:7], atol=1e-3)


def test_the_tracks_own_error_is_taken_out_as_a_joint_estimate_does():
    # Gaussian, in the vertical alone: p = x + b from ranges, x = 0 +- height_sd, b = 0 +- own_sd.
    own_sd, height_sd, range_sd, seen = 40.0, 30.0, 10.0, 55.0
    R = 6.4e6
    total = np.hypot(own_sd, height_sd)
    # What a filter with the height as a range of total deviation comes to.
    weight = total**2 / (total**2 + range_sd**2)
    passed = Passed(
        np.zeros((1, 3)), np.ones(1), np.ones(1, bool), RangeNoise(1.0), np.array([0, 0, R]), R, total
    )
    cov = np.diag([4.0, 9.0, weight * range_sd**2])
    fix = overflight.on_the_ground(
        Fix(np.array([0.0, 0.0, -weight * seen]), cov, np.array(False)), passed, own_sd
    )
    J = np.array([[1 / range_sd**2 + 1 / height_sd**2, 1 / range_sd**2], [1 / range_sd**2] * 2])
    J[1, 1] += own_sd**-2.0
    joint = np.linalg.inv(J)
    mean = joint @ np.full(2, seen / range_sd**2)
    assert -fix.x[2] == pytest.approx(mean[0], rel=1e-6)
    np.testing.assert_allclose(np.diag(fix.cov), [4 + own_sd**2, 9 + own_sd**2, joint[0, 0]], rtol=1e-6)


@pytest.mark.usefixtures("two_times")
def test_a_constant_own_error_is_in_the_covariance():
    settings = replace_settings(own_position_sd_m=60.0, nodes=1, estimators=("nls",))
    found = locate_ground(Weaving(), settings, 200, 2)
    fixes = found.fixes["nls"]
    low, high = mean_band(3, 200, 0.999)
    error = (fixes.x - found.x)[:, 0]
    assert low < nees(error, fixes.cov[:, 0]).mean() < high
    assert nees(error, fixes.cov[:, 0] - 3000 * np.diag([1, 1, 0])).mean() > high


@pytest.mark.usefixtures("two_times")
def test_nodes_that_hear_too_little_have_no_position():
    settings = replace_settings(link_radius_m=2500.0, estimators=("nls", "ekf"))
    found = locate_ground(Weaving(), settings, 10, 3)
    for fixes in found.fixes.values():
        known = np.isfinite(fixes.x).all(axis=-1)
        assert 0.1 < known.mean() < 0.9
        np.testing.assert_array_equal(known, np.isfinite(found.bound[..., 0, 0]))
    summary = summarize_ground(settings, found)
    assert summary["estimators"]["nls"]["located"] < summary["hear_enough"] + 1e-9
    with pytest.raises(LocalizationError, match=r"ground.link_radius_m = 900 m: no node hears 6 beacons"):
        locate_ground(Weaving(), replace_settings(link_radius_m=900.0), 3, 3)


def test_one_coordinate_more_makes_no_node_better_than_its_bound(found):
    # The bound by finite differences of the likelihood's expectation, for one node.
    leg = found.leg
    x = found.x[0, 0]
    d = np.linalg.norm(x - leg.beacons, axis=1)
    steps = 0.5 * np.eye(3)
    rows = np.array(
        [
            np.linalg.norm(x + s - leg.beacons, axis=1) - np.linalg.norm(x - s - leg.beacons, axis=1)
            for s in steps
        ]
    )
    gradient = np.where(d <= SETTINGS.link_radius_m, rows, 0.0).T / SETTINGS.range_sd_m
    down = (leg.earth_centre - x) / np.linalg.norm(leg.earth_centre - x)
    passed = Passed(
        leg.beacons[None],
        d[None],
        (d <= SETTINGS.link_radius_m)[None],
        SETTINGS.noise,
        leg.earth_centre,
        leg.earth_radius,
        30.0,
    )
    J = gradient.T @ gradient + np.outer(down, down) / 30.0**2
    np.testing.assert_allclose(overflight.bound(passed, x[None])[0], np.linalg.inv(J), rtol=1e-4)


def test_the_table_fits_a_terminal_of_80_columns(found):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(ground_table(summarize_ground(SETTINGS, found)))
    assert "…" not in console.export_text()


def test_where_all_are_ambiguous_the_table_says_why_it_is_empty(found):
    summary = summarize_ground(SETTINGS, found)
    assert without_figures(summary) == ""
    fixes = {name: replace(f, ambiguous=np.ones_like(f.ambiguous)) for name, f in found.fixes.items()}
    summary = summarize_ground(SETTINGS, replace(found, fixes=fixes))
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(ground_table(summary))
    text = console.export_text()
    assert "All ambiguous: least squares, EKF, CKF, SR-CKF." in text
    assert "nan" not in text


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"range_sd_m": 0.0}, "range_sd_m = 0 m with range_error_share = 0: one of them must be above zero"),
        ({"nearest_m": 5000.0}, "nearest_m = 5000 m: must be below farthest_m = 5000 m"),
        ({"beacon_rate_hz": 0.1}, "beacon_rate_hz = 0.1 Hz: makes fewer than 8 beacons"),
        ({"estimators": []}, "at least 1 item"),
        ({"estimators": ["ukf"]}, "'nls', 'ekf', 'ckf' or 'srckf'"),
        ({"height_sd_m": 0.0}, "greater than 0"),
    ],
)
def test_what_no_scenario_may_state(change, told):
    with pytest.raises(ValidationError, match=told):
        replace_settings(**change)


def test_the_leg_must_be_inside_the_flight():
    _, scenario = load_scenario("ground_nodes")
    with pytest.raises(ScenarioError, match=r"ground.start_s = 500 s: with duration_s = 80 s does not end"):
        replaced(scenario, {"ground.start_s": 500.0})


def test_the_command_reports_the_ground_without_a_network(command, flight, undrawn, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('title = "mine"\n[ground]\nnodes = 3\nestimators = ["srckf"]\n')
    status, out, err = command("localize", path, "--draws", 4, "--out", tmp_path, "--json")
    assert (status, err) == (0, "")
    summary = json.loads(out)
    assert summary == json.loads((tmp_path / "localize.json").read_text())
    assert summary["ground"]["estimators"]["srckf"]["located"] == 1.0
    assert (tmp_path / "ground.html").read_text().count("<td>SR-CKF</td>") == 1
    assert not (tmp_path / "localize.html").exists()
    status, _, err = command("localize", path, "--nodes", 20, "--out", tmp_path)
    assert status == 2
    assert "has no network; those on the ground are ground.nodes" in err
    path.write_text('title = "mine"\n[ground]\nlink_radius_m = 500\n')
    status, _, err = command("localize", path, "--draws", 2, "--out", tmp_path)
    assert status == 2
    # One line, without the blank ones of a progress bar.
    assert err.count("\n") == 1
    assert err.endswith("mine: ground.link_radius_m = 500 m: no node hears 6 beacons\n")

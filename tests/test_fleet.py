from dataclasses import fields

import numpy as np
import pytest
from fleetalign.network.fleet import CentrePath, Fleet, FleetError, FleetSettings, draw_formation
from fleetalign.sins import earth
from pydantic import ValidationError
from scipy import stats

LLA_0 = np.array([np.radians(30), np.radians(120), 5.0])
S_START, S_END, END = 400.0, 440.0, 480.0
OMEGA = 2 * np.pi / 20


class Mission:
    """At rest, 40 s at 5 m/s^2 and on at 200 m/s to the north-east, a climb of 1 km, and two turns of S."""

    def at(self, t):
        t = np.asarray(t, float)
        u = np.clip(t - 20, 0, 40)
        along, v_along = 2.5 * u**2 + 200 * np.maximum(t - 60, 0), 5 * u
        climb = np.clip((t - 60) / 100, 0, 1)
        up, v_up = 500 * (1 - np.cos(np.pi * climb)), 5 * np.pi * np.sin(np.pi * climb)
        w = OMEGA * (np.clip(t, S_START, S_END) - S_START)
        across, v_across = 6 / OMEGA**2 * (1 - np.cos(w)), 6 / OMEGA * np.sin(w)
        # Along the earth's curve, to second order.
        down, v_down = along**2 / 2 / 6.37e6 - up, along * v_along / 6.37e6 - v_up
        C_en = earth.C_en(*LLA_0[:2])
        to_e = C_en @ np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
        lla = earth.lla_from_ecef(
            earth.ecef_from_lla(LLA_0) + np.stack([along, across, down], axis=-1) @ to_e.T
        )
        v_e = np.stack([v_along, v_across, v_down], axis=-1) @ to_e.T
        v_n = np.einsum("kji,kj->ki", earth.C_en(lla[:, 0], lla[:, 1]), v_e)
        return lla, v_n, np.tile([1.0, 0, 0, 0], (len(t), 1))


@pytest.fixture(scope="module")
def path():
    return CentrePath(Mission(), 0.0, END)


def formation(seed=1, **settings):
    return draw_formation(FleetSettings(**settings), np.random.default_rng(seed))


def in_cylinder(fleet, t, x_e):
    """Positions in the cylinder's frame, NED, m."""
    centre = fleet.centre(t)
    C_en = earth.C_en(centre[:, 0], centre[:, 1])
    return (x_e - earth.ecef_from_lla(centre)[:, None]) @ C_en


def path_of_centre(path, t):
    """Velocity and acceleration (k, 3) in e of the centre, by central differences."""
    fleet = Fleet(formation(), path)
    x = [earth.ecef_from_lla(fleet.centre(t + h)) for h in (-0.5, 0.0, 0.5)]
    return x[2] - x[0], 4 * (x[2] - 2 * x[1] + x[0])


# The draws


def test_homes_fill_the_cylinder_evenly():
    f = formation(nodes=1000, radius_m=15_000, height_m=4_000)
    radius = np.hypot(f.home[:, 0], f.home[:, 1])
    azimuth = np.arctan2(f.home[:, 1], f.home[:, 0])
    for uniform in ((radius / 15_000) ** 2, azimuth / (2 * np.pi) + 0.5, -f.home[:, 2] / 4_000):
        assert stats.kstest(uniform, "uniform").pvalue > 0.001
    # Independent of each other: 1000 draws correlate by 1 / sqrt(1000).
    assert np.abs(np.corrcoef([radius, azimuth, f.home[:, 2]]) - np.eye(3)).max() < 4 / np.sqrt(1000)


def test_a_further_node_leaves_the_draws_of_the_others():
    a, b = formation(nodes=50), formation(nodes=51)
    for field in fields(a):
        if not field.name.startswith("anchor"):
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name)[:-1])
    assert np.sum(a.anchor != b.anchor[:-1]) <= 1
    both = a.anchor & b.anchor[:-1]
    np.testing.assert_array_equal(a.anchor_position_error[both], b.anchor_position_error[:-1][both])
    assert not np.array_equal(a.home, formation(seed=2, nodes=50).home)


def test_the_stated_share_are_anchors_and_never_the_own_ship():
    for seed in range(20):
        f = formation(seed, nodes=10, anchor_share=0.9)
        assert f.anchor.sum() == 9
        assert not f.anchor[0]
    assert formation(nodes=30).anchor.sum() == 6


def test_anchors_err_by_the_stated_deviations():
    f = formation(nodes=1000, anchor_share=0.9, anchor_position_sd_m=3.0, anchor_velocity_sd_mps=0.2)
    for error, sd in ((f.anchor_position_error, 3.0), (f.anchor_velocity_error, 0.2)):
        assert not error[~f.anchor].any()
        # Of 2700 draws: five deviations of a standard deviation.
        assert np.std(error[f.anchor]) == pytest.approx(sd, rel=5 / np.sqrt(2 * 2700))
        assert abs(np.mean(error[f.anchor])) < 5 * sd / np.sqrt(2700)


def test_switching_errors_and_weaves_off_leaves_the_homes():
    a, b = (
        formation(),
        formation(anchor_position_sd_m=0, anchor_velocity_sd_mps=0, weave_m=0, anchor_share=0.5),
    )
    np.testing.assert_array_equal(a.home, b.home)
    np.testing.assert_array_equal(a.slot_key, b.slot_key)
    assert not b.anchor_position_error.any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"anchor_share": 0.0}, "anchor_share = 0 makes 0 of 50 nodes anchors"),
        ({"nodes": 30, "anchor_share": 0.01}, "1 to 29 are allowed"),
        ({"nodes": 2, "anchor_share": 1.0}, "as the own ship is none"),
        ({"radius_m": 0}, "radius_m"),
        ({"height_m": 0}, "height_m"),
        ({"nodes": 1}, "nodes"),
    ],
)
def test_impossible_fleets_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        FleetSettings(**settings)


# The centre


def test_the_centre_begins_at_rest_and_then_goes_at_the_own_ships_speed(path):
    v, _ = path_of_centre(path, np.array([0.5, 300.0]))
    # At most half a second's acceleration of a take-off run smoothed over 20 s.
    assert np.linalg.norm(v[0]) < 1.5
    # A home 20 km north or south moves along meridians that are 0.2 % closer or wider.
    assert np.linalg.norm(v[1]) == pytest.approx(200, abs=0.4)


def test_the_centre_does_not_follow_the_manoeuvre(path):
    t = np.arange(S_START - 30, S_END + 30, 0.5)
    _, a = path_of_centre(path, t)
    lla = Fleet(formation(), path).centre(t)
    a_n = np.einsum("kji,kj->ki", earth.C_en(lla[:, 0], lla[:, 1]), a)
    # The own ship's is 6 m/s^2; what is left is the S's mean offset of 61 m, come and gone in 20 s.
    assert np.abs(a_n[:, 1] - a_n[:, 0]).max() / np.sqrt(2) < 0.15


def test_the_base_stays_at_its_height(path):
    t = np.arange(0.0, END, 7.3)
    assert np.abs(Fleet(formation(), path).centre(t)[:, 2] - 5.0).max() < 0.01
    high = CentrePath(Mission(), 0.0, END, base_height_m=-200.0)
    assert np.abs(Fleet(formation(), high).centre(t)[:, 2] + 200.0).max() < 0.01


def test_the_own_ship_is_at_home_in_level_flight(path):
    f = formation()
    fleet = Fleet(f, path)
    t = np.arange(200.0, 350.0, 10.0)
    own = in_cylinder(fleet, t, fleet.at(t)[0])[:, 0]
    # The home is laid off along the ellipsoid: some metres at 20 km.
    assert np.abs(own[:, :2] - f.home[0, :2]).max() < 20
    assert np.ptp(own[:, :2], axis=0).max() < 2


def test_a_short_path_does():
    brief = CentrePath(Mission(), 200.0, 200.5)
    x_e, _ = Fleet(formation(), brief).at(np.array([200.0, 200.25, 200.5]))
    assert np.linalg.norm(np.diff(x_e, axis=0), axis=-1).mean() == pytest.approx(50, rel=0.1)


# The paths


def test_velocity_is_the_derivative_of_position(path):
    fleet = Fleet(formation(), path)
    # Away from the steps of the own ship's acceleration; h^2 / 6 of a weave's third derivative is 2e-6 m/s.
    t = np.arange(3.05, END - 3, 1.7)
    h = 0.01
    numeric = (fleet.at(t + h)[0] - fleet.at(t - h)[0]) / (2 * h)
    assert np.abs(numeric - fleet.at(t)[1])[:, 1:].max() < 1e-5


def test_all_other_nodes_stay_inside(path):
    t = np.arange(0.0, END, 1.0)
    for seed in range(5):
        fleet = Fleet(formation(seed, weave_m=2_000, weave_period_s=60), path)
        x = in_cylinder(fleet, t, fleet.at(t)[0])[:, 1:]
        # Rounding of metres in e.
        assert np.hypot(x[..., 0], x[..., 1]).max() < 20_000 + 1e-6
        assert x[..., 2].max() < 1e-6
        assert x[..., 2].min() > -5_000 - 1e-6


def test_weaves_have_the_stated_size_and_accelerations(path):
    fleet = Fleet(formation(nodes=200), path)
    t = np.arange(0.0, END, 1.0)
    x = in_cylinder(fleet, t, fleet.at(t)[0])[:, 1:]
    offset = x - fleet.formation.home[1:]
    assert np.abs(offset).max() == pytest.approx(400, abs=1)
    a = np.abs(np.diff(offset, 2, axis=0)).max(axis=0)
    whole = fleet.formation.amplitude[1:] == 400
    assert whole.mean() > 0.5
    assert 0.64 < a[whole].min() < a[whole].max() < 2.25


def test_the_own_ship_flies_the_truth(path):
    t = np.arange(0.0, END, 13.0)
    x_e, v_e = Fleet(formation(), path).at(t)
    lla, v_n, _ = Mission().at(t)
    np.testing.assert_array_equal(x_e[:, 0], earth.ecef_from_lla(lla))
    C_en = earth.C_en(lla[:, 0], lla[:, 1])
    np.testing.assert_allclose(v_e[:, 0], (C_en @ v_n[..., None])[..., 0], rtol=0, atol=1e-12)


def test_anchors_believe_a_constant_error(path):
    f = formation(anchor_position_sd_m=5.0, anchor_velocity_sd_mps=0.1)
    fleet = Fleet(f, path)
    t = np.arange(0.0, END, 13.0)
    x_e, v_e = fleet.at(t)
    believed = fleet.believed(t, x_e, v_e)
    error = in_cylinder(fleet, t, believed[0]) - in_cylinder(fleet, t, x_e)
    np.testing.assert_allclose(error, np.broadcast_to(f.anchor_position_error, error.shape), atol=1e-6)
    sizes = np.linalg.norm(believed[1] - v_e, axis=-1)
    np.testing.assert_allclose(sizes[5], np.linalg.norm(f.anchor_velocity_error, axis=-1), atol=1e-9)


def test_the_times_are_cut_as_one_likes(path):
    fleet = Fleet(formation(), path)
    t = np.arange(0.0, END, 11.0)
    whole, parts = fleet.at(t), [fleet.at(part) for part in np.array_split(t, 3)]
    for i in range(2):
        np.testing.assert_array_equal(whole[i], np.concatenate([part[i] for part in parts]))


def test_times_without_a_path_are_refused(path):
    with pytest.raises(FleetError, match=r"time outside the fleet's 0\.000 to 480\.000 s"):
        Fleet(formation(), path).at(np.array([500.0]))
    with pytest.raises(FleetError, match="the end must be after the start"):
        CentrePath(Mission(), 10.0, 10.0)

"""What nodes measure of each other by radio, and their clocks. Bounds of statistics are five deviations."""

from dataclasses import fields

import numpy as np
import pytest
from fleetalign.network._geometry import distances_and_rates
from fleetalign.network.clock import SPEED_OF_LIGHT, Clocks, ClockSettings
from fleetalign.network.fleet import FleetSettings, draw_formation
from fleetalign.network.observations import node_pairs
from fleetalign.network.radio import Radio, RadioSettings
from pydantic import ValidationError

K, N = 200, 30
T = 0.1 * np.arange(K)
TRUE_SD = {"range_sd_m": 1e-3, "range_rate_sd_mps": 1e-4}
"""Settings under which measurements are the truth but for what is switched on beside them."""


def motion(nodes=N, seed=3):
    """Positions and velocities (K, nodes, 3) of nodes in straight flight, and their heights."""
    children = np.random.default_rng(seed).spawn(nodes)
    x_0 = np.array([c.uniform([-2e4, -2e4, -5e3], [2e4, 2e4, 0]) for c in children])
    v = np.array([c.normal(0, 100, 3) for c in children])
    x = x_0 + v * T[:, None, None]
    return x, np.broadcast_to(v, x.shape), -x[..., 2]


X, V, HEIGHT = motion()
FIRST, SECOND = node_pairs(N).T
DISTANCE = np.linalg.norm(X[:, FIRST] - X[:, SECOND], axis=-1)


def observe(seed=1, nodes=N, anchor=None, **settings):
    x, v, height = motion(nodes)
    return Radio(RadioSettings(**settings), nodes, np.random.default_rng(seed), anchor).observe(
        T, x, v, height
    )


def assert_spread(errors, sd):
    """Independent Gaussian errors with this deviation, and no mean."""
    assert np.std(errors) == pytest.approx(sd, rel=5 / np.sqrt(2 * errors.size))
    assert abs(np.mean(errors)) < 5 * sd / np.sqrt(errors.size)


def assert_share(hits, probability):
    """Independent hits with this probability."""
    assert abs(np.mean(hits) - probability) < 5 * np.sqrt(probability * (1 - probability) / hits.size)


# Pairs and draws


def test_pairs_are_in_the_order_in_which_nodes_join():
    np.testing.assert_array_equal(node_pairs(4), [[1, 0], [2, 0], [2, 1], [3, 0], [3, 1], [3, 2]])
    np.testing.assert_array_equal(node_pairs(51)[: 50 * 49 // 2], node_pairs(50))


EVERYTHING = {
    "shadowing_sd_db": 4.0,
    "range_sd_share": 0.01,
    "range_uniform_share": 0.01,
    "range_bias_sd_m": 5.0,
    "nlos_share": 0.1,
    "nlos_coherence_s": 3.0,
    "altitude_sd_m": 10.0,
    "altitude_bias_sd_m": 5.0,
    "ranging": "one_way",
    "clock": {"resync_s": 0.7},
}


def test_the_same_seed_measures_the_same_and_another_does_not():
    a, b, c = observe(**EVERYTHING), observe(**EVERYTHING), observe(seed=2, **EVERYTHING)
    for field in fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))
    for name in ("ranges", "range_rates", "heard", "nlos", "power_dbm", "altitude", "clock_offset"):
        assert not np.array_equal(getattr(a, name), getattr(c, name)), name


@pytest.mark.parametrize("cuts", [[100], [1, 2, 29, 31, 199]])
def test_chunks_do_not_matter(cuts):
    whole = observe(**EVERYTHING)
    radio = Radio(RadioSettings(**EVERYTHING), N, np.random.default_rng(1))
    parts = [
        radio.observe(*part) for part in zip(*(np.split(a, cuts) for a in (T, X, V, HEIGHT)), strict=True)
    ]
    for field in fields(whole):
        value = getattr(whole, field.name)
        if np.ndim(value) and len(value) == K:
            chunks = np.concatenate([getattr(part, field.name) for part in parts])
            np.testing.assert_array_equal(chunks, value, err_msg=field.name)


def test_a_further_node_leaves_what_the_others_measure():
    a, b = observe(**EVERYTHING), observe(nodes=N + 1, **EVERYTHING)
    for field in fields(a):
        one, two = getattr(a, field.name), getattr(b, field.name)
        if np.ndim(one) == 2 and len(one) == K:
            np.testing.assert_array_equal(one, two[:, : one.shape[1]], err_msg=field.name)


@pytest.mark.parametrize("effect", EVERYTHING)
def test_switching_one_effect_on_leaves_the_draws_of_the_others(effect):
    quiet = {"altitude_sd_m": 10.0}
    a, b = observe(**quiet), observe(**{**quiet, effect: EVERYTHING[effect]})
    ranges = {"range_sd_share", "range_uniform_share", "range_bias_sd_m", "nlos_share", "ranging"}
    touched = {
        "shadowing_sd_db": {"linked", "heard", "power_dbm"},
        "altitude_bias_sd_m": {"altitude"},
        "ranging": {"ranges", "range_sd", "range_rates"},
        "nlos_share": {"ranges", "range_sd", "nlos"},
        "clock": {"clock_offset"},
    }.get(effect, {"ranges", "range_sd"} if effect in ranges else set())
    for field in fields(a):
        if field.name not in touched:
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)
        elif field.name != "range_sd":
            assert not np.array_equal(getattr(a, field.name), getattr(b, field.name)), field.name


# Links


@pytest.mark.parametrize("exponent", [2.0, 3.5])
def test_without_shadowing_links_fill_a_disc(exponent):
    seen = observe(link_radius_m=15_000, path_loss_exponent=exponent, loss_probability=0)
    np.testing.assert_array_equal(seen.linked, DISTANCE <= 15_000)
    np.testing.assert_array_equal(seen.heard, seen.linked)


def test_power_is_that_of_free_space_and_falls_by_six_decibels_a_doubling():
    radio = RadioSettings(tx_power_dbm=53.0, carrier_mhz=1500.0)
    # Friis: (wavelength / 4 pi d)^2.
    friis = 53 + 20 * np.log10(SPEED_OF_LIGHT / 1.5e9 / (4 * np.pi * 7_000))
    assert float(radio.power_dbm(7_000)) == pytest.approx(friis, abs=1e-9)
    assert float(radio.power_dbm(7_000) - radio.power_dbm(14_000)) == pytest.approx(6.02, abs=0.001)
    assert float(radio.power_dbm(radio.link_radius_m)) == pytest.approx(radio.sensitivity_dbm)
    assert float(radio.link_margin_db(25_000)) == pytest.approx(6.02, abs=0.001)
    steep = RadioSettings(path_loss_exponent=4.0)
    assert float(steep.power_dbm(7_000) - steep.power_dbm(14_000)) == pytest.approx(12.04, abs=0.002)
    # Another exponent and power move the sensitivity, not the radius.
    assert steep.sensitivity_dbm < radio.sensitivity_dbm


def test_shadowing_is_a_links_own_and_stays():
    seen = observe(link_radius_m=15_000, shadowing_sd_db=6.0)
    shadowing = seen.power_dbm - RadioSettings().power_dbm(DISTANCE)
    assert np.ptp(shadowing, axis=0).max() < 1e-9
    assert_spread(shadowing[0], 6.0)
    margin = 20 * np.log10(15_000 / DISTANCE) + shadowing
    np.testing.assert_array_equal(seen.linked, margin >= 0)


def test_linked_pairs_are_those_that_are_observed():
    radio = Radio(RadioSettings(link_radius_m=15_000, shadowing_sd_db=6.0), N, np.random.default_rng(1))
    linked = radio.linked(np.linalg.norm(X[:, :, None] - X[:, None], axis=-1))
    np.testing.assert_array_equal(linked[:, FIRST, SECOND], radio.observe(T, X, V, HEIGHT).linked)
    np.testing.assert_array_equal(linked, linked.transpose(0, 2, 1))
    assert not np.diagonal(linked, axis1=1, axis2=2).any()


def test_packets_are_lost_by_the_stated_probability():
    seen = observe(loss_probability=0.1)
    assert seen.linked.all()
    assert_share(~seen.heard, 0.1)
    # Independent from epoch to epoch: lost twice in a row.
    assert_share(~seen.heard[:-1] & ~seen.heard[1:], 0.01)
    assert not observe(loss_probability=1).heard.any()


@pytest.mark.parametrize(
    ("nodes", "radius_m", "degree", "with_four"),
    [
        (50, 5_000, 2.3, 0.21),
        (50, 10_000, 9.4, 0.96),
        (50, 15_000, 18.8, 1.0),
        (50, 50_000, 49.0, 1.0),
        (30, 10_000, 5.6, 0.78),
        (30, 20_000, 17.1, 1.0),
    ],
)
def test_neighbours_at_the_papers_radii(nodes, radius_m, degree, with_four):
    neighbours = []
    radio = Radio(RadioSettings(link_radius_m=radius_m), nodes, np.random.default_rng(0))
    i, j = radio.pairs.T
    for seed in range(60):
        home = draw_formation(FleetSettings(nodes=nodes), np.random.default_rng(seed)).home[None]
        linked = radio.observe(np.array([float(seed)]), home, 0 * home, -home[..., 2]).linked[0]
        neighbours.append(np.bincount(np.concatenate([i[linked], j[linked]]), minlength=nodes))
    # Fleets' means scatter by some 10 %; 60 of them.
    assert np.mean(neighbours) == pytest.approx(degree, rel=0.05)
    assert np.mean(np.array(neighbours) >= 4) == pytest.approx(with_four, abs=0.03)


# Ranges and range rates


def test_ranges_have_the_stated_noise():
    seen = observe()
    assert_spread(seen.ranges - DISTANCE, 50.0)
    assert (seen.range_sd == 50.0).all()
    # White: neighbours in time and in the list of pairs do not correlate.
    error = (seen.ranges - DISTANCE) / 50
    for a, b in ((error[1:], error[:-1]), (error[:, 1:], error[:, :-1])):
        assert abs(np.mean(a * b)) < 5 / np.sqrt(a.size)


def test_noise_can_grow_with_the_distance():
    seen = observe(range_sd_m=10.0, range_sd_share=0.02)
    sd = np.hypot(10.0, 0.02 * DISTANCE)
    assert_spread((seen.ranges - DISTANCE) / sd, 1.0)
    # The receiver goes by its measured range.
    np.testing.assert_allclose(seen.range_sd, np.hypot(10.0, 0.02 * seen.ranges))


def test_uniform_noise_is_bounded_by_its_share():
    seen = observe(range_sd_m=1e-3, range_uniform_share=0.4)
    share = (seen.ranges - DISTANCE) / DISTANCE
    assert 0.3999 < np.abs(share).max() < 0.4 + 1e-5
    assert_spread(share, 0.4 / np.sqrt(3))
    np.testing.assert_allclose(seen.range_sd, 0.4 * seen.ranges / np.sqrt(3), rtol=1e-6)


def test_a_links_bias_stays_and_is_stated():
    seen = observe(**TRUE_SD, range_bias_sd_m=20.0)
    error = seen.ranges - DISTANCE
    assert np.ptp(error, axis=0).max() < 0.02
    assert_spread(error[0], 20.0)
    np.testing.assert_allclose(observe(range_bias_sd_m=20.0).range_sd, np.hypot(50.0, 20.0))


def test_a_biased_node_shifts_all_its_ranges_and_nobody_is_told():
    seen = observe(**TRUE_SD, biased_nodes=0.2, node_bias_m=300.0)
    assert seen.biased.sum() == 6
    expected = 300.0 * (seen.biased[FIRST].astype(float) + seen.biased[SECOND])
    assert np.abs(seen.ranges - DISTANCE - expected).max() < 0.01
    assert seen.range_sd.max() < 0.01


def test_links_without_line_of_sight_are_too_long_for_as_long_as_they_last():
    seen = observe(**TRUE_SD, nlos_share=0.3, nlos_mean_m=150.0, nlos_coherence_s=2.0)
    excess = seen.ranges - DISTANCE
    assert np.abs(excess[~seen.nlos]).max() < 0.01
    blocks = excess.reshape(10, 20, -1)
    assert np.ptp(blocks, axis=1).max() < 0.02
    drawn, blocked = blocks[:, 0], seen.nlos[::20]
    assert_share(blocked, 0.3)
    detours = drawn[blocked]
    assert detours.min() > -0.01
    # Exponential: the deviation is the mean, that of the squares' mean 2 sqrt(5) of its square.
    assert np.mean(detours) == pytest.approx(150, rel=5 / np.sqrt(detours.size))
    assert np.mean(detours**2) == pytest.approx(2 * 150**2, rel=5 * np.sqrt(5) / np.sqrt(detours.size))
    # Anew each time.
    assert_share(blocked[:-1] & blocked[1:], 0.09)
    assert seen.range_sd.max() < 0.01


def test_range_rates_are_the_rates_of_the_ranges():
    seen = observe(**TRUE_SD)
    numeric = (DISTANCE[2:] - DISTANCE[:-2]) / 0.2
    # Beyond 5 km the third derivative, some 3 v^3 / d^2, times h^2 / 6 is below 1 cm/s.
    far = DISTANCE[1:-1] > 5_000
    assert np.abs(seen.range_rates[1:-1] - numeric)[far].max() < 0.01
    projected = np.sum((V[:, FIRST] - V[:, SECOND]) * (X[:, FIRST] - X[:, SECOND]), axis=-1) / DISTANCE
    assert np.abs(seen.range_rates - projected).max() < 1e-3
    assert_spread(observe().range_rates - projected, 0.03)
    assert observe().range_rate_sd == 0.03


def test_compiled_geometry_is_numpys():
    distances, rates = distances_and_rates(X, np.ascontiguousarray(V))
    np.testing.assert_allclose(distances, DISTANCE, rtol=1e-14)
    d, w = X[:, FIRST] - X[:, SECOND], V[:, FIRST] - V[:, SECOND]
    np.testing.assert_allclose(rates, np.sum(d * w, axis=-1) / DISTANCE, rtol=1e-12, atol=1e-10)
    same = np.ones((1, 2, 3))
    assert [a.item() for a in distances_and_rates(same, same)] == [0, 0]


def test_nodes_at_one_place_have_a_stated_result():
    x, v = np.zeros((K, 2, 3)), np.ones((K, 2, 3)) * [[100.0], [-100.0]]
    radio = Radio(RadioSettings(loss_probability=0), 2, np.random.default_rng(1))
    seen = radio.observe(T, x, v, np.zeros((K, 2)))
    assert seen.heard.all()
    assert np.isfinite(seen.power_dbm).all()
    assert_spread(seen.ranges, 50.0)
    assert_spread(seen.range_rates, 0.03)


# Clocks


def test_two_way_ranging_is_free_of_clocks_and_one_way_is_not():
    clock = {"sync_sd_ns": 100.0}
    two, one = observe(clock=clock), observe(clock=clock, ranging="one_way")
    difference = one.clock_offset[:, FIRST] - one.clock_offset[:, SECOND]
    np.testing.assert_allclose(one.ranges - two.ranges, SPEED_OF_LIGHT * difference, atol=1e-6)
    drift = one.clock_frequency[:, FIRST] - one.clock_frequency[:, SECOND]
    np.testing.assert_allclose(one.range_rates - two.range_rates, SPEED_OF_LIGHT * drift, atol=1e-9)
    np.testing.assert_array_equal(one.clock_offset, two.clock_offset)
    # 100 ns are 30 m.
    assert np.std(SPEED_OF_LIGHT * difference) == pytest.approx(30 * np.sqrt(2), rel=0.2)


def clocks(seed=1, anchors=20, nodes=400, **settings):
    anchor = np.arange(nodes) < anchors
    return Clocks(ClockSettings(**settings), anchor, np.random.default_rng(seed))


def test_an_accuracy_of_5e_9_is_ten_metres_in_6_7_seconds():
    offset, frequency = clocks(resync_s=100, sync_sd_ns=0, frequency_stability=0).at(np.array([0.0, 6.67]))
    assert 4.95e-9 < np.abs(frequency).max() <= 5e-9
    assert_spread(frequency[0, 20:] / 5e-9, 1 / np.sqrt(3))
    assert SPEED_OF_LIGHT * np.abs(offset[1]).max() == pytest.approx(10, rel=0.01)
    np.testing.assert_allclose(offset[1], 6.67 * frequency[0], rtol=1e-12)


def test_a_stability_of_1e_10_is_three_centimetres_a_second():
    _, frequency = clocks(frequency_accuracy=0).at(T)
    assert_spread(SPEED_OF_LIGHT * frequency, 0.02998)
    assert abs(np.mean(frequency[1:] * frequency[:-1])) < 5 * 1e-20 / np.sqrt(frequency.size)


def test_clocks_are_set_anew():
    offset, _ = clocks(resync_s=2.0, sync_sd_ns=10.0, frequency_accuracy=1e-8).at(T)
    set_anew = offset[::20]
    assert_spread(set_anew / 1e-9, 10.0)
    assert abs(np.mean(set_anew[1:] * set_anew[:-1])) < 5 * 1e-16 / np.sqrt(set_anew.size)
    # In between they run on: 1.9 s at up to 1e-8.
    assert 1.8e-8 < np.abs(offset[19::20] - set_anew).max() <= 1.9e-8


def test_anchors_keep_network_time():
    offset, frequency = clocks(anchors=300, resync_s=5.0, frequency_stability=0).at(T)
    assert np.ptp(offset[:50, :300], axis=0).max() == 0
    assert not frequency[:, :300].any()
    assert frequency[:, 300:].all()


# Altimeters


def test_altitudes_have_noise_and_bias():
    assert observe().altitude is None
    assert np.isnan(RadioSettings().assumed_altitude_sd_m)
    seen = observe(nodes=200, altitude_sd_m=11.0, altitude_bias_sd_m=30.0)
    error = seen.altitude - motion(200)[2]
    bias = error.mean(axis=0)
    assert_spread(bias, np.hypot(30.0, 11.0 / np.sqrt(K)))
    assert_spread((error - bias) * np.sqrt(K / (K - 1)), 11.0)
    assert RadioSettings(altitude_sd_m=3, altitude_bias_sd_m=4).assumed_altitude_sd_m == 5


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("link_radius_m", 0),
        ("range_sd_m", 0),
        ("loss_probability", 1.01),
        ("nlos_mean_m", 0),
        ("altitude_sd_m", 0),
        ("altitude_sd_m", True),
        ("altitude_sd_m", "11"),
        ("ranging", "three_way"),
        ("range_sd_m", float("nan")),
        ("clock", {"resync_s": 0}),
    ],
)
def test_impossible_radios_are_refused(name, value):
    with pytest.raises(ValidationError, match=name):
        RadioSettings(**{name: value})

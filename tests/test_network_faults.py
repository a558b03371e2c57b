"""A network that is jammed, blocked and lied to: what follows in links, ranges, routes and fixes."""

from functools import partial

import numpy as np
import pytest
from fleetalign.cosim.run import generator
from fleetalign.cosim.scenario import ScenarioError, load_scenario, replaced
from fleetalign.network.faults import NetworkFaults, drawn
from fleetalign.network.fleet import CentrePath, Fleet, draw_formation
from fleetalign.network.fleet_network import FleetNetwork, fly_network
from fleetalign.network.lies import Chosen, FalseRanges, Lies, Offset
from fleetalign.network.radio import Radio
from fleetalign.network.record import FixFate
from fleetalign.sins import earth

START_S = 505.0


@pytest.fixture(scope="module")
def path(flight):
    return CentrePath(flight, flight.time[0], flight.time[-1])


def network(**rooms):
    return FleetNetwork.model_validate({"fleet": {"nodes": 20, "anchor_share": 0.3}, **rooms})


def fly(path, settings, seconds, run=0, seed=5):
    return fly_network(path, START_S, START_S + seconds, settings, partial(generator, seed, run))


@pytest.fixture(scope="module")
def observed(path):
    """What a fleet's radios measure of each other every 0.5 s from 0 to 10 s, under faults."""
    settings = network()
    fleet = Fleet(draw_formation(settings.fleet, np.random.default_rng(1)), path)
    t = START_S + 0.5 * np.arange(20)
    x_e, v_e = fleet.at(t)

    def observe(**faults):
        trouble = drawn(
            NetworkFaults.model_validate(faults),
            None,
            fleet,
            path.truth.at(path.time[:1])[0][0],
            START_S,
            False,
            np.random.default_rng(2),
        )
        radio = Radio(
            settings.radio,
            20,
            np.random.default_rng(3),
            fleet.formation.anchor,
            trouble and trouble.disturbances,
        )
        return radio.observe(t, x_e, v_e, np.zeros(x_e.shape[:2])), radio, fleet

    return observe


def ned(fleet, t):
    """(k, n, 3) of the nodes about the fleet's centre."""
    centre = fleet.centre(t)
    apart = fleet.at(t)[0] - earth.ecef_from_lla(centre)[:, None]
    return apart @ earth.C_en(centre[:, 0], centre[:, 1])


def test_a_jammer_takes_links_of_nodes_inside_while_it_lasts(observed):
    jammer = {"north_m": 5e3, "radius_m": 8e3, "share": 0.8, "start_s": 3.0, "duration_s": 4.0}
    quiet, _, fleet = observed()
    jammed, radio, _ = observed(jamming=[jammer])
    at_s = quiet.t - START_S
    i, j = quiet.pairs.T
    inside = np.hypot(*np.moveaxis(ned(fleet, quiet.t)[..., :2] - [5e3, 0.0], -1, 0)) <= 8e3
    hit = (inside[:, i] | inside[:, j]) & ((at_s >= 3.0) & (at_s < 7.0))[:, None]
    assert 0.2 < hit[8].mean() < 0.9
    # 50 km less 80 %.
    distance = np.linalg.norm(ned(fleet, quiet.t)[:, i] - ned(fleet, quiet.t)[:, j], axis=-1)
    np.testing.assert_array_equal(jammed.linked, np.where(hit, distance <= 10e3, distance <= 50e3))
    # All else is as it was.
    np.testing.assert_array_equal(jammed.ranges, quiet.ranges)
    np.testing.assert_array_equal(jammed.heard, quiet.heard & jammed.linked)
    # The tables of links say the same.
    x_e = fleet.at(quiet.t)[0]
    apart = np.linalg.norm(x_e[:, :, None] - x_e[:, None], axis=-1)
    tables = radio.linked(apart, radio.lost_decades(quiet.t, x_e))
    np.testing.assert_array_equal(tables[:, i, j], jammed.linked)


def test_a_jammer_on_the_ground_stays_there(observed):
    # The fleet is 100 km from where the own ship took off.
    away, _, _ = observed(jamming=[{"of": "takeoff", "radius_m": 3e4, "share": 0.99}])
    near, _, _ = observed(jamming=[{"of": "takeoff", "radius_m": 3e5, "share": 0.99}])
    assert away.linked.all()
    assert not near.linked.any()


@pytest.mark.parametrize("links", ["own_ship", "all"])
def test_a_blocked_side_makes_detours_on_that_side(observed, links):
    side = {"links": links, "bearing_deg": 90.0, "start_s": 2.0, "duration_s": 5.0}
    quiet, _, fleet = observed()
    blocked, _, _ = observed(blocked_side=[side])
    i, j = quiet.pairs.T
    at_s = quiet.t - START_S
    east = ned(fleet, quiet.t)[..., 1]
    of_fleet, of_own = (east[:, i] > 0) | (east[:, j] > 0), (j == 0) & (east[:, i] > east[:, :1])
    there = of_fleet if links == "all" else of_own
    there &= ((at_s >= 2.0) & (at_s < 7.0))[:, None]
    np.testing.assert_array_equal(blocked.nlos, there)
    detour = blocked.ranges - quiet.ranges
    assert (detour[there] > 0).all()
    np.testing.assert_array_equal(detour[~there], 0.0)
    # Exponential, mean 150 m, the same for 10 s: as many draws as blocked pairs.
    drawn_ = detour[6, there[6]]
    assert np.mean(drawn_) == pytest.approx(150.0, abs=4 * 150.0 / np.sqrt(len(drawn_)))
    np.testing.assert_allclose(detour[6, there[6]], detour[7, there[6]], atol=1e-6)


def test_nothing_at_fault_leaves_every_draw_as_it_was(observed):
    quiet, _, _ = observed()
    harmless, _, _ = observed(jamming=[{"share": 0.0}], blocked_side=[{"start_s": 3000.0}])
    for name in ("ranges", "range_rates", "heard", "clock_offset", "power_dbm"):
        np.testing.assert_array_equal(getattr(harmless, name), getattr(quiet, name))


def test_fixes_fail_while_all_is_jammed_and_come_back(path):
    jammer = {"radius_m": 1e6, "share": 0.99, "start_s": 3.0, "duration_s": 3.0}
    fixes, record = fly(path, network(faults={"jamming": [jammer]}), 9.0)
    at_s = record.time - START_S
    made = record.fate == FixFate.DELIVERED
    # Tables of links are a second apart.
    assert not made[(at_s >= 3.0) & (at_s < 5.95)].any()
    assert made[at_s < 2.9].mean() > 0.9
    assert made[at_s > 7.05].mean() > 0.9
    assert len(fixes) == made.sum()


def test_one_side_without_sight_biases_fixes_and_their_covariance_does_not_know(path):
    nees = {}
    for name, faults in (("clean", {}), ("blocked", {"blocked_side": [{}]})):
        squares = []
        for run in range(12):
            _, record = fly(path, network(faults=faults, localization={"loss": "squared"}), 0.0, run)
            error = np.hstack([record.error_n[0, 0], record.velocity_error_n[0, 0]])
            if np.isfinite(error).all():
                squares.append(error @ np.linalg.solve(record.cov[0], error))
        nees[name] = np.mean(squares)
    # Six degrees of freedom: the mean of twelve runs has a standard deviation of 1.
    assert nees["clean"] < 9.0
    assert nees["blocked"] > 9.0


def test_who_is_chosen():
    anchor = np.arange(20) % 4 == 1
    for seed in range(20):
        drawn_ = Chosen(nodes=(3,), anchors=2, others=4).drawn(anchor, np.random.default_rng(seed))
        assert anchor[drawn_].sum() == 2
        assert 5 <= len(drawn_) - anchor[drawn_].sum() + 1 <= 6
        assert 0 not in drawn_
    assert len(Chosen(anchor_share=0.34).drawn(anchor, np.random.default_rng(1))) == 2
    assert len(Chosen(anchor_share=1.0, anchors=9).drawn(anchor, np.random.default_rng(1))) == 5
    assert len(Chosen().drawn(anchor, np.random.default_rng(1))) == 0


def test_of_their_place_only_anchors_lie():
    anchor = np.arange(20) % 4 == 1
    told = Offset(nodes=tuple(range(1, 8)), direction="own"), FalseRanges(nodes=(2,), start_s=3.0)
    lies = Lies(told, anchor, START_S, np.random.default_rng(1))
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(lies.since_s)), [1, 2, 5])
    np.testing.assert_array_equal(lies.since_s[[1, 2, 5]], START_S + np.array([0.0, 3.0, 0.0]))
    off = np.linalg.norm(lies.positions_n(np.array([START_S])), axis=-1)
    np.testing.assert_allclose(off, [300.0 * np.isin(np.arange(20), [1, 5])])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fixes.faults.lies": [{"kind": "ramp", "nodes": [50]}]}, "node 50: allowed is 0 to 49"),
        ({"fixes.faults.clock_jumps": [{"nodes": [77]}]}, "node 77"),
        ({"fixes.faults.jamming": [{"share": 1.0}]}, "share = 1.0"),
        ({"fixes.faults.lies": [{"kind": "rumour"}]}, "'offset', 'ramp', 'ranges'"),
        (
            {"fixes.faults.lies": [{"kind": "ranges", "others": 2}, {"kind": "ramp", "others": 2}]},
            "fixes.faults.lies.1: others = 2: only anchors say where they are, allowed is 0",
        ),
        (
            {"fixes.faults.lies": [{"kind": "offset", "nodes": [3, 0]}]},
            "fixes.faults.lies.0: nodes has 0, the own ship: only anchors say where they are",
        ),
        (
            {"fixes.faults.lies": [{"kind": "offset", "anchors": 1, "start_s": 40.0}]},
            "fixes.faults.lies[0].start_s = 40 s: must be before the end of the alignment, at 40 s",
        ),
        (
            {"fixes.faults.attacks": [{"kind": "forged"}, {"kind": "forged", "start_s": 60.0}]},
            "fixes.faults.attacks[1].start_s = 60 s: must be before the end of the alignment, at 40 s",
        ),
        (
            {"fixes.faults.jamming": [{"start_s": 60.0}]},
            "fixes.faults.jamming[0].start_s = 60 s: must be before",
        ),
        (
            {"fixes.faults.blocked_side": [{"start_s": 60.0}]},
            "fixes.faults.blocked_side[0].start_s = 60 s: must",
        ),
        (
            {"alignment.duration_s": 10.0, "fixes.faults.clock_jumps": [{"others": 1}]},
            "fixes.faults.clock_jumps[0].at_s = 10 s: must be before the end of the alignment, at 10 s",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(gao2009, changes, words):
    with pytest.raises(ScenarioError) as told:
        replaced(gao2009, {**changes, "variants": {}})
    assert words in str(told.value)
    assert len(str(told.value).splitlines()) == 1


def test_faults_may_begin_until_the_alignment_ends(gao2009):
    kinds = {
        "lies": {"kind": "ramp", "anchors": 1, "start_s": 39.9},
        "attacks": {"kind": "forged", "start_s": 39.9},
        "jamming": {"start_s": 39.9},
        "blocked_side": {"start_s": 39.9},
        "clock_jumps": {"others": 1, "at_s": 39.9},
    }
    late = replaced(gao2009, {"variants": {}} | {f"fixes.faults.{kind}": [of] for kind, of in kinds.items()})
    assert all(getattr(late.fixes.faults, kind) for kind in kinds)


def test_the_bundled_scenario_names_all_of_them():
    _, scenario = load_scenario("network_faults")
    named = set()
    for name in scenario.variants:
        faults = scenario.variant(name).fixes.faults
        named |= {
            field
            for field in NetworkFaults.model_fields
            if getattr(faults, field) != getattr(NetworkFaults(), field)
        }
    assert named == set(NetworkFaults.model_fields)

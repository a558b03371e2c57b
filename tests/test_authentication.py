"""Tags of packets: what is forged, changed or sent again is fused by no filter, and all else by all."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.estimate import FixOutcome
from fleetalign.align.filters import FILTERS, align
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.settings import FilterSettings
from fleetalign.cosim.run import fixes_of, simulate
from fleetalign.cosim.scenario import ScenarioError, load_scenario, replaced
from fleetalign.network.attacks import Forgery, Replay, Tampering, attacked
from fleetalign.network.authentication import TAG_BYTES, Authentication, genuine, tags
from fleetalign.network.fixes import concatenate, read_fixes, write_fixes
from fleetalign.sins.earth import GravityModel

KEYED = Authentication(key_hex="5a" * 32)
USED = (FixOutcome.FUSED, FixOutcome.INITIALIZED)
PERIOD_S = 0.1


@pytest.fixture(scope="module")
def run(flight, stated):
    """A run on fixes of stated noise, 10 Hz and up to 50 ms late."""
    return simulate(replaced(stated, {"alignment.filters": ["ekf"]}), flight, 0, seed=3)


@pytest.fixture(scope="module")
def aligned(run, stated):
    """Aligns by a filter on fixes that are given, from a time after the record's start on."""

    def align_(name, fixes, from_s=0.0):
        first = round(from_s / (run.imu.time[1] - run.imu.time[0]))
        record = (run.imu.time[first:], run.imu.dtheta_b[first:], run.imu.dv_b[first:])
        settings = FilterSettings(delay_sd_ms=14.4, heading_sd_deg=20.0)
        told = settings, stated.imu, GravityModel.J2
        given = AlignmentInput.checked(*record, run.q_nb_coarse, fixes, *told)
        return align(given, FILTERS[name])

    return align_


def attack(fixes, *attacks, authentication=KEYED, wrong_keys=(), seed=1):
    rng = np.random.default_rng(seed)
    return attacked(fixes, attacks, authentication, wrong_keys, fixes.t_valid[0], PERIOD_S, rng)


def used(estimate, fixes, arrivals):
    """How many of the packets that arrive then a filter took."""
    return np.count_nonzero(np.isin(estimate.fix_outcome, USED) & np.isin(fixes.t_arrival, arrivals))


def test_a_tag_depends_on_all_that_a_packet_says_and_on_its_key(run):
    fixes = run.fixes[:3]
    before = tags(fixes, KEYED)
    assert {len(tag) for tag in before} == {TAG_BYTES}
    assert len(set(before)) == 3
    changes = {
        "source": fixes.source + 1,
        "sequence": fixes.sequence + 1,
        "t_stamp": fixes.t_stamp + 1e-6,
        "lla": fixes.lla * (1 + 1e-15),
        "v_n": fixes.v_n * (1 + 1e-15),
        "cov": fixes.cov * (1 + 1e-15),
    }
    for name, value in changes.items():
        changed = replace(fixes, **{name: value})
        assert not set(tags(changed, KEYED)) & set(before), name
        assert not genuine(changed, before, KEYED).any(), name
    # What the receiver finds out itself is not in it.
    later = replace(fixes, t_arrival=fixes.t_arrival + 0.1, t_valid=fixes.t_valid + 1.0)
    assert tags(later, KEYED) == before
    assert genuine(fixes, before, KEYED).all()
    assert not genuine(fixes, before, Authentication(key_hex="5b" * 32)).any()
    assert not genuine(fixes, [tag[:-1] for tag in before], KEYED).any()


def test_nodes_have_keys_of_their_own_and_passphrases_make_some(run):
    spoken = Authentication(passphrase="over the plain")
    keys = [each.key(node) for each in (KEYED, spoken) for node in range(20)]
    assert len(set(keys)) == 40
    assert spoken.key(3) == Authentication(passphrase="over the plain").key(3)
    assert spoken.key(3) != Authentication(passphrase="over the plane").key(3)
    # One node cannot speak for another.
    fixes = run.fixes[:2]
    stolen = replace(fixes, source=fixes.source + 1)
    assert not genuine(fixes, tags(stolen, KEYED), KEYED).any()


@pytest.mark.parametrize("name", FILTERS)
def test_forged_and_changed_packets_are_fused_by_no_filter(run, aligned, name):
    fixes, intruders = attack(run.fixes, Forgery(share=0.3), Tampering(share=0.3))
    assert len(intruders.forged) > 200
    estimate = aligned(name, fixes)
    bad = np.isin(fixes.t_arrival, intruders.forged)
    assert (estimate.fix_outcome[bad] == FixOutcome.UNAUTHENTIC).all()
    assert estimate.count(FixOutcome.UNAUTHENTIC) == len(intruders.forged)
    # As if nothing had come with them.
    alone = aligned(name, fixes[~bad])
    np.testing.assert_array_equal(estimate.lla, alone.lla)
    np.testing.assert_array_equal(estimate.q_nb, alone.q_nb)
    # Without tags those are taken that a gate lets through, and good ones are lost to them, as copies: 28 to
    # 116 and 46 to 124.
    near = Forgery(share=0.3, offset_n_m=(30.0, 0.0, 0.0))
    open_, intruders = attack(run.fixes, near, authentication=None)
    believed = aligned(name, open_)
    assert used(believed, open_, intruders.forged) > 20
    assert believed.count(FixOutcome.DUPLICATE) > 20


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("after_s", [0.25, 1.1, 8.0])
@pytest.mark.parametrize("original_lost", [False, True], ids=["copy", "original lost"])
def test_packets_sent_again_are_fused_by_no_filter(run, aligned, name, after_s, original_lost):
    replay = Replay(share=0.3, after_s=after_s, original_lost=original_lost)
    fixes, intruders = attack(run.fixes, replay)
    assert len(intruders.replayed) > 80
    assert used(aligned(name, fixes), fixes, intruders.replayed) == 0


@pytest.mark.parametrize("name", FILTERS)
def test_a_packet_sent_again_while_others_are_silent_is_not_fused(run, aligned, name):
    # 20 s to 24 s: nothing arrives but, 1.5 s late, what had been sent and lost before. Its number is new.
    at_s = run.fixes.t_valid - run.fixes.t_valid[0]
    lost = (at_s >= 20.0) & (at_s < 22.0)
    silent = (at_s >= 20.0) & (at_s < 24.0)
    again = replace(run.fixes, t_arrival=run.fixes.t_arrival + 1.5)[lost]
    sent = concatenate([run.fixes[~silent], again])
    verified = replace(sent, authentic=genuine(sent, tags(sent, KEYED), KEYED))
    assert used(aligned(name, verified), verified, again.t_arrival) == 0
    # Numbers and arrivals alone do not tell: it is the age that does. What goes by stamps takes them all for
    # what they are, late; others are left with their gate.
    outcome = aligned(name, sent).fix_outcome[np.isin(sent.t_arrival, again.t_arrival)]
    assert len(outcome) == 20
    assert np.isin(outcome, USED if name == "ekf_stamped" else (FixOutcome.GATED,)).all()


@pytest.mark.parametrize("name", FILTERS)
def test_packets_from_before_the_alignment_are_not_fused_when_sent_again(run, aligned, name):
    from_s = 10.0
    start_s = run.imu.time[0] + from_s
    old = run.fixes.t_arrival < start_s - 0.5
    # Sent again as the first that the filter hears.
    again = replace(run.fixes, t_arrival=start_s + 0.001 + 1e-5 * np.arange(len(old)))[old]
    again = again[again.t_arrival < start_s + 0.01]
    fixes = concatenate([run.fixes[run.fixes.t_valid >= start_s], again])
    fixes = replace(fixes, authentic=genuine(fixes, tags(fixes, KEYED), KEYED))
    stale = again.t_arrival - again.t_stamp > KEYED.fresh_s
    assert stale.sum() > 80
    assert used(aligned(name, fixes, from_s), fixes, again.t_arrival[stale]) == 0


def test_late_packets_that_are_fresh_are_taken(run):
    sent = replace(run.fixes, t_arrival=run.fixes.t_stamp + 0.15)
    assert genuine(sent, tags(sent, KEYED), KEYED).all()
    assert not genuine(replace(sent, t_arrival=sent.t_stamp + 0.25), tags(sent, KEYED), KEYED).any()


def test_packets_from_the_future_are_not_taken(run):
    # Clocks that agree to less than 1 ms are no future; what is beyond would last for longer than it may.
    for ahead_s, taken in ((5e-4, True), (2e-3, False), (0.1, False)):
        sent = replace(run.fixes, t_arrival=run.fixes.t_stamp - ahead_s)
        assert (genuine(sent, tags(sent, KEYED), KEYED) == taken).all()


def test_clocks_that_jump_a_second_ahead_do_not_let_old_packets_in(flight):
    # Sent again 0.9 s later, packets look 0.1 s ahead of their arrival. Were they genuine, l2linf would
    # refuse them for some seconds and then start anew on them: 32 of 96 were used.
    changes = {
        "variants": {},
        "fixes.fleet": {"nodes": 16, "anchor_share": 0.44},
        "fixes.authentication": {"key_hex": "5a" * 32},
        "fixes.faults.clock_jumps": [{"nodes": list(range(1, 16)), "at_s": 2.0, "jump_us": 1e6}],
        "fixes.faults.attacks": [
            {"kind": "replayed", "after_s": 0.9, "share": 1.0, "original_lost": True, "start_s": 2.5}
        ],
        "alignment.duration_s": 12.0,
        "alignment.filters": ["ekf_stamped", "l2linf"],
    }
    run = simulate(replaced(load_scenario("network_faults")[1], changes), flight, 0, 3)
    assert run.network is not None
    fixes = run.fixes.sorted_by_arrival()
    again = run.network.faults.replayed_arrival
    assert len(again) > 80
    young = np.isin(fixes.t_arrival, again) & (fixes.t_arrival - fixes.t_stamp < KEYED.fresh_s)
    assert young.sum() == len(again)
    assert not fixes.authentic[young].any()
    for estimate in run.estimates.values():
        assert used(estimate, fixes, fixes.t_arrival) > 10
        assert used(estimate, fixes, again) == 0


def test_tags_change_nothing_where_nobody_attacks(flight, gao2009):
    short = replaced(
        gao2009, {"alignment.duration_s": 3.0, "fixes.fleet.nodes": 30, "fixes.fleet.anchor_share": 0.3}
    )
    plain, _ = fixes_of(short, flight, 0, 3)
    tagged, record = fixes_of(replaced(short, {"fixes.authentication": {"passphrase": "a"}}), flight, 0, 3)
    assert len(plain) > 20
    for name in ("t_stamp", "t_arrival", "lla", "v_n", "cov", "source", "sequence", "authentic"):
        np.testing.assert_array_equal(getattr(tagged, name), getattr(plain, name))
    assert not record.faults.silenced.any()


def test_the_intruders_packets_are_known_whatever_befalls_packets(flight, gao2009):
    """Detours and copies take 0.7 s at most, what is sent again comes 1 s late; forged is what is aside."""
    short = {
        "variants": {},
        "alignment.duration_s": 3.0,
        "fixes.fleet.nodes": 30,
        "fixes.fleet.anchor_share": 0.3,
    }
    attacks = [{"kind": "tampered", "share": 0.4}, {"kind": "replayed", "share": 0.4, "after_s": 1.0}]
    packets = {"detour_share": 0.5, "detour_max_s": 0.2, "copies": 3}
    scenario = replaced(gao2009, short | {"fixes.faults.attacks": attacks, "faults.packets": packets})
    fixes, record = fixes_of(scenario, flight, 0, 3)
    true, _ = fixes_of(replaced(gao2009, short), flight, 0, 3)
    aside = (fixes.lla != true.lla[np.searchsorted(true.sequence, fixes.sequence)]).any(axis=1)
    again = fixes.t_arrival - fixes.t_valid > 1.0
    assert min(aside.sum(), again.sum()) > 20
    np.testing.assert_array_equal(np.isin(fixes.t_arrival, record.faults.forged_arrival), aside)
    np.testing.assert_array_equal(np.isin(fixes.t_arrival, record.faults.replayed_arrival), again)


def test_nobody_uses_what_a_node_without_the_key_says(flight, gao2009):
    short = {"alignment.duration_s": 3.0, "fixes.fleet.nodes": 30, "fixes.fleet.anchor_share": 0.3}
    lies = [{"kind": "offset", "anchors": 9, "start_s": 1.0}]
    wrong = {"fixes.faults.wrong_keys": {"anchors": 3}}
    keyed = replaced(gao2009, {**short, **wrong, "fixes.authentication": {"passphrase": "a"}})
    fixes, record = fixes_of(keyed, flight, 0, 3)
    out = record.faults.silenced
    assert out.sum() == 3
    assert record.anchor[out].all()
    assert fixes.authentic.all()
    # Whatever they say makes no difference; without tags it does.
    silenced = np.flatnonzero(out).tolist()
    lies[0] = {"kind": "offset", "nodes": silenced, "start_s": 1.0}
    for scenario, same in ((keyed, True), (replaced(gao2009, {**short, **wrong}), False)):
        honest, _ = fixes_of(scenario, flight, 0, 3)
        lied, _ = fixes_of(replaced(scenario, {"fixes.faults.lies": lies}), flight, 0, 3)
        assert np.array_equal(honest.lla, lied.lla) == same
    # If it is the maker of the fixes that has it not, there are none to use.
    maker = {"fixes.faults.wrong_keys": {"nodes": [record.maker]}}
    none, _ = fixes_of(replaced(keyed, maker), flight, 0, 3)
    assert len(none)
    assert not none.authentic.any()


def test_refused_packets_are_known_in_files(run, tmp_path):
    fixes = replace(run.fixes, authentic=np.arange(len(run.fixes)) % 3 > 0)
    for file in (tmp_path / "fixes.csv", tmp_path / "fixes.parquet"):
        write_fixes(fixes, file)
        np.testing.assert_array_equal(read_fixes(file).authentic, fixes.authentic)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fixes.authentication": {}}, "neither is given"),
        ({"fixes.authentication": {"passphrase": "a", "key_hex": "00" * 16}}, "both are given"),
        ({"fixes.authentication": {"key_hex": "00" * 15}}, "allowed are 32 to 128"),
        ({"fixes.faults.attacks": [{"kind": "forged", "share": 2.0}]}, "share = 2.0"),
        (
            {"fixes.localization.solver": "distributed", "fixes.faults.attacks": [{"kind": "forged"}]},
            "there is no packet to attack",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(gao2009, changes, words):
    with pytest.raises(ScenarioError) as told:
        replaced(gao2009, {**changes, "variants": {}})
    assert words in str(told.value)
    assert len(str(told.value).splitlines()) == 1

"""Nodes that contradict the others: found out in time, and honest ones left alone."""

from functools import partial

import numpy as np
import pytest
from fleetalign.cosim.run import generator
from fleetalign.cosim.scenario import ScenarioError, replaced
from fleetalign.network import survey
from fleetalign.network.fleet import CentrePath
from fleetalign.network.fleet_network import FleetNetwork, fly_network
from fleetalign.network.localization import quarantine
from fleetalign.network.localization.problem import NodeOutcome
from fleetalign.network.localization.quarantine import Monitor
from fleetalign.network.record import QuarantineReason

START_S = 505.0
LIE_S = 2.0
"""From the start of the alignment."""


@pytest.fixture(scope="module")
def path(flight):
    return CentrePath(flight, flight.time[0], flight.time[-1])


def network(lies=(), **rooms):
    """20 nodes, six of them anchors, and lies of theirs that begin at `LIE_S`."""
    told = {
        "fleet": {"nodes": 20, "anchor_share": 0.3},
        "localization": {"quarantine": {}},
        "faults": {"lies": [{"start_s": LIE_S, **lie} for lie in lies]},
    }
    return FleetNetwork.model_validate({**told, **rooms})


def fly(path, settings, seconds, run=0, seed=5):
    return fly_network(path, START_S, START_S + seconds, settings, partial(generator, seed, run))


def caught(record):
    """Seconds after its lie at which each liar was first left out; and how many honest nodes ever were."""
    told = record.faults
    lies = np.isfinite(told.lying_s)
    return (told.found_s - told.lying_s)[lies], int(told.left_out_without_cause.sum())


def own_rms(record, since_s):
    rows = record.time >= START_S + since_s
    return np.sqrt(np.mean(record.error_n[rows, 0] ** 2))


def test_what_is_watched_is_as_large_as_noise_makes_it(path, monkeypatch):
    # Both statistics, in standard deviations, are what limits are laid at.
    beliefs, ranges = [], []
    of_belief, of_ranges = quarantine._belief_excess, quarantine.range_excess

    def watched_beliefs(*given):
        found = of_belief(*given)
        beliefs.append(found[:, given[3]].ravel() ** 2)
        return found

    def watched_ranges(bias):
        ranges.append(bias[np.isfinite(bias)] ** 2)
        return of_ranges(bias)

    monkeypatch.setattr(quarantine, "_belief_excess", watched_beliefs)
    monkeypatch.setattr(quarantine, "range_excess", watched_ranges)
    for run in range(6):
        fly(path, network(), 4.0, run)
    # Six numbers of six anchors: epochs are independent, windows that overlap are not, and what anchors err
    # in common is in all of a run.
    assert np.mean(np.concatenate(beliefs)) == pytest.approx(6.0, rel=0.15)
    # Neighbours are taken for known, which they are not: residuals are smaller.
    assert 0.5 < np.mean(np.concatenate(ranges)) < 1.1


def test_honest_nodes_are_left_alone_and_fixes_are_what_they_were(path):
    for run in range(4):
        fixes, record = fly(path, network(), 5.0, run)
        assert caught(record) == (pytest.approx([]), 0)
        unwatched, _ = fly(path, network(localization={}), 5.0, run)
        np.testing.assert_array_equal(fixes.lla, unwatched.lla)
        np.testing.assert_array_equal(fixes.cov, unwatched.cov)


def test_a_ramp_is_found_before_it_does_harm(path):
    ratios = []
    for run in range(4):
        _, record = fly(path, network([{"kind": "ramp", "anchors": 1}]), 12.0, run)
        after, false = caught(record)
        # With 30 nodes 4 s on average; fewer nodes see less.
        assert (after < 9.5).all()
        assert false == 0
        reason = record.faults.quarantined_for
        assert set(reason[reason > 0]) == {QuarantineReason.BELIEF}
        _, clean = fly(path, network(), 12.0, run)
        ratios.append(own_rms(record, LIE_S) / own_rms(clean, LIE_S))
        # What it says no longer counts; where others have it, it is known.
        liar = np.flatnonzero(np.isfinite(record.faults.lying_s))[0]
        assert record.outcome[-1, liar] == NodeOutcome.LOCATED
        assert np.linalg.norm(record.error_n[-1, liar]) < 60.0 < 5.0 * 13.0
    assert np.mean(ratios) < 1.3
    # Where nobody looks, what it says goes on to grow, and the own ship's error with it.
    _, believed = fly(path, network([{"kind": "ramp", "anchors": 1}], localization={}), 25.0, run)
    assert own_rms(believed, 20.0) > 1.5 * own_rms(clean, LIE_S)


@pytest.mark.parametrize("direction", ["same", "own"])
def test_a_third_that_is_far_off_is_found_at_once(path, direction):
    lie = {"kind": "offset", "anchor_share": 0.34, "direction": direction}
    for run in range(4):
        _, record = fly(path, network([lie]), 4.0, run)
        after, false = caught(record)
        assert len(after) == 2
        # At the epoch itself: its fix rests on none of them.
        assert (after < 0.05).all()
        assert false == 0
        assert np.isfinite(record.error_n[-1, 0]).all()
        assert np.linalg.norm(record.error_n[-1, 0]) < 100.0


def test_who_lies_from_the_start_is_a_suspect_there(path):
    _, record = fly(path, network([{"kind": "offset", "anchors": 1, "start_s": 0.0}]), 2.0, 1)
    after, false = caught(record)
    assert (after == 0).all()
    assert false == 0
    assert np.linalg.norm(record.error_n[-1, 0]) < 60.0


def test_all_anchors_together_can_say_what_they_like(path):
    _, record = fly(path, network([{"kind": "offset", "anchor_share": 1.0}]), 4.0)
    # Ranges know no place: the majority is believed.
    off = record.error_n[record.time > START_S + LIE_S + 0.05, 0].mean(axis=0)
    assert off[0] == pytest.approx(300.0, abs=30.0)
    assert np.isnan(record.faults.quarantined_s).all()


@pytest.mark.parametrize("range_m", [300.0, -300.0])
@pytest.mark.parametrize("who", ["others", "anchors"])
def test_false_ranges_are_found(path, range_m, who):
    for run in range(2):
        _, record = fly(
            path, network([{"kind": "ranges", who: 1, "range_m": range_m, "start_s": LIE_S + 0.5}]), 5.0, run
        )
        after, false = caught(record)
        assert (after < 1.5).all()
        # Ranges of an anchor at the edge point all one way: that it is they, or a neighbour, is hard to say.
        assert false <= (who == "anchors")
        liar = np.flatnonzero(np.isfinite(record.faults.lying_s))[0]
        if record.faults.quarantined_for[liar] == QuarantineReason.RANGES:
            assert record.outcome[-1, liar] == NodeOutcome.QUARANTINED
        # Who is left out in the middle of a second was located before, with a standard deviation.
        assert np.isfinite(record.sd_n[record.outcome == NodeOutcome.LOCATED]).all()


def test_a_clock_that_jumps_matters_one_way_alone(path):
    jump = {"clock_jumps": [{"anchors": 1, "others": 2, "nodes": [0], "at_s": LIE_S}]}
    quiet = [fly(path, network(radio={"ranging": kind}), 4.0) for kind in ("one_way", "two_way")]
    loud = [fly(path, network(faults=jump, radio={"ranging": kind}), 4.0) for kind in ("one_way", "two_way")]
    # Two-way: in the stamps of the own ship's clock and no other place. The maker's may have jumped, too.
    (fixes, record), (jumped, other) = quiet[1], loud[1]
    np.testing.assert_array_equal(record.error_n, other.error_n)
    moved = (jumped.t_stamp - fixes.t_stamp)[fixes.t_valid >= START_S + LIE_S]
    assert set(np.round(moved * 1e6, 3)) <= {-1.0, 0.0}
    assert not np.isfinite(other.faults.lying_s).any()
    # One-way: 300 m in all ranges of each. Clocks of others are estimated anew at each epoch; an anchor's is
    # taken for right, until it is found out.
    after, false = caught(loud[0][1])
    assert len(after) == 1
    assert (after < 0.5).all()
    assert false == 0
    assert own_rms(loud[0][1], LIE_S) < 1.3 * own_rms(quiet[0][1], LIE_S)


def test_many_who_are_off_together_are_no_liars(path):
    # Half of the fleet has no line of sight: ranges disagree by far more than their noise, and nobody is it.
    side = {"blocked_side": [{"links": "all", "start_s": LIE_S}]}
    disturbed = []
    for run in range(4):
        _, record = fly(path, network(faults=side), 5.0, run)
        # To stand back when nodes are started is another judgement, of one epoch and until the next start.
        assert set(record.faults.quarantined_for) <= {QuarantineReason.NONE, QuarantineReason.START}
        disturbed.append(len(record.faults.disturbed_s))
        assert (record.faults.disturbed_s >= START_S + LIE_S).all()
    assert sum(disturbed) > 20
    _, quiet = fly(path, network(), 5.0)
    assert len(quiet.faults.disturbed_s) == 0


def test_who_was_left_out_without_cause_is_asked_back(path):
    # Three of seven drift alike. At first an honest anchor is taken for a liar; 5 s later they are found.
    lie = {"kind": "ramp", "anchor_share": 0.4}
    fleet = {"nodes": 16, "anchor_share": 0.44}
    _, record = fly(path, network([lie], fleet=fleet, rate_hz=5.0), 14.0, 4)
    told = record.faults
    [honest] = np.flatnonzero(told.left_out_without_cause)
    assert np.isnan(told.lying_s[honest])
    assert not told.out_without_cause.any()
    after, false = caught(record)
    assert false == 1
    assert len(after) == 3
    assert np.isfinite(after).all()
    # Meanwhile it is located by the others, before and after that it is an anchor.
    out_s = told.found_out[told.found_out[:, 0] == honest, 1]
    back_s = np.nanmin(told.found_s)
    out = (record.time >= out_s - 1e-6) & (record.time < back_s - 1e-6)
    assert len(out_s) == 1
    assert out.sum() > 10
    assert set(record.outcome[out, honest]) == {NodeOutcome.LOCATED}
    assert set(record.outcome[~out, honest]) == {NodeOutcome.ANCHOR}


def test_whom_the_search_names_does_not_rest_on_who_was_left_out(path):
    # Two lie alike, and one honest anchor was taken for a liar before: with them out, it agrees with all.
    lie = {"kind": "offset", "anchor_share": 0.34}
    _, record = fly(path, network([lie]), 4.0)
    told = record.faults
    seen = survey_evidence(path, network([lie]), 4.0)
    liars = set(np.flatnonzero(np.isfinite(told.lying_s)).tolist())
    honest = next(i for i in np.flatnonzero(record.anchor).tolist() if i not in liars)
    for believed_not in (set(), {honest}, liars):
        stand = seen(believed_not)
        assert stand.to_disbelieve(0.0, 2) == (liars, True)
    assert stand.excess == 0.0


def survey_evidence(path, settings, seconds):
    """Makes the `Stand` of a fleet at the end, its tracker having disbelieved some from the start on."""
    kept = []

    class Kept(survey.WatchedTracker):
        def _tried(self, past, *who):
            kept.append((self, past))
            return super()._tried(past, *who)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(survey, "WatchedTracker", Kept)
        fly(path, settings, seconds)
    watcher, past = kept[0]
    return lambda who: watcher._tried(past, who, ())


def test_the_watch_goes_on_from_segment_to_segment(path, monkeypatch):
    lies = [{"kind": "ramp", "anchors": 1}, {"kind": "ranges", "others": 1}]
    long_, _ = fly(path, network(lies), 12.0)
    monkeypatch.setattr(survey, "SEGMENT", 4)
    short, record = fly(path, network(lies), 12.0)
    after, _ = caught(record)
    assert len(after) == 2
    assert np.isfinite(after).all()
    # Found in one segment, left out in all that follow, though each starts from nothing.
    liars = np.isfinite(record.faults.lying_s)
    last = record.outcome[-1, liars]
    assert set(last) == {NodeOutcome.LOCATED, NodeOutcome.QUARANTINED}
    assert np.linalg.norm(record.error_n[-1, liars][last == NodeOutcome.LOCATED]) < 60.0
    # And on any number of cores.
    for cores in (1, 3):
        monkeypatch.setattr(survey.os, "cpu_count", lambda cores=cores: cores)
        np.testing.assert_array_equal(fly(path, network(lies), 12.0)[0].lla, short.lla)
    assert not np.array_equal(long_.lla, short.lla)


def test_fewer_than_half_are_left_out():
    anchor = np.arange(12) < 7
    monitor = Monitor(quarantine.QuarantineSettings(), anchor, 10.0)
    assert monitor.limits.windows == (1, 10, 30)
    assert monitor.may_disbelieve([]) == 3
    # Those whose ranges are not used count, if they are anchors.
    assert monitor.may_disbelieve([2, 9]) == 2
    assert monitor.may_disbelieve([0, 1, 2, 3, 4]) == 0
    # Once no more may be, no anchor's ranges are judged but of those who are not believed.
    monitor.leave_out([4, 5], [1], 3.0)
    assert np.flatnonzero(monitor.judged([1])).tolist() == [2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
    monitor.leave_out([4, 5], [1, 2, 3], 4.0)
    assert np.flatnonzero(monitor.judged([1, 2, 3])).tolist() == [4, 5, 7, 8, 9, 10, 11]
    # Who is no longer among those left out is asked back.
    monitor.leave_out([5], [1, 2, 3], 5.0)
    assert monitor.left_out(QuarantineReason.BELIEF) == {5}
    assert np.isnan(monitor.since_s[4])
    assert monitor.since_s[[1, 2, 5]].tolist() == [3.0, 4.0, 3.0]
    # And is known to have been left out; another time is told again.
    monitor.leave_out([4], [1, 2, 3, 5], 6.0)
    told = [(1, 3.0), (4, 3.0), (5, 3.0), (2, 4.0), (3, 4.0), (4, 6.0)]
    assert monitor.found_out == told


def test_a_distributed_solver_is_not_watched(gao2009):
    changes = {
        "fixes.localization.solver": "distributed",
        "fixes.localization.quarantine": {},
        "variants": {},
    }
    with pytest.raises(ScenarioError, match="nobody sees all") as told:
        replaced(gao2009, changes)
    assert len(str(told.value).splitlines()) == 1

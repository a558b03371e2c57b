"""What is told of faults: twins without them, jumps that no flag tells, quarantines, the table."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fleetalign.align.estimate import FixOutcome, NavStatus
from fleetalign.cosim.clean_twin import clean_twin, has_faults, without_faults
from fleetalign.cosim.fault_report import fault_rows, told_faults
from fleetalign.cosim.fault_score import FaultScorer, jumps
from fleetalign.cosim.network_fault_score import network_figures
from fleetalign.cosim.pages import write_page
from fleetalign.cosim.run import simulate, simulate_all
from fleetalign.cosim.scenario import load_scenario, replaced
from fleetalign.cosim.score import Scorer
from fleetalign.cosim.variants import run_variants
from fleetalign.network.record import FaultRecord, QuarantineReason

FILTERS = ["ekf_stamped", "l2linf"]
LATE = {"faults.packets.detour_share": 0.2, "outages": [{"start_s": 10.0, "duration_s": 5.0}]}


@pytest.fixture(scope="module")
def run(stated, flight):
    return simulate(replaced(stated, {"alignment.filters": ["ekf_stamped"]}), flight, 0, 1)


def test_a_fault_is_judged_against_its_twin(stated, gao2009):
    climb = {"alignment.start": "climb", "alignment.duration_s": 60.0}
    scenarios = {
        "out": replaced(stated, LATE),
        "as stated": stated,
        "climb": replaced(stated, climb),
        "climb out": replaced(stated, climb | LATE),
        "other": replaced(stated, LATE | {"fixes.rate_hz": 5.0}),
    }
    assert [has_faults(scenario) for scenario in scenarios.values()] == [True, False, False, True, True]
    assert clean_twin(scenarios["out"], scenarios) == "as stated"
    assert clean_twin(scenarios["climb out"], scenarios) == "climb"
    assert clean_twin(scenarios["other"], scenarios) is None  # none is quite like it
    assert clean_twin(scenarios["climb out"], {"as stated": stated}) is None
    lying = replaced(gao2009, {"fixes.faults.clock_jumps": [{"nodes": [1], "at_s": 5.0, "jump_us": 1.0}]})
    assert has_faults(lying)
    assert not has_faults(gao2009)
    assert clean_twin(lying, {"lying": lying, "as stated": gao2009}) == "as stated"


def test_a_jump_without_a_flag_is_found(run, window):
    """Of 4 standard deviations to the north, and of 2, from one row on."""
    found = run.estimates["ekf_stamped"]
    assert jumps(found, window, run.imu)[1] == 0
    before, _ = jumps(found, window, run.imu)
    for sigmas, more in ((4.5, 1), (2.0, 0)):
        lla = found.lla.copy()
        lla[200:, 0] += sigmas * found.sd[199, 0] / 6.37e6
        total, unflagged = jumps(replace(found, lla=lla), window, run.imu)
        assert (total - before, unflagged) == (more, more)
        told = found.jump.copy()
        told[200] = sigmas
        assert jumps(replace(found, lla=lla, jump=told), window, run.imu) == (total, 0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_vibration_hides_no_jump_of_velocity(run, window, axis, sign):
    """0.6 standard deviations above the threshold and as much below, at every 20th row of the second half:
    there corrections are of up to a half, and vibration moves the velocity by one from row to row."""
    found = run.estimates["ekf_stamped"]
    rows = np.arange(200, len(found.time), 20)
    for sigmas, seen in ((3.6, 1), (2.4, 0)):
        for row in rows:
            v_n = found.v_n.copy()
            v_n[row:, axis] += sign * sigmas * max(found.sd[row - 1 : row + 1, 3 + axis])
            assert jumps(replace(found, v_n=v_n), window, run.imu) == (seen, seen), row


def test_nothing_jumps_without_faults_though_the_imu_vibrates(stated, flight, window):
    """Ten times as much as by default: it moves the velocity by five standard deviations from row to row."""
    scenario = replaced(stated, {"alignment.filters": FILTERS, "imu.vibration_mps": 0.1})
    for run_id in range(5):
        run = simulate(scenario, flight, run_id, 1)
        for found in run.estimates.values():
            assert jumps(found, window, run.imu)[1] == 0


def test_counts_are_of_what_became_of_fixes(stated, flight, window):
    """Made-up outcomes of 400 fixes: 40 outliers, of which 2 are believed; 9 good ones are refused."""
    scenario = replaced(stated, {"alignment.filters": FILTERS} | LATE)
    scorer, scores = FaultScorer(scenario, window), Scorer(window, tuple(FILTERS))
    for run_id in range(2):
        done = simulate(scenario, flight, run_id, 1)
        k = len(done.fixes)
        outlier = np.arange(k) < 40
        outcome = np.where(outlier, FixOutcome.GATED, FixOutcome.FUSED)
        outcome[[3, 4]], outcome[50:59] = FixOutcome.FUSED, FixOutcome.GATED
        outcome[60:70], outcome[70:75] = FixOutcome.DUPLICATE, FixOutcome.PENDING
        outcome[80:84] = FixOutcome.INITIALIZED
        estimates = {name: replace(found, fix_outcome=outcome) for name, found in done.estimates.items()}
        done = replace(done, estimates=estimates, outlier=outlier)
        scorer.add(done)
        scores.add(done)
    found = scores.scores()
    clean = {name: 0.5 * score.errors[:, -1] for name, score in found.items()}
    row = scorer.rows(found, clean)["filters"]["l2linf"]
    assert row["outliers"] == 80
    assert row["outliers_rejected"] == 38 / 40
    assert row["good"] == 2 * (k - 40 - 15)
    assert row["good_lost"] == 9 / (k - 55)
    assert row["duplicates"] == 20
    assert row["restarts"] == 2 * 3
    low, high = row["nees_band95"]
    assert low < 3 < high
    assert row["nees"] == pytest.approx(found["l2linf"].nees[:, -1].mean())
    assert {name: ratio[0] for name, ratio in row["over_clean"].items()} == pytest.approx(
        {"level": 2.0, "heading": 2.0, "velocity": 2.0}
    )
    mean, most = row["outages"][0]["dead_reckoning_after_s"]
    assert 2.9 <= mean <= most <= 3.2
    low, high = row["outages"][0]["nees_band95"]
    assert low < 3 < high
    assert row["outages"][0]["after_30_s"] is None  # the record ends before
    assert scorer.rows(found, None)["filters"]["l2linf"]["over_clean"] is None


def test_without_a_run_that_lasts_there_is_no_band(stated, flight, window):
    scenario = replaced(stated, {"alignment.filters": ["l2linf"]} | LATE)
    scorer, scores = FaultScorer(scenario, window), Scorer(window, ("l2linf",))
    done = simulate(scenario, flight, 0, 1)
    lost = done.estimates["l2linf"]
    lost = replace(lost, q_nb=np.full_like(lost.q_nb, np.nan))
    done = replace(done, estimates={"l2linf": lost})
    scorer.add(done)
    scores.add(done)
    row = scorer.rows(scores.scores(), None)["filters"]["l2linf"]
    assert (row["nees"], row["nees_band95"]) == (None, None)
    assert (row["outages"][0]["nees"], row["outages"][0]["nees_band95"]) == (None, None)


def test_an_outage_that_is_never_told_has_no_time(stated, flight, window):
    scenario = replaced(stated, {"alignment.filters": ["l2linf"]} | LATE)
    scorer, scores = FaultScorer(scenario, window), Scorer(window, ("l2linf",))
    done = simulate(scenario, flight, 0, 1)
    silent = np.full(len(done.estimates["l2linf"].time), NavStatus.AIDED)
    done = replace(done, estimates={"l2linf": replace(done.estimates["l2linf"], status=silent)})
    scorer.add(done)
    scores.add(done)
    row = scorer.rows(scores.scores(), None)["filters"]["l2linf"]
    assert row["outages"][0]["dead_reckoning_after_s"] is None


def record(lying, found_out, asked_back=(), suspects=(), standing_back=()):
    """`found_out` has all times at which each node was found out; suspects of a start stand back at 10 s."""
    nothing, n, reasons = np.empty(0), len(lying), QuarantineReason
    times = [(node, at_s) for node, told in enumerate(found_out) for at_s in told]
    last, reason = np.full(n, np.nan), np.full(n, int(reasons.NONE))
    for node, at_s in times:
        if node not in asked_back:
            last[node], reason[node] = at_s, reasons.BELIEF
    last[list(standing_back)], reason[list(standing_back)] = 10.0, reasons.START
    suspected = np.isin(np.arange(n), [*suspects, *standing_back])
    times = np.array(times, float).reshape(-1, 2)
    lying = np.array(lying, float)
    return FaultRecord(lying, np.zeros(n, bool), last, reason, times, suspected, nothing, nothing)


def test_quarantines_are_of_liars_or_false():
    nan = np.nan
    records = [record([nan, 10, 10], [[], [20], []]), record([nan, 10, nan], [[], [16], [30]])]
    found = network_figures(records)
    assert found["lying"] == 3
    assert found["quarantined"] == 2 / 3
    assert found["quarantined_after_s"] == [8.0, 10.0]
    assert (found["false_quarantines"], found["false_at_end"], found["honest_suspects"]) == (1, 1, 0)
    assert found["false_share"] == 1 / 3
    assert network_figures([record([nan], [[]])])["quarantined"] is None
    early = network_figures([record([10, 10], [[2], [12]])])  # one of them left out before its first lie
    assert (early["quarantined"], early["false_quarantines"], early["false_at_end"]) == (0.5, 1, 1)
    assert early["quarantined_after_s"] == [2.0, 2.0]


def test_who_was_asked_back_was_left_out_all_the_same():
    nan = np.nan
    # An honest one, a liar found before its lie and twice after, and one that is not let in from the start.
    told = record([nan, 10, 10, nan], [[12], [2, 15, 19], [], []], [0], [3], [2])
    found = network_figures([told])
    assert (found["false_quarantines"], found["false_at_end"], found["honest_suspects"]) == (2, 0, 1)
    assert found["false_share"] == 2 / 2
    assert (found["quarantined"], found["quarantined_at_end"]) == (1.0, 1.0)
    assert found["quarantined_after_s"] == [2.5, 5.0]  # the first time after the lie
    back = network_figures([record([10, 10], [[12], [14]], asked_back=[1])])
    assert (back["quarantined"], back["quarantined_at_end"]) == (1.0, 0.5)
    line = told_faults({"faults": {"x": {"against": None, "filters": {}, "network": back}}})[-1]
    assert "100.0 % of them were quarantined after 3.0 s, 4.0 s at most (50.0 % at the end)" in line
    line = told_faults({"faults": {"x": {"against": None, "filters": {}, "network": found}}})[-1]
    assert line.endswith(
        "; 2 honest nodes were, 0 at the end; 1 stood back as suspects of a start, 0 at the end"
    )


def test_suspects_of_a_start_are_counted_apart_at_any_time_and_at_the_end():
    nan = np.nan
    # Two suspects, of whom one was let in; one that is out, one asked back; one found out, and again when it
    # lied.
    told = record([nan, nan, nan, nan, 10], [[], [], [5], [6], [7, 12]], [3], [0], [1])
    found = network_figures([told])
    assert (found["honest_suspects"], found["honest_suspects_at_end"]) == (2, 1)
    assert (found["false_quarantines"], found["false_at_end"]) == (3, 1)
    line = told_faults({"faults": {"x": {"against": None, "filters": {}, "network": found}}})[-1]
    assert line.endswith(
        "; 3 honest nodes were, 1 at the end; 2 stood back as suspects of a start, 1 at the end"
    )


def test_runs_in_which_nodes_contradicted_each_other_and_none_was_named_are_told():
    quiet = record([np.nan], [[]])
    found = network_figures([quiet, replace(quiet, disturbed_s=np.array([3.0, 4.0]))])
    assert found["disturbed_runs"] == 1
    line = told_faults({"faults": {"x": {"against": None, "filters": {}, "network": found}}})[-1]
    assert line.endswith("; in 1 runs nodes contradicted each other and none could be named")
    assert network_figures([quiet])["disturbed_runs"] == 0


def test_forged_packets_are_counted_where_somebody_attacks(run, gao2009, window):
    """Of made-up attackers: 9 of the fixes that were fused, then none; nobody sent any again."""
    forgery = {"variants": {}, "fixes.faults.attacks": [{"kind": "tampered"}]}
    for scenario, hit, told in (
        (replaced(gao2009, forgery), slice(100, 109), 9),
        (replaced(gao2009, forgery), slice(0), 0),
        (gao2009, slice(0), None),
    ):
        faults = replace(record([np.nan], [[]]), forged_arrival=run.fixes.t_arrival[hit])
        done = replace(run, network=SimpleNamespace(faults=faults))
        scorer, scores = FaultScorer(scenario, window), Scorer(window, ("ekf_stamped",))
        scorer.add(done)
        scores.add(done)
        row = scorer.rows(scores.scores(), None)["filters"]["ekf_stamped"]
        assert (row["forged_fused"], row["replayed_fused"]) == (told, None)


def test_the_table_keeps_to_80_columns_and_tells_all(run, tmp_path):
    row = {
        "outliers_rejected": 0.9973,
        "good_lost": None,
        "late": 3,
        "duplicates": 4,
        "restarts": 5,
        "nees": 3.2,
        "nees_band95": (2.5, 3.5),
        "outages": [
            {
                "dead_reckoning_after_s": [3.0, 3.1],
                "nees": 9.5,
                "nees_band95": (2.5, 3.5),
                "position_nees": [3.0, None, None],
                "after_30_s": None,
            }
        ],
        "unflagged_jumps": 0,
        "over_clean": {"level": [1.0, 0.9, 1.1], "heading": [None, None, None], "velocity": [1.2, 1, 2]},
        "failed_runs": 100,
        "failures": {"imu_lost": 100},
        "imu_samples": {"not_finite": 5000},
        "forged_fused": 437,
        "replayed_fused": 0,
    }
    network = network_figures([record([10.0], [[20.0]])])
    block = {"against": "as stated", "filters": dict.fromkeys(FILTERS, row), "network": network}
    summary = {"faults": {"an outage": block}}
    lines = told_faults(summary)
    assert max(map(len, lines[:-1])) <= 80  # the last is a sentence
    assert lines[3] == "an outage"
    assert lines[4].startswith(f"  {FILTERS[0]} ")
    for told in ("99.73 %", "3.1", "3.20", "1.00", "1.20"):
        assert told in lines[4]
    assert lines[5:9] == [
        "    NEES at the end of the outage 9.50 of 3 (band 2.50 to 3.50)",
        "    started again 5 times over all runs",
        "    forged packets fused: 437, replayed packets fused: 0",
        "    failed runs: 100 imu_lost",
    ]
    assert "after 10.0 s, 10.0 s at most; 0 honest" in lines[-1]
    (only,) = fault_rows(summary)
    assert (only["name"], only["against"]) == ("an outage", "as stated")
    shown = only["filters"][0]
    assert [nees["outside"] for nees in shown["nees"]] == [False, True]
    whole = fault_rows({"faults": {"x": block | {"filters": {"l2linf": row | {"outages": []}}}}})
    assert len(whole[0]["filters"][0]["nees"]) == 1
    write_page(tmp_path / "page.html", "faults.html.j2", {}, faults=[only])
    assert "forged packets fused: 437, replayed packets fused: 0<" in (tmp_path / "page.html").read_text()
    none = row | {"forged_fused": None, "replayed_fused": None}
    (quiet,) = fault_rows({"faults": {"x": block | {"filters": {"l2linf": none}}}})
    assert quiet["filters"][0]["attacked"] == ""
    assert (shown["why"], shown["imu"]) == ("100 imu_lost", "5000 not finite")
    assert fault_rows({}) == []


def test_variants_are_told_by_their_names_and_against_their_twins(stated, flight, window):
    """Copies that a filter drops change nothing: errors over those of the twin, and of no other, are 1."""
    slow = {"fixes.rate_hz": 5.0}
    variants = {"slow copies": {**slow, "faults.packets.copies": 2}, "slow": slow}
    scenario = replaced(stated, {"runs": 2, "alignment.filters": FILTERS, "variants": variants})
    scorer = Scorer(window, tuple(FILTERS))
    scorer.add(*simulate_all(scenario, flight, 2, scenario.seed))
    told = run_variants(scenario, flight, scorer.scores())
    assert list(told["variants"]) == list(variants)
    assert list(told["faults"]) == ["slow copies"]
    assert told["faults"]["slow copies"]["against"] == "slow"
    for row in told["faults"]["slow copies"]["filters"].values():
        assert row["duplicates"] > 0
        assert [ratio[0] for ratio in row["over_clean"].values()] == pytest.approx([1.0] * 3)


def test_the_bundled_scenario_has_a_twin_for_each_fault():
    scenario = load_scenario("faults")[1]
    names = {"as stated": scenario, **{name: scenario.variant(name) for name in scenario.variants}}
    for name, variant in names.items():
        if has_faults(variant):
            twin = clean_twin(variant, names)
            assert without_faults(variant) == without_faults(names[twin]), name


def test_faults_of_the_scenario_itself_are_told(command, flight, tmp_path, undrawn):
    file = tmp_path / "own.toml"
    file.write_text(
        'title = "Own"\nruns = 2\nflight.s_start_s = 500\nalignment.duration_s = 5.0\n'
        'alignment.filters = ["ekf_stamped"]\nfaults.packets.outlier_share = 0.2\n'
    )
    status, out, _ = command("run", file, "--out", tmp_path / "own", "--json")
    assert status == 0
    told = json.loads(out)["faults"]["as stated"]
    assert told["against"] is None
    assert told["filters"]["ekf_stamped"]["outliers"] > 5
    assert told["filters"]["ekf_stamped"]["over_clean"] is None

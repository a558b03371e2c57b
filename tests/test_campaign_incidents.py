"""What befell a run: in a campaign's rows, its summary and its report."""

from types import SimpleNamespace

import numpy as np
import pytest
from fleetalign.align.estimate import FixOutcome, NavStatus
from fleetalign.cosim.campaign import incidents, report
from fleetalign.cosim.campaign.ledger import Ledger
from fleetalign.cosim.campaign.plan import load_campaign
from fleetalign.cosim.campaign.shard import done_shard
from fleetalign.network.record import FaultRecord


def a_run(outcomes, arrival=None, outlier=None, status=(), jump=(0.0,), fix_jump=(0.5,), faults=...):
    """As much of a run and its estimate as is read."""
    fixes = SimpleNamespace(t_arrival=np.arange(len(outcomes)) if arrival is None else np.array(arrival))
    network = None if faults is ... else SimpleNamespace(faults=faults)
    run = SimpleNamespace(fixes=fixes, outlier=outlier, network=network)
    found = SimpleNamespace(
        fix_outcome=np.array(outcomes, np.int64),
        status=np.array(status, np.int64),
        jump=np.array(jump),
        fix_jump=np.array(fix_jump),
        held_imu_samples=7,
    )
    return incidents.incidents(run, found, 20.0)


def test_fixes_are_counted_by_what_became_of_them():
    outcomes = [FixOutcome.INITIALIZED, *[FixOutcome.FUSED] * 4, *[FixOutcome.GATED] * 3]
    found = a_run([*outcomes, FixOutcome.LATE, FixOutcome.LATE, FixOutcome.UNAUTHENTIC, FixOutcome.PENDING])
    assert (found["gated"], found["late"], found["unauthentic"]) == (3, 2, 1)
    assert found["outliers_used"] is None  # none were made
    # Outcomes are in the order of arrival, who is false in that of the fixes: the last two came first.
    used = a_run(outcomes, [2, 3, 4, 5, 6, 7, 0, 1], np.array([True, False, *[False] * 4, True, True]))
    assert used["outliers_used"] == 3
    assert a_run(outcomes, outlier=np.array([*[False] * 4, *[True] * 4]))["outliers_used"] == 1


def test_time_alone_and_the_largest_jump():
    status = [
        NavStatus.NOT_STARTED,
        *[NavStatus.AIDED] * 5,
        *[NavStatus.DEAD_RECKONING] * 9,
        NavStatus.STOPPED,
    ]
    found = a_run([], status=status, jump=[np.nan, 0.0, 4.5, 2.0], fix_jump=[np.nan, 4.5])
    assert found["dead_reckoning_s"] == 0.45
    assert found["largest_jump_sd"] == 4.5
    assert found["held_imu_samples"] == 7
    # A method without a covariance has no jumps.
    assert a_run([], jump=[0.0, 0.0], fix_jump=[np.nan])["largest_jump_sd"] is None


def test_nodes_that_were_left_out_and_those_of_them_that_had_not_lied():
    nothing, nobody = np.empty(0), np.zeros(6, bool)
    faults = FaultRecord(
        lying_s=np.array([np.nan, 10.0, 10.0, np.nan, np.nan, 20.0]),
        silenced=nobody,
        quarantined_s=np.array([np.nan, 12.0, np.nan, np.nan, np.nan, 19.0]),
        quarantined_for=np.array([0, 1, 0, 0, 0, 2]),
        # A liar and one of those without cause were asked back.
        found_out=np.array([[1, 12.0], [2, 15.0], [3, 30.0], [5, 19.0]]),
        suspected=nobody,
        forged_arrival=nothing,
        replayed_arrival=nothing,
    )
    found = a_run([], faults=faults)
    assert (found["quarantined"], found["honest_quarantined"]) == (4, 2)
    for nobody in (None, ...):
        found = a_run([], faults=nobody)
        assert (found["quarantined"], found["honest_quarantined"]) == (None, None)


SCENARIO = """
title = "Outliers in an outage"
outages = [{ start_s = 1.0, duration_s = 4.0 }]
[flight]
s_start_s = 500
[alignment]
duration_s = 5.0
filters = ["ekf_stamped"]
[faults.packets]
outlier_share = 0.5
[faults]
imu = [{ kind = "nan", start_s = 0.5, duration_s = 0.1 }]
"""


@pytest.mark.parametrize("faults", [True, False])
def test_a_report_tells_of_faults_where_there_are_some(command, tmp_path, undrawn, flight, faults):
    base = SCENARIO if faults else SCENARIO.split("outages")[0] + "[flight]" + SCENARIO.split("[flight]")[1]
    (tmp_path / "base.toml").write_text(base.split("[faults.packets]")[0] if not faults else base)
    file, folder = tmp_path / "campaign.toml", tmp_path / "a folder"
    file.write_text('title = "Told"\nscenario = "base.toml"\nruns = 2\nseed = 3\n')
    campaign = load_campaign(file)
    with Ledger(folder, campaign, resume=False) as ledger:
        for shard in campaign.shards:
            ledger.add(shard, done_shard(campaign.scenario(shard.point), shard))
    status, out, _ = command("report", folder)
    page = (folder / "report.html").read_text()
    assert status == 0
    assert ("What befell the runs" in page) == faults
    # From 3 s after the last fix that was taken, in the second before 1 s, until 5 s.
    (only,) = report.summarize(folder).scores
    alone_s = only.befell["dead_reckoning_s"]
    assert 0.94 < alone_s < 2.0 if faults else alone_s == 0.0
    assert only.befell["held_imu_samples"] == (10 if faults else 0)
    assert only.befell["gated"] > 0 or not faults
    if faults:
        assert f"<td>{alone_s:.2f}</td>" in page
        assert "IMU samples held, a run" in page
        assert "nodes left out" not in page
    # What is to be typed stands there as a shell takes it, and what runs are ordered by.
    replay = f"fleetalign run '{folder}/points/000000.toml' --run-id"
    assert replay in page.replace("&#39;", "'")
    assert "greatest NEES" in page
    assert replay in out
    assert ("worst      ekf_stamped, locked_out: " if faults else "worst      ekf_stamped, NEES ") in out

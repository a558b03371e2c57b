"""A hundred runs of a fleet that is lied to, attacked and disturbed: what both filters make of its fixes.

The bundled scenario on a smaller fleet and a shorter window; each fault against the same runs without it.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band
from fleetalign.align.estimate import FixOutcome
from fleetalign.cosim.fault_score import FaultScorer
from fleetalign.cosim.resampling import paired_ratios
from fleetalign.cosim.run import simulate_all
from fleetalign.cosim.scenario import load_scenario, replaced
from fleetalign.cosim.score import Scorer

RUNS = 100
FILTERS = ("ekf_stamped", "l2linf")
USED = (FixOutcome.FUSED, FixOutcome.INITIALIZED)
SMALL = {
    "variants": {},
    "fixes.fleet.nodes": 16,
    "fixes.fleet.anchor_share": 0.44,
    "fixes.rate_hz": 5.0,
    "fixes.localization.quarantine": {},
    "fixes.authentication": {"key_hex": "5a" * 32},
    "alignment.duration_s": 20.0,
    "alignment.filters": FILTERS,
}
FAULTS = {
    "clean": {},
    "ramp": {"fixes.faults.lies": [{"kind": "ramp", "anchors": 1, "start_s": 2.0}]},
    "attacked": {
        "fixes.faults.attacks": [
            {"kind": "forged"},
            {"kind": "tampered", "share": 0.1},
            {"kind": "replayed", "after_s": 1.5, "share": 0.1, "original_lost": True},
        ],
        "fixes.faults.wrong_keys": {"anchors": 1},
    },
    "jammed": {"fixes.faults.jamming": [{"radius_m": 15e3, "share": 0.7, "start_s": 5.0, "duration_s": 6.0}]},
    "blocked": {"fixes.faults.blocked_side": [{"start_s": 5.0, "duration_s": 6.0}]},
    "clocks": {"fixes.faults.clock_jumps": [{"anchors": 1, "others": 3, "nodes": [0], "at_s": 5.0}]},
}


@dataclass
class Played:
    """All runs of a scenario."""

    errors: dict
    """(runs, 5) at the end, by filter."""
    nees: dict
    """(runs,) of the misalignment at the end, by filter."""
    failures: int
    rows: dict
    """As in `summary.json`."""
    fix_nees: np.ndarray
    """(runs,) of six, the mean over a run's own fixes; NaN without."""
    faulty_nees: np.ndarray
    """The same, of those from 5 s to 11 s."""
    made: np.ndarray
    """(runs,) share of epochs with a fix."""
    faults: list
    """`FaultRecord` of each run."""
    refused: int
    """Packets that were not taken for genuine, over all runs."""
    refused_used: int
    """Those of them that a filter used."""
    keyless: int
    """Runs whose maker of fixes has not the key: none is genuine."""


def play(flight, faults, runs):
    scenario = replaced(load_scenario("network_faults")[1], {**SMALL, **faults})
    scorer, fault_scorer, of_fixes, of_faulty, made, records = None, None, [], [], [], []
    refused = refused_used = keyless = 0
    for run in simulate_all(scenario, flight, runs, scenario.seed):
        if scorer is None:
            start_s = run.imu.time[0]
            scorer = Scorer(flight, FILTERS)
            fault_scorer = FaultScorer(scenario, flight)
        scorer.add(run)
        fault_scorer.add(run)
        net = run.network
        error = np.hstack([net.error_n[:, 0], net.velocity_error_n[:, 0]])
        good = np.isfinite(error).all(axis=1) & np.isfinite(net.cov).all(axis=(1, 2))
        squares = np.full(len(error), np.nan)
        squares[good] = np.einsum(
            "ka,ka->k", error[good], np.linalg.solve(net.cov[good], error[good][..., None])[..., 0]
        )
        at_s = net.time - start_s
        of_fixes.append(np.nanmean(squares))
        during = squares[(at_s >= 5.0) & (at_s < 11.0) & good]
        of_faulty.append(during.mean() if len(during) else np.nan)
        made.append(good.mean())
        records.append(net.faults)
        false = ~run.fixes.authentic[np.argsort(run.fixes.t_arrival, kind="stable")]
        refused, keyless = refused + false.sum(), keyless + false.all()
        for estimate in run.estimates.values():
            refused_used += (np.isin(estimate.fix_outcome, USED) & false).sum()
            known = ~np.isnan(estimate.v_n[:, 0])
            assert known[np.argmax(known) :].all() or false.all()
            for values in (estimate.lla, estimate.v_n, estimate.q_nb, estimate.sd):
                assert np.isfinite(values[known]).all()
    scores = scorer.scores()
    return Played(
        {name: scores[name].errors[:, -1] for name in FILTERS},
        {name: scores[name].nees[:, -1] for name in FILTERS},
        sum(len(score.failures) for score in scores.values()),
        fault_scorer.rows(scores, None),
        np.array(of_fixes),
        np.array(of_faulty),
        np.array(made),
        records,
        refused,
        refused_used,
        keyless,
    )


@pytest.fixture(scope="module")
def played(flight):
    """Plays each scenario once: those that nobody asks for in this process are not."""
    kept = {}

    def of(name):
        if name not in kept:
            kept[name] = play(flight, FAULTS[name], RUNS)
        return kept[name]

    return of


def ratios(faulty, clean, name):
    """Of RMS errors at the end to those of the same runs without the fault, each with its 95 % interval."""
    return paired_ratios(faulty.errors[name], clean.errors[name])


def test_nobody_honest_is_left_out_and_errors_are_known(played):
    clean = played("clean")
    assert clean.failures == 0
    assert clean.rows["network"]["false_quarantines"] == 0
    # Errors of anchors last over a run: its mean counts for one fix of 6 +- 3.5 at worst, 100 6 +- 0.35.
    assert clean.fix_nees.mean() == pytest.approx(6.0, abs=3 * 0.35)
    for name in FILTERS:
        low, high = mean_band(3, RUNS)
        assert low < clean.nees[name].mean() < high


def test_an_anchor_that_drifts_is_out_within_30_s_in_all_runs(played):
    ramp, clean = played("ramp"), played("clean")
    after = np.concatenate([(told.found_s - told.lying_s) for told in ramp.faults])
    after = after[np.isfinite(np.concatenate([told.lying_s for told in ramp.faults]))]
    assert len(after) == RUNS
    # It has lied for 18 s at the end. Measured: 7.0 s, 10.8 s at most.
    assert (after < 18.0).all()
    assert ramp.rows["network"]["false_quarantines"] == 0
    assert ramp.failures == 0
    for name in FILTERS:
        # The upper ends of the intervals, too.
        for group, ratio in ratios(ramp, clean, name).items():
            assert ratio[2] <= 1.5, (name, group)
        # Until it is found the fixes are off by a little that no covariance knows: three standard deviations
        # of a mean of three over so many runs.
        assert ramp.nees[name].mean() < clean.nees[name].mean() + 3 * np.sqrt(6 / RUNS)


def test_no_packet_that_is_false_or_old_or_by_a_wrong_key_is_used(played):
    attacked, clean = played("attacked"), played("clean")
    # A fifth is forged, a tenth changed, a tenth sent again, of a hundred packets a run.
    assert attacked.refused > 30 * RUNS
    assert attacked.refused_used == 0
    for name in FILTERS:
        row = attacked.rows["filters"][name]
        assert row["forged_fused"] == row["replayed_fused"] == 0
        for group, ratio in ratios(attacked, clean, name).items():
            assert ratio[2] <= 1.5, (name, group)
    # One of sixteen nodes makes the fixes, and one of seven anchors has no key.
    assert 0 < attacked.keyless < 20
    assert attacked.failures == attacked.keyless * len(FILTERS)


def test_jamming_costs_fixes_and_heading_and_no_honesty(played):
    jammed, clean = played("jammed"), played("clean")
    assert jammed.failures == 0
    assert 0.5 < jammed.made.mean() < 0.995
    assert jammed.rows["network"]["false_quarantines"] == 0
    # Where few ranges are left a fix may be uncertain by hundreds of metres, and no normal distribution has
    # its errors then: four runs of a hundred are beyond 20 (one 239), the others as they should be.
    meanwhile = jammed.faulty_nees[np.isfinite(jammed.faulty_nees)]
    assert np.median(meanwhile) == pytest.approx(6.0, abs=1.0)
    assert (meanwhile > 20.0).sum() < 12
    # The band ends at 3.5. Measured are the numbers below: what estimates the delay does worse, as fixes are
    # missing. Three standard deviations of a mean of three over so many runs.
    for name, measured in (("ekf_stamped", 3.52), ("l2linf", 4.45)):
        assert jammed.nees[name].mean() < measured + 3 * np.sqrt(6 / RUNS)
    for name in FILTERS:
        for group, ratio in ratios(jammed, clean, name).items():
            assert ratio[2] < 2.0, (name, group)


def test_no_sight_of_one_side_is_what_no_covariance_knows(played):
    blocked, clean = played("blocked"), played("clean")
    assert blocked.failures == 0
    assert blocked.rows["network"]["false_quarantines"] == 0
    # Out of the band of 6, and bounded: no residual tells detours of one side from another position.
    assert 7.5 < np.nanmean(blocked.faulty_nees) < 20.0
    for name in FILTERS:
        # 4.1 and 4.3 measured, beyond the band's end of 3.5.
        assert blocked.nees[name].mean() < 4.3 + 3 * np.sqrt(6 / RUNS)
        for group, ratio in ratios(blocked, clean, name).items():
            assert ratio[2] < 2.0, (name, group)


def test_clocks_that_jump_by_a_microsecond_do_no_harm_two_way(played):
    clocks, clean = played("clocks"), played("clean")
    assert clocks.failures == 0
    # No range knows of it.
    np.testing.assert_array_equal(clocks.fix_nees, clean.fix_nees)
    for name in FILTERS:
        low, high = mean_band(3, RUNS)
        assert low < clocks.nees[name].mean() < high
        for group, ratio in ratios(clocks, clean, name).items():
            assert ratio[2] < 1.2, (name, group)
    # The stamps do: a filter that goes by them does not get the same digits.
    some = clocks.errors["ekf_stamped"], clean.errors["ekf_stamped"]
    assert not np.array_equal(*some)

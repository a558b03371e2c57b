"""Scores of hand-made errors, whose values can be told beforehand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fleetalign.align.estimate import FixOutcome, NavStatus, RunOutcome
from fleetalign.cosim.resampling import LEAST_RUNS, bootstrap_rms_interval, paired_ratios, rms_over
from fleetalign.cosim.score import (
    FilterScore,
    Scorer,
)
from fleetalign.sins import attitude

NAN = np.nan
COVERAGE_RUNS = 2000


def a_score(errors, **more) -> FilterScore:
    """Errors (runs, m), alike in all five columns, at 1, 2, ... m s."""
    errors = np.array(errors, float)
    runs, m = errors.shape
    return FilterScore(
        name="ekf",
        time=np.arange(1.0, m + 1),
        errors=np.repeat(errors[:, :, None], 5, axis=2),
        position_errors=np.zeros((runs, m, 3)),
        position_nees=np.zeros((runs, m)),
        **{"nees": np.zeros((runs, m)), "nis": np.zeros(runs), "fused": np.ones(runs, np.int64), **more},
        delay=np.zeros((runs, m)),
        status=np.full((runs, m), NavStatus.AIDED),
        fix_outcomes=dict.fromkeys(FixOutcome, 0),
        failures={},
    )


def test_rms_leaves_out_runs_without_an_error():
    score = a_score([[NAN, 3.0, NAN], [NAN, 4.0, -2.0]])
    np.testing.assert_array_equal(score.rms[:, 0], [NAN, np.sqrt(12.5), 2.0])


def test_window_is_what_comes_after_half_the_time():
    """Four times: the last half is 3 and 4 s; 2 s is half itself, and outside."""
    score = a_score([[100.0, 100.0, 1.0, 2.0], [100.0, 100.0, 3.0, NAN]])
    np.testing.assert_allclose(score.window_rms, np.full(5, np.sqrt((1 + 4 + 9) / 3)))


@pytest.mark.parametrize(
    ("others", "reason"),
    [
        ([], "locked_out"),
        ([FixOutcome.DUPLICATE] * 20, "locked_out"),
        ([FixOutcome.UNAUTHENTIC] * 20, "locked_out"),
        ([FixOutcome.NOT_FINITE, FixOutcome.INVALID] * 9, "locked_out"),
        ([FixOutcome.LATE] * 2, None),
        ([FixOutcome.FUSED, FixOutcome.DUPLICATE], "locked_out"),
        ([FixOutcome.FUSED] * 2, None),  # half is not more than half
    ],
)
def test_locked_out_is_by_the_fixes_that_the_gate_could_have_let_in(others, reason):
    """Six of ten refused, and others beside them, in a run that ends on the truth."""
    outcome = np.array([FixOutcome.GATED] * 6 + [FixOutcome.FUSED] * 4 + others)
    still, level = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    time = np.array([0.0, 1.0, 2.0])
    truth = SimpleNamespace(time=time, dt=1.0, lla=still, v_n=still, q_nb=level)
    estimate = SimpleNamespace(
        time=time,
        lla=still,
        v_n=still,
        q_nb=level,
        sd=np.ones((3, 15)),
        misalignment_cov=np.tile(np.eye(3), (3, 1, 1)),
        delay=time,
        status=np.full(3, NavStatus.AIDED),
        outcome=RunOutcome.ALIGNED,
        fix_outcome=outcome,
        fused=outcome == FixOutcome.FUSED,
        nis=np.ones(len(outcome)),
    )
    run = SimpleNamespace(
        run_id=3,
        fixes=outcome,
        q_nb_coarse=attitude.from_euler(*np.radians([1.0, 1.0, 10.0])),
        estimates={"ekf": estimate},
    )
    scorer = Scorer(truth, ("ekf",))
    scorer.add(run)
    assert scorer.scores()["ekf"].failures == ({3: reason} if reason else {})


@pytest.mark.parametrize(
    ("errors", "time"),
    [
        ([0.5, 0.5, 0.5, 0.5], 1.0),
        ([9.0, 0.5, 0.5, 0.5], 2.0),
        ([0.5, 9.0, 0.5, 0.5], 3.0),
        ([0.5, 0.5, 1.0, 0.5], 4.0),  # the limit itself is not below it
        ([NAN, 0.5, 0.5, 0.5], 2.0),
        ([0.5, 0.5, 0.5, 9.0], None),
        ([0.5, 0.5, 0.5, NAN], None),
    ],
)
def test_time_below_is_that_of_the_first_output_after_the_last_excess(errors, time):
    assert a_score([errors]).time_below(slice(0, 2), 1.0) == time


def test_time_below_takes_the_worst_of_its_columns_and_no_other():
    score = a_score([[0.5, 0.5, 0.5]])
    errors = score.errors.copy()
    errors[0, 1, 1] = 9.0
    score = replace(score, errors=errors)
    assert score.time_below(slice(0, 2), 1.0) == 3.0
    assert score.time_below(slice(2, 3), 1.0) == 1.0


def test_mean_nees_is_over_the_runs_that_have_one():
    score = a_score(np.zeros((3, 3)), nees=np.array([[1.0, NAN, NAN], [2.0, 4.0, NAN], [6.0, 8.0, NAN]]))
    np.testing.assert_array_equal(score.mean_nees, [3.0, 6.0, NAN])


def test_mean_nis_counts_fixes_and_not_runs():
    zeros = np.zeros((3, 1))
    assert a_score(zeros, nis=np.array([4.0, 8.0, NAN]), fused=np.array([3, 1, 0])).mean_nis == 5.0
    assert np.isnan(a_score(zeros, nis=np.full(3, NAN), fused=np.zeros(3, np.int64)).mean_nis)


@pytest.mark.parametrize("bias", [0.0, 3.0])
@pytest.mark.parametrize(("runs", "coverage"), [(50, 0.91), (200, 0.945)])
def test_interval_of_an_rms_covers_it(bias, runs, coverage):
    """The chi-square interval of zero-mean errors would cover the biased RMS always."""
    errors = bias + np.random.default_rng(8).normal(size=(runs, COVERAGE_RUNS))
    low, high = bootstrap_rms_interval(errors)
    rms = np.hypot(bias, 1.0)
    covered = np.mean((low < rms) & (rms < high))
    three_sd = 3 * np.sqrt(0.95 * 0.05 / COVERAGE_RUNS)
    assert coverage - three_sd < covered < 0.95 + three_sd


def test_interval_of_two_values_is_that_of_a_binomial():
    """Of 100 runs half err by 0, half by 1: the mean square of a resample is binomial(100, 1/2) / 100."""
    errors = np.repeat([[0.0], [1.0]], 50, axis=0)
    low, high = bootstrap_rms_interval(errors)[:, 0] ** 2
    assert (low, high) == (pytest.approx(0.40, abs=0.011), pytest.approx(0.60, abs=0.011))
    np.testing.assert_array_equal(bootstrap_rms_interval(np.full((40, 1), -2.0)), [[2.0], [2.0]])


def test_interval_is_repeatable_and_leaves_out_lost_runs():
    errors = np.random.default_rng(1).normal(size=(1500, 2))
    lost = np.vstack([errors, [[NAN, NAN]]])
    np.testing.assert_array_equal(bootstrap_rms_interval(lost), bootstrap_rms_interval(errors))
    assert np.isnan(bootstrap_rms_interval(errors[: LEAST_RUNS - 1])).all()
    assert np.isfinite(bootstrap_rms_interval(errors[:LEAST_RUNS])).all()


def test_ratio_to_a_bound_covers_one_for_an_estimator_on_it():
    rng = np.random.default_rng(5)
    floor = np.array([20.0, 30.0, 1.3, 0.01, 0.02])
    covered = []
    for _ in range(200):
        ratios = rms_over(floor * rng.normal(size=(100, 5)), floor)
        covered.append([ratio[1] < 1 < ratio[2] for ratio in ratios.values()])
    # 95 %, less a little at 100 runs, +- 3 standard deviations of a share of 200.
    assert (np.abs(np.mean(covered, axis=0) - 0.94) < 3 * np.sqrt(0.94 * 0.06 / 200)).all()
    worse = rms_over(2 * floor * rng.normal(size=(1000, 5)), floor)
    assert [ratio[0] for ratio in worse.values()] == pytest.approx([2.0] * 3, rel=0.08)


def test_paired_ratio_is_sharper_than_its_parts():
    """What both filters have in common cancels: the interval is that of the difference."""
    rng = np.random.default_rng(6)
    common = rng.normal(size=(100, 5))
    errors, reference = 1.1 * common + 0.05 * rng.normal(size=(100, 5)), common
    for ratio, low, high in paired_ratios(errors, reference).values():
        assert low < 1.1 < high
        assert high - low < 0.04 < 0.2 < np.ptp(bootstrap_rms_interval(common[:, :1]))
        assert low < ratio < high
    lost = np.vstack([errors, np.full((1, 5), NAN)]), np.vstack([reference, 1e9 * np.ones((1, 5))])
    assert paired_ratios(*lost)["level"][0] == paired_ratios(errors, reference)["level"][0]
    few = paired_ratios(errors[:5], reference[:5])["heading"]
    assert np.isfinite(few[0])
    assert np.isnan(few[1:]).all()


def test_share_of_time_outside_the_band_sees_a_covariance_that_is_wrong():
    rng = np.random.default_rng(7)
    nees = rng.chisquare(3, (100, 400))
    consistent = a_score(np.zeros((100, 400)), nees=nees)
    # 5 % of 400 independent times, +- 3 standard deviations.
    assert abs(consistent.nees_outside - 0.05) < 3 * np.sqrt(0.05 * 0.95 / 400)
    assert a_score(np.zeros((100, 400)), nees=2 * nees).nees_outside > 0.99
    assert np.isnan(a_score(np.zeros((3, 4)), nees=np.full((3, 4), NAN)).nees_outside)

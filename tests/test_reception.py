"""What a filter does with records and fixes that are late, broken or missing for a while."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import chi_square_quantile, nees
from fleetalign.align.estimate import FixOutcome, NavStatus, RunOutcome
from fleetalign.align.filters import FILTERS, align
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.reception import counted_from, received
from fleetalign.align.settings import DelayModel
from fleetalign.cosim.run import simulate
from fleetalign.cosim.scenario import replaced
from fleetalign.sins import attitude, earth


@pytest.fixture(scope="module")
def alone(stated):
    """The scenario with one filter, so that simulating a run is cheap."""
    return replaced(stated, {"alignment.filters": ["ekf_stamped"]})


def again(scenario, window, run, delay=DelayModel.STAMPED, imu=None, fixes=None, q_nb=None, **settings):
    """Align anew on a run's data, some of it replaced."""
    imu, fixes = imu or run.imu, run.fixes if fixes is None else fixes
    told = scenario.alignment.settings.model_copy(update=settings)
    q_nb = run.q_nb_coarse if q_nb is None else q_nb
    measured = imu.time, imu.dtheta_b, imu.dv_b, q_nb, fixes
    return align(AlignmentInput.checked(*measured, told, scenario.imu, window.gravity), delay)


def final_nees(estimate, window):
    phi = attitude.misalignment(estimate.q_nb[-1], window.q_nb[-1])
    return float(nees(phi, estimate.misalignment_cov[-1]))


@pytest.mark.parametrize("delay", list(DelayModel))
@pytest.mark.parametrize("offset_m", [120.0, 500.0, 5000.0])
def test_a_bad_first_fix_is_recovered_from(alone, window, delay, offset_m):
    run = simulate(alone, window, 1, seed=7)
    lla = run.fixes.lla.copy()
    lla[0] = earth.displaced(lla[0], [offset_m, 0.0, 0.0])
    estimate = again(alone, window, run, delay, fixes=replace(run.fixes, lla=lla))
    clean = again(alone, window, run, delay)
    assert estimate.count(FixOutcome.INITIALIZED) == 2
    assert estimate.count(FixOutcome.GATED) == alone.alignment.settings.restart_after_gated
    # Told before, or in the row of the restart.
    restart = estimate.fix_time[estimate.fix_outcome == FixOutcome.INITIALIZED][1]
    (told,) = np.nonzero(estimate.status == NavStatus.DEAD_RECKONING)
    assert 1 <= len(told) <= 2
    assert np.abs(estimate.time[told] - restart).max() < 0.2
    error, clean_error = (
        np.linalg.norm(attitude.misalignment(e.q_nb[-1], window.q_nb[-1])) for e in (estimate, clean)
    )
    assert error < clean_error + 2 * np.sqrt(np.trace(clean.misalignment_cov[-1]))


@pytest.mark.parametrize("samples", [5, 20, 100])
def test_a_gap_in_the_imu_leaves_an_honest_covariance(alone, window, samples):
    errors = []
    for run_id, first in enumerate((1000, 1500, 2000, 2500, 3000, 3500)):
        run = simulate(alone, window, run_id, seed=7)
        dtheta_b, dv_b = run.imu.dtheta_b.copy(), run.imu.dv_b.copy()
        dtheta_b[first : first + samples], dv_b[first : first + samples] = np.nan, np.nan
        estimate = again(alone, window, run, imu=replace(run.imu, dtheta_b=dtheta_b, dv_b=dv_b))
        assert estimate.held_imu_samples == samples
        assert estimate.outcome is RunOutcome.ALIGNED
        errors.append(final_nees(estimate, window))
    assert np.mean(errors) < chi_square_quantile(0.9999, 18) / 6


def test_attitude_is_carried_to_a_late_first_fix(alone, window):
    run = simulate(alone, window, 2, seed=7)
    late = run.fixes[run.fixes.t_valid > window.time[0] + 13.0]
    for delay in DelayModel:
        estimate = again(alone, window, run, delay, fixes=late)
        first = int(np.flatnonzero(np.isfinite(estimate.q_nb[:, 0]))[0])
        row = np.searchsorted(window.time, estimate.time[first] - 1e-6)
        # Meanwhile the aircraft has banked and turned; the coarse error has turned with it, and no more.
        error = np.abs(attitude.misalignment(estimate.q_nb[first], window.q_nb[row]))
        assert np.degrees(np.linalg.norm(error)) < 12
        assert final_nees(estimate, window) < chi_square_quantile(0.9999, 3)


def test_stamps_with_a_known_error_are_fused_consistently(stated, window):
    jittery = replaced(stated, {"alignment.filters": ["ekf_stamped"], "fixes.stamp_sd_ms": 30.0})
    told, ignorant = [], []
    for run_id in range(8):
        run = simulate(jittery, window, run_id, seed=7)
        for nis, stamp_sd_ms in ((told, 30.0), (ignorant, 0.0)):
            estimate = again(jittery, window, run, stamp_sd_ms=stamp_sd_ms)
            nis.append(np.mean(estimate.nis[estimate.fused]))
    assert np.mean(told) == pytest.approx(6, abs=0.3)
    assert np.mean(ignorant) > 6.4


def test_fixes_from_before_the_record_are_late(alone, window):
    run = simulate(alone, window, 0, seed=7)
    early = replace(
        run.fixes,
        t_stamp=run.fixes.t_stamp - 60,
        t_arrival=run.fixes.t_arrival - 60,
    )
    for delay in DelayModel:
        assert again(alone, window, run, delay, fixes=early).outcome is RunOutcome.NO_FIX


def test_horizon_and_clock_margins_are_where_they_are_said_to_be(alone, window):
    fixes = simulate(alone, window, 0, seed=7).fixes
    t_stamp = window.time[0] + 10.0
    single = replace(
        fixes[:3],
        t_stamp=np.full(3, t_stamp),
        t_arrival=t_stamp + np.array([-0.02, -0.005, 1.0]),
    )
    found = received(window.time, single)
    outcome, _ = counted_from(window.time, found, by_stamp=True, stamp_sd=0.0)
    assert list(outcome) == [FixOutcome.FUTURE, FixOutcome.PENDING, FixOutcome.PENDING]
    outcome, _ = counted_from(window.time, found, by_stamp=True, stamp_sd=0.004)
    assert outcome[0] == FixOutcome.PENDING
    outcome, _ = counted_from(window.time, found, by_stamp=False, stamp_sd=0.0)
    assert (outcome == FixOutcome.PENDING).all()


@pytest.mark.parametrize(("late_s", "expected"), [(1.995, FixOutcome.FUSED), (2.015, FixOutcome.LATE)])
def test_the_edge_of_the_horizon(alone, window, late_s, expected):
    run = simulate(alone, window, 0, seed=7)
    t_arrival = run.fixes.t_stamp.copy()
    t_arrival[100] += late_s
    fixes = replace(run.fixes, t_arrival=t_arrival)
    sorted_row = int(np.flatnonzero(fixes.sorted_by_arrival().sequence == fixes.sequence[100])[0])
    assert again(alone, window, run, fixes=fixes).fix_outcome[sorted_row] == expected


def test_the_date_line_changes_nothing(alone, window):
    run = simulate(alone, window, 0, seed=7)
    here = again(alone, window, run)
    shift = np.array([0.0, np.pi - run.fixes.lla[200, 1], 0.0])
    lla = run.fixes.lla + shift
    lla[:, 1] = attitude.wrapped(lla[:, 1])
    assert lla[:, 1].min() < 0 < lla[:, 1].max()
    there = again(alone, window, run, fixes=replace(run.fixes, lla=lla))
    assert there.count(FixOutcome.GATED) == 0
    np.testing.assert_allclose(there.q_nb[-1], here.q_nb[-1], atol=1e-9)


def test_the_first_fix_decides_however_bad_it_is(stated, window):
    noisy = replaced(stated, {"fixes.position_sd_m": 1e5, "fixes.velocity_sd_mps": 1e3})
    run = simulate(noisy, window, 3, seed=7)
    for estimate in run.estimates.values():
        row = np.searchsorted(window.time, estimate.time[20] - 1e-6)
        deviation = earth.displacement_n(estimate.lla[20], window.lla[row]) / estimate.sd[20, :3]
        assert np.abs(deviation).max() < 5


@pytest.mark.parametrize("latitude", [1.6, -2.5])
def test_a_latitude_beyond_a_pole_is_invalid(alone, window, latitude):
    run = simulate(alone, window, 0, seed=7)
    lla = run.fixes.lla.copy()
    lla[0, 0] = latitude
    assert again(alone, window, run, fixes=replace(run.fixes, lla=lla)).fix_outcome[0] == FixOutcome.INVALID


@pytest.mark.parametrize("q_nb", [[0, 0, 0, 0], [1, 0, 0], [np.nan, 0, 0, 0], [2, 0, 0, 0]])
def test_coarse_attitude_must_be_a_unit_quaternion(alone, window, q_nb):
    run = simulate(alone, window, 0, seed=7)
    with pytest.raises(ValueError, match="unit quaternion"):
        again(alone, window, run, q_nb=q_nb)


def test_arrays_of_different_lengths_are_refused(alone, window):
    run = simulate(alone, window, 0, seed=7)
    with pytest.raises(ValueError, match=r"must be \(n,\)"):
        again(alone, window, run, imu=replace(run.imu, dv_b=run.imu.dv_b[:-5]))


def test_every_named_filter_has_a_delay_model():
    assert set(FILTERS.values()) == set(DelayModel)

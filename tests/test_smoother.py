"""The fixed-interval smoother: against a batch solution, consistent over the whole interval, and its ends."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align import _smoothing_kernel
from fleetalign.align.consistency import mean_band, nees
from fleetalign.align.estimate import FixOutcome, RunOutcome
from fleetalign.align.filters import align
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.settings import DelayModel, FilterSettings
from fleetalign.align.smoother import smooth
from fleetalign.cosim.run import coarse_attitude, fixes_of, generator
from fleetalign.cosim.scenario import replaced
from fleetalign.sins import attitude
from fleetalign.sins.imu import simulate_imu

RUNS = 40


given = AlignmentInput.checked


def record_of(scenario, flight, window, run_id):
    imu = simulate_imu(window.time, window.dtheta_b, window.dv_b, scenario.imu, generator(5, run_id, "imu"))
    rng = generator(5, run_id, "coarse attitude")
    q_nb = coarse_attitude(window.q_nb[0], scenario.alignment.coarse, rng)
    return imu.time, imu.dtheta_b, imu.dv_b, q_nb, fixes_of(scenario, flight, run_id, 5)[0]


@pytest.fixture(scope="module")
def budget(stated, window):
    return stated.alignment.settings, stated.imu, window.gravity


@pytest.fixture(scope="module")
def smoothed(stated, flight, window, budget):
    return [smooth(given(*record_of(stated, flight, window, i), *budget)) for i in range(RUNS)]


def test_backward_pass_is_the_batch_solution():
    """On a random linear system the recursion gives what all measurements at once give."""
    rng = np.random.default_rng(1)
    n, steps = 16, 6
    Phi9 = np.hstack([np.eye(9), np.zeros((9, 6))]) + 0.2 * rng.normal(size=(9, 15))
    Phi = np.eye(n)
    Phi[:9, :15] = Phi9
    Q, R = np.diag(rng.uniform(0.1, 0.5, n)), np.diag(rng.uniform(0.5, 2, 6))
    H, z = rng.normal(size=(steps, 6, n)), rng.normal(size=(steps, 6))

    # Batch: all states at once, in information form.
    information = np.zeros((steps * n, steps * n))
    vector = np.zeros(steps * n)
    information[:n, :n] = np.eye(n)
    for k in range(steps):
        here, before = slice(k * n, (k + 1) * n), slice((k - 1) * n, k * n)
        if k:
            step = np.zeros((n, steps * n))
            step[:, here], step[:, before] = np.eye(n), -Phi
            information += step.T @ np.linalg.solve(Q, step)
        information[here, here] += H[k].T @ np.linalg.solve(R, H[k])
        vector[here] += H[k].T @ np.linalg.solve(R, z[k])
    covariance = np.linalg.inv(information)
    state = covariance @ vector

    # Filter, then the two steps back.
    x, P = np.zeros(n), np.eye(n)
    kept = []
    for k in range(steps):
        if k:
            x, P = Phi @ x, Phi @ P @ Phi.T + Q
        S = H[k] @ P @ H[k].T + R
        K = P @ H[k].T @ np.linalg.inv(S)
        innovation = z[k] - H[k] @ x
        x, P = x + K @ innovation, P - K @ S @ K.T
        kept.append((x, P, K, S, innovation))
    y, Y = np.zeros(n), np.zeros((n, n))
    for k in range(steps - 1, -1, -1):
        x, P, K, S, innovation = kept[k]
        here = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(x - P @ y, state[here], atol=1e-10)
        np.testing.assert_allclose(P - P @ Y @ P, covariance[here, here], atol=1e-10)
        _smoothing_kernel.back_through_update(y, Y, H[k], np.linalg.cholesky(S), K, innovation)
        _smoothing_kernel.back_through_transition(y, Y, Phi9)


def test_it_ends_where_the_filter_does_and_is_never_worse(stated, flight, window, budget, smoothed):
    filtered = align(given(*record_of(stated, flight, window, 0), *budget), DelayModel.STAMPED)
    known = slice(0, 15)
    np.testing.assert_allclose(smoothed[0].sd[-1, known], filtered.sd[-1, known], rtol=2e-3)
    # One began with 10 deg of heading, the other with what the first pass left: some arcsec of 20.
    assert np.abs(attitude.misalignment(smoothed[0].q_nb[-1], filtered.q_nb[-1])[:2]).max() < 3e-5
    assert (smoothed[0].sd[:, known] < 1.003 * filtered.sd[:, known]).all()


def test_consistent_over_the_whole_interval(window, smoothed):
    rows = np.searchsorted(window.time, smoothed[0].time - 0.5 * window.dt)
    values = [nees(attitude.misalignment(s.q_nb, window.q_nb[rows]), s.misalignment_cov) for s in smoothed]
    low, high = mean_band(3, RUNS, 0.9999)
    mean = np.mean(values, axis=0)
    assert low < mean.min()
    assert mean.max() < high


def test_many_fixes_at_one_epoch_are_one_of_their_mean(stated, flight, window, budget):
    """Ten copies with ten times the covariance say what one fix says; the smoother makes room for them."""
    times = 10
    *record, fixes = record_of(stated, flight, window, 0)
    few = fixes[fixes.t_arrival < record[0][0] + 4]
    copies = few[np.repeat(np.arange(len(few)), times)]
    copies = replace(
        copies, cov=times * copies.cov, source=np.tile(np.arange(times, dtype=np.int64), len(few))
    )
    # Vibration is in every fix anew: without it, ten fixes are no more than one.
    settings, imu, gravity = budget
    still = imu.model_copy(update={"vibration_mps": 0.0})
    end = int(np.searchsorted(record[0], record[0][0] + 5))
    time, dtheta_b, dv_b = (column[:end] for column in record[:3])
    one, many = (
        smooth(given(time, dtheta_b, dv_b, record[3], some, settings, still, gravity))
        for some in (few, copies)
    )
    assert many.count(FixOutcome.FUSED) + many.count(FixOutcome.INITIALIZED) == times * len(few)
    apart = attitude.misalignment(many.q_nb, one.q_nb)
    # Copies are linearised one after another, by states that the earlier ones have moved.
    np.testing.assert_allclose(apart / one.sd[:, 6:9], 0, atol=0.05)
    np.testing.assert_allclose(many.sd[:, 3:9], one.sd[:, 3:9], rtol=0.02)


def test_heading_is_known_from_the_first_second(window, smoothed):
    rows = np.searchsorted(window.time, smoothed[0].time - 0.5 * window.dt)
    phi = np.array([attitude.misalignment(s.q_nb, window.q_nb[rows]) for s in smoothed])
    rms = np.sqrt(np.mean(phi**2, axis=0))
    # The whole record told each of its epochs the same: the first is as good as the last.
    np.testing.assert_allclose(rms[5], rms[-1], rtol=0.15)


def test_noise_that_is_told_wrong_leaves_the_band(stated, flight, window):
    """The smoother of a fix noise told at half its size: a covariance four times too small."""
    doubled = replaced(stated, {"fixes.position_sd_m": 20.0, "fixes.velocity_sd_mps": 0.2}, "test")
    values = []
    for run_id in range(RUNS):
        time, dtheta_b, dv_b, q_nb, fixes = record_of(doubled, flight, window, run_id)
        fixes = replace(fixes, cov=fixes.cov / 4)
        told = FilterSettings(gate_probability=1 - 1e-15)
        s = smooth(given(time, dtheta_b, dv_b, q_nb, fixes, told, doubled.imu, window.gravity))
        values.append(nees(attitude.misalignment(s.q_nb[-1], window.q_nb[-1]), s.misalignment_cov[-1]))
    assert np.mean(values) > mean_band(3, RUNS, 0.9999)[1]


def test_a_restart_divides_the_record(stated, flight, window, budget):
    """Fixes that jump by a kilometre for good: the filter starts again, and the smoother knows nothing
    across."""
    time, dtheta_b, dv_b, q_nb, fixes = record_of(stated, flight, window, 0)
    jumped = fixes.lla + np.where(fixes.t_valid[:, None] > window.time[0] + 20, [0.0, 0.0, 1000.0], 0.0)
    s = smooth(given(time, dtheta_b, dv_b, q_nb, replace(fixes, lla=jumped), *budget))
    assert s.count(FixOutcome.INITIALIZED) == 2
    after = s.time > window.time[0] + 25
    before = s.time < window.time[0] + 19
    rows = np.searchsorted(window.time, s.time - 0.5 * window.dt)
    height = s.lla[:, 2] - window.lla[rows, 2]
    assert np.abs(height[before]).max() < 20
    assert np.abs(height[after] - 1000).max() < 20
    assert np.isfinite(s.sd[:, :15]).all()
    # Half a record tells less: the heading of its last second is known as from twenty seconds, not from
    # forty.
    whole = smooth(given(time, dtheta_b, dv_b, q_nb, fixes, *budget))
    assert (s.sd[before, 8] > 1.1 * whole.sd[before, 8]).all()


def test_no_fix_no_state(stated, flight, window, budget):
    record = record_of(stated, flight, window, 0)
    s = smooth(given(*record[:4], record[4][:0], *budget))
    assert s.outcome is RunOutcome.NO_FIX
    assert np.isnan(s.lla).all()

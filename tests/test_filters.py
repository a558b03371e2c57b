"""The alignment filter: its steps against readable twins, its care for late and broken data, its bounds."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align import _kernels, _memory, measurement
from fleetalign.align.estimate import FixOutcome, RunOutcome
from fleetalign.align.filters import align, align_all
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.settings import DelayModel, FilterSettings
from fleetalign.cosim.run import coarse_attitude, generator, simulate
from fleetalign.cosim.scenario import CoarseAttitude, replaced
from fleetalign.network.fixes import concatenate
from fleetalign.network.source import FixSource, draw_fixes
from fleetalign.sins import attitude, earth
from fleetalign.sins.earth import GravityModel
from fleetalign.sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from fleetalign.sins.gaussian import kalman_update
from fleetalign.sins.imu import ImuErrors, simulate_imu
from fleetalign.sins.mechanization import NavigationState

SETTINGS, ERRORS = FilterSettings(), ImuErrors()


@pytest.fixture(scope="module")
def record(window):
    """IMU, coarse attitude and fixes without delay, of one run."""
    imu = simulate_imu(window.time, window.dtheta_b, window.dv_b, ERRORS, generator(1, 0, "imu"))
    fixes = drawn(window, delay={"kind": "none"})
    q_nb_coarse = attitude.multiply(attitude.from_rotvec([0.017, -0.017, 0.17]), window.q_nb[0])
    return imu, q_nb_coarse, fixes


def run(record, fixes=None, delay=DelayModel.STAMPED, imu=None, settings=SETTINGS, errors=ERRORS):
    record_imu, q_nb_coarse, record_fixes = record
    imu = record_imu if imu is None else imu
    fixes = record_fixes if fixes is None else fixes
    measured = imu.time, imu.dtheta_b, imu.dv_b, q_nb_coarse, fixes
    return align(AlignmentInput.checked(*measured, settings, errors, GravityModel.J2), delay)


def bits(estimate):
    return {name: np.asarray(value).tobytes() for name, value in vars(estimate).items()}


@pytest.mark.parametrize("delay", DelayModel)
def test_records_that_are_aligned_together_do_not_touch_each_other(record, delay):
    """They share a working memory, whatever a run has left there: one that was lost, one of fewer fixes, one
    that never starts, one with copies."""
    imu, q_nb_coarse, fixes = record
    beyond = replace(fixes, v_n=1e300 * fixes.v_n)
    given = [
        AlignmentInput.checked(
            imu.time, imu.dtheta_b, imu.dv_b, q_nb_coarse, some, SETTINGS, ERRORS, GravityModel.J2
        )
        for some in (beyond, fixes[3::3], fixes[:0], concatenate([fixes, fixes]), fixes)
    ]
    together = align_all(given, delay)
    outcomes = (
        RunOutcome.NOT_FINITE,
        RunOutcome.ALIGNED,
        RunOutcome.NO_FIX,
        RunOutcome.ALIGNED,
        RunOutcome.ALIGNED,
    )
    assert tuple(found.outcome for found in together) == outcomes
    for found, alone in zip(together, (align(one, delay) for one in given), strict=True):
        assert bits(found) == bits(alone)


def assert_ends_alike(a, b, atol=0.0):
    for name in ("lla", "v_n", "q_nb", "accel_bias", "gyro_bias", "sd"):
        np.testing.assert_allclose(getattr(a, name)[-1], getattr(b, name)[-1], rtol=0, atol=atol)


@pytest.mark.parametrize(("estimated", "n"), [(False, 16), (True, 16), (True, 19)])
def test_compiled_update_is_the_readable_one(estimated, n):
    rng = np.random.default_rng(3)
    state = NavigationState(
        np.array([0.52, 2.1, 1010.0]), np.array([140.0, 141.0, 2.0]), attitude.from_euler(0.5, 0.05, 0.8)
    )
    time = 0.01 * np.arange(11)
    increments = rng.normal(0, 1e-4, (11, 6)) + np.array([4e-3, 1e-3, -2e-3, 0.01, -0.02, -0.11])
    arm = np.array([3.0, -1.0, -2.0])
    biases = rng.normal(0, [1e-3] * 3 + [1e-5] * 3)
    X = np.concatenate([state.lla, state.v_n, state.q_nb, biases, [0.03], arm, [0.0]])
    scale = np.repeat([10, 0.3, 1e-3, 1e-3, 1e-6, 0.02, 0.1], [3, 3, 3, 3, 3, 1, 3])[:n]
    root = rng.normal(size=(n, n)) * scale[:, None]
    P = root @ root.T
    fix_lla = earth.displaced(state.lla, [8.0, -5.0, 3.0])
    fix_v_n, cov = state.v_n + [0.1, -0.2, 0.05], np.diag([100.0] * 3 + [0.01] * 3)
    age, delay_sd, vibration = 0.034, 0.0144, 1e-4

    moving, innovation, _, buffers = _memory.steps_memory(n)
    _kernels.kinematics(X, time, increments, 10, 10, 0, *moving)
    _, f_n, w_b, arms, u = moving
    f_b = increments[1:, 3:].sum(axis=0) / 0.1 - X[10:13]
    w_ib_b = (1.5 * increments[10, :3] - 0.5 * increments[9, :3]) / 0.01
    motion = measurement.kinematics(state, f_b, w_ib_b - X[13:16], arm, GravityModel.J2)
    np.testing.assert_allclose(u, motion.u, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(f_n, motion.f_n, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(w_b, motion.w_b, rtol=1e-12, atol=1e-15)
    rotated = attitude.rotate(state.q_nb, np.array([arm, np.cross(motion.w_b, arm)]))
    np.testing.assert_allclose(arms, rotated, rtol=1e-12, atol=1e-12)

    expected = measurement.measure(state, fix_lla, fix_v_n, cov, vibration, age, delay_sd, estimated, motion)
    z, H, R = expected
    x, P_expected, _, S = kalman_update(np.zeros(n), P, z, H[:, :n], R)
    X_new, P_new = X.copy(), P.copy()
    nis, applied = _kernels.update(
        X_new, P_new, fix_lla, fix_v_n, cov, vibration, age, delay_sd, estimated, *moving, 1e9,
        innovation, buffers,
    )  # fmt: skip
    assert applied
    np.testing.assert_allclose(innovation, expected.innovation, rtol=1e-9)
    assert nis == pytest.approx(z @ np.linalg.solve(S, z), rel=1e-9)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(P_new / np.outer(scale, scale), P_expected / np.outer(scale, scale), atol=1e-9)
    assert (P_new == P_new.T).all()
    corrected = NavigationState(X_new[0:3], X_new[3:6], X_new[6:10])
    np.testing.assert_allclose(earth.displacement_n(state.lla, corrected.lla), x[POSITION], rtol=1e-5)
    np.testing.assert_allclose(state.v_n - corrected.v_n, x[VELOCITY], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        attitude.misalignment(state.q_nb, corrected.q_nb), x[MISALIGN], rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(X_new[10:13] - X[10:13], x[ACCEL], rtol=1e-6)
    np.testing.assert_allclose(X_new[13:16] - X[13:16], x[GYRO], rtol=1e-6, atol=1e-18)
    np.testing.assert_allclose(X_new[17:20] - X[17:20], -x[16:] if n > 16 else 0.0, rtol=1e-6, atol=1e-12)
    assert X_new[16] == pytest.approx(X[16] - x[15], rel=1e-9)

    untouched, P_same = X.copy(), P.copy()
    refused = _kernels.update(
        untouched, P_same, fix_lla, fix_v_n, cov, vibration, age, delay_sd, estimated, *moving, 1e-9,
        innovation, buffers,
    )  # fmt: skip
    assert not refused[1]
    assert (untouched == X).all()
    assert (P_same == P).all()


def test_shuffled_fixes_end_where_sorted_ones_do(record):
    _, _, fixes = record
    rng = np.random.default_rng(4)
    late = rng.uniform(0, 1.99, len(fixes))
    # All must have arrived, or the two ends differ by what is still on its way.
    arrival = np.minimum(fixes.t_valid + late, record[0].time[-1])
    shuffled = replace(fixes, t_arrival=arrival).sorted_by_arrival()
    assert np.count_nonzero(np.diff(shuffled.t_valid) < 0) > 100
    in_order, out_of_order = run(record), run(record, shuffled)
    assert out_of_order.count(FixOutcome.FUSED) == len(fixes) - 1
    assert_ends_alike(in_order, out_of_order, atol=1e-9)


def drawn(window, **source):
    """Fixes of run 0 from a source with these settings."""
    settings = FixSource.model_validate(source)
    return draw_fixes(window, window.time[0], window.time[-1], settings, generator(1, 0, "fixes"))


def test_stamps_between_samples_are_honoured(record, window):
    """Stamps that fall between IMU samples cost nothing: the remainder is carried by the motion."""
    uneven = drawn(window, rate_hz=7.3, delay={"kind": "constant", "delay_ms": 37.3})
    estimate = run(record, uneven)
    fused = np.count_nonzero(estimate.fused)
    assert fused >= len(uneven) - 2
    assert np.mean(estimate.nis[estimate.fused]) == pytest.approx(6, abs=4 * np.sqrt(12 / fused))


@pytest.mark.parametrize("delay", list(DelayModel))
def test_duplicates_change_nothing(record, delay):
    _, _, fixes = record
    again = [replace(fixes, t_arrival=fixes.t_arrival + shift) for shift in (0.0, 0.013, 0.2)]
    single, triple = run(record, delay=delay), run(record, concatenate(again), delay=delay)
    arrived = sum(np.count_nonzero(part.t_arrival <= record[0].time[-1]) for part in again)
    assert triple.count(FixOutcome.DUPLICATE) == arrived - len(fixes)
    for name in ("lla", "v_n", "q_nb", "sd"):
        np.testing.assert_array_equal(getattr(single, name), getattr(triple, name))


def test_fixes_beyond_the_horizon_are_counted_and_not_fused(record):
    _, _, fixes = record
    too_late = np.zeros(len(fixes), bool)
    too_late[50:60] = True
    delayed = replace(fixes, t_arrival=fixes.t_arrival + np.where(too_late, 2.5, 0.0))
    estimate = run(record, delayed)
    assert estimate.count(FixOutcome.LATE) == 10
    assert_ends_alike(estimate, run(record, fixes[~too_late]))


def test_without_stamps_an_overtaken_packet_is_not_fused(record):
    _, _, fixes = record
    arrival = fixes.t_arrival.copy()
    arrival[100] += 0.35
    overtaken = replace(fixes, t_arrival=arrival)
    estimate = run(record, overtaken, delay=DelayModel.ESTIMATED)
    assert estimate.count(FixOutcome.LATE) == 1
    kept = np.arange(len(fixes)) != 100
    assert_ends_alike(estimate, run(record, fixes[kept], delay=DelayModel.ESTIMATED))


def test_stamp_after_arrival_is_refused(record):
    _, _, fixes = record
    stamp = fixes.t_stamp.copy()
    stamp[10] += 1.0
    assert run(record, replace(fixes, t_stamp=stamp)).count(FixOutcome.FUTURE) == 1


@pytest.mark.parametrize("delay", list(DelayModel))
@pytest.mark.parametrize("field", ["lla", "v_n", "cov"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_fix_that_is_not_finite_never_reaches_the_state(record, delay, field, value):
    _, _, fixes = record
    broken = getattr(fixes, field).copy()
    broken[20].flat[0] = value
    estimate = run(record, replace(fixes, **{field: broken}), delay=delay)
    assert estimate.count(FixOutcome.NOT_FINITE) == 1
    assert estimate.outcome is RunOutcome.ALIGNED
    kept = np.arange(len(fixes)) != 20
    assert_ends_alike(estimate, run(record, fixes[kept], delay=delay))


@pytest.mark.parametrize("delay", list(DelayModel))
@pytest.mark.parametrize("kind", ["zero", "negative", "indefinite", "skewed"])
def test_a_fix_without_a_proper_covariance_is_not_fused(record, delay, kind):
    _, _, fixes = record
    cov = fixes.cov.copy()
    if kind == "zero":
        cov[30, 3:, 3:] = 0
    elif kind == "negative":
        cov[30, 4, 4] *= -1
    elif kind == "indefinite":
        cov[30, 3, 4] = cov[30, 4, 3] = 1.5 * cov[30, 3, 3]
    else:
        cov[30, 0, 1] = 0.5 * cov[30, 0, 0]
    estimate = run(record, replace(fixes, cov=cov), delay=delay)
    assert estimate.fix_outcome[30] == FixOutcome.INVALID
    kept = np.arange(len(fixes)) != 30
    assert_ends_alike(estimate, run(record, fixes[kept], delay=delay))


@pytest.mark.parametrize("delay", list(DelayModel))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_imu_sample_that_is_not_finite_never_reaches_the_state(record, delay, value):
    imu, _, _ = record
    dtheta_b, dv_b = imu.dtheta_b.copy(), imu.dv_b.copy()
    dtheta_b[700, 1], dv_b[1500:1505, 0] = value, value
    estimate = run(record, delay=delay, imu=replace(imu, dtheta_b=dtheta_b, dv_b=dv_b))
    assert estimate.held_imu_samples == 6
    assert estimate.outcome is RunOutcome.ALIGNED
    for name in ("lla", "v_n", "q_nb", "sd"):
        assert np.isfinite(getattr(estimate, name)).all()


def test_no_usable_fix_is_an_outcome(record):
    _, _, fixes = record
    for unusable in (replace(fixes, lla=np.full_like(fixes.lla, np.nan)), fixes[:0]):
        estimate = run(record, unusable)
        assert estimate.outcome is RunOutcome.NO_FIX
        assert np.isnan(estimate.lla).all()


@pytest.mark.parametrize("time", [[0.0], [1.0, 1.0, 1.0], [2.0, 1.0, 0.0], [0.0, np.nan, np.nan]])
def test_time_must_increase(record, time):
    zero = np.zeros((len(time), 3))
    with pytest.raises(ValueError, match="time must increase"):
        AlignmentInput.checked(time, zero, zero, [1, 0, 0, 0], record[2], SETTINGS, ERRORS, GravityModel.J2)


def test_outliers_are_gated(record):
    _, _, fixes = record
    rng = np.random.default_rng(6)
    bad = np.zeros(len(fixes), bool)
    bad[rng.choice(np.arange(20, len(fixes)), 40, replace=False)] = True
    v_n = fixes.v_n + np.where(bad[:, None], 10.0, 0.0)
    estimate = run(record, replace(fixes, v_n=v_n))
    assert (estimate.fix_outcome[bad] == FixOutcome.GATED).all()
    assert estimate.count(FixOutcome.GATED) == 40
    assert_ends_alike(estimate, run(record, fixes[~bad]))


def test_covariance_stays_symmetric_and_positive(record):
    estimate = run(record)
    C = estimate.misalignment_cov
    assert (np.swapaxes(C, 1, 2) == C).all()
    assert (np.linalg.eigvalsh(C) > 0).all()
    assert (estimate.sd[:, :15] > 0).all()
    assert (estimate.sd[:, 15] == 0).all()


def test_ignored_delay_makes_the_error_that_theory_says(record, window):
    """A constant delay that is ignored displaces the position by v tau, along the track."""
    late = drawn(window, delay={"kind": "constant", "delay_ms": 50.0})
    estimate = run(record, late, delay=DelayModel.IGNORED)
    rows = np.searchsorted(window.time, estimate.time - 1e-6)
    error = earth.displacement_n(estimate.lla, window.lla[rows])
    track = window.v_n[rows] / np.linalg.norm(window.v_n[rows], axis=1, keepdims=True)
    along = np.sum(error * track, axis=1)
    assert np.mean(along[200:]) == pytest.approx(-10.0, abs=2.0)
    stamped = run(record, late, delay=DelayModel.STAMPED)
    error = earth.displacement_n(stamped.lla, window.lla[rows])
    assert np.mean(np.sum(error * track, axis=1)[200:]) == pytest.approx(0.0, abs=2.0)


def test_mean_delay_is_found(window, stated):
    constant = replaced(stated, {"fixes.delay": {"kind": "constant", "delay_ms": 50.0}})
    for run_id in range(3):
        estimate = simulate(constant, window, run_id, seed=2).estimates["l2linf"]
        deviation = (estimate.delay[-1] - 0.05) / estimate.sd[-1, 15]
        assert abs(deviation) < 4
        assert estimate.sd[-1, 15] < 0.005


def test_coarse_attitude_draws_signs_only():
    q_nb = attitude.from_euler(0.1, 0.05, 2.0)
    coarse = CoarseAttitude()
    errors = np.array(
        [
            attitude.attitude_error(coarse_attitude(q_nb, coarse, np.random.default_rng(i)), q_nb)
            for i in range(64)
        ]
    )
    np.testing.assert_allclose(np.abs(np.degrees(errors)), np.tile([1.0, 1.0, 10.0], (64, 1)), atol=1e-9)
    assert (np.abs(np.sign(errors).mean(axis=0)) < 0.5).all()

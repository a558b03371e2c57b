"""Alignment by cubature points: against the shared algebra, against derivatives, and where these fail."""

import numpy as np
import pytest
from fleetalign.align import _cubature_kernel, _kernels, _memory
from fleetalign.align.consistency import mean_band
from fleetalign.align.filters import align
from fleetalign.align.inputs import AlignmentInput
from fleetalign.align.measurement import N_STATES
from fleetalign.align.settings import DelayModel, Transform
from fleetalign.cosim.run import alignment_window, coarse_attitude, generator, simulate
from fleetalign.cosim.scenario import replaced
from fleetalign.cosim.score import Scorer
from fleetalign.network.fixes import Fixes
from fleetalign.sins import attitude
from fleetalign.sins.gaussian import cubature_points, cubature_update

ROOTED = {"plain": False, "rooted": True}


def state(rng) -> np.ndarray:
    X = np.zeros(_kernels.N_X)
    X[:3], X[3:6] = [0.5, 2.0, 1000.0], [150.0, 120.0, -3.0]
    X[6:10] = attitude.from_euler(0.3, -0.2, 0.8)
    X[10:16] = 1e-3 * rng.standard_normal(6)
    X[16] = 0.02
    return X


def covariance(rng, n=N_STATES) -> np.ndarray:
    sd = np.array([5.0] * 3 + [0.2] * 3 + [0.02] * 3 + [1e-3] * 3 + [1e-6] * 3 + [5e-3])
    root = rng.standard_normal((n, 2 * n)) / np.sqrt(2 * n)
    return sd[:, None] * (root @ root.T + 0.3 * np.eye(n)) * sd


def corrected(X, e) -> np.ndarray:
    Y = X.copy()
    _kernels.correct(Y, e)
    return Y


def between(X, Y) -> np.ndarray:
    e = np.zeros(N_STATES)
    _cubature_kernel.error_between(X, Y, e)
    return e


def test_the_error_between_two_states_is_what_correction_takes_off():
    rng = np.random.default_rng(1)
    X = state(rng)
    sizes = np.array([2e3] * 3 + [20] * 3 + [1.0] * 3 + [0.1] * 3 + [1e-3] * 3 + [0.1])
    for _ in range(20):
        e = sizes * rng.standard_normal(N_STATES)
        np.testing.assert_allclose(between(X, corrected(X, e)), e, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("shape", [(5, 5), (38, 22)])
def test_triangles_are_square_roots(shape):
    A = np.random.default_rng(2).standard_normal(shape)
    A[:, 1] = 0.0
    product, L = A.T @ A, np.full((shape[1], shape[1]), np.nan)
    _cubature_kernel.triangularize(A, L)
    np.testing.assert_allclose(L @ L.T, product, atol=1e-12)
    assert (np.triu(L, 1) == 0).all()
    again = np.empty_like(L)
    assert _cubature_kernel.factorize(product, again)
    np.testing.assert_allclose(again @ again.T, product, atol=1e-12)
    assert not _cubature_kernel.factorize(product - 1e-3 * np.eye(len(product)), again)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(4)
    time = 0.01 * np.arange(8)
    increments = np.tile([2e-3, -1e-3, 3e-3, 0.02, 0.05, -0.11], (8, 1))
    return time, increments + 1e-4 * rng.standard_normal((8, 6))


HELD = np.zeros((8, 6))
HELD[5] = [4e-6, 0.0, 9e-6, 1e-4, 0.0, 4e-3]


def held_covariance(X) -> np.ndarray:
    """What row 5 of `HELD`, in b, adds in n."""
    C = attitude.to_dcm(X[6:10])
    added = np.zeros((N_STATES, N_STATES))
    added[3:6, 3:6], added[6:9, 6:9] = (C @ np.diag(v) @ C.T for v in (HELD[5, 3:], HELD[5, :3]))
    return added


def test_held_samples_cost_in_their_axis(record):
    time, increments = record
    rng = np.random.default_rng(7)
    X, P = state(rng), covariance(rng)
    _, _, work, _ = _memory.steps_memory(N_STATES)
    without, kept = P.copy(), P.copy()
    _kernels.predict(X.copy(), without, time, increments, np.zeros((8, 6)), 5, np.zeros(N_STATES), 0, work)
    _kernels.predict(X, kept, time, increments, HELD, 5, np.zeros(N_STATES), 0, work)
    np.testing.assert_allclose(kept - without, held_covariance(X), atol=1e-15)
    moved = kept[:9, :9]  # what prediction writes is symmetric to the last bit
    assert (moved == moved.T).all()


@pytest.mark.parametrize("held", [np.zeros((8, 6)), HELD], ids=["sound", "held"])
@pytest.mark.parametrize("rooted", ROOTED.values(), ids=ROOTED)
def test_prediction_is_that_of_the_points(record, rooted, held):
    time, increments = record
    rng = np.random.default_rng(5)
    X, P, noise = state(rng), covariance(rng), 1e-6 * np.ones(N_STATES)
    _, _, work, _ = _memory.steps_memory(N_STATES)

    def carried(Y):
        Y = Y.copy()
        _kernels.navigate(Y, time, increments, 5, 0, work[3], work[4], work[5])
        return Y

    errors = cubature_points(np.zeros(N_STATES), np.linalg.cholesky(P))
    centre = carried(X)
    after = np.array([between(centre, carried(corrected(X, e))) for e in errors])
    spread = after - after.mean(axis=0)
    expected = spread.T @ spread / len(after) + np.diag(noise)

    kept = np.linalg.cholesky(P) if rooted else P.copy()
    memory = _cubature_kernel.points_memory(N_STATES, rooted)
    _cubature_kernel.cubature_predict(X, kept, time, increments, held, 5, noise, 0, work, memory)
    expected += held.any() * held_covariance(X)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        (kept @ kept.T if rooted else kept) / sd / sd[:, None], expected / sd / sd[:, None], atol=1e-9
    )
    np.testing.assert_allclose(between(corrected(centre, after.mean(axis=0)), X) / sd, 0, atol=1e-9)


@pytest.mark.parametrize("rooted", ROOTED.values(), ids=ROOTED)
@pytest.mark.parametrize("estimated", [False, True])
def test_an_update_is_that_of_the_shared_algebra(record, rooted, estimated):
    time, increments = record
    rng = np.random.default_rng(6)
    X, P = state(rng), covariance(rng)
    R = np.diag([9.0] * 3 + [0.01] * 3)
    lla, v_n = X[:3] + [2e-7, -3e-7, 4.0], X[3:6] + [0.1, -0.2, 0.05]
    motion, innovation, _, _ = _memory.steps_memory(N_STATES)
    C, f_n, w_b, arm, u = motion

    def image(e):
        Y, z = corrected(X, e), np.zeros(6)
        _kernels.kinematics(Y, time, increments, 7, 3, 0, C, f_n, w_b, arm, u)
        _kernels.fill_innovation(Y, lla, v_n, 0.03 + estimated * Y[16], arm, u, z)
        return z

    errors = cubature_points(np.zeros(N_STATES), np.linalg.cholesky(P))
    images = np.array([image(e) for e in errors])
    # The error's truth has the innovation's image where the error is right: what is left then is noise.
    expected = cubature_update(np.zeros(N_STATES), P, errors, images, np.zeros(6), R)

    kept, before = np.linalg.cholesky(P) if rooted else P.copy(), X.copy()
    memory = _cubature_kernel.points_memory(N_STATES, rooted)
    nis, taken = _cubature_kernel.cubature_update(
        X, kept, lla, v_n, R, 0.03, estimated, time, increments, 7, 3, 0, motion, np.inf, innovation, memory
    )
    assert taken
    mean = images.mean(axis=0)
    np.testing.assert_allclose(innovation, mean, rtol=1e-9, atol=1e-12)
    assert nis == pytest.approx(mean @ np.linalg.solve(expected.innovation_cov, mean), rel=1e-9)
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(between(before, X) / sd, expected.x / sd, atol=1e-8)
    np.testing.assert_allclose(
        (kept @ kept.T if rooted else kept) / sd / sd[:, None], expected.P / sd / sd[:, None], atol=1e-9
    )


def test_a_fix_beyond_the_gate_changes_nothing(record):
    time, increments = record
    rng = np.random.default_rng(7)
    X, P = state(rng), covariance(rng)
    motion, innovation, _, _ = _memory.steps_memory(N_STATES)
    before = X.copy(), P.copy()
    nis, taken = _cubature_kernel.cubature_update(
        X, P, X[:3] + [1.0, 0, 0], X[3:6].copy(), np.eye(6), 0.0, False, time, increments, 7, 3, 0, motion,
        30.0, innovation, _cubature_kernel.points_memory(N_STATES, False),
    )  # fmt: skip
    assert nis > 30
    assert not taken
    np.testing.assert_array_equal(X, before[0])
    np.testing.assert_array_equal(P, before[1])


@pytest.fixture(scope="module")
def wide(stated):
    """Misalignments beyond what derivatives stand for."""
    changes = {"alignment.coarse.heading_error_deg": 40.0, "alignment.settings.heading_sd_deg": 40.0}
    for angle in ("coarse.roll_error_deg", "coarse.pitch_error_deg", "settings.level_sd_deg"):
        changes[f"alignment.{angle}"] = 5.0
    return replaced(stated, changes | {"alignment.filters": ["ekf_stamped", "ckf_stamped"]}, "test")


def test_points_are_consistent_where_derivatives_are_not(wide, flight):
    runs = 12
    scorer = Scorer(alignment_window(wide, flight), wide.alignment.filters)
    for i in range(runs):
        scorer.add(simulate(wide, flight, i, 7))
    scores = scorer.scores()
    ekf, ckf = scores["ekf_stamped"], scores["ckf_stamped"]
    low, high = mean_band(3, runs, 1 - 1e-6)
    assert low < ckf.mean_nees[-1] < high
    assert ekf.mean_nees[-1] > 1.5 * ckf.mean_nees[-1]
    assert np.hypot(*ckf.rms[-1, :2]) < 0.8 * np.hypot(*ekf.rms[-1, :2])


def test_points_do_as_derivatives_where_errors_are_small(stated, flight):
    small = {"roll_error_deg": 0.02, "pitch_error_deg": 0.02, "heading_error_deg": 0.1}
    changes = {f"alignment.coarse.{name}": value for name, value in small.items()}
    changes |= {"alignment.settings.level_sd_deg": 0.02, "alignment.settings.heading_sd_deg": 0.1}
    names = ["ekf_stamped", "ckf_stamped", "l2linf", "ckf_l2linf", "srckf_l2linf"]
    run = simulate(replaced(stated, changes | {"alignment.filters": names}, "test"), flight, 0, 7)
    for by_derivatives, by_points in (names[:2], names[2:4]):
        ekf, ckf = run.estimates[by_derivatives], run.estimates[by_points]
        apart = attitude.misalignment(ckf.q_nb[-1], ekf.q_nb[-1])
        np.testing.assert_allclose(apart / ekf.sd[-1, 6:9], 0, atol=0.05)
        np.testing.assert_allclose(ckf.sd[-1], ekf.sd[-1], rtol=0.01)
    plain, rooted = run.estimates["ckf_l2linf"], run.estimates["srckf_l2linf"]
    np.testing.assert_allclose(rooted.sd, plain.sd, rtol=1e-6)
    np.testing.assert_allclose(
        attitude.misalignment(rooted.q_nb, plain.q_nb) / plain.sd[:, 6:9], 0, atol=1e-5
    )


def test_square_roots_outlive_what_breaks_the_covariance(stated, flight):
    """Arithmetic alone: one form goes on with a finite covariance where the other ends. Fixes are not as
    sharp as they are told to be, so this says nothing of the estimate; for that see
    `test_in_single_precision_the_square_root_keeps_the_estimate_that_the_plain_filter_loses`."""
    run = simulate(stated, flight, 0, 7)
    few = run.fixes[:40]
    # 10 nm against the 1 km of the start: squared, 22 decades, and a double holds 16.
    sharp = Fixes(
        few.t_valid, few.t_stamp, few.t_arrival, few.lla, few.v_n, 1e-18 * few.cov, few.source, few.sequence
    )
    window = alignment_window(stated, flight)
    end = int(np.searchsorted(run.imu.time, run.imu.time[0] + 4))
    imu = run.imu
    q_nb = coarse_attitude(window.q_nb[0], stated.alignment.coarse, generator(7, 0, "coarse attitude"))
    settings = stated.alignment.settings.model_copy(
        update={"gate_probability": 1 - 1e-15, "restart_after_gated": 100_000}
    )
    measured = imu.time[:end], imu.dtheta_b[:end], imu.dv_b[:end], q_nb, sharp
    given = AlignmentInput.checked(*measured, settings, stated.imu, window.gravity)
    found = {
        transform: align(given, DelayModel.IGNORED, transform)
        for transform in (Transform.CUBATURE, Transform.SQUARE_ROOT)
    }
    assert found[Transform.SQUARE_ROOT].outcome.name == "ALIGNED"
    assert np.isfinite(found[Transform.SQUARE_ROOT].sd[-1]).all()
    assert found[Transform.CUBATURE].outcome.name == "NOT_FINITE"

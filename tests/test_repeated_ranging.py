"""The rangefinder and the filters of Uryvsky et al. against closed forms, scipy and brute force."""

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band, nees
from fleetalign.network.localization.plane import distances, gauss_newton
from fleetalign.network.localization.problem import LocalizationError
from fleetalign.network.localization.rangefinder import covariance_as_printed, rangefinder
from fleetalign.network.localization.repeated_ranging import AS_PRINTED, PRINTED_GAIN, UPDATES
from scipy.optimize import brentq, least_squares

REFERENCES = np.array([[0.0, 0.0], [100.0, 0.0]])
ELEMENTS = np.array([[30.0, 60.0], [140.0, 50.0], [-20.0, 90.0]])


@pytest.fixture
def case():
    """x, K, x_n, Q_n of 200 estimates, with discrepancies of 0.1 to 10 standard deviations."""
    rng = np.random.default_rng(2)
    root = rng.standard_normal((2, 200, 3, 6))
    K, Q = root @ np.swapaxes(root, -1, -2)
    d = np.linalg.cholesky(K + Q) @ rng.standard_normal((200, 3, 1))
    d *= 10 ** rng.uniform(-1, 1, (200, 1, 1))
    x = rng.standard_normal((200, 3))
    return x, K, x + d[..., 0], Q


def test_exact_ranges_give_the_place_with_the_covariance_of_its_errors():
    ranges, _ = distances(ELEMENTS, REFERENCES)
    sd = np.array([0.5, 1.5])
    found = rangefinder(REFERENCES, ranges, sd)
    np.testing.assert_allclose(found.x, ELEMENTS, atol=1e-6)
    for k, element in enumerate(ELEMENTS):
        moved = [rangefinder(REFERENCES, ranges[k] + step, sd).x - element for step in 1e-4 * np.eye(2)]
        by_range = np.array(moved).T / 1e-4
        # Forward differences of 0.1 mm over tens of metres: some 1e-5.
        np.testing.assert_allclose(found.cov[k], by_range * sd**2 @ by_range.T, rtol=1e-3)


def test_the_printed_covariance_is_right_for_equal_variances_alone():
    ranges, _ = distances(ELEMENTS, REFERENCES)
    equal = rangefinder(REFERENCES, ranges, np.array([2.0, 2.0]))
    printed = covariance_as_printed(equal.x, REFERENCES, np.array([2.0, 2.0]))
    np.testing.assert_allclose(printed, equal.cov, rtol=1e-9)
    printed = covariance_as_printed(equal.x, REFERENCES, np.array([0.5, 2.0]))
    assert (np.abs(printed[:, 0, 1] - printed[:, 1, 0]) > 0.1).all()


def test_circles_that_do_not_meet_leave_y_unknown():
    found = rangefinder(REFERENCES, np.array([[45.0, 50.0], [60.0, 70.0]]), np.ones(2))
    assert found.converged.tolist() == [False, True]
    # The foot of the common chord is at (45^2 - 50^2 + 100^2) / 200.
    np.testing.assert_allclose(found.x[0], [47.625, 0.0], atol=1e-9)
    assert found.cov[0, 0, 0] == pytest.approx(0.5)
    assert found.cov[0, 1, 1] == pytest.approx(1e4)


@pytest.mark.parametrize(
    ("references", "ranges", "told"),
    [
        ([[0, 0], [100, 0]], [0.0, 80.0], "range 0 = 0 m: must be positive"),
        ([[0, 0], [100, 0]], [50.0, -80.0], "range 1 = -80 m: must be positive"),
        ([[0, 0], [0, 0]], [50.0, 80.0], "x = 0 m: it must be above 0"),
        ([[0, 0], [100, 5]], [50.0, 80.0], "on the x axis"),
    ],
)
def test_what_cannot_be_located_is_told(references, ranges, told):
    with pytest.raises(LocalizationError, match=told):
        rangefinder(np.array(references, float), np.array(ranges), np.ones(2))


def test_the_kalman_filter_of_like_fixes_is_their_mean():
    rng = np.random.default_rng(1)
    Q = np.array([[2.0, 0.7], [0.7, 1.0]])
    fixes = rng.multivariate_normal([5.0, -3.0], Q, (300, 6))
    x, K = fixes[:, 0], np.tile(Q, (300, 1, 1))
    for n in range(1, 6):
        x, K, *_ = UPDATES["kalman"](x, K, fixes[:, n], Q)
    np.testing.assert_allclose(x, fixes.mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(K[0], Q / 6, rtol=1e-12)
    low, high = mean_band(2, 300, 0.999)
    assert low < nees(x - [5.0, -3.0], K).mean() < high


def test_regularization_inflates_the_noise_as_little_as_the_limit_asks(case):
    x, K, x_n, Q = case
    found = UPDATES["regularized"](x, K, x_n, Q, 2.0)
    inflated = 0
    for k in range(len(x)):
        d = x_n[k] - x[k]

        def beyond(alpha, d=d, k=k):
            return d @ np.linalg.solve(K[k] + alpha * Q[k], d) - 2.0 * 3

        alpha = brentq(beyond, 1.0, 1e6) if beyond(1.0) > 0 else 1.0
        inflated += alpha > 1
        np.testing.assert_allclose(found.innovation_cov[k], K[k] + alpha * Q[k], rtol=1e-6, atol=1e-9)
    assert 20 < inflated < 180


def test_adaptation_of_uncoupled_coordinates_is_each_one_s_own():
    k, q, d = np.array([1.0, 4.0]), np.array([3.0, 5.0]), np.array([6.0, 1.0])
    for name, limit in (("adaptive", 1.0), ("regularized_adaptive", 3.0)):
        found = UPDATES[name](np.zeros(2), np.diag(k), d, np.diag(q), 3.0)
        s = np.maximum(k + q, d**2 / limit)
        np.testing.assert_allclose(found.x, k / s * d)
        np.testing.assert_allclose(found.P, np.diag(k - k**2 / s), atol=1e-12)


@pytest.mark.parametrize("name", list(UPDATES))
def test_no_filter_depends_on_units_or_claims_more_than_kalman(name, case):
    x, K, x_n, Q = case
    unit = np.array([1.0, 1e-3, 20.0])
    scale = unit[:, None] * unit
    found = UPDATES[name](x, K, x_n, Q, 3.0)
    other = UPDATES[name](x * unit, K * scale, x_n * unit, Q * scale, 3.0)
    np.testing.assert_allclose(other.x, found.x * unit, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.P, found.P * scale, rtol=1e-6, atol=1e-9)
    kalman = UPDATES["kalman"](x, K, x_n, Q, 3.0)
    assert (np.linalg.eigvalsh(found.P - kalman.P) > -1e-9).all()
    assert (np.linalg.eigvalsh(K - found.P) > -1e-9).all()


@pytest.mark.parametrize("name", ["regularized", "regularized_adaptive"])
def test_what_is_within_the_limit_is_kalmans(name, case):
    x, K, x_n, Q = case
    found, kalman = (UPDATES[n](x, K, x_n, Q, 1e6) for n in (name, "kalman"))
    np.testing.assert_allclose(found.x, kalman.x, rtol=1e-9)


def test_an_outlier_is_followed_as_printed_and_held_off_as_mended():
    x, K, Q = np.zeros(2), 0.2 * np.eye(2), np.eye(2)
    outlier = np.array([15.0, 12.0])
    far = np.linalg.norm(UPDATES["kalman"](x, K, outlier, Q, 3.0).x)
    assert np.linalg.norm(PRINTED_GAIN["regularized"](x, K, outlier, Q, 3.0).x) > 2 * far
    for name in ("regularized", "adaptive", "regularized_adaptive"):
        assert np.linalg.norm(UPDATES[name](x, K, outlier, Q, 3.0).x) < 0.3 * far


def test_the_printed_equations_are_those_of_the_paper():
    x, K = np.array([1.0, 2.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
    Q, limit = np.array([[1.0, -0.2], [-0.2, 3.0]]), 3.0
    for d in (np.array([0.5, -0.5]), np.array([4.0, -3.0]), np.array([8.0, 0.1])):
        squares, p = d**2, limit * np.trace(K + Q)
        H6 = K @ np.linalg.inv(K + Q)
        H9 = K @ np.linalg.inv(K + min(1.0, p / squares.sum()) * Q)
        beyond = (np.sort(squares) > np.linalg.eigvalsh(K + Q)).all()
        H12 = K @ np.linalg.inv(np.diag(squares))
        gains = {
            "kalman": H6,
            "regularized": H9,
            "adaptive": H12 if beyond else H6,
            "regularized_adaptive": H12 if beyond else H9,
        }
        for name, H in gains.items():
            printed = AS_PRINTED[name](x, K, x + d, Q, limit)
            np.testing.assert_allclose(printed.gain, H, rtol=1e-9)
            np.testing.assert_allclose(printed.x, x + d + H @ d, rtol=1e-9)
            np.testing.assert_allclose(printed.P, K - K @ H, rtol=1e-9, atol=1e-12)
            mended = PRINTED_GAIN[name](x, K, x + d, Q, limit)
            np.testing.assert_allclose(mended.x, x + H @ d, rtol=1e-9)
            kept = np.eye(2) - H
            np.testing.assert_allclose(mended.P, kept @ K @ kept.T + H @ Q @ H.T, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", list(UPDATES))
def test_coordinates_may_change_places(name, case):
    x, K, x_n, Q = case
    order = [2, 0, 1]
    for updates in (UPDATES, PRINTED_GAIN, AS_PRINTED):
        found = updates[name](x, K, x_n, Q, 3.0)
        other = updates[name](
            x[:, order], K[:, order][..., order], x_n[:, order], Q[:, order][..., order], 3.0
        )
        np.testing.assert_allclose(other.x, found.x[:, order], rtol=1e-9, atol=1e-9)


def test_huber_s_loss_is_that_of_scipy():
    rng = np.random.default_rng(7)
    anchors, sd = rng.uniform(0, 100, (12, 2)), rng.uniform(0.5, 2.0, 12)
    node = np.array([40.0, 55.0])
    ranges = np.linalg.norm(node - anchors, axis=1) + sd * rng.standard_normal(12)
    ranges[:2] += [30.0, -15.0]

    def residuals(x):
        return (ranges - np.linalg.norm(x - anchors, axis=1)) / sd

    expected = least_squares(residuals, node, loss="huber", f_scale=1.5, xtol=1e-12, ftol=1e-12).x
    found = gauss_newton(anchors, ranges, sd, node + 3.0, tolerance_m=1e-8, huber=1.5)
    np.testing.assert_allclose(found.x, expected, atol=1e-5)
    assert np.linalg.norm(gauss_newton(anchors, ranges, sd, node).x - expected) > 1.0

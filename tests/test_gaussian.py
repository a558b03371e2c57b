"""Gaussian updates against each other and against the textbook's closed forms."""

import numpy as np
import pytest
from fleetalign.sins.gaussian import (
    cubature_points,
    cubature_update,
    joseph,
    kalman_update,
    lower_root,
    square_root_cubature_update,
    transposed,
)

BATCH, N, M = 7, 4, 3


@pytest.fixture
def case():
    rng = np.random.default_rng(5)
    root = rng.standard_normal((BATCH, N, 2 * N))
    x, P = rng.standard_normal((BATCH, N)), root @ transposed(root)
    H, noise = rng.standard_normal((BATCH, M, N)), rng.standard_normal((BATCH, M, 2 * M))
    return x, P, H, noise @ transposed(noise), rng.standard_normal((BATCH, M))


def test_the_linear_update_is_that_of_the_information_form(case):
    x, P, H, R, z = case
    found = kalman_update(x, P, z - (H @ x[..., None])[..., 0], H, R)
    J = np.linalg.inv(P) + transposed(H) @ np.linalg.solve(R, H)
    y = np.linalg.solve(P, x[..., None]) + transposed(H) @ np.linalg.solve(R, z[..., None])
    np.testing.assert_allclose(found.P, np.linalg.inv(J), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.x, np.linalg.solve(J, y)[..., 0], rtol=1e-9)


def test_cubature_updates_of_a_linear_measurement_are_the_linear_one(case):
    x, P, H, R, z = case
    linear = kalman_update(x, P, z - (H @ x[..., None])[..., 0], H, R)
    root = np.linalg.cholesky(P)
    points = cubature_points(x, root)
    images = points @ transposed(H)
    plain = cubature_update(x, P, points, images, z, R)
    rooted = square_root_cubature_update(x, points, images, z, np.linalg.cholesky(R))
    for found, cov in ((plain, plain.P), (rooted, rooted.P @ transposed(rooted.P))):
        np.testing.assert_allclose(found.x, linear.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.gain, linear.gain, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(cov, linear.P, rtol=1e-9, atol=1e-9)


def test_cubature_points_have_the_mean_and_the_covariance(case):
    x, P, *_ = case
    points = cubature_points(x, np.linalg.cholesky(P))
    centred = points - x[..., None, :]
    np.testing.assert_allclose(points.mean(axis=-2), x, atol=1e-12)
    np.testing.assert_allclose(transposed(centred) @ centred / (2 * N), P, rtol=1e-10, atol=1e-10)


def test_a_wrong_gain_costs_what_joseph_says(case):
    x, P, H, R, _ = case
    best = kalman_update(x, P, np.zeros((BATCH, M)), H, R)
    worse = joseph(P, 1.3 * best.gain, H, R)
    assert (np.trace(worse, axis1=-2, axis2=-1) > np.trace(best.P, axis1=-2, axis2=-1)).all()
    # Off the optimum the cost is quadratic: (0.3)^2 gain S gain^T.
    extra = 0.09 * best.gain @ best.innovation_cov @ transposed(best.gain)
    np.testing.assert_allclose(worse - best.P, extra, rtol=1e-6, atol=1e-9)


def test_a_lower_root_is_one(case):
    rows = np.random.default_rng(1).standard_normal((BATCH, 9, N))
    root = lower_root(rows)
    np.testing.assert_allclose(root @ transposed(root), transposed(rows) @ rows, rtol=1e-12)
    assert (np.triu(root, 1) == 0).all()
    assert (np.diagonal(root, axis1=-2, axis2=-1) > 0).all()


def test_square_roots_in_single_precision_outlive_the_plain_update():
    # A prior of (1 km)^2, and the sum of two components to 1 mm, again and again: (1e3 / 1e-3)^2 is beyond
    # the 24 bits of single precision, 1e3 / 1e-3 is not.
    x, z = np.zeros(2, np.float32), np.zeros(1, np.float32)
    H, root_R = np.array([[1, 1]], np.float32), np.array([[1e-3]], np.float32)
    S = 1e3 * np.eye(2, dtype=np.float32)
    P, R = S @ S.T, root_R @ root_R.T
    for k in range(4):
        points = cubature_points(x, S)
        S = square_root_cubature_update(x, points, points @ H.T, z, root_R).P
        assert S.dtype == np.float32
        assert np.linalg.norm(H @ S) == pytest.approx(1e-3 / np.sqrt(k + 1), rel=1e-4)

    def plain(P, times):
        for _ in range(times):
            points = cubature_points(x, np.linalg.cholesky(P))
            P = cubature_update(x, P, points, points @ H.T, z, R).P

    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        plain(P, 4)

"""One node against anchors: linear and least-squares solutions, their covariance, and refusals."""

import numpy as np
import pytest
from fleetalign.network.localization.bound import cramer_rao
from fleetalign.network.localization.plane import (
    check_anchors,
    check_ranges,
    gauss_newton,
    in_plane,
    information,
    lateration,
    range_bound,
)
from fleetalign.network.localization.problem import LocalizationError

ANCHORS = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 80.0], [120.0, 90.0]])
NODE = np.array([37.0, 41.0])
TRUE = np.linalg.norm(NODE - ANCHORS, axis=1)


def test_exact_ranges_give_the_position_in_two_and_three_dimensions():
    np.testing.assert_allclose(lateration(ANCHORS, TRUE), NODE, atol=1e-9)
    found = gauss_newton(ANCHORS, TRUE, np.ones(4), np.array([60.0, 10.0]))
    assert found.converged
    np.testing.assert_allclose(found.x, NODE, atol=1e-6)
    anchors = np.column_stack([ANCHORS, [0.0, 10.0, 30.0, 5.0]])
    ranges = np.linalg.norm([37.0, 41.0, -20.0] - anchors, axis=1)
    found = gauss_newton(anchors, ranges, np.ones(4), lateration(anchors, ranges) + 5.0)
    np.testing.assert_allclose(found.x, [37.0, 41.0, -20.0], atol=1e-6)


def test_an_anchor_that_is_not_heard_says_nothing():
    ranges = np.append(TRUE, 1.0)
    anchors, sd = np.vstack([ANCHORS, [[500.0, 500.0]]]), np.array([1.0, 1, 1, 1, np.inf])
    heard = np.isfinite(sd)
    np.testing.assert_allclose(lateration(anchors, ranges, heard), NODE, atol=1e-9)
    np.testing.assert_allclose(gauss_newton(anchors, ranges, sd, NODE + 3.0).x, NODE, atol=1e-6)


def test_the_covariance_is_that_of_the_errors_and_the_bound():
    rng = np.random.default_rng(3)
    sd = np.array([0.5, 1.0, 2.0, 1.0])
    ranges = TRUE + sd * rng.standard_normal((4000, 4))
    found = gauss_newton(
        np.tile(ANCHORS, (4000, 1, 1)), ranges, np.tile(sd, (4000, 1)), lateration(ANCHORS, ranges)
    )
    bound = range_bound(NODE, ANCHORS, sd)
    # The scatter of 4,000 draws is within 5 sd of a Wishart's diagonal, sqrt(2 / 4000) each, of the bound.
    scatter = np.cov(found.x.T)
    np.testing.assert_allclose(np.diag(scatter), np.diag(bound), rtol=5 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(found.cov.mean(axis=0), bound, rtol=0.02, atol=0.01)


def test_the_bound_of_one_node_is_that_of_the_network_in_the_plane():
    sd = np.array([0.5, 1.0, 2.0, 1.0])
    links = np.column_stack([np.full(4, 4), np.arange(4)])
    anchor, x = np.array([True] * 4 + [False]), np.vstack([ANCHORS, NODE])
    problem = in_plane(links, TRUE, sd, anchor, x)
    bound = cramer_rao(problem, np.column_stack([x, np.zeros(5)])).cov[4]
    np.testing.assert_allclose(bound[:2, :2], range_bound(NODE, ANCHORS, sd), rtol=1e-6)
    assert bound[2, 2] < 2e-6
    np.testing.assert_allclose(np.linalg.inv(information(NODE, ANCHORS, sd)), range_bound(NODE, ANCHORS, sd))


@pytest.mark.parametrize("value", [0.0, -3.0, np.nan, np.inf])
def test_ranges_that_are_none_are_refused(value):
    with pytest.raises(LocalizationError, match=r"range 1 = .* m: must be positive"):
        check_ranges(np.array([1.0, value]), np.ones(2))


def test_infinite_deviations_mean_not_heard_and_others_must_be_positive():
    check_ranges(np.ones(2), np.array([1.0, np.inf]))
    with pytest.raises(LocalizationError, match=r"range_sd 0 = 0 m"):
        check_ranges(np.ones(2), np.array([0.0, 1.0]))


def test_anchors_that_leave_a_mirror_image_are_refused():
    check_anchors(ANCHORS)
    with pytest.raises(LocalizationError, match="2 anchors: at least 3"):
        check_anchors(ANCHORS[:2])
    with pytest.raises(LocalizationError, match="all 3 anchors lie on a line"):
        check_anchors(np.array([[0.0, 0.0], [1.0, 1.0], [5.0, 5.0]]))
    with pytest.raises(LocalizationError, match="lie on a plane"):
        check_anchors(np.column_stack([ANCHORS, np.zeros(4)]))

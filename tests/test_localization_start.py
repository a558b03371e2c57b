"""Starts of localisation: spherical location, DV-distance, semidefinite programming."""

import numpy as np
import pytest
from fleetalign.network.localization.dv_distance import dv_distance, path_distances
from fleetalign.network.localization.problem import LocalizationError, RangeProblem
from fleetalign.network.localization.sdp import sdp_start
from fleetalign.network.localization.spherical import locate_successively, neighbors


def fleet(rng, n=30, anchors=8, radius=25e3, sd=0.0, **more):
    """Nodes in a cylinder of radius 20 km, height 5 km; the first ones are anchors."""
    r, a = 20e3 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    x = np.column_stack([r * np.cos(a), r * np.sin(a), 5e3 * rng.random(n) - 2500])
    i, j = np.tril_indices(n, -1)
    d = np.linalg.norm(x[i] - x[j], axis=1)
    k = d <= radius
    ranges = d[k] + sd * rng.standard_normal(k.sum())
    links = np.column_stack([i, j])[k].astype(np.int64)
    problem = RangeProblem(links, ranges, np.full(len(links), sd or 1.0), np.arange(n) < anchors, x, **more)
    return problem, x


def test_links_by_node():
    problem, _ = fleet(np.random.default_rng(0), n=9, radius=15e3)
    links = neighbors(problem)
    for node in range(9):
        slots = slice(links.first[node], links.first[node + 1])
        ends = problem.links[links.link[slots]]
        assert sorted(links.other[slots]) == sorted(ends.sum(axis=1) - node)
        assert (np.where(links.sign[slots] > 0, ends[:, 0], ends[:, 1]) == node).all()
    assert links.first[-1] == 2 * len(problem.links)


@pytest.mark.parametrize("references", [0, 4])
def test_spherical_location_is_exact_without_noise(references):
    problem, x = fleet(np.random.default_rng(1))
    found = locate_successively(problem, references=references)
    assert found.located.all()
    np.testing.assert_allclose(found.x, x, atol=0.5)


def test_clock_offsets_are_found_with_positions():
    rng = np.random.default_rng(2)
    problem, x = fleet(rng, clocks=True)
    clock = np.where(problem.anchor, 0.0, 1e4 * rng.standard_normal(30))
    i, j = problem.links.T
    problem.ranges[:] += clock[i] - clock[j]
    found = locate_successively(problem)
    assert found.located.all()
    np.testing.assert_allclose(found.x, x, atol=1.0)
    np.testing.assert_allclose(found.clock, clock, atol=1.0)


def test_heights_settle_the_vertical():
    # Coplanar anchors: without heights, above and below are alike.
    rng = np.random.default_rng(3)
    x = np.column_stack([1e4 * rng.standard_normal((6, 2)), np.zeros(6)])
    x[5] = 2000.0, 3000.0, -1500.0
    links = np.array([(5, j) for j in range(5)])
    ranges = np.linalg.norm(x[5] - x[:5], axis=1)
    curvature = 1 / 6.37e6
    height = np.full(6, np.nan)
    height[5] = -x[5, 2] + 0.5 * curvature * (x[5, :2] ** 2).sum()
    problem = RangeProblem(
        links, ranges, np.full(5, 1.0), np.arange(6) < 5, x, height=height, curvature=curvature
    )
    np.testing.assert_allclose(locate_successively(problem, ambiguous_too=False).x[5], x[5], atol=0.1)
    problem = RangeProblem(links, ranges, np.full(5, 1.0), np.arange(6) < 5, x)
    assert not locate_successively(problem, ambiguous_too=False).located[5]
    assert locate_successively(problem).margin[5] == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize(
    "places",
    [
        [[0, 0, 0], [9e3, 0, 0], [0, 9e3, 1e3]],
        [[0, 0, 0], [5e3, 0, 0], [9e3, 0, 0], [15e3, 0, 0], [20e3, 0, 0]],
    ],
    ids=["three neighbours", "in one line"],
)
def test_node_without_a_place_is_not_located(places):
    x = np.array([*places, [3e3, 4e3, 2e3]])
    n = len(x)
    links = np.array([(n - 1, j) for j in range(n - 1)])
    ranges = np.linalg.norm(x[-1] - x[:-1], axis=1)
    problem = RangeProblem(links, ranges, np.full(n - 1, 50.0), np.arange(n) < n - 1, x)
    found = locate_successively(problem)
    assert not found.located[-1]
    assert np.isnan(found.x[-1]).all()


def test_covariance_matches_the_scatter_of_a_single_node():
    # 400 draws: a ratio of variances, of 3 degrees of freedom each, has a standard deviation of
    # sqrt(2 / 1200) = 4 %.
    rng = np.random.default_rng(4)
    _, x = fleet(rng, n=9)
    x[8] = 1e3, -2e3, 5e3
    links = np.array([(8, j) for j in range(8)])
    distance = np.linalg.norm(x[8] - x[:8], axis=1)
    squares = []
    for _ in range(400):
        ranges = distance + 10 * rng.standard_normal(8)
        found = locate_successively(RangeProblem(links, ranges, np.full(8, 10.0), np.arange(9) < 8, x))
        error = found.x[8] - x[8]
        squares.append(error @ np.linalg.solve(found.cov[8], error))
    assert np.mean(squares) / 3 == pytest.approx(1, abs=0.16)


def test_paths_go_along_links():
    x = np.array([[0, 0, 0], [5e3, 0, 0], [5e3, 4e3, 0], [9e9, 0, 0]])
    links = np.array([(1, 0), (2, 1)])
    problem = RangeProblem(links, np.array([5e3, 4e3]), np.ones(2), np.array([True, False, False, False]), x)
    np.testing.assert_allclose(path_distances(problem), [[0, 5e3, 9e3, np.inf]])


def test_dv_distance_reaches_what_hears_no_anchor():
    # Paths of several hops are crude: the error stays a fraction of the fleet's size, 20 km.
    problem, x = fleet(np.random.default_rng(5), n=60, anchors=10, radius=13e3)
    found = dv_distance(problem)
    horizontal = np.linalg.norm((found - x)[10:, :2], axis=1)
    assert np.isfinite(horizontal).all()
    assert np.median(horizontal) < 3e3
    np.testing.assert_array_equal(found[:10], x[:10])


def test_semidefinite_start_is_exact_on_complete_graphs():
    problem, x = fleet(np.random.default_rng(6), n=10, anchors=5, radius=1e6)
    np.testing.assert_allclose(sdp_start(problem), x, atol=20.0)


def test_semidefinite_start_says_what_it_does_not_take():
    problem, _ = fleet(np.random.default_rng(7), n=51)
    with pytest.raises(LocalizationError, match="up to 50 nodes; got 51"):
        sdp_start(problem)
    problem, _ = fleet(np.random.default_rng(7), n=10, clocks=True)
    with pytest.raises(LocalizationError, match="clock offsets"):
        sdp_start(problem)

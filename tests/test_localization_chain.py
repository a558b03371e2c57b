"""From ranges to positions, cold: accuracy against the bound, and verdicts that hold."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.network.localization.bound import cramer_rao, flipped, normalized_error_squared
from fleetalign.network.localization.chain import LocalizationSettings, localize, usable_nodes
from fleetalign.network.localization.problem import NodeOutcome, RangeProblem


def fleet(rng, n=50, anchors=10, radius=15e3, sd=50.0, nlos=0.0, **more):
    """Nodes in a cylinder of radius 20 km, height 5 km; anchors at random, never node 0."""
    r, a = 20e3 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    x = np.column_stack([r * np.cos(a), r * np.sin(a), 5e3 * rng.random(n) - 2500])
    i, j = np.tril_indices(n, -1)
    d = np.linalg.norm(x[i] - x[j], axis=1)
    k = d <= radius
    ranges = d[k] + sd * rng.standard_normal(k.sum())
    ranges += np.where(rng.random(k.sum()) < nlos, rng.exponential(150, k.sum()), 0)
    anchor = np.zeros(n, np.bool_)
    anchor[rng.permutation(np.arange(1, n))[:anchors]] = True
    links = np.column_stack([i, j])[k].astype(np.int64)
    return RangeProblem(links, ranges, np.full(len(links), sd or 1.0), anchor, x, **more), x


def against_bound(draws, nlos, settings=None):
    """RMSE over bound, share located, flipped nodes, normalised errors squared of located nodes."""
    squares = least = located = flips = nodes = 0.0
    normalized = []
    for seed in range(draws):
        problem, x = fleet(np.random.default_rng(seed), nlos=nlos)
        bound, found = cramer_rao(problem, x), localize(problem, settings)
        good = found.outcome == NodeOutcome.LOCATED
        assert bound.localizable[good].all()
        squares += ((found.x - x)[good] ** 2).sum()
        least += (bound.sd[good] ** 2).sum()
        flips += (flipped(found.x, x, bound.cov) & good).sum()
        located += good.sum()
        nodes += (~problem.anchor).sum()
        normalized.append(normalized_error_squared(found.x, x, found.cov)[good])
    return np.sqrt(squares / least), located / nodes, flips, np.concatenate(normalized)


def test_cold_start_reaches_the_bound():
    # Over 40 draws the ratio has a standard deviation of 3 % (bootstrap), the mean of three-degree-of-freedom
    # squares over 1,600 nodes, correlated within a draw, one of 0.1.
    ratio, located, flips, normalized = against_bound(40, nlos=0.0)
    assert ratio == pytest.approx(1, abs=0.09)
    assert located > 0.97
    assert flips == 0
    assert normalized.mean() == pytest.approx(3, abs=0.3)


def test_one_sided_loss_takes_ranges_that_are_too_long():
    # 1.23 over 100 draws, squares 1.63: standard deviations of 6 % over 20.
    robust = against_bound(20, nlos=0.1)
    plain = against_bound(20, nlos=0.1, settings=LocalizationSettings(loss="squared"))
    assert robust[0] < 1.4
    assert plain[0] > robust[0] + 0.15


@pytest.mark.parametrize("radius", [10e3, 7e3])
def test_no_wrong_position_is_called_located_in_sparse_networks(radius):
    for seed in range(3):
        problem, x = fleet(np.random.default_rng(seed), radius=radius)
        found, bound = localize(problem), cramer_rao(problem, x)
        good = found.outcome == NodeOutcome.LOCATED
        assert bound.localizable[good].all()
        assert not (flipped(found.x, x, bound.cov) & good).any()


def test_exact_without_noise():
    problem, x = fleet(np.random.default_rng(2), sd=0.0)
    found = localize(problem)
    assert (found.outcome <= NodeOutcome.LOCATED).all()
    np.testing.assert_allclose(found.x, x, atol=1e-3)


def test_clock_offsets_come_out():
    rng = np.random.default_rng(3)
    problem, x = fleet(rng, sd=10.0, clocks=True)
    clock = np.where(problem.anchor, 0.0, 3e3 * rng.standard_normal(50))
    i, j = problem.links.T
    problem.ranges[:] += clock[i] - clock[j]
    found, bound = localize(problem), cramer_rao(problem, x)
    good = found.outcome == NodeOutcome.LOCATED
    assert good.sum() > 30
    assert not (flipped(found.x, x, bound.cov) & good).any()
    assert np.abs(found.clock - clock)[good].max() < 100


@pytest.mark.parametrize("seed", [2, 3, 11])
def test_biased_node_is_the_suspect(seed):
    # Node 0 within 11 km of the middle: at the rim, a bias is a move outwards.
    problem, x = fleet(np.random.default_rng(seed))
    own = (problem.links == 0).any(axis=1)
    found = localize(replace(problem, ranges=problem.ranges + 500.0 * own))
    np.testing.assert_array_equal(np.flatnonzero(found.suspect), [0])
    assert found.outcome[0] == NodeOutcome.INCONSISTENT
    assert np.isnan(found.x[0]).all()
    good = found.outcome == NodeOutcome.LOCATED
    assert good.sum() >= 38
    assert not (flipped(found.x, x, cramer_rao(problem, x).cov) & good).any()


def test_anchor_that_is_not_where_it_says_is_the_suspect():
    problem, _ = fleet(np.random.default_rng(5))
    liar = int(np.flatnonzero(problem.anchor)[0])
    told = problem.anchor_x.copy()
    told[liar, 0] += 3e3
    found = localize(replace(problem, anchor_x=told))
    np.testing.assert_array_equal(np.flatnonzero(found.suspect), [liar])


def test_every_node_hears_enough_or_is_said_to_hear_too_little():
    # Node 5 hears four, one of which, 6, hears but three: both are out.
    x = np.random.default_rng(6).uniform(-5e3, 5e3, (7, 3))
    links = np.array([(4, 0), (4, 1), (4, 2), (4, 3), (5, 0), (5, 1), (5, 2), (6, 0), (6, 1), (6, 5)])
    ranges = np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
    problem = RangeProblem(links, ranges, np.full(10, 10.0), np.arange(7) < 4, x)
    np.testing.assert_array_equal(usable_nodes(problem), [True] * 5 + [False] * 2)
    found = localize(problem)
    assert (found.outcome[5:] == NodeOutcome.TOO_FEW_NEIGHBOURS).all()
    assert np.isnan(found.x[5:]).all()


@pytest.mark.parametrize("anchors", [1, 2, 3])
def test_too_few_anchors_locate_nothing(anchors):
    problem, _ = fleet(np.random.default_rng(7), n=12, anchors=anchors, radius=1e6)
    found = localize(problem)
    assert not (found.outcome == NodeOutcome.LOCATED).any()
    assert set(found.outcome[~problem.anchor]) <= {NodeOutcome.SINGULAR, NodeOutcome.AMBIGUOUS}


@pytest.mark.parametrize("dimensions", [1, 2], ids=["collinear", "coplanar"])
def test_anchors_in_a_line_or_plane_leave_images(dimensions):
    problem, x = fleet(np.random.default_rng(8), n=14, anchors=6, radius=1e6)
    flat = x.copy()
    flat[problem.anchor, dimensions:] = 0.0
    i, j = problem.links.T
    ranges = np.linalg.norm(flat[i] - flat[j], axis=1) + 50 * np.random.default_rng(9).standard_normal(len(i))
    found = localize(replace(problem, ranges=ranges, anchor_x=flat))
    assert set(found.outcome[~problem.anchor]) <= {NodeOutcome.SINGULAR, NodeOutcome.AMBIGUOUS}


def test_two_nodes_at_one_place():
    rng = np.random.default_rng(10)
    problem, x = fleet(rng)
    free = np.flatnonzero(~problem.anchor)[:2]
    x[free[1]] = x[free[0]]
    i, j = np.tril_indices(50, -1)
    d = np.linalg.norm(x[i] - x[j], axis=1)
    k = d <= 15e3
    links = np.column_stack([i, j])[k]
    ranges = np.abs(d[k] + 50 * rng.standard_normal(k.sum()))
    found = localize(RangeProblem(links, ranges, np.full(len(links), 50.0), problem.anchor, x))
    assert (found.outcome[free] == NodeOutcome.LOCATED).all()
    assert np.linalg.norm(found.x[free] - x[free], axis=1).max() < 1e3


def test_network_without_links_is_reported():
    x = np.zeros((3, 3))
    nothing = RangeProblem(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.arange(3) < 1, x)
    found = localize(nothing)
    few = NodeOutcome.TOO_FEW_NEIGHBOURS
    np.testing.assert_array_equal(found.outcome, [NodeOutcome.ANCHOR, few, few])


def test_semidefinite_start_is_no_worse():
    problem, x = fleet(np.random.default_rng(11), n=16, anchors=4, radius=18e3)
    plain = localize(problem)
    anew = localize(problem, LocalizationSettings(use_sdp=True))
    bound = cramer_rao(problem, x)
    good = anew.outcome == NodeOutcome.LOCATED
    assert not (flipped(anew.x, x, bound.cov) & good).any()
    assert good.sum() >= (plain.outcome == NodeOutcome.LOCATED).sum()

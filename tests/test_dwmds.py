"""Weighted multidimensional scaling: as printed, as mended, and its readable twin."""

import numpy as np
import pytest
from fleetalign.network.localization.dwmds import dwmds
from fleetalign.network.localization.problem import RangeProblem


def network(rng, n=14, anchors=6, sd=0.0, **more):
    x = rng.uniform(-1, 1, (n, 3)) * [1e4, 1e4, 5e3]
    links = np.column_stack(np.tril_indices(n, -1)).astype(np.int64)
    d = np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
    ranges = d + sd * rng.standard_normal(len(d))
    return RangeProblem(links, ranges, np.full(len(d), sd or 1.0), np.arange(n) < anchors, x, **more), x


def twin(problem, x, update, weights):
    """One sweep in numpy, over a complete graph."""
    n, printed = problem.nodes, update == "printed"
    measured = np.zeros((n, n))
    i, j = problem.links.T
    measured[i, j] = measured[j, i] = problem.ranges
    others = ~np.eye(n, dtype=bool)

    def distances(x):
        return np.linalg.norm(x[:, None] - x, axis=2)

    size = np.abs(measured - distances(x)) * others + 1e-6 * others
    mean = size.sum(axis=1) / (n - 1)
    relative = size.sum(axis=1) / measured.sum(axis=1)
    square = (size**2).sum(axis=1) / (n - 1)
    w = others.astype(float)
    if weights == "adaptive":
        reliability = 1 / ((mean[:, None] if printed else mean) + relative[:, None] * measured)
        w = others * reliability / (others * reliability).sum(axis=1, keepdims=True)
    elif weights == "residual":
        w = others / (square[:, None] + square)
    if printed:
        w = w * np.where(problem.anchor, 2.0, 1.0)
    x, before = x.copy(), x.copy()
    for i in np.flatnonzero(~problem.anchor):
        seen = before if printed else x
        own = others[i]
        ratio = (measured[i] / np.where(own, distances(seen)[i], 1))[own, None]
        term = (1 - ratio) * seen[own]
        if not printed:
            term = term + ratio * seen[i]
        x[i] = (w[i, own, None] * term).sum(axis=0) / w[i, own].sum()
    return x


@pytest.mark.parametrize("weights", ["unit", "adaptive", "residual"])
@pytest.mark.parametrize("update", ["mended", "printed"])
def test_sweeps_are_those_of_the_readable_twin(update, weights):
    rng = np.random.default_rng(0)
    problem, x = network(rng, sd=50.0)
    start = np.where(problem.anchor[:, None], x, x + 300 * rng.standard_normal(x.shape))
    expected = start
    for _ in range(3):
        expected = twin(problem, expected, update, weights)
    found = dwmds(problem, start, update=update, weights=weights, sweeps=3, tolerance_m=0)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("weights", ["unit", "adaptive", "residual"])
def test_mended_update_is_exact_without_noise(weights):
    rng = np.random.default_rng(1)
    problem, x = network(rng)
    start = x + 200 * rng.standard_normal(x.shape)
    found = dwmds(problem, start, weights=weights, sweeps=3000, tolerance_m=1e-5)
    np.testing.assert_allclose(found, x, atol=0.5)


def test_printed_update_leaves_even_the_truth():
    # Without the self term, exact ranges at exact positions give the origin: each factor 1 - dhat / d is 0.
    problem, x = network(np.random.default_rng(2))
    found = dwmds(problem, x, update="printed", sweeps=1)
    np.testing.assert_allclose(found[6:], 0, atol=1e-3)
    np.testing.assert_array_equal(found[:6], x[:6])
    np.testing.assert_allclose(dwmds(problem, x, sweeps=1), x, atol=1e-3)


def test_unit_weights_lower_the_cost_at_every_sweep():
    rng = np.random.default_rng(3)
    problem, x = network(rng, sd=50.0)
    i, j = problem.links.T
    x = x + 2e3 * rng.standard_normal(x.shape)
    costs = []
    for _ in range(30):
        x = dwmds(problem, x, sweeps=1, tolerance_m=0)
        costs.append(((problem.ranges - np.linalg.norm(x[i] - x[j], axis=1)) ** 2).sum())
    assert (np.diff(costs) < 0).all()


def test_heights_pull():
    problem, x = network(np.random.default_rng(4))
    heights = np.where(problem.anchor, np.nan, -x[:, 2] + 400)
    with_height, _ = network(np.random.default_rng(4), height=heights)
    moved = dwmds(with_height, x, sweeps=1) - x
    assert (moved[6:, 2] < -1).all()


def test_two_nodes_at_one_place_stay_finite():
    problem, x = network(np.random.default_rng(5))
    start = x.copy()
    start[7] = start[8]
    assert np.isfinite(dwmds(problem, start, sweeps=50)).all()


def test_nodes_without_start_take_no_part():
    problem, x = network(np.random.default_rng(6))
    start = x.copy()
    start[9] = np.nan
    found = dwmds(problem, start, sweeps=5)
    assert np.isnan(found[9]).all()
    np.testing.assert_allclose(np.delete(found, 9, axis=0), np.delete(x, 9, axis=0), atol=1e-3)

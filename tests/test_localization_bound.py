"""What ranges can tell: information, bound, nodes that can be located."""

import casadi
import numpy as np
import pytest
from fleetalign.network.localization.bound import cramer_rao, fisher_information, flipped
from fleetalign.network.localization.problem import RangeProblem
from scipy.optimize import least_squares


def network(rng, n=8, anchors=4, **more):
    x = rng.uniform(-1, 1, (n, 3)) * [2e4, 2e4, 2.5e3]
    links = np.column_stack(np.tril_indices(n, -1)).astype(np.int64)
    ranges = np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
    return RangeProblem(links, ranges, rng.uniform(10, 60, len(links)), np.arange(n) < anchors, x, **more), x


@pytest.mark.parametrize("clocks", [False, True])
@pytest.mark.parametrize("anchor_sd", [0.0, 20.0])
def test_information_is_that_of_the_derivatives(clocks, anchor_sd):
    rng = np.random.default_rng(0)
    problem, x = network(
        rng, clocks=clocks, anchor_sd=anchor_sd, height=np.full(8, 100.0), height_sd=7.0, curvature=1e-7
    )
    n, B = 8, 4 if clocks else 3
    S = casadi.MX.sym("S", B, n)
    terms = []
    for (i, j), sd in zip(problem.links.tolist(), problem.range_sd, strict=True):
        distance = casadi.norm_2(S[:3, i] - S[:3, j])
        terms.append((distance + S[3, i] - S[3, j] if clocks else distance) / sd)
    for i in range(n):
        terms.append((-S[2, i] + 0.5e-7 * (S[0, i] ** 2 + S[1, i] ** 2)) / 7.0)
        if problem.anchor[i] and anchor_sd > 0:
            terms += [S[a, i] / anchor_sd for a in range(3)]
            terms += [1e3 * S[3, i]] if clocks else []
    jacobian = casadi.Function("J", [S], [casadi.jacobian(casadi.vertcat(*terms), casadi.vec(S))])
    state = np.zeros((B, n))
    state[:3] = x.T
    J = np.array(jacobian(state))
    if anchor_sd == 0:
        J = J[:, 4 * B :]
    np.testing.assert_allclose(fisher_information(problem, x)[0], J.T @ J, rtol=1e-9, atol=1e-15)


def test_bound_is_the_scatter_of_least_squares():
    # 300 draws: a variance has a relative standard deviation of sqrt(2 / 300) = 8 %, the mean of 12 less.
    rng = np.random.default_rng(1)
    problem, x = network(rng)
    i, j = problem.links.T

    def residuals(free, ranges):
        y = x.copy()
        y[4:] = free.reshape(-1, 3)
        return (ranges - np.linalg.norm(y[i] - y[j], axis=1)) / problem.range_sd

    errors = []
    for _ in range(300):
        ranges = problem.ranges + problem.range_sd * rng.standard_normal(len(i))
        errors.append(least_squares(residuals, x[4:].ravel(), args=(ranges,), method="lm").x - x[4:].ravel())
    expected = np.diagonal(cramer_rao(problem, x).cov[4:], axis1=1, axis2=2).ravel()
    ratio = np.mean(np.square(errors), axis=0) / expected
    assert (np.abs(ratio - 1) < 5 * 0.082).all()
    assert ratio.mean() == pytest.approx(1, abs=0.12)


def test_null_space_marks_nodes_that_can_move():
    rng = np.random.default_rng(2)
    problem, x = network(rng, n=9)
    i, j = problem.links.T
    # Node 8 keeps two links, node 7 three, node 6 none.
    keep = (i != 6) & (j != 6) & ~((i == 8) & (j > 1)) & ~((i == 7) & (j > 2))
    cut = RangeProblem(
        problem.links[keep], problem.ranges[keep], problem.range_sd[keep], problem.anchor, problem.anchor_x
    )
    bound = cramer_rao(cut, x)
    np.testing.assert_array_equal(np.flatnonzero(~bound.localizable), [6, 8])
    assert np.isnan(bound.cov[[6, 8]]).all()
    assert (bound.cov[:4] == 0).all()
    # Those two take no part in the rest.
    keep &= (i != 8) & (j != 8)
    without = RangeProblem(
        problem.links[keep], problem.ranges[keep], problem.range_sd[keep], problem.anchor, problem.anchor_x
    )
    np.testing.assert_allclose(cramer_rao(without, x).cov[[4, 5, 7]], bound.cov[[4, 5, 7]], rtol=1e-6)


def test_network_that_turns_about_its_anchors_cannot_be_located():
    problem, x = network(np.random.default_rng(3), n=8, anchors=2)
    assert not cramer_rao(problem, x).localizable[2:].any()
    problem, x = network(np.random.default_rng(3), n=8, anchors=3)
    assert cramer_rao(problem, x).localizable.all()


def test_flipped_is_beyond_noise():
    problem, x = network(np.random.default_rng(4))
    bound = cramer_rao(problem, x)
    estimate = x.copy()
    step = np.linalg.cholesky(bound.cov[4]) @ [0.0, 0.0, 1.0]
    # Chi-square of three degrees of freedom exceeds 30.7 once in a million.
    estimate[4] += 5.4 * step
    estimate[5] += 5.7 * np.linalg.cholesky(bound.cov[5]) @ [0.0, 0.0, 1.0]
    estimate[6] = np.nan
    np.testing.assert_array_equal(np.flatnonzero(flipped(estimate, x, bound.cov)), [5])

"""The fading filter of Wan et al. and its two networks: equations, twins, forms that fail, 2,000 nodes."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import nees
from fleetalign.network.localization import distributed_ekf
from fleetalign.network.localization.bound import cramer_rao
from fleetalign.network.localization.central_ekf import fig_2_derivatives, refine_central
from fleetalign.network.localization.distributed_ekf import refine_distributed
from fleetalign.network.localization.dv_distance import path_lateration
from fleetalign.network.localization.fading_ekf import PUBLISHED, FadingEkf, initial, step, stopped
from fleetalign.network.localization.plane import in_plane
from fleetalign.network.localization.plane_chain import certain, locate_in_plane
from fleetalign.network.localization.plane_network import check_plane_network, plane_network
from fleetalign.network.localization.problem import LocalizationError
from fleetalign.network.localization.spherical import neighbors
from scipy.spatial import KDTree


def network(seed, nodes=120, radius_m=20.0, side_m=100.0, share=0.2, sd_m=0.5):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, side_m, (nodes, 2))
    links = KDTree(x).query_pairs(radius_m, output_type="ndarray").astype(np.int64)
    ranges = np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1) + sd_m * rng.standard_normal(len(links))
    anchor = np.arange(nodes) < share * nodes
    return x, in_plane(links, np.maximum(ranges, 0.01), np.full(len(links), sd_m), anchor, x)


def test_one_step_is_the_printed_equations():
    """By scalar loops, for two filters of three ranges, the second step after the first."""
    rng = np.random.default_rng(1)
    settings = FadingEkf(max_fading=1e300, noise="sage_husa", sage_forgetting=0.9, range_sd_m=0.3)
    x, heard = rng.normal(size=(2, 2)), np.ones((2, 3), bool)
    H, v = rng.normal(size=(2, 2, 3, 2)), 5 * rng.normal(size=(2, 2, 3))
    f = initial(x, 3, settings)
    for k in range(2):
        f = step(f, v[k], H[k], settings, heard)
    for i in range(2):
        P, Q, R, lam, at = 25 * np.eye(2), 0.01 * np.eye(2), 0.09 * np.eye(3), 1.0, x[i]
        for k in range(2):
            h, e = H[k, i], v[k, i]
            C = np.outer(e, e) * (0.5 if k == 0 else lam / (1 + lam))
            lam = max(1.0, np.trace(C - h @ Q @ h.T - R) / np.trace(h @ P @ h.T))
            before, P = P, lam * P + Q
            K = P @ h.T @ np.linalg.inv(h @ P @ h.T + R)
            at, after = at + K @ e, (np.eye(2) - K @ h) @ P
            d = (1 - 0.9) / (1 - 0.9 ** (k + 2))
            R = (1 - d) * R + d * (np.outer(e, e) - h @ P @ h.T)
            Q = (1 - d) * Q + d * (np.outer(K @ e, K @ e) + after - before)
            P = after
        np.testing.assert_allclose(f.x[i], at, rtol=1e-9)
        np.testing.assert_allclose(f.P[i], P, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(f.R[i], R, rtol=1e-9)
        np.testing.assert_allclose(f.Q[i], Q, rtol=1e-7, atol=1e-10)
        assert f.fading[i] == pytest.approx(lam)


@pytest.mark.parametrize("noise", ["positive", "fixed"])
def test_compiled_sweep_is_the_step_of_matrices(noise):
    x, problem = network(2)
    start = np.where(problem.anchor[:, None], x, x + np.random.default_rng(0).normal(0, 5, x.shape))
    settings = FadingEkf(noise=noise, max_steps=7, range_sd_m=0.5, initial_sd_m=5.0)
    swept = refine_distributed(problem, start, settings)
    net = plane_network(problem, start)
    arguments = net.part, net.free, neighbors(problem), settings
    twin = distributed_ekf._by_matrices(problem, net.x.copy(), *arguments)
    np.testing.assert_allclose(swept.x, twin.x, rtol=0, atol=1e-8)
    np.testing.assert_allclose(swept.P, twin.P, rtol=1e-7, atol=1e-10)


def test_sparse_and_dense_central_forms_are_one_filter():
    x, problem = network(3)
    start = x + np.random.default_rng(0).normal(0, 3, x.shape)
    settings = FadingEkf(noise="fixed", max_fading=1.0, process_sd_m=0.0, max_steps=5, range_sd_m=0.5)
    sparse, dense = (refine_central(problem, start, settings, dense=dense) for dense in (False, True))
    np.testing.assert_allclose(sparse.x, dense.x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(sparse.P, dense.P, rtol=1e-6, atol=1e-9)


def test_normal_equations_and_their_inverse_by_dense_matrices():
    x, problem = network(4, nodes=60, radius_m=30.0)
    net = plane_network(problem, x)
    d, H = net.predicted(x)
    w = np.random.default_rng(0).uniform(0.5, 2.0, len(d))
    A = H.toarray().T @ np.diag(w) @ H.toarray() + 0.3 * np.eye(net.unknowns)
    entries = net.entries(H, w, 0.3)
    np.testing.assert_allclose(net.normal(entries).toarray(), A, atol=1e-12)
    np.testing.assert_allclose(net.diagonal(entries), np.diag(A), atol=1e-12)
    k = net.unknowns // 2
    blocks = np.linalg.inv(A).reshape(k, 2, k, 2)[np.arange(k), :, np.arange(k), :]
    factor = net.factorized(entries)
    np.testing.assert_allclose(factor.own_blocks(), blocks, atol=1e-10)
    np.testing.assert_allclose(A @ factor.solve(d @ H), d @ H, atol=1e-9)
    bumped = net.moved(x, 1e-6 * np.eye(net.unknowns)[7])
    np.testing.assert_allclose((net.predicted(bumped)[0] - d) / 1e-6, H.toarray()[:, 7], atol=1e-5)


def test_rows_4_and_5_of_the_printed_derivatives_stand_in_the_wrong_columns():
    nodes = np.array([[0.0, 9.0], [1.0, 1.0], [4.0, 6.0], [9.0, 8.0], [8.0, 2.0]])
    d, H = fig_2_derivatives(nodes)
    for column in range(4):
        moved = nodes.copy()
        moved[2 + column // 2, column % 2] += 1e-6
        np.testing.assert_allclose((fig_2_derivatives(moved)[0] - d) / 1e-6, H[:, column], atol=1e-5)
    _, printed = fig_2_derivatives(nodes, "printed")
    np.testing.assert_array_equal(printed[:3], H[:3])
    np.testing.assert_array_equal(printed[3:], H[3:][:, [2, 3, 0, 1]])


def test_the_fading_factor_needs_a_limit_where_neighbours_are_taken_for_beacons():
    x, problem = network(5, radius_m=14.0)
    start = path_lateration(problem)
    rest = {"noise": "fixed", "neighbor_covariance": False, "range_sd_m": 0.5, "max_steps": 40}
    error = {}
    for limit in (2.0, 1e4):
        found = refine_distributed(problem, start, FadingEkf(max_fading=limit, **rest))
        error[limit] = np.nanmean(np.linalg.norm(found.x - x, axis=1)[~problem.anchor])
    assert error[2.0] < np.nanmean(np.linalg.norm(start - x, axis=1)[~problem.anchor])
    assert error[1e4] > 10 * error[2.0]


def test_the_published_form_loses_its_covariance_and_the_mended_one_keeps_it():
    _, problem = network(6, radius_m=15.0)
    start = path_lateration(problem)
    printed = refine_distributed(problem, start, replace_stop(PUBLISHED))
    mended = refine_distributed(problem, start, FadingEkf(range_sd_m=0.5))
    held = ~problem.anchor & np.isfinite(mended.x[:, 0])
    assert printed.diverged.any() or np.linalg.eigvalsh(printed.P[held]).min() < 0
    assert np.linalg.eigvalsh(mended.P[held]).min() > 0
    assert not mended.diverged.any()


def replace_stop(settings):
    """The printed filter, let run on by the mended stop rule."""
    return settings.model_copy(update={"stop": "step", "max_steps": 20})


def test_the_printed_stop_rule_stops_at_a_step_towards_the_origin():
    before = np.array([[30.0, 40.0], [10.0, 0.0]])
    printed, mended = FadingEkf(stop="norms"), FadingEkf(stop="step")
    assert stopped(0.9 * before, before, printed)
    assert not stopped(0.9 * before, before, mended)
    assert not stopped(1.1 * before, before, printed)
    assert stopped(before + 1e-3, before, mended)


def test_the_plane_chain_reaches_the_bound_with_a_covariance_that_is_true():
    """Networks of 18 neighbours a node, rigid but for single nodes that the verdict leaves out."""
    squares, errors, told = [], [], []
    for seed in range(20):
        x, problem = network(seed, radius_m=24.0)
        found = locate_in_plane(problem)
        bound = cramer_rao(problem, np.column_stack([x, np.zeros(len(x))]))
        good = bound.localizable & ~problem.anchor & certain(problem, found.x)
        error = (found.x - x)[good]
        told.append(good.sum() / 96)
        squares.append([np.sum(error**2), np.sum(bound.sd[good] ** 2)])
        errors.append(nees(error, found.cov[good]).mean())
    total = np.sum(squares, axis=0)
    # The squares of some 3,800 components, of which the weakest weigh most.
    assert np.sqrt(total[0] / total[1]) < 1.05
    assert np.mean(told) > 0.97
    # Nodes of a network share errors: four standard errors of the mean over draws.
    assert np.mean(errors) == pytest.approx(2.0, abs=4 * np.std(errors) / np.sqrt(20))
    assert np.std(errors) < 0.3


def test_a_node_that_fits_in_two_places_is_not_called_certain():
    x, problem = network(8, nodes=40, radius_m=45.0, sd_m=0.1)
    node = 25
    # Two anchors are a line: their node fits as well on its other side.
    pair = replace(
        problem,
        links=np.array([[node, 0], [node, 1]]),
        ranges=np.linalg.norm(x[node] - x[:2], axis=1),
        range_sd=np.full(2, 0.1),
    )
    assert not certain(pair, x)[node]
    assert certain(problem, x).all()


@pytest.mark.parametrize("form", ["central", "distributed"])
def test_2000_nodes_are_refined(form):
    x, problem = network(7, nodes=2000, radius_m=20.0, side_m=420.0, share=0.1)
    start = path_lateration(problem)
    settings = FadingEkf(noise="fixed", range_sd_m=0.5, initial_sd_m=5.0)
    found = (refine_central if form == "central" else refine_distributed)(problem, start, settings)
    known = ~problem.anchor & np.isfinite(start[:, 0])
    before, after = (np.linalg.norm(y - x, axis=1)[known] for y in (start, found.x))
    assert known.sum() > 1700
    assert np.median(after) < 0.35 * np.median(before)


def test_path_lateration_of_nodes_that_hear_their_beacons():
    x, problem = network(8, nodes=30, radius_m=200.0, sd_m=1e-6)
    for options in ({}, {"nearest": None}, {"linear": True}):
        np.testing.assert_allclose(path_lateration(problem, **options), x, atol=0.05)


def test_nodes_without_a_way_to_three_beacons_have_no_start_and_no_estimate():
    _, problem = network(9)
    alone = 100
    kept = ~(problem.links == alone).any(axis=1)
    cut = replace(
        problem, links=problem.links[kept], ranges=problem.ranges[kept], range_sd=problem.range_sd[kept]
    )
    start = path_lateration(cut)
    assert np.isnan(start[alone]).all()
    for found in (refine_distributed(cut, start), refine_central(cut, start)):
        assert np.flatnonzero(np.isnan(found.x[:, 0])).tolist() == [alone]
    with pytest.raises(LocalizationError, match=r"part of 1 nodes \(100\) has 0 beacons: at least 3"):
        check_plane_network(cut)


def test_networks_that_cannot_be_located_are_refused_in_one_line():
    x, problem = network(10)
    with pytest.raises(LocalizationError, match=r"range 3 = 0 m: must be positive"):
        check_plane_network(replace(problem, ranges=np.where(np.arange(len(problem.ranges)) == 3, 0.0, 5.0)))
    two = np.arange(len(x)) < 2
    with pytest.raises(LocalizationError, match="2 anchors: at least 3"):
        check_plane_network(replace(problem, anchor=two))
    line = np.where(problem.anchor[:, None], [[1.0, 2.0, 0.0]] * np.arange(len(x))[:, None], 0.0)
    with pytest.raises(LocalizationError, match="anchors lie on a line"):
        check_plane_network(replace(problem, anchor_x=line))
    with pytest.raises(LocalizationError, match="x0 must have shape"):
        refine_distributed(problem, x[:5])

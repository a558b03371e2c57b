"""The fleet's least squares: derivatives, factors, one epoch against scipy, and epochs in a row."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.network.localization import _cholesky, _dense, _tracking, tracking
from fleetalign.network.localization.chain import LocalizationSettings
from fleetalign.network.localization.least_squares import Loss, refine
from fleetalign.network.localization.problem import LocalizationError, NodeOutcome, RangeProblem
from fleetalign.network.localization.tracking import Epochs, Tracker
from fleetalign.network.observations import node_pairs
from scipy.optimize import approx_fprime, least_squares

N, ANCHORS = 16, 7


def fleet(rng, n=N):
    """Positions, velocities and anchors of a small fleet; node 0 is no anchor."""
    x = rng.uniform([-5e3, -5e3, -3e3], [5e3, 5e3, 0], (n, 3))
    v = np.array([140.0, 140.0, 0.0]) + rng.uniform(-30, 30, (n, 3))
    return x, v, np.arange(n) >= n - ANCHORS


def distances(x, pairs):
    return np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)


def distance_rates(x, v, pairs):
    d, w = x[pairs[:, 0]] - x[pairs[:, 1]], v[pairs[:, 0]] - v[pairs[:, 1]]
    return np.sum(d * w, axis=1) / np.linalg.norm(d, axis=1)


def terms_for(rng, clocks, rates, loss=_dense.SQUARED):
    """Terms of all kinds about a fleet, its state, and the places of its nodes among the unknowns."""
    x, v, anchor = fleet(rng)
    pairs = node_pairs(N)
    B = (3 + clocks) * (1 + rates)
    S = np.zeros((N, B))
    S[:, :3] = x + rng.normal(0, 30, x.shape)
    if rates:
        S[:, 3 + clocks : 6 + clocks] = v + rng.normal(0, 1, v.shape)
    m = len(pairs)
    terms = _dense.Terms(
        links=pairs,
        ranges=distances(x, pairs) + rng.normal(0, 50, m),
        w_range=np.where(rng.random(m) < 0.9, 1 / 50**2, 0.0),
        rates=distance_rates(x, v, pairs) if rates else np.empty(0),
        w_rate=np.full(m if rates else 0, 1 / 0.3**2),
        loss=loss,
        threshold=0.5,
        clocks=clocks,
        prior=S + rng.normal(0, 1, S.shape),
        w_prior=np.where(anchor[:, None], 0.25, 0.0) * np.ones((N, B)),
        height=-x[:, 2] + rng.normal(0, 10, N),
        w_height=np.where(np.arange(N) % 2, 1e-2, 0.0),
        curvature=1.5e-7,
    )
    return S, np.arange(N), terms


@pytest.mark.parametrize("loss", [_dense.SQUARED, _dense.HUBER, _dense.ONE_SIDED])
@pytest.mark.parametrize(("clocks", "rates"), [(False, False), (True, False), (False, True), (True, True)])
def test_gradient_is_that_of_the_cost(clocks, rates, loss):
    S, place, terms = terms_for(np.random.default_rng(1), clocks, rates, loss)
    g, none = np.empty(S.size), np.empty((0, 0))
    scratch = np.empty(S.size)

    def cost(state):
        return _dense.evaluate(state.reshape(S.shape), place, terms, none, scratch)

    _dense.evaluate(S, place, terms, none, g)
    numerical = -approx_fprime(S.ravel(), cost, 1e-4)
    # Forward differences of 1e-4 m err by half of that times the curvature.
    np.testing.assert_allclose(g, numerical, rtol=1e-3, atol=2e-3 * np.abs(numerical).max())


def test_normal_equations_are_the_curvature_where_residuals_vanish():
    rng = np.random.default_rng(2)
    S, place, terms = terms_for(rng, clocks=False, rates=True)
    x, v = S[:, :3], S[:, 3:]
    terms = terms._replace(
        ranges=distances(x, terms.links),
        rates=distance_rates(x, v, terms.links),
        prior=S,
        height=-x[:, 2] + 0.5 * terms.curvature * (x[:, 0] ** 2 + x[:, 1] ** 2),
    )
    A, g = np.empty((S.size, S.size)), np.empty(S.size)
    _dense.evaluate(S, place, terms, A, g)
    A = np.triu(A) + np.triu(A, 1).T
    none, up, down = np.empty((0, 0)), np.empty(S.size), np.empty(S.size)
    for k in rng.choice(S.size, 12, replace=False):
        step = np.zeros(S.size)
        step[k] = 1e-2
        _dense.evaluate(S + step.reshape(S.shape), place, terms, none, up)
        _dense.evaluate(S - step.reshape(S.shape), place, terms, none, down)
        np.testing.assert_allclose((down - up) / 2e-2, A[k], rtol=1e-4, atol=1e-6 * A[k, k])


@pytest.mark.parametrize("size", [1, 4, 7, 60])
def test_factors_and_inverse_blocks(size):
    rng = np.random.default_rng(size)
    M = rng.standard_normal((size, size))
    A = M @ M.T + size * np.eye(size)
    U = A.copy()
    assert _cholesky.factorize(U)
    np.testing.assert_allclose(np.triu(U), np.linalg.cholesky(A).T, rtol=1e-12, atol=1e-12)
    b = rng.standard_normal(size)
    x = b.copy()
    _cholesky.substitute(U, x)
    np.testing.assert_allclose(A @ x, b, atol=1e-10)
    B = 1 if size % 3 else 3
    blocks = np.empty((size // B, B, B))
    _cholesky.covariance_blocks(U, blocks)
    inverse = np.linalg.inv(A)
    for p, block in enumerate(blocks):
        np.testing.assert_allclose(block, inverse[p * B : p * B + B, p * B : p * B + B], atol=1e-12)
    assert not _cholesky.factorize(A - 10 * size * np.eye(size))


def ranging(rng, sd=50.0):
    x, _, anchor = fleet(rng)
    pairs = node_pairs(N)
    ranges = distances(x, pairs) + rng.normal(0, sd, len(pairs))
    return x, RangeProblem(pairs, ranges, np.full(len(pairs), sd), anchor, x, anchor_sd=2.0)


def test_refined_positions_are_scipys():
    rng = np.random.default_rng(3)
    x, problem = ranging(rng)

    def residuals(flat):
        z = flat.reshape(N, 3)
        anchors = (z - problem.anchor_x)[problem.anchor] / problem.anchor_sd
        return np.concatenate(
            [(problem.ranges - distances(z, problem.links)) / problem.range_sd, anchors.ravel()]
        )

    peer = least_squares(residuals, x.ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    ours = refine(problem, x + rng.normal(0, 300, x.shape), tolerance=1e-8)
    assert ours.converged
    assert ours.cost == pytest.approx(peer.cost, rel=1e-10)
    np.testing.assert_allclose(ours.x, peer.x.reshape(N, 3), atol=1e-4)
    cov = np.linalg.inv(peer.jac.T @ peer.jac)
    blocks = np.stack([cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(N)])
    np.testing.assert_allclose(ours.cov, blocks, rtol=1e-3, atol=1e-3)


def test_one_sided_loss_bears_detours():
    errors = {"squared": [], "one_sided": []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, problem = ranging(rng, sd=10.0)
        problem.ranges[rng.random(len(problem.ranges)) < 0.1] += 300.0
        for kind, of_kind in errors.items():
            error = (refine(problem, x, Loss(kind=kind, threshold=2.0)).x - x)[~problem.anchor]
            of_kind.append(np.sqrt(np.mean(error**2)))
    assert np.mean(errors["one_sided"]) < 0.6 * np.mean(errors["squared"])


def test_nodes_at_one_place_give_a_finite_result():
    rng = np.random.default_rng(4)
    x, problem = ranging(rng)
    x[1] = x[2]
    i = np.flatnonzero((problem.links == [2, 1]).all(axis=1))
    problem.ranges[:] = distances(x, problem.links)
    problem.ranges[i] = -3.0
    solution = refine(problem, x)
    assert np.isfinite(solution.x).all()
    assert np.isfinite(solution.cov).all()
    assert np.abs(solution.x - x).max() < 10


def test_problem_names_what_is_wrong():
    _, good = ranging(np.random.default_rng(5))
    fields = dict(vars(good))
    for changes, words in (
        ({"anchor": np.zeros(N, bool)}, "no anchors"),
        ({"links": good.links * 0}, "join two nodes"),
        ({"links": good.links + 5}, "join nodes 0 to 15"),
        ({"ranges": good.ranges * np.nan}, "ranges must be finite"),
        ({"range_sd": good.range_sd * 0}, "positive"),
        ({"ranges": good.ranges[1:]}, "shape"),
        ({"anchor_x": good.anchor_x * np.inf}, "anchors must be finite"),
    ):
        with pytest.raises(LocalizationError, match=words):
            RangeProblem(**{**fields, **changes})


SD = 50.0, 0.03


def epochs(rng, k, heard=None, n=N, rate_hz=10.0, moving=True, level=()):
    """A fleet in constant motion in the frame of its mean velocity, as it measures itself; and its truth.

    Nodes ``level`` stand and stay at one height.
    """
    x0, v, anchor = fleet(rng, n)
    if level:
        x0[list(level), 2], v[list(level), 2] = -1500.0, v[:, 2].mean()
    t = np.arange(k) / rate_hz
    x = x0 + (v - v.mean(axis=0)) * t[:, None, None] * moving
    pairs = node_pairs(n)
    ranges = np.stack([distances(row, pairs) for row in x])
    rates = np.stack([distance_rates(row, v, pairs) for row in x])
    m = len(pairs)
    seen = Epochs(
        t=t,
        pairs=pairs,
        ranges=ranges + rng.normal(0, SD[0], (k, m)),
        range_sd=np.full((k, m), SD[0]),
        rates=rates + rng.normal(0, SD[1], (k, m)),
        rate_sd=SD[1],
        heard=np.ones((k, m), bool) if heard is None else heard(t, pairs),
        belief_x=x,
        belief_v=np.tile(v, (k, 1, 1)),
        height=None,
        curvature=0.0,
    )
    return seen, x, v, anchor


def part(seen, rows):
    """Some of the epochs."""
    fields = {
        name: value[rows]
        for name, value in vars(seen).items()
        if isinstance(value, np.ndarray) and name != "pairs"
    }
    return replace(seen, **fields)


def test_an_epoch_is_the_joint_maximum_likelihood_estimate():
    rng = np.random.default_rng(6)
    seen, x, v, anchor = epochs(rng, 3)
    tracker = Tracker(anchor, LocalizationSettings(loss="squared"), 1.0, 0.01)
    track = tracker.advance(seen)

    def residuals(flat, k):
        z, w = flat.reshape(2, N, 3)
        return np.concatenate(
            [
                (seen.ranges[k] - distances(z, seen.pairs)) / SD[0],
                (seen.rates[k] - distance_rates(z, w, seen.pairs)) / SD[1],
                (z - x[k])[anchor].ravel() / 1.0,
                (w - v)[anchor].ravel() / 0.01,
            ]
        )

    for k in range(3):
        start = np.concatenate([x[k].ravel(), v.ravel()])
        peer = least_squares(residuals, start, args=(k,), x_scale="jac", xtol=1e-8, ftol=1e-8)
        z, w = peer.x.reshape(2, N, 3)
        cov = np.linalg.inv(peer.jac.T @ peer.jac)
        own = np.r_[0:3, 3 * N : 3 * N + 3]
        sd = np.sqrt(np.diag(cov))[own]
        # The search ends within a small part of a standard deviation.
        assert (np.abs(track.x[k, 0] - z[0]) < 0.05 * sd[:3]).all()
        assert (np.abs(track.v[k, 0] - w[0]) < 0.05 * sd[3:]).all()
        np.testing.assert_allclose(np.sqrt(np.diag(track.own_cov[k])), sd, rtol=0.05)
    assert (track.outcome[:, ~anchor] == NodeOutcome.LOCATED).all()


def test_errors_are_as_the_covariance_says_and_white():
    squares, products = [], []
    for seed in range(12):
        seen, x, v, anchor = epochs(np.random.default_rng(seed), 40)
        track = Tracker(anchor, LocalizationSettings(), 1e-2, 1e-4).advance(seen)
        error = np.concatenate([track.x[:, 0] - x[:, 0], track.v[:, 0] - v[0]], axis=1)
        root = np.linalg.inv(np.linalg.cholesky(track.own_cov))
        normal = np.einsum("kij,kj->ki", root, error)
        squares.append(np.mean(normal**2))
        products.append(np.mean(normal[1:] * normal[:-1]))
    # 2,880 normal numbers: their mean square is 1 to 0.026, their lag-one product 0 to 0.019 (one sigma).
    assert np.mean(squares) == pytest.approx(1.0, abs=0.09)
    assert np.mean(products) == pytest.approx(0.0, abs=0.06)


def test_cuts_into_calls_do_not_matter():
    seen, _, _, anchor = epochs(np.random.default_rng(8), 20)

    whole = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    tracker = Tracker(anchor, LocalizationSettings(), 1.0, 0.01)
    parts = [tracker.advance(part(seen, rows)) for rows in (slice(0, 7), slice(7, 20))]
    # A new call starts its velocities' trend anew: the searches end at other points within the tolerance.
    sd = np.sqrt(np.einsum("kii->ki", whole.own_cov))
    difference = np.concatenate([p.x[:, 0] for p in parts]) - whole.x[:, 0]
    assert (np.abs(difference) < 0.05 * sd[:, :3]).all()


def test_a_silent_node_has_no_estimate_and_comes_back():
    def heard(t, pairs):
        silent = (t >= 2) & (t < 9)
        return ~(silent[:, None] & (pairs == 0).any(axis=1))

    seen, x, _, anchor = epochs(np.random.default_rng(9), 200, heard)
    tracker = Tracker(anchor, LocalizationSettings(), 1.0, 0.01)
    located = np.zeros(200, bool)
    for first in range(0, 200, 50):
        rows = slice(first, first + 50)
        track = tracker.advance(part(seen, rows))
        located[rows] = track.outcome[:, 0] == NodeOutcome.LOCATED
        error = np.linalg.norm(track.x[:, 0] - x[rows, 0], axis=1)
        assert (np.isnan(error) | (error < 6 * SD[0])).all()
        silent = (seen.t[rows] >= 2) & (seen.t[rows] < 9)
        assert np.isnan(error[silent]).all()
        assert np.isin(track.outcome[silent, 0], [NodeOutcome.TOO_FEW_NEIGHBOURS]).all()
    assert located[:20].all()
    assert located[150:].all()


def test_noise_that_leaves_a_position_too_uncertain_is_no_fix():
    seen, _, _, anchor = epochs(np.random.default_rng(11), 20)
    seen.range_sd[10:] *= 20  # The same measurements, trusted less.
    seen = replace(seen, rate_sd=30.0)
    track = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    assert (track.outcome[:10, 0] == NodeOutcome.LOCATED).all()
    assert (track.outcome[10:, 0] == NodeOutcome.SINGULAR).all()
    assert np.isnan(track.x[10:, 0]).all()
    assert np.isnan(track.own_cov[10:]).all()
    patient = LocalizationSettings(max_position_sd_m=5000.0)
    track = Tracker(anchor, patient, 1.0, 0.01).advance(seen)
    spread = np.sqrt(np.einsum("kii->k", track.own_cov[10:, :3, :3]))
    assert (track.outcome[:, 0] == NodeOutcome.LOCATED).all()
    assert ((spread > LocalizationSettings().max_position_sd_m) & (spread < 5000)).all()


def test_a_node_with_a_mirror_image_waits_until_it_hears_more():
    """The own ship hears four anchors at one height, and from 1.5 s on all nodes."""
    flat = (9, 11, 13, 15)

    def heard(t, pairs):
        apart = (pairs == 0).any(axis=1) & ~np.isin(pairs, flat).any(axis=1)
        return ~((t < 1.5)[:, None] & apart)

    seen, x, _, anchor = epochs(np.random.default_rng(14), 40, heard, level=flat)
    tracker = Tracker(anchor, LocalizationSettings(), 1.0, 0.01)
    outcomes = []
    for first in range(0, 40, 10):
        track = tracker.advance(part(seen, slice(first, first + 10)))
        outcomes += list(track.outcome[:, 0])
        others = track.outcome[:, 1 : N - ANCHORS]
        assert (others == NodeOutcome.LOCATED).all()
        assert np.isfinite(track.x[:, 0]).all() == (first == 30)
    # It is tried at 0 s and at 1 s, and not at 2 s: each wait is twice the one before.
    assert set(outcomes[:10]) == {NodeOutcome.AMBIGUOUS}
    assert set(outcomes[10:30]) <= {NodeOutcome.AMBIGUOUS, NodeOutcome.SINGULAR}
    assert set(outcomes[30:]) == {NodeOutcome.LOCATED}
    assert np.linalg.norm(track.x[:, 0] - x[30:, 0], axis=1).max() < 6 * SD[0]


def test_a_search_that_ends_before_it_has_settled_is_no_fix(monkeypatch):
    seen, x, v, anchor = epochs(np.random.default_rng(13), 12)
    away = x[10:].copy()
    away[:, 0] += [2000.0, -1000.0, 1500.0]
    for k in range(2):
        seen.ranges[10 + k] = distances(away[k], seen.pairs)
        seen.rates[10 + k] = distance_rates(away[k], v, seen.pairs)
    found = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    assert (found.outcome[:, 0] == NodeOutcome.LOCATED).all()
    np.testing.assert_allclose(found.x[10:, 0], away[:, 0], atol=1.0)
    monkeypatch.setattr(tracking, "_ITERATIONS", 1)
    track = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    assert (track.outcome[:10, 0] == NodeOutcome.LOCATED).all()
    assert track.outcome[10, 0] == NodeOutcome.NOT_CONVERGED
    assert np.isnan(track.x[10, 0]).all()
    assert np.isnan(track.own_cov[10]).all()
    # It goes on from where it was.
    assert track.outcome[11, 0] in (NodeOutcome.NOT_CONVERGED, NodeOutcome.LOCATED)


def test_one_range_however_long_is_no_contradiction():
    """`_MOST_MISFIT`: it counts as three standard deviations, and many together count as a contradiction."""
    seen, x, _, anchor = epochs(np.random.default_rng(12), 20)
    mine = np.flatnonzero((seen.pairs == 0).any(axis=1))
    seen.ranges[:, mine[3]] += 5000.0
    track = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    assert (track.outcome[:, : N - ANCHORS] == NodeOutcome.LOCATED).all()
    assert np.linalg.norm(track.x[:, 0] - x[:, 0], axis=1).max() < 6 * SD[0]

    # From the second second on half of them are too short: no state fits.
    seen.ranges[10:, mine[::2]] -= 2000.0
    track = Tracker(anchor, LocalizationSettings(), 1.0, 0.01).advance(seen)
    assert (track.outcome[:10, 0] == NodeOutcome.LOCATED).all()
    assert set(track.outcome[10:, 0]) <= {NodeOutcome.INCONSISTENT, NodeOutcome.NOT_CONVERGED}
    assert (track.outcome[10:, 0] == NodeOutcome.INCONSISTENT).any()


@pytest.mark.parametrize(("clocks", "rates"), [(False, True), (True, True)])
def test_misfit_is_the_sum_of_squares_with_long_ranges_cut(clocks, rates):
    S, _, terms = terms_for(np.random.default_rng(15), clocks, rates)
    terms.ranges[7] += 10_000.0
    terms.w_rate[::3] = 0.0
    misfit, residuals, neighbours = np.empty(N), np.empty(N, np.int64), np.empty(N, np.int64)
    _tracking._misfits(S, terms, misfit, residuals, neighbours)
    x, v, (i, j) = S[:, :3], S[:, 3 + clocks : 6 + clocks], terms.links.T
    offset = S[i, 3] - S[j, 3] if clocks else 0.0
    drift = S[i, 7] - S[j, 7] if clocks else 0.0
    by_range = terms.w_range * (terms.ranges - distances(x, terms.links) - offset) ** 2
    by_rate = terms.w_rate * (terms.rates - distance_rates(x, v, terms.links) - drift) ** 2
    heard = terms.w_range > 0
    size = np.where(heard, np.minimum(by_range, 9.0) + by_rate, 0.0)
    count = np.where(heard, 1 + (terms.w_rate > 0), 0)
    for told, link in ((misfit, size), (residuals, count), (neighbours, heard)):
        both = np.bincount(i, link, N) + np.bincount(j, link, N)
        np.testing.assert_allclose(told, both, rtol=1e-9)


@pytest.mark.parametrize("B", [6, 8])
def test_prediction_keeps_accelerations_in_the_frame_of_the_fleet(B):
    rng = np.random.default_rng(16)
    S, last = rng.normal(0, 100, (2, N, B))
    place = np.arange(N)
    place[[2, 9]] = -1
    on, V, dt = place >= 0, 4 if B == 8 else 3, 0.1
    v, before = S[:, V : V + 3], last[:, V : V + 3]
    expected, was = S.copy(), last.copy()
    expected[on, :3] += (v - v[on].mean(axis=0))[on] * dt
    expected[on, V : V + 3] += (v - before)[on]
    if B == 8:
        expected[on, 3] += S[on, 7] * dt
    was[:, V : V + 3] = v
    _tracking._predict(S, last, place, dt, V)
    np.testing.assert_allclose(S, expected, atol=1e-11)
    np.testing.assert_allclose(last, was)

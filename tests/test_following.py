"""Nodes followed from epoch to epoch: against a joint solution, its covariance, gaps, and in the network."""

from functools import partial

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band, nees
from fleetalign.cosim.run import generator
from fleetalign.network.fleet import CentrePath
from fleetalign.network.fleet_network import FleetNetwork, fly_network
from fleetalign.network.localization import _cholesky, _tracking
from fleetalign.network.localization.chain import LocalizationSettings
from fleetalign.network.localization.epochs import Track
from fleetalign.network.localization.following import Follower
from fleetalign.network.localization.problem import NodeOutcome
from fleetalign.network.localization.tracking import RESTART_S
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

DT, ACCELERATION = 0.2, 3.0
KALMAN = LocalizationSettings.model_validate(
    {"tracker": "kalman", "maneuver_acceleration_mps2": ACCELERATION}
)


class Scene:
    """n nodes that accelerate at random over k epochs, seen with white errors and a constant one, in frames
    that move and turn. The first epoch's covariances hold for all."""

    def __init__(self, rng, k, n):
        a = ACCELERATION * rng.standard_normal((k, n, 3))
        x, v = np.empty((k, n, 3)), np.empty((k, n, 3))
        x[0], v[0] = 1e3 * rng.standard_normal((n, 3)), 50 * rng.standard_normal((n, 3))
        for i in range(1, k):
            x[i], v[i] = x[i - 1] + DT * v[i - 1] + DT**2 / 2 * a[i], v[i - 1] + DT * a[i]
        self.t = DT * np.arange(k)
        self.C_en = Rotation.from_rotvec(np.outer(self.t, [1e-2, -2e-2, 5e-3])).as_matrix()
        self.centre_e = np.outer(self.t, [200.0, -30.0, 10.0])
        sd = np.array([5.0, 5.0, 8.0, 0.3, 0.3, 0.5])
        root = np.tile(np.diag(sd), (n, 1, 1)) + 0.1 * sd[:, None] * rng.standard_normal((n, 6, 6))
        self.noise = root @ np.swapaxes(root, 1, 2)
        self.shared = np.tile(np.diag([1.0, 1.0, 1.5, 0, 0, 0]) ** 2, (n, 1, 1))
        self.truth_e = np.concatenate([x, v], axis=-1)
        self.truth = np.concatenate([(x - self.centre_e[:, None]) @ self.C_en, v @ self.C_en], axis=-1)
        errors = (root @ rng.standard_normal((k, n, 6, 1)))[..., 0]
        # The constant error is one of place: it turns with no frame.
        constant = np.sqrt(self.shared[0].diagonal()[:3]) * rng.standard_normal((n, 3))
        self.z = self.truth + errors
        self.z[..., :3] += constant @ self.C_en
        self.outcome = np.full((k, n), int(NodeOutcome.LOCATED))

    def track(self, rows=slice(None), shared=True):
        located = (self.outcome == NodeOutcome.LOCATED)[rows, :, None]
        z = np.where(located, self.z[rows], np.nan)
        part = self.shared if shared else 0 * self.shared
        cov = self.noise + part
        own = np.tile(cov[0], (len(z), 1, 1))
        sd = np.sqrt(np.einsum("nii->ni", cov))
        return Track(z[..., :3], z[..., 3:], own, sd, self.outcome[rows], cov, part)

    def frames(self, rows=slice(None)):
        return self.t[rows], self.centre_e[rows], self.C_en[rows]


def test_the_followed_state_is_that_of_all_epochs_solved_at_once():
    scene = Scene(np.random.default_rng(1), 7, 2)
    found = Follower(KALMAN).advance(scene.track(shared=False), *scene.frames())
    # All states as unknowns, in axes that stay: information of fixes and of the steps between them.
    F = np.kron([[1.0, DT], [0.0, 1.0]], np.eye(3))
    G = np.vstack([DT**2 / 2 * np.eye(3), DT * np.eye(3)])
    W = ACCELERATION**2 * G @ G.T + 1e-8 * np.eye(6)
    J, y = np.zeros((42, 42)), np.zeros(42)
    for k in range(7):
        rows, C = slice(6 * k, 6 * k + 6), np.kron(np.eye(2), scene.C_en[k])
        information = C @ np.linalg.inv(scene.noise[0]) @ C.T
        J[rows, rows] += information
        origin = np.append(scene.centre_e[k], np.zeros(3))
        y[rows] += information @ (C @ scene.z[k, 0] + origin)
        if k:
            A = np.zeros((6, 42))
            A[:, 6 * k - 6 : 6 * k], A[:, rows] = -F, np.eye(6)
            J += A.T @ np.linalg.solve(W, A)
    joint, cov = np.linalg.solve(J, y)[-6:], np.linalg.inv(J)[-6:, -6:]
    back = np.kron(np.eye(2), scene.C_en[-1]).T
    expected = back @ (joint - np.append(scene.centre_e[-1], np.zeros(3)))
    np.testing.assert_allclose(found.x[-1, 0], expected[:3], atol=1e-3)
    np.testing.assert_allclose(found.v[-1, 0], expected[3:], atol=1e-3)
    np.testing.assert_allclose(found.own_cov[-1], back @ cov @ back.T, rtol=1e-3, atol=1e-4)


def test_the_stated_covariance_is_that_of_the_errors_with_what_they_share():
    scene = Scene(np.random.default_rng(2), 60, 300)
    follower = Follower(KALMAN)
    follower.advance(scene.track(slice(0, 59)), *scene.frames(slice(0, 59)))
    last = follower.advance(scene.track(slice(59, 60)), *scene.frames(slice(59, 60)))
    error = np.concatenate([last.x[0], last.v[0]], axis=-1) - scene.truth[-1]
    low, high = mean_band(6, 300, 0.999)
    # Covariances stand in the frame's axes, which turned by a quarter of a radian; those of all are alike.
    stated = np.array([np.diag(s**2) for s in last.sd])
    spread = np.sqrt(np.mean(error**2, axis=0) / np.mean(last.sd**2, axis=0))
    # An RMS of 300 is known to 1 / sqrt(600), 0.04: four of these.
    np.testing.assert_allclose(spread, 1.0, atol=0.17)
    assert np.mean(last.sd[:, :3] ** 2) < 0.2 * np.mean(np.einsum("nii->ni", scene.noise)[:, :3])
    assert nees(error, stated).mean() < 1.3 * high
    assert nees(error, stated).mean() > 0.7 * low


def test_what_is_shared_is_kept_out_of_the_filter_and_added_after_it():
    scene = Scene(np.random.default_rng(6), 8, 2)
    alone, both = (Follower(KALMAN).advance(scene.track(shared=s), *scene.frames()) for s in (False, True))
    np.testing.assert_allclose(both.x, alone.x, atol=1e-9)
    np.testing.assert_allclose(both.own_cov, alone.own_cov + scene.shared[0], atol=1e-9)


def test_own_covariance_is_consistent():
    own = [Scene(np.random.default_rng(100 + run), 25, 1) for run in range(200)]
    values = []
    for scene in own:
        found = Follower(KALMAN).advance(scene.track(), *scene.frames())
        error = np.concatenate([found.x[-1], found.v[-1]], axis=-1) - scene.truth[-1]
        values.append(nees(error[0], found.own_cov[-1]))
    low, high = mean_band(6, 200, 0.999)
    assert low < np.mean(values) < high


def test_a_node_that_is_not_located_is_predicted_for_a_while_and_then_starts_anew():
    rng = np.random.default_rng(3)
    k = int(RESTART_S / DT) + 20
    scene = Scene(rng, k, 3)
    scene.outcome[10:13, 1] = NodeOutcome.TOO_FEW_NEIGHBOURS
    scene.outcome[10 : k - 2, 2] = NodeOutcome.NOT_CONVERGED
    found = Follower(KALMAN).advance(scene.track(), *scene.frames())
    assert np.isnan(found.x[10:13, 1]).all()
    assert np.isfinite(found.x[13:, 1]).all()
    # Carried on over the gap, it is not where the epoch alone puts it; after too long a gap it is.
    assert np.linalg.norm(found.x[13, 1] - scene.z[13, 1, :3]) > 0.1
    np.testing.assert_array_equal(found.x[k - 2, 2], scene.z[k - 2, 2, :3])
    assert np.linalg.norm(found.x[k - 1, 2] - scene.z[k - 1, 2, :3]) > 0.1


def test_cuts_into_calls_do_not_matter():
    scene = Scene(np.random.default_rng(4), 12, 3)
    whole = Follower(KALMAN).advance(scene.track(), *scene.frames())
    follower = Follower(KALMAN)
    parts = [follower.advance(scene.track(rows), *scene.frames(rows)) for rows in (slice(0, 5), slice(5, 12))]
    np.testing.assert_array_equal(np.concatenate([p.x for p in parts]), whole.x)
    np.testing.assert_array_equal(np.concatenate([p.own_cov for p in parts]), whole.own_cov)


def test_the_anchors_part_of_covariances_is_that_of_dense_matrices():
    rng = np.random.default_rng(5)
    n, B = 6, 3
    root = rng.standard_normal((n * B, 2 * n * B))
    w = np.zeros((n, B))
    w[4:] = rng.uniform(1, 20, (2, B))
    J = root @ root.T + np.diag(w.ravel())
    place = np.array([5, 0, 1, 2, 3, 4])
    order = np.concatenate([np.arange(B) + B * i for i in np.argsort(place)])
    U = J[np.ix_(order, order)].copy()
    _cholesky.factorize(U)
    _cholesky.covariance_blocks(U, np.empty((n, B, B)))
    shared = np.empty((n, B, B))
    _tracking.of_anchors(U, place, w, shared)
    cov = np.linalg.inv(J)
    whole = cov @ np.diag(w.ravel()) @ cov
    for i in range(n):
        rows = slice(B * i, B * i + B)
        np.testing.assert_allclose(shared[i], whole[rows, rows], rtol=1e-9)


def test_a_tracker_betters_the_fixes_and_nothing_else_of_the_network(flight):
    tracker = "regularized_adaptive"
    path = CentrePath(flight, flight.time[0], flight.time[-1])
    ways = {}
    for name in ("epoch", tracker):
        settings = FleetNetwork.model_validate({"localization": {"tracker": name}, "rate_hz": 5.0})
        runs = [fly_network(path, 510.0, 516.0, settings, partial(generator, 3, run)) for run in range(3)]
        ways[name] = runs
    for (before, was), (after, now) in zip(ways["epoch"], ways[tracker], strict=True):
        np.testing.assert_array_equal(before.t_arrival, after.t_arrival)
        np.testing.assert_array_equal(was.outcome, now.outcome)
        np.testing.assert_array_equal(was.error_n[0], now.error_n[0])
    late = slice(15, None)
    rms = {
        name: np.sqrt(np.mean([np.nanmean(r.error_n[late, 0] ** 2) for _, r in runs]))
        for name, runs in ways.items()
    }
    assert rms[tracker] < 0.5 * rms["epoch"]
    last = [np.hstack([r.error_n[-1, 0], r.velocity_error_n[-1, 0]]) for _, r in ways[tracker]]
    # Three fixes: the band that one in a thousand leaves.
    low, high = mean_band(6, 3, 0.999)
    assert low < nees(last, [r.cov[-1] for _, r in ways[tracker]]).mean() < high


def test_unknown_trackers_and_accelerations_are_refused():
    for field, value in (("tracker", "alpha_beta"), ("maneuver_acceleration_mps2", -1.0)):
        with pytest.raises(ValidationError, match=field):
            LocalizationSettings.model_validate({field: value})

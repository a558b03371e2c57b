"""The distributed solver of a fleet: one update against its definition, what broadcasts cost, fixes."""

import re
from functools import partial

import numpy as np
import pytest
from fleetalign.align.consistency import nees
from fleetalign.cosim.run import generator
from fleetalign.cosim.scenario import ScenarioError, replaced
from fleetalign.network.fleet import OWN_SHIP, CentrePath
from fleetalign.network.fleet_network import WARM_UP_S, FleetNetwork, fly_network
from fleetalign.network.localization import _dense, _distributed
from fleetalign.network.localization.gossip import _adjacent
from fleetalign.network.observations import node_pairs
from fleetalign.network.record import FixFate
from scipy.optimize import approx_fprime

EPOCH_S = 510.0
N, ANCHORS = 9, 4


class World:
    """A small fleet, what it measures at one epoch, and what its nodes know before."""

    def __init__(self, clocks, seed=0):
        rng = np.random.default_rng(seed)
        self.V = 4 if clocks else 3
        B = 2 * self.V
        self.pairs = node_pairs(N)
        m = len(self.pairs)
        truth = np.zeros((N, B))
        truth[:, :3] = rng.uniform(-5e3, 5e3, (N, 3))
        truth[:, self.V : self.V + 3] = rng.normal(0, 100, (N, 3))
        if clocks:
            truth[:, 3], truth[:, 7] = rng.normal(0, 30, N), rng.normal(0, 1, N)
        self.truth, self.clocks = truth, clocks
        self.anchor = np.arange(N) >= N - ANCHORS
        self.S = truth + rng.normal(0, 1, truth.shape) * np.where(self.anchor, 0, 1)[:, None]
        root = rng.normal(0, 3, (N, B, B))
        self.P = root @ np.swapaxes(root, 1, 2) + np.eye(B)
        told = np.array([self.measured(truth[i], truth[j]) for i, j in self.pairs])
        self.ranges = told[:, 0] + rng.normal(0, 5, m)
        self.rates = told[:, 1] + rng.normal(0, 0.1, m)
        self.w_prior = np.where(self.anchor[:, None], np.full(B, 0.5**-2), 0.0)

    def measured(self, first, second):
        """Range and rate of a link, by the states of its nodes."""
        apart, d = first[:3] - second[:3], np.linalg.norm(first[:3] - second[:3])
        rate = (first - second)[self.V : self.V + 3] @ apart / d
        if not self.clocks:
            return np.array([d, rate])
        return np.array([d + first[3] - second[3], rate + first[7] - second[7]])

    def advance(self, lost, dt=0.0, S=None, told=None):
        """States after one epoch, with what was told of others; both of copies."""
        m, B = len(self.pairs), 2 * self.V
        S = (self.S if S is None else S).copy()
        P, (told_S, told_P) = self.P.copy(), told or (self.S.copy(), self.P.copy())
        terms = _dense.Terms(
            self.pairs, self.ranges, np.full(m, 5.0**-2), self.rates, np.full(m, 0.1**-2), _dense.SQUARED,
            1.0, self.clocks, S.copy(), self.w_prior, np.zeros(N), np.zeros(N), 0.0,
        )  # fmt: skip
        beliefs = np.where(self.anchor[:, None], self.truth, 0.0)[None]
        out = (
            np.empty((1, N, B)), np.empty((1, B, B)), np.empty((N, B, B)), np.empty((1, N)),
            np.empty((1, N), np.int64), np.empty((1, N), np.int64), np.empty(1, np.bool_),
            np.empty((0, B, B)),
        )  # fmt: skip
        moved = beliefs.copy()
        moved[0, self.anchor, :3] += dt * self.truth[self.anchor, self.V : self.V + 3] + [7.0, -3.0, 1.0]
        _distributed.track(
            np.array([0.0, dt]), S, P, told_S, told_P, np.arange(N), terms, terms.w_range[None],
            terms.w_rate[None], self.ranges[None], self.rates[None], moved, np.zeros((1, N)),
            _adjacent(self.pairs, N), beliefs[0].copy(), 2.0, lost, out,
        )  # fmt: skip
        return S, P, told_S, told_P


@pytest.mark.parametrize("clocks", [False, True])
def test_one_sweep_is_the_update_of_each_node_by_itself(clocks):
    """By stacked equations with derivatives by finite differences; half of the links are of second nodes."""
    world = World(clocks)
    B = 2 * world.V
    P = 2 * world.P.copy()
    S, found_P, *_ = world.advance(np.zeros((1, 1, N), bool))
    shift = np.append([7.0, -3.0, 1.0], np.zeros(B - 3))
    before = world.S + np.where(world.anchor[:, None], 0.0, shift)
    before[world.anchor, :3] += shift[:3]
    told_P = P.copy()
    told_P[world.anchor] = np.diag(np.full(B, 0.25))
    for node in (0, 3):
        A, g = np.linalg.inv(P[node]), np.zeros(B)
        for m, (i, j) in enumerate(world.pairs):
            if node not in (i, j):
                continue
            other = j if i == node else i

            def link(x, i=i, j=j, node=node):
                both = {i: before[i], j: before[j], node: x}
                return world.measured(both[i], both[j])

            expected = link(before[node])
            H = np.array([approx_fprime(before[node], lambda x, c=c: link(x)[c], 1e-4) for c in (0, 1)])
            for c, (z, sd) in enumerate(((world.ranges[m], 5.0), (world.rates[m], 0.1))):
                w = 1 / (sd**2 + H[c] @ told_P[other] @ H[c])
                A += w * np.outer(H[c], H[c])
                g += w * (z - expected[c]) * H[c]
        np.testing.assert_allclose(found_P[node], np.linalg.inv(A), rtol=2e-3, atol=2e-3)
        np.testing.assert_allclose(S[node] - before[node], np.linalg.solve(A, g), rtol=2e-3, atol=2e-3)


def test_a_lost_broadcast_leaves_the_one_before_carried_on():
    world = World(False)
    lost = np.zeros((1, 2, N), bool)
    lost[:, :, 3] = True
    dt = 0.5
    *_, told_S, told_P = world.advance(lost, dt)
    straight = world.S[3, :3] + dt * world.S[3, 3:] + [7.0, -3.0, 1.0]
    np.testing.assert_allclose(told_S[3, :3], straight, atol=1e-9)
    F = np.eye(6) + dt * np.eye(6, k=3)
    W = 4.0 * np.kron([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]], np.eye(3))
    np.testing.assert_allclose(told_P[3], F @ world.P[3] @ F.T + W, rtol=1e-9)
    _, _, heard_S, _ = world.advance(np.zeros((1, 2, N), bool), dt)
    assert np.abs(heard_S[3, :3] - straight).max() > 0.1


@pytest.fixture(scope="module")
def path(flight):
    return CentrePath(flight, flight.time[0], flight.time[-1])


def fly(path, run=0, seconds=2.0, **rooms):
    rooms["localization"] = {"solver": "distributed", **rooms.get("localization", {})}
    settings = FleetNetwork.model_validate(rooms)
    return fly_network(path, EPOCH_S, EPOCH_S + seconds, settings, partial(generator, 5, run))


@pytest.mark.parametrize(("nodes", "sweeps", "extra"), [(50, 2, 0), (30, 3, 10)])
def test_fixes_are_late_by_their_frames_and_broadcasts_fill_the_slots(path, nodes, sweeps, extra):
    fixes, record = fly(
        path,
        fleet={"nodes": nodes},
        protocol={"extra_slots": extra},
        localization={"sweeps": sweeps},
    )
    frame = (nodes + extra) * 0.5e-3
    made = record.fate == FixFate.DELIVERED
    assert made.mean() > 0.9
    ends = (record.time + record.delay)[made] / frame
    np.testing.assert_allclose(ends, np.round(ends), atol=1e-5)
    assert (record.delay[made] > sweeps * frame - 1e-9).all()
    assert (record.delay[made] < (sweeps + 1) * frame).all()
    assert (fixes.source == OWN_SHIP).all()
    epochs = 21 + round(WARM_UP_S * 10)
    assert record.slots_used == record.transmissions == nodes * sweeps * epochs
    assert record.slots == pytest.approx((WARM_UP_S + 2.0 + 1.0) / 0.5e-3, abs=2)


def test_lost_broadcasts_are_counted_and_cost_accuracy(path):
    errors = []
    for loss in (0.0, 0.6):
        squares = []
        for run in range(4):
            _, record = fly(path, run, radio={"loss_probability": loss})
            squares.append(np.nanmean(np.sum(record.error_n[5:, 0] ** 2, axis=1)))
            assert record.delivered / record.sent == pytest.approx(1 - loss, abs=0.02)
        errors.append(np.sqrt(np.mean(squares)))
    assert errors[1] > 1.5 * errors[0]


def test_covariance_of_the_own_ships_fix_is_nearly_true(path):
    """Two sweeps: correlated errors of neighbours and what fades leave it within a third of the truth."""
    ratio = []
    for run in range(24):
        _, record = fly(path, run)
        error = np.hstack([record.error_n[-1, 0], record.velocity_error_n[-1, 0]])
        ratio.append(nees(error, record.cov[-1]))
    # The mean of 24 of six degrees has a standard deviation of 0.7.
    assert 4.0 < np.mean(ratio) < 8.5
    assert np.mean(ratio) / 0.4 > 8.5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fixes.localization.sweeps": 5}, "a frame takes 25 ms, so that 4 fit between epochs at 10 Hz"),
        ({"fixes.protocol.kind": "leach"}, 'solver = "distributed" with protocol.kind = "leach"'),
        ({"fixes.protocol.access": "csma"}, 'solver = "distributed" with protocol.access = "csma"'),
        ({"fixes.localization.tracker": "kalman"}, 'allowed is tracker = "epoch"'),
        ({"fixes.localization.sweeps": 0}, "fixes.localization.sweeps = 0: allowed is [1, 100]"),
    ],
)  # fmt: skip
def test_what_cannot_be_broadcast_is_refused_in_one_line(gao2009, changes, words):
    with pytest.raises(ScenarioError, match=re.escape(words)) as told:
        replaced(gao2009, {"fixes.localization.solver": "distributed", **changes, "variants": {}})
    assert len(str(told.value).splitlines()) == 1

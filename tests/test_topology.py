"""Links in flight: tables against the radio and against time, and what LEACH takes from the estimates."""

from functools import partial

import numpy as np
import pytest
from fleetalign.cosim.run import generator
from fleetalign.network.fleet import CentrePath, Fleet, FleetSettings, draw_formation
from fleetalign.network.fleet_network import FleetNetwork, fly_network
from fleetalign.network.localization.problem import NodeOutcome
from fleetalign.network.protocol import ProtocolSettings, solvers
from fleetalign.network.radio import Radio, RadioSettings
from fleetalign.network.record import FixFate
from fleetalign.network.topology import draw_topology

START_S = 510.0


@pytest.fixture(scope="module")
def path(flight):
    return CentrePath(flight, flight.time[0], flight.time[-1])


def fly(path, seconds, seed=5, **rooms):
    settings = FleetNetwork.model_validate(rooms)
    return fly_network(path, START_S, START_S + seconds, settings, partial(generator, seed, 0))


def test_tables_are_the_links_of_their_time(path):
    fleet = Fleet(draw_formation(FleetSettings(), np.random.default_rng(1)), path)
    radio = Radio(RadioSettings(link_radius_m=15e3), 50, np.random.default_rng(2))
    time = np.array([500.0, 510.0, 520.0])
    topology = draw_topology(fleet, radio, time, ProtocolSettings(), np.random.default_rng(3))
    for s, t in enumerate(time):
        x, _ = fleet.at(np.array([t]))
        distance = np.linalg.norm(x[0, :, None] - x[0, None], axis=-1)
        np.testing.assert_allclose(topology.distance[s], distance, atol=1e-6)
        np.testing.assert_array_equal(topology.linked[s], (distance <= 15e3) & ~np.eye(50, dtype=bool))
    np.testing.assert_array_equal(topology.at(np.array([499.0, 500.0, 509.9, 510.0, 600.0])), [0, 0, 0, 1, 2])
    np.testing.assert_array_equal(topology.ranging, topology.linked)
    # Nodes weave by hundreds of metres: some links change.
    assert (topology.linked[0] != topology.linked[2]).any()


def test_leach_ranges_with_heads_alone(path):
    _, dmdg = fly(path, 2.0, protocol={"kind": "dmdg"})
    _, leach = fly(path, 2.0, protocol={"kind": "leach"})
    head = leach.head[0]
    assert 0 < head.sum() < 30
    assert not leach.linked[0][np.ix_(~head, ~head)].any()
    assert leach.linked[0][np.ix_(head, ~head)].all()
    own = leach.outcome[:, 0] == NodeOutcome.LOCATED
    assert own.any()
    # A few ranges in the place of 49.
    assert np.sqrt(np.mean(leach.cov[own, 0, 0])) > 1.5 * np.sqrt(np.mean(dmdg.cov[:, 0, 0]))


def test_a_fix_is_delayed_by_its_own_packet(path):
    """With slots as long as the epochs are apart, the delay of each epoch's packet is known beforehand."""
    fixes, record = fly(path, 5.0, radio={"loss_probability": 0.0}, fleet={"nodes": 10, "anchor_share": 0.6})
    delivered = record.fate == FixFate.DELIVERED
    assert delivered.all()
    # 100 ms are twenty frames of 5 ms: the wait for the slot is always the same, and within a frame.
    np.testing.assert_allclose(record.delay, record.delay[0], atol=2e-7)
    assert 0 < record.delay[0] < 0.0055
    np.testing.assert_allclose(np.sort(fixes.t_valid), record.time, atol=1e-9)


def test_stamps_are_off_by_the_two_clocks(path):
    clock = {"frequency_accuracy": 0.0, "sync_sd_ns": 1e6, "resync_s": 1e4}
    fixes, record = fly(path, 1.0, radio={"clock": clock})
    formation = draw_formation(FleetSettings(), generator(5, 0, "fleet"))
    radio = Radio(FleetNetwork(radio={"clock": clock}).radio, 50, generator(5, 0, "radio"), formation.anchor)
    x, nothing = np.random.default_rng(0).normal(0, 1e3, (11, 50, 3)), np.zeros((11, 50, 3))
    offset = radio.observe(record.time, x, nothing, nothing[..., 0]).clock_offset
    maker = solvers(formation.solver_key)[0]
    assert record.maker == maker
    order = np.argsort(fixes.sequence)
    expected = (offset[:, maker] - offset[:, 0])[fixes.sequence[order]]
    assert np.abs(expected).max() > 1e-5
    np.testing.assert_allclose((fixes.t_stamp - fixes.t_valid)[order], expected, atol=1e-9)


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_a_node_that_was_missed_at_first_comes_back_soon(path, rate_hz, monkeypatch):
    observe = Radio.observe

    def deaf_at_first(self, t, *others):
        seen = observe(self, t, *others)
        seen.heard[np.ix_(t < START_S + 0.5, (self.pairs == 0).any(axis=1))] = False
        return seen

    monkeypatch.setattr(Radio, "observe", deaf_at_first)
    _, record = fly(path, 6.0, rate_hz=rate_hz)
    located = record.outcome[:, 0] == NodeOutcome.LOCATED
    assert not located[record.time < START_S + 0.5].any()
    assert located[record.time > START_S + 1.9].all()


def test_a_biased_anchor_stands_back(path):
    outcomes = []
    for seed in range(4):
        radio = {"biased_nodes": 0.02, "node_bias_m": -600.0, "range_sd_m": 20.0}
        _, record = fly(path, 1.0, seed=seed, radio=radio)
        biased = Radio(FleetNetwork(radio=radio).radio, 50, generator(seed, 0, "radio"), record.anchor).biased
        assert biased.sum() == 1
        outcomes.append(record.outcome[-1, biased][0])
        located = record.outcome[-1] == NodeOutcome.LOCATED
        healthy = located & ~biased
        error = record.error_n[-1, healthy] / record.sd_n[-1, healthy]
        assert np.sqrt(np.mean(error**2)) < 2.0
    assert NodeOutcome.INCONSISTENT in outcomes


def test_a_few_detours_are_no_contradiction(path):
    _, record = fly(path, 2.0, radio={"nlos_share": 0.1, "nlos_mean_m": 300.0})
    assert np.mean(record.fate == FixFate.DELIVERED) > 0.9

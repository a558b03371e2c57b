"""LEACH, the baseline: heads take turns, clusters form around them, and traffic goes by way of them."""

import math

import numpy as np
import pytest
from fleetalign.network import leach
from fleetalign.network.protocol import ProtocolError, ProtocolSettings, carry
from fleetalign.network.traffic import PacketFate, Traffic
from scipy.sparse.csgraph import shortest_path


def fleet(nodes, radius, rng):
    """Positions in the paper's cylinder: one table of distances and links."""
    r, angle = 20e3 * np.sqrt(rng.random(nodes)), 2 * np.pi * rng.random(nodes)
    x = np.stack([r * np.cos(angle), r * np.sin(angle), 5e3 * rng.random(nodes)], axis=1)
    distance = np.linalg.norm(x[:, np.newaxis] - x, axis=2)[np.newaxis]
    return distance, (distance <= radius) & ~np.eye(nodes, dtype=bool)


@pytest.mark.parametrize(("nodes", "heads"), [(50, 10), (50, 5), (30, 10), (7, 7)])
def test_each_node_is_head_once_in_an_epoch(nodes, heads):
    epoch = nodes // heads
    head = leach.elect_heads(nodes, 40 * epoch, heads, np.random.default_rng(0))
    assert head.any(axis=1).all()
    turns = head.reshape(40, epoch, nodes).sum(axis=1)
    assert (turns == 1).all()
    # Which of an epoch's rounds a node serves in is uniform: each count is binomial, sd sqrt(n p (1 - p)).
    p = heads / nodes
    for r in range(epoch):
        margin = 4 * math.sqrt(nodes * p * (1 - p) / 40)
        assert head[r::epoch].sum(axis=1).mean() == pytest.approx(heads, abs=margin)


def test_heads_are_spread_over_an_epoch_that_is_not_whole():
    """50 nodes, 15 heads: 1/p is 3.3, an epoch 3 rounds, and some are not heads in it."""
    head = leach.elect_heads(50, 300, 15, np.random.default_rng(0))
    turns = head.reshape(100, 3, 50).sum(axis=1)
    assert turns.max() == 1
    # The chances of a round are 0.3, 0.3/0.7 and 0.3/0.4 of those left: 0.3 of all in each.
    assert turns.mean() == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / 5000))


def test_there_is_always_a_head():
    """Of two nodes with one head on average, none comes forward in one round of four."""
    head = leach.elect_heads(2, 2000, 1, np.random.default_rng(3))
    assert head.any(axis=1).all()
    first = head[0::2].sum(axis=1)
    # Nobody, and so the one with the least draw, or one: 3 of 4; both: 1 of 4.
    assert (first == 2).mean() == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 1000))
    # With both spent, the next round's head is whichever draws less.
    spent = head[1::2][first == 2]
    assert (spent.sum(axis=1) == 1).all()
    assert spent[:, 0].mean() == pytest.approx(0.5, abs=4 * math.sqrt(0.25 / len(spent)))


def test_a_node_more_leaves_the_draws_of_the_others():
    """With the same share of heads, the first rounds of an epoch are the same for those that were there."""
    ten = leach.elect_heads(10, 50, 2, np.random.default_rng(6))
    fifteen = leach.elect_heads(15, 50, 3, np.random.default_rng(6))
    drawn = ten[::5].sum(axis=1) > 1
    np.testing.assert_array_equal(ten[::5][drawn], fifteen[::5, :10][drawn])
    longer = leach.elect_heads(10, 80, 2, np.random.default_rng(6))
    np.testing.assert_array_equal(ten, longer[:50])


def test_rounds_are_counted_from_time_zero():
    link_time = np.arange(15.0, 95.0, 1.0)
    head = leach.heads_at(link_time, 20, 4, 20.0, np.random.default_rng(0))
    rounds = leach.elect_heads(20, 5, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(head, rounds[(link_time // 20).astype(int)])
    assert not np.array_equal(head[4], head[5])


def test_members_join_the_nearest_head_in_reach():
    rng = np.random.default_rng(5)
    distance, linked = fleet(40, 9e3, rng)
    head = rng.random((1, 40)) < 0.15
    own = leach.own_heads(distance, linked, head)[0]
    assert (own == -1).any()
    for node in range(40):
        reach = [k for k in range(40) if head[0, k] and linked[0, node, k]]
        if head[0, node]:
            assert own[node] == node
        else:
            assert own[node] == (min(reach, key=lambda k: distance[0, node, k]) if reach else -1)


def test_nodes_range_with_heads_alone():
    rng = np.random.default_rng(5)
    _, linked = fleet(30, 15e3, rng)
    head = rng.random((1, 30)) < 0.2
    mask = leach.ranging_mask(linked, head)
    np.testing.assert_array_equal(mask, mask.transpose(0, 2, 1))
    members = ~head[0]
    assert not mask[0][np.ix_(members, members)].any()
    np.testing.assert_array_equal(mask[0][head[0]], linked[0][head[0]])
    assert not leach.ranging_mask(linked, np.zeros((1, 30), dtype=bool)).any()


def send(source, destination, distance, linked, head):
    traffic = Traffic(np.zeros(1), np.array([source]), np.array([destination]))
    settings, key = ProtocolSettings(kind="leach", heads=1), np.arange(distance.shape[1])
    rng = np.random.default_rng(0)
    got = carry(traffic, np.zeros(1), distance, linked, settings, key, 0.0, rng, 1.0, head)
    return got.fate[0], got.hops[0]


def test_packets_go_by_way_of_the_heads():
    """All are linked; 0, 1, 2 with head 2 and 3, 4, 5 with head 5: repeated nodes are skipped."""
    x = np.array([0.0, 1, 2, 100, 101, 102])[:, np.newaxis] * 100
    distance = np.abs(x - x.T)[np.newaxis]
    linked = ~np.eye(6, dtype=bool)[np.newaxis]
    head = np.array([[False, False, True, False, False, True]])
    for source, destination, hops in [
        (0, 4, 3),
        (0, 1, 2),
        (0, 2, 1),
        (2, 0, 1),
        (2, 5, 1),
        (2, 3, 2),
        (0, 5, 2),
    ]:
        assert send(source, destination, distance, linked, head) == (PacketFate.DELIVERED, hops)
    # Without a link between the heads there is no way, whatever other links there are.
    linked[0, 2, 5] = linked[0, 5, 2] = False
    assert send(0, 4, distance, linked, head) == (PacketFate.NO_ROUTE, 1)
    assert send(0, 1, distance, linked, head) == (PacketFate.DELIVERED, 2)
    # A third head passes on between the two.
    head[0, 1] = True
    assert send(0, 4, distance, linked, head) == (PacketFate.DELIVERED, 3)
    assert send(2, 5, distance, linked, head) == (PacketFate.DELIVERED, 2)


def test_hops_are_those_of_the_shortest_path_among_heads():
    rng = np.random.default_rng(8)
    distance, linked = fleet(40, 12e3, rng)
    head = leach.elect_heads(40, 1, 10, rng)
    own = leach.own_heads(distance, linked, head)[0]
    hops = shortest_path((linked[0] & head[0] & head[0][:, np.newaxis]).astype(float), unweighted=True)
    fates = []
    for source in range(40):
        destination = (source + 7) % 40
        fate, taken = send(source, destination, distance, linked, head)
        fates.append(fate)
        a, b = own[source], own[destination]
        if a < 0 or b < 0 or not np.isfinite(hops[a, b]):
            assert fate == PacketFate.NO_ROUTE
        else:
            assert taken == (source != a) + hops[a, b] + (destination != b)
    assert {PacketFate.DELIVERED, PacketFate.NO_ROUTE} == set(fates)


def test_more_heads_than_nodes_are_refused():
    ProtocolSettings(kind="leach", heads=50).check(50)
    ProtocolSettings(kind="dmdg", heads=51).check(50)
    with pytest.raises(ProtocolError, match="heads = 51 must be at most the number of nodes, 50"):
        ProtocolSettings(kind="leach", heads=51).check(50)

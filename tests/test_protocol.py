"""The fleet's network: slots, queues, retries and routes, against an event simulation and by theory."""

import heapq
import math
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.network import dmdg, leach, tdma
from fleetalign.network.indicators import delay_statistics
from fleetalign.network.protocol import ProtocolError, ProtocolSettings, carry, solvers
from fleetalign.network.traffic import PacketFate, Traffic, TrafficError, periodic_traffic
from pydantic import ValidationError
from scipy.constants import speed_of_light
from scipy.sparse.csgraph import shortest_path

SLOT = 0.5e-3
PAYLOAD = 250e-6


def fleet(nodes, radius, rng, tables=1):
    """Positions in the paper's cylinder, moved a little from table to table: distances and links."""
    r, angle = 20e3 * np.sqrt(rng.random(nodes)), 2 * np.pi * rng.random(nodes)
    x = np.stack([r * np.cos(angle), r * np.sin(angle), 5e3 * rng.random(nodes)], axis=1)
    x = x + np.cumsum(rng.normal(0, 300, (tables, nodes, 3)), axis=0)
    distance = np.linalg.norm(x[:, :, np.newaxis] - x[:, np.newaxis], axis=3)
    return distance, (distance <= radius) & ~np.eye(nodes, dtype=bool)


def line(*links, nodes, spacing=5e3):
    """Nodes in a row, with the links given: one table."""
    x = spacing * np.arange(nodes)
    linked = np.zeros((1, nodes, nodes), dtype=bool)
    for i, j in links:
        linked[0, i, j] = linked[0, j, i] = True
    return np.abs(x[:, np.newaxis] - x)[np.newaxis], linked


def one_flow(created, source=0, destination=1):
    created = np.sort(np.asarray(created, dtype=float))
    return Traffic(created, np.full(len(created), source), np.full(len(created), destination))


def simulate(traffic, link_time, distance, linked, settings, slot_key, loss_probability, seed, end_s):
    """The TDMA network event by event, with the readable routes: arrivals, fates, transmissions, hops."""
    head_rng, loss_rng = np.random.default_rng(seed).spawn(2)
    n, p = len(slot_key), len(traffic)
    clustered = settings.kind == "leach"
    head = np.zeros((len(link_time), n), dtype=bool)
    if clustered:
        head = leach.heads_at(link_time, n, settings.heads, settings.round_s, head_rng)
        own_head = leach.own_heads(distance, linked, head)
    order = [int(node) for node in tdma.slot_order(slot_key)]
    owners = tdma.slot_owners(slot_key, settings.extra_slots)
    width, slot_s = len(owners), settings.slot_ms * 1e-3
    first, last = (int(np.floor(t / slot_s + 1e-6)) for t in (traffic.created[0], end_s))
    lost = tdma.lost_slots(owners, last // width - first // width + 1, loss_probability, loss_rng)

    queues, told, turn = [[] for _ in range(n)], np.zeros(n, dtype=int), -1
    arrival, fate = np.full(p, np.nan), np.full(p, PacketFate.STILL_QUEUED)
    sent, hops, tries, void = np.zeros(p, int), np.zeros(p, int), {}, np.full(p, np.inf)
    # What happens: a packet comes to a node (0) before a slot begins (1).
    events = [(t, 0, k, int(traffic.source[k])) for k, t in enumerate(traffic.created)]
    events += [(slot * slot_s + 1e-9, 1, slot, 0) for slot in range(first, last)]
    heapq.heapify(events)
    while events:
        time, is_slot, number, node = heapq.heappop(events)
        if not is_slot:
            if len(queues[node]) == settings.queue_length:
                fate[number] = PacketFate.QUEUE_FULL
            else:
                queues[node].append(number)
                tries[number] = 0
            continue
        start = number * slot_s
        table = max(int(np.searchsorted(link_time, time, side="right")) - 1, 0)
        node = owners[number % width]
        if node < 0:
            relays = [k for k in range(1, n + 1) if (
                head[table, order[(turn + k) % n]] if clustered else told[order[(turn + k) % n]] > 0
            )]  # fmt: skip
            if not relays:
                continue
            turn = (turn + relays[0]) % n
            node = order[turn]
        while queues[node]:
            packet = queues[node][0]
            target = int(traffic.destination[packet])
            if clustered:
                to = leach.next_hop(
                    node, target, distance[table], linked[table], head[table], own_head[table]
                )
            else:
                to, void[packet] = dmdg.next_hop(
                    node, target, distance[table], linked[table], told, settings.load_weight_m, void[packet]
                )
            if to < 0:
                fate[queues[node].pop(0)] = PacketFate.NO_ROUTE
                continue
            sent[packet] += 1
            tries[packet] += 1
            if not lost[number // width - first // width, number % width]:
                queues[node].pop(0)
                hops[packet] += 1
                at = start + settings.payload_s + distance[table, node, to] / speed_of_light
                if to == target:
                    arrival[packet], fate[packet] = at, PacketFate.DELIVERED
                else:
                    told[to] += 1
                    heapq.heappush(events, (at, 0, packet, to))
            elif tries[packet] > settings.max_retries:
                fate[queues[node].pop(0)] = PacketFate.RETRIES_EXHAUSTED
            break
        told[node] = len(queues[node])
    return arrival, fate, sent, hops


@pytest.mark.parametrize("kind", ["dmdg", "leach"])
@pytest.mark.parametrize(("extra_slots", "queue_length", "loss"), [(0, 64, 0.0), (3, 1, 0.2), (12, 64, 0.5)])
def test_kernel_is_the_event_simulation(kind, extra_slots, queue_length, loss):
    rng = np.random.default_rng(7)
    nodes, link_time = 12, 0.5 * np.arange(6)
    distance, linked = fleet(nodes, 14e3, rng, len(link_time))
    source = rng.integers(nodes, size=24)
    destination = (source + rng.integers(1, nodes, size=24)) % nodes
    traffic = periodic_traffic(source, destination, 0.3, 2.9, 0.1, 0.1 * rng.random(24))
    settings = ProtocolSettings(
        kind=kind, extra_slots=extra_slots, queue_length=queue_length, heads=3, round_s=1.0, max_retries=2
    )
    key = rng.random(nodes)
    args = (traffic, link_time, distance, linked, settings, key, loss)
    ours = carry(*args, np.random.default_rng(5), 3.0)
    arrival, fate, sent, hops = simulate(*args, 5, 3.0)
    np.testing.assert_array_equal(ours.fate, fate)
    np.testing.assert_allclose(ours.arrival, arrival, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ours.transmissions, sent)
    np.testing.assert_array_equal(ours.hops, hops)
    # The cases are of use only if they hold what they are to test.
    assert (fate == PacketFate.DELIVERED).sum() > 50
    assert hops.max() >= 3
    assert queue_length == 64 or (fate == PacketFate.QUEUE_FULL).any()


@pytest.mark.parametrize("access", ["tdma", "csma"])
@pytest.mark.parametrize("kind", ["dmdg", "leach"])
def test_delay_is_the_sum_of_its_parts(access, kind):
    rng = np.random.default_rng(3)
    distance, linked = fleet(20, 18e3, rng)
    traffic = periodic_traffic(np.arange(20), solvers(rng.random(20)), 0.0, 3.0, 0.1)
    settings = ProtocolSettings(kind=kind, access=access, heads=4, extra_slots=10)
    got = carry(traffic, np.zeros(1), distance, linked, settings, rng.random(20), 0.1, rng, 5.0)
    parts = np.stack([got.slot_wait, got.queue_wait, got.retry_wait, got.carriage])
    arrived = got.delivered
    assert arrived.sum() > 100
    np.testing.assert_allclose(parts.sum(axis=0)[arrived], got.delay[arrived], rtol=0, atol=1e-12)
    assert np.isnan(parts[:, ~arrived]).all()
    assert (parts[:, arrived] >= -1e-9).all()
    assert all(part[arrived].max() > 0 for part in parts)
    # Each hop carries the payload, and the light no farther than the fleet reaches.
    assert (got.carriage >= got.hops * PAYLOAD)[arrived].all()
    assert (got.carriage <= got.hops * (PAYLOAD + 45e3 / speed_of_light))[arrived].all()
    assert (got.transmissions >= got.hops).all()


def test_a_packet_waits_for_half_a_frame_on_average():
    """Single hop, no loss, packets far apart at random times: the wait is uniform over the frame."""
    rng = np.random.default_rng(1)
    nodes, k = 50, 4000
    distance, linked = fleet(nodes, 60e3, rng)
    created = np.arange(k) * 0.2 + 0.1 * rng.random(k)
    got = carry(
        one_flow(created),
        np.zeros(1),
        distance,
        linked,
        ProtocolSettings(),
        np.arange(nodes),
        0.0,
        rng,
        900.0,
    )
    frame = nodes * SLOT
    wait = got.slot_wait / frame
    assert got.delivered.all()
    # The mean of k uniform variables has sd 1/sqrt(12 k); their Kolmogorov distance exceeds 1.95/sqrt(k) in
    # 0.1 % of draws.
    assert wait.mean() == pytest.approx(0.5, abs=4 / math.sqrt(12 * k))
    assert np.abs(np.sort(wait) - np.arange(k) / k).max() < 1.95 / math.sqrt(k)
    np.testing.assert_allclose(
        got.delay - got.slot_wait, PAYLOAD + distance[0, 0, 1] / speed_of_light, atol=1e-12
    )


def test_delay_is_constant_when_the_period_is_a_multiple_of_the_frame():
    distance, linked = line((0, 1), nodes=50)
    settings = ProtocolSettings(guard_us=200.0)
    key = np.arange(50)[::-1]
    for start in (0.0, 0.013, 7.1):
        traffic = periodic_traffic(np.array([0]), np.array([1]), start, start + 50, 0.1)
        got = carry(
            traffic, np.zeros(1), distance, linked, settings, key, 0.0, np.random.default_rng(0), start + 51
        )
        assert len(traffic) == 501
        # Node 0 has the last slot of a frame; frames are counted from time 0.
        wait = (49 * SLOT - start) % (50 * SLOT)
        expected = wait + PAYLOAD + 5e3 / speed_of_light
        np.testing.assert_allclose(got.delay, expected, rtol=0, atol=1e-9)
        statistics = delay_statistics(got)
        assert statistics.sd_within < 1e-9
        assert np.isnan(statistics.lag1_correlation)
        assert statistics.time_synchronism == 1


def test_retries_are_geometric():
    rng = np.random.default_rng(2)
    nodes, k, loss, retries = 4, 20_000, 0.3, 3
    distance, linked = line((0, 1), nodes=nodes)
    settings = ProtocolSettings(max_retries=retries)
    got = carry(
        one_flow(np.arange(k) * 0.02),
        np.zeros(1),
        distance,
        linked,
        settings,
        np.arange(nodes),
        loss,
        rng,
        500.0,
    )
    for sent in range(1, retries + 1):
        share = (got.delivered & (got.transmissions == sent)).mean()
        expected = (1 - loss) * loss ** (sent - 1)
        assert share == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / k))
    dropped = (got.fate == PacketFate.RETRIES_EXHAUSTED).mean()
    expected = loss ** (retries + 1)
    assert dropped == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / k))
    # A retry costs a frame.
    retried = got.retry_wait[got.delivered] / (nodes * SLOT)
    np.testing.assert_allclose(retried, got.transmissions[got.delivered] - 1, atol=1e-9)


def test_an_overloaded_node_sends_in_all_its_slots():
    nodes, end = 10, 20.0
    distance, linked = line((0, 1), nodes=nodes)
    traffic = one_flow(np.arange(0, end, 2e-3))
    settings = ProtocolSettings(queue_length=20)
    got = carry(
        traffic, np.zeros(1), distance, linked, settings, np.arange(nodes), 0.0, np.random.default_rng(0), end
    )
    slots = round(end / (nodes * SLOT))
    assert got.slots == slots * nodes
    assert got.slots_used == got.delivered.sum() == slots
    assert got.counts()[PacketFate.QUEUE_FULL] == len(traffic) - slots - 20
    assert got.queue_peak == 20
    # Once the queue is full, a packet waits for all that are before it.
    late = got.delivered & (traffic.created > 1.0)
    assert (got.delay[late] > 19 * nodes * SLOT).all()


def test_greedy_paths_are_rarely_longer_than_the_shortest():
    rng = np.random.default_rng(11)
    longer, total = 0, 0
    for _ in range(4):
        distance, linked = fleet(40, 15e3, rng)
        hops = shortest_path(linked[0].astype(float), unweighted=True)
        for source in range(0, 40, 3):
            for target in range(40):
                if source == target or not np.isfinite(hops[source, target]):
                    continue
                path = dmdg.path(source, target, distance[0], linked[0], np.zeros(40), 0.0)
                assert path[-1] == target
                assert linked[0][path[:-1], path[1:]].all()
                longer += len(path) - 1 - hops[source, target]
                total += hops[source, target]
    assert 0 <= longer / total < 0.05


def test_a_packet_gets_out_of_a_void():
    """Node 1 is nearest to the target, 5, and has no link onward: the way there goes back, and far around."""
    x = np.array([[0, 0], [4, 0], [0, 4], [0, 8], [5, 8], [8, 0], [8, 5.0]]) * 1e3
    distance = np.linalg.norm(x[:, np.newaxis] - x, axis=2)[np.newaxis]
    linked = np.zeros((1, 7, 7), dtype=bool)
    for i, j in [(0, 1), (0, 2), (2, 3), (3, 4), (4, 6), (6, 5)]:
        linked[0, i, j] = linked[0, j, i] = True
    assert dmdg.path(0, 5, distance[0], linked[0], np.zeros(7), 0.0) == [0, 1, 0, 2, 3, 4, 6, 5]
    got = carry(
        one_flow([0.0], 0, 5), np.zeros(1), distance, linked, ProtocolSettings(), np.arange(7), 0.0,
        np.random.default_rng(0), 1.0,
    )  # fmt: skip
    assert got.delivered.all()
    assert got.hops[0] == 7
    linked[0, 6, 5] = linked[0, 5, 6] = False
    got = carry(
        one_flow([0.0], 0, 5), np.zeros(1), distance, linked, ProtocolSettings(), np.arange(7), 0.0,
        np.random.default_rng(0), 1.0,
    )  # fmt: skip
    assert got.fate[0] == PacketFate.NO_ROUTE
    assert np.isnan(got.arrival[0])


def test_routes_follow_the_tables():
    """From 0 to 3 by way of 1, from 1 s on by way of 2, from 2 s on not at all; both relays lie behind 0."""
    x = np.array([[0, 0], [-3, 3], [-3, -3], [9, 0.0]]) * 1e3
    distance = np.tile(np.linalg.norm(x[:, np.newaxis] - x, axis=2), (3, 1, 1))
    linked = np.zeros((3, 4, 4), dtype=bool)
    for table, relay in ((0, 1), (1, 2)):
        linked[table, [0, relay, relay, 3], [relay, 0, 3, relay]] = True
    created = [0.0, 0.5, 0.9995, 1.0, 1.5, 2.0]
    got = carry(
        one_flow(created, 0, 3), np.arange(3.0), distance, linked, ProtocolSettings(), np.arange(4), 0.0,
        np.random.default_rng(0), 3.0,
    )  # fmt: skip
    assert got.fate.tolist() == [PacketFate.DELIVERED] * 5 + [PacketFate.NO_ROUTE]
    assert got.hops.tolist() == [2, 2, 2, 2, 2, 0]


def test_load_is_shared_between_relays():
    """Two relays between 0 and 3, of which 1 is a little nearer to 3."""
    distance = np.full((1, 4, 4), 5e3)
    distance[0, [1, 3], [3, 1]] = 4.9e3
    distance[0, [0, 3], [3, 0]] = 9e3
    linked = np.zeros((1, 4, 4), dtype=bool)
    for i, j in [(0, 1), (0, 2), (1, 3), (2, 3)]:
        linked[0, i, j] = linked[0, j, i] = True
    np.testing.assert_array_equal(
        [dmdg.next_hop(0, 3, distance[0], linked[0], np.array([0, k, 0, 0]), 1000.0)[0] for k in (0, 1)],
        [1, 2],
    )
    # Node 1 is busy with packets of its own.
    created = np.sort(np.concatenate([np.arange(400) * 5e-3, np.arange(400) * 3e-3]))
    source = np.where(np.isin(created, np.arange(400) * 5e-3), 0, 1)
    traffic = Traffic(created, source, np.full(800, 3))
    delays = [
        carry(
            traffic, np.zeros(1), distance, linked, ProtocolSettings(load_weight_m=weight, queue_length=1000),
            np.arange(4), 0.0, np.random.default_rng(0), 10.0,
        ).delay[source == 0].mean()
        for weight in (0.0, 1000.0)
    ]  # fmt: skip
    assert delays[1] < 0.8 * delays[0]


def test_extra_slots_help_a_relay():
    """Three nodes send by way of node 3, which has one slot in five."""
    distance, linked = line((0, 3), (1, 3), (2, 3), (3, 4), nodes=5)
    source = np.array([0, 1, 2])
    traffic = periodic_traffic(source, np.full(3, 4), 0.0, 4.0, 4e-3)
    settings = [ProtocolSettings(extra_slots=extra) for extra in (0, 3)]
    none, three = (
        carry(traffic, np.zeros(1), distance, linked, s, np.arange(5), 0.0, np.random.default_rng(0), 4.1)
        for s in settings
    )
    assert none.counts()[PacketFate.QUEUE_FULL] > 0.3 * len(traffic)
    assert three.delivered.mean() > 0.99
    owners = tdma.slot_owners(np.array([2.0, 0.0, 1.0]), 2)
    assert owners.tolist() == [1, -1, 2, -1, 0]


def test_the_same_seed_gives_the_same_deliveries():
    rng = np.random.default_rng(4)
    distance, linked = fleet(30, 15e3, rng)
    traffic = periodic_traffic(np.arange(30), solvers(rng.random(30)), 0.0, 2.0, 0.1)
    key = rng.random(30)
    for access in ("tdma", "csma"):
        for kind in ("dmdg", "leach"):
            settings = ProtocolSettings(kind=kind, access=access, heads=6)
            first, again, other = (
                carry(
                    traffic,
                    np.zeros(1),
                    distance,
                    linked,
                    settings,
                    key,
                    0.2,
                    np.random.default_rng(seed),
                    3.0,
                )
                for seed in (8, 8, 9)
            )
            np.testing.assert_array_equal(first.arrival, again.arrival)
            np.testing.assert_array_equal(first.head, again.head)
            assert not np.array_equal(first.arrival, other.arrival, equal_nan=True)


def test_a_node_more_leaves_losses_of_the_others():
    key = np.random.default_rng(0).random(11)
    ten, eleven = (
        tdma.lost_slots(tdma.slot_owners(key[:n], 2), 400, 0.3, np.random.default_rng(1)) for n in (10, 11)
    )
    for node in range(10):
        np.testing.assert_array_equal(
            ten[:, tdma.slot_owners(key[:10], 2) == node], eleven[:, tdma.slot_owners(key, 2) == node]
        )
    assert len({column.tobytes() for column in eleven.T}) == 13


@pytest.mark.parametrize(("hear", "collide"), [(False, True), (True, False)])
def test_csma_collides_where_senders_do_not_hear_each_other(hear, collide):
    """Nodes 0 and 2 send to node 1 at once: they collide if hidden, or if they draw the same back-off."""
    links = [(0, 1), (1, 2)] + ([(0, 2)] if hear else [])
    distance, linked = line(*links, nodes=3)
    k = 300
    traffic = Traffic(np.repeat(np.arange(k) * 0.1, 2), np.tile([0, 2], k), np.ones(2 * k, dtype=np.int64))
    settings = ProtocolSettings(access="csma", window_min=64, max_retries=0)
    got = carry(
        traffic, np.zeros(1), distance, linked, settings, np.arange(3), 0.0, np.random.default_rng(0), 40.0
    )
    assert (got.delivered | (got.fate == PacketFate.RETRIES_EXHAUSTED)).all()
    both = got.fate.reshape(k, 2)
    assert (both[:, 0] == both[:, 1]).all()
    assert got.collisions == 2 * (both[:, 0] == PacketFate.RETRIES_EXHAUSTED).sum()
    # Hidden, they overlap if their back-offs differ by less than the two mini-slots of a packet.
    expected = (64 + 2 * 63) / 64**2 if collide else 1 / 64
    margin = 4 * math.sqrt(expected * (1 - expected) / k)
    assert got.collisions / (2 * k) == pytest.approx(expected, abs=margin)
    retried = carry(
        traffic, np.zeros(1), distance, linked, ProtocolSettings(access="csma"), np.arange(3), 0.0,
        np.random.default_rng(0), 40.0,
    )  # fmt: skip
    assert retried.delivered.all()
    assert retried.transmissions.sum() == 2 * k + retried.collisions


def test_csma_receivers_that_send_do_not_hear():
    """Two nodes that send to each other in the same mini-slot both lose, until their windows are wider."""
    distance, linked = line((0, 1), nodes=2)
    traffic = Traffic(np.zeros(2), np.array([0, 1]), np.array([1, 0]))
    settings = ProtocolSettings(access="csma", window_min=1, window_max=1, max_retries=3)
    got = carry(
        traffic, np.zeros(1), distance, linked, settings, np.arange(2), 0.0, np.random.default_rng(0), 1.0
    )
    assert (got.fate == PacketFate.RETRIES_EXHAUSTED).all()
    assert got.collisions == got.transmissions.sum() == 8
    settings = ProtocolSettings(access="csma", window_min=1, window_max=1024, max_retries=20)
    got = carry(
        traffic, np.zeros(1), distance, linked, settings, np.arange(2), 0.0, np.random.default_rng(0), 1.0
    )
    assert got.delivered.all()
    assert got.collisions >= 2


def test_csma_far_apart_is_used_twice():
    """Two pairs without a link between them send at the same time, which TDMA does not let them."""
    distance, linked = line((0, 1), (2, 3), nodes=4)
    traffic = Traffic(np.zeros(2), np.array([0, 2]), np.array([1, 3]))
    settings = ProtocolSettings(access="csma", window_min=1, window_max=1)
    got = carry(
        traffic, np.zeros(1), distance, linked, settings, np.arange(4), 0.0, np.random.default_rng(0), 1.0
    )
    np.testing.assert_allclose(got.delay, PAYLOAD + 5e3 / speed_of_light, atol=1e-12)
    assert got.collisions == 0


def test_solvers_are_others_and_each_solves_once():
    key = np.random.default_rng(0).random(50)
    solver = solvers(key)
    assert (solver != np.arange(50)).all()
    assert sorted(solver) == list(range(50))
    order = np.argsort(key)
    assert solver[order[3]] == order[4]
    assert solver[order[-1]] == order[0]
    with pytest.raises(ProtocolError, match="another node"):
        solvers(np.zeros(1))


def test_traffic_is_periodic_and_in_order():
    traffic = periodic_traffic(np.array([0, 1]), np.array([1, 2]), 10.0, 10.3, 0.1, np.array([0.05, 0.0]))
    np.testing.assert_allclose(traffic.created, [10, 10.05, 10.1, 10.15, 10.2, 10.25, 10.3])
    np.testing.assert_array_equal(traffic.source, [1, 0, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(traffic.destination, [2, 1, 2, 1, 2, 1, 2])
    assert len(set(traffic.flow)) == 2
    assert len(periodic_traffic(np.array([0]), np.array([1]), 0.0, 560.0, 0.1)) == 5601


def test_statistics_of_known_delays():
    """Two flows, one steady, one alternating; one packet lost."""
    rng = np.random.default_rng(0)
    distance, linked = line((0, 1), nodes=2)
    traffic = periodic_traffic(np.array([0, 1]), np.array([1, 0]), 0.0, 9.95, 0.05)
    got = carry(traffic, np.zeros(1), distance, linked, ProtocolSettings(), np.arange(2), 0.0, rng, 20.0)
    arrival = traffic.created + np.where(traffic.source == 0, 0.02, 0.04)
    arrival += np.where((traffic.source == 1) & (np.arange(len(traffic)) % 4 == 1), 0.03, 0.0)
    fate = got.fate.copy()
    arrival[0], fate[0] = np.nan, PacketFate.QUEUE_FULL
    statistics = delay_statistics(replace(got, arrival=arrival, fate=fate))
    assert (statistics.sent, statistics.delivered) == (400, 399)
    assert statistics.time_synchronism == pytest.approx(299 / 399)
    assert statistics.mean == pytest.approx((199 * 0.02 + 200 * 0.055) / 399)
    assert statistics.sd_between == pytest.approx(0.0175)
    assert statistics.sd_within == pytest.approx(math.sqrt(200 / 399) * 0.015)
    # Half of the packets alternate about their mean, the others do not vary: 199 of 397 pairs.
    assert statistics.lag1_correlation == pytest.approx(-(199 / 397) / (200 / 399))
    assert statistics.p50 == pytest.approx(0.04)
    assert statistics.transmissions_per_packet == pytest.approx(400 / 399)
    own = delay_statistics(got, traffic.destination == 0)
    assert own.sent == 200
    nothing = delay_statistics(got, np.zeros(400, dtype=bool))
    assert nothing.delivered == 0
    assert np.isnan([nothing.mean, nothing.p95, nothing.lag1_correlation, nothing.sd_within]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"slot_ms": 0.2}, r"slot_ms = 0.2 ms .* at least 0.25 ms"),
        ({"slot_ms": 0.3, "guard_us": 133.0}, r"slot_ms = 0.3 ms .* at least 0.383 ms"),
        (
            {"access": "csma", "mini_slot_us": 100.0, "guard_us": 133.0},
            r"mini_slot_us = 100 us .* at least 133 us",
        ),
        ({"window_min": 64, "window_max": 32}, r"window_min = 64 mini-slots .* window_max = 32"),
        ({"heads": 0}, "heads"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        ProtocolSettings(**settings)


def test_a_network_that_cannot_work_is_refused():
    rng = np.random.default_rng(0)
    distance, linked = fleet(5, 60e3, rng)
    longest = distance[linked].max()

    def refused(message, settings=None, traffic=None, **changes):
        arrays = {"link_time": np.zeros(1), "distance": distance, "linked": linked} | changes
        with pytest.raises(ProtocolError, match=message) as error:
            carry(
                traffic or one_flow([0.0]), *arrays.values(), ProtocolSettings(**(settings or {})),
                np.arange(5), 0.0, rng, 1.0,
            )  # fmt: skip
        assert "\n" not in str(error.value)

    least = PAYLOAD * 1e3 + longest / speed_of_light * 1e3
    with pytest.raises(ProtocolError, match=r"slot_ms = 0.27 ms .* at least") as error:
        ProtocolSettings(slot_ms=0.27).guard(longest)
    told = float(str(error.value).split("at least ")[1].split()[0])
    assert least <= told < 1.001 * least
    assert ProtocolSettings(slot_ms=told).guard(longest) == pytest.approx(longest / speed_of_light)

    refused("slot_ms = 0.27 ms", {"slot_ms": 0.27})
    refused("guard_us = 20 us is shorter than .* longest link", {"guard_us": 20.0})
    refused("mini_slot_us = 30 us", {"access": "csma", "mini_slot_us": 30.0})
    refused("heads = 6 must be at most the number of nodes, 5", {"kind": "leach", "heads": 6})
    refused("shape", distance=distance[0])
    refused("increase", link_time=np.array([-1.0]))
    refused("both directions", linked=np.triu(linked[0])[np.newaxis])
    refused("nodes 0 to 4", traffic=one_flow([0.0], 0, 5))
    refused("before time 0", traffic=one_flow([-1.0]))
    refused("finite", distance=np.where(np.eye(5) > 0, np.nan, distance))


@pytest.mark.parametrize(
    ("created", "source", "destination", "message"),
    [
        ([0.0, 1.0], [0], [1, 1], "source must have shape"),
        ([1.0, 0.0], [0, 0], [1, 1], "order"),
        ([np.nan], [0], [1], "finite"),
        ([0.0], [2], [2], "node 2 sends to itself"),
        ([0.0], [-1], [2], "from 0"),
    ],
)
def test_bad_traffic_is_refused(created, source, destination, message):
    with pytest.raises(TrafficError, match=message):
        Traffic(np.array(created), np.array(source), np.array(destination))


def test_bad_periods_are_refused():
    with pytest.raises(TrafficError, match="period_s = 0 s"):
        periodic_traffic(np.array([0]), np.array([1]), 0.0, 1.0, 0.0)
    with pytest.raises(TrafficError, match="phases"):
        periodic_traffic(np.array([0]), np.array([1]), 0.0, 1.0, 0.1, np.array([0.2]))


def test_no_packets_and_no_time():
    distance, linked = line((0, 1), nodes=2)
    for traffic, end in ((one_flow([]), 1.0), (one_flow([5.0]), 1.0)):
        for access in ("tdma", "csma"):
            got = carry(
                traffic, np.zeros(1), distance, linked, ProtocolSettings(access=access), np.arange(2), 0.1,
                np.random.default_rng(0), end,
            )  # fmt: skip
            assert got.slots == 0
            assert (got.fate == PacketFate.STILL_QUEUED).all()
            assert np.isnan(delay_statistics(got).slot_use)

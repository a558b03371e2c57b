"""Compiled loops over the slots of channel sharing: TDMA and CSMA.

The TDMA loop has a readable twin in the tests, an event simulation; `tdma` and `csma` state the models.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED
from ._queues import (
    COLLISIONS,
    QUEUE_WAIT,
    RETRIES_EXHAUSTED,
    ROUNDING_S,
    SLOT_WAIT,
    SLOTS,
    SLOTS_USED,
    enter_created,
    head_of_queue,
    leave,
    receive,
)


@njit(**COMPILED)
def _extra_owner(links, table, order, told, turn):
    """Place in ``order`` of the next node after ``turn`` that an extra slot goes to; -1 for none."""
    n = len(order)
    for step in range(1, n + 1):
        place = (turn + step) % n
        node = order[place]
        if links.relay[table, node] and (links.clustered or told[node] > 0):
            return place
    return -1


@njit(**COMPILED)
def carry_tdma(
    packets, queues, links, order, owners, lost, slot_s, payload_s, speed, max_retries, first_slot, last_slot
):
    """Slots ``first_slot`` to ``last_slot`` (not included) of a frame with ``owners``, -1 for an extra slot.

    ``order`` (n,) nodes in order of their slots; ``lost`` (frames, slots of a frame) whether what is sent in
    a slot is lost; the first row is the frame of ``first_slot``. Returns totals (4,).
    """
    totals = np.zeros(4, dtype=np.int64)
    totals[SLOTS] = max(last_slot - first_slot, 0)
    frame_slots = len(owners)
    first_frame = first_slot // frame_slots
    created, table, turn = 0, 0, -1
    for slot in range(first_slot, last_slot):
        time = slot * slot_s
        while table + 1 < len(links.time) and links.time[table + 1] <= time + ROUNDING_S:
            table += 1
        created = enter_created(packets, queues, created, time + ROUNDING_S, totals)
        node = owners[slot % frame_slots]
        if node < 0:
            place = _extra_owner(links, table, order, queues.told, turn)
            if place < 0:
                continue
            turn, node = place, order[place]
        if queues.length[node] == 0:
            queues.told[node] = 0
            continue

        length, size = queues.length[node], queues.ring.shape[1]
        for place in range(length - queues.fresh[node], length):
            packet = queues.ring[node, (queues.first[node] + place) % size]
            packets.turn[packet] = time
            packets.parts[packet, SLOT_WAIT] += time - packets.ready[packet]
        queues.fresh[node] = 0

        packet, to = head_of_queue(packets, queues, links, table, node)
        received = False
        if packet >= 0:
            totals[SLOTS_USED] += 1
            if packets.tries[packet] == 0:
                packets.tried[packet] = time
                packets.parts[packet, QUEUE_WAIT] += time - packets.turn[packet]
            packets.tries[packet] += 1
            packets.sent[packet] += 1
            received = not lost[slot // frame_slots - first_frame, slot % frame_slots]
            if received:
                leave(queues, node)
            elif packets.tries[packet] > max_retries:
                leave(queues, node)
                packets.fate[packet] = RETRIES_EXHAUSTED
        queues.told[node] = queues.length[node]
        if received:
            arrival = time + payload_s + links.distance[table, node, to] / speed
            created = enter_created(packets, queues, created, arrival, totals)
            receive(packets, queues, packet, to, time, arrival, totals)
    return totals


@njit(**COMPILED)
def _mark_spoiled(linked, sending, to, spoiled):
    """Which of the packets now on the air another sender spoils at their receiver, or finds it sending."""
    for node in range(len(sending)):
        if sending[node]:
            for other in range(len(sending)):
                if other != node and sending[other] and (other == to[node] or linked[other, to[node]]):
                    spoiled[node] = True


@njit(**COMPILED)
def carry_csma(
    packets,
    queues,
    links,
    rng,
    loss,
    mini_s,
    airtime,
    payload_s,
    speed,
    max_retries,
    window_min,
    window_max,
    first,
    last,
):
    """Mini-slots ``first`` to ``last`` (not included); a packet is on the air for ``airtime`` of them.

    ``rng`` is drawn from in the order of events: a back-off where one begins, an error where a packet ends.
    Returns totals (4,).
    """
    n = len(queues.length)
    totals = np.zeros(4, dtype=np.int64)
    totals[SLOTS] = max(last - first, 0)
    backoff = np.full(n, -1)
    ends = np.full(n, -1)
    to = np.full(n, -1)
    sending = np.zeros(n, dtype=np.bool_)
    spoiled = np.zeros(n, dtype=np.bool_)
    busy = np.zeros(n, dtype=np.bool_)
    left = np.zeros(n)
    ending = np.empty(n, dtype=np.int64)
    arrivals = np.empty(n)
    created, table, on_air = 0, 0, 0
    for mini in range(first, last):
        time = mini * mini_s
        while table + 1 < len(links.time) and links.time[table + 1] <= time + ROUNDING_S:
            table += 1

        # Packets end in the order in which they arrive, so that queues stay in order.
        ended = 0
        for node in range(n if on_air else 0):
            if sending[node] and ends[node] == mini:
                sent = (mini - airtime) * mini_s
                arrival = sent + payload_s + links.distance[table, node, to[node]] / speed
                at = ended
                while at > 0 and arrivals[at - 1] > arrival:
                    arrivals[at], ending[at] = arrivals[at - 1], ending[at - 1]
                    at -= 1
                arrivals[at], ending[at] = arrival, node
                ended += 1
        for k in range(ended):
            node = ending[k]
            packet = queues.ring[node, queues.first[node]]
            error = rng.random() < loss
            totals[COLLISIONS] += spoiled[node]
            if not (error or spoiled[node]):
                leave(queues, node)
                created = enter_created(packets, queues, created, arrivals[k], totals)
                receive(packets, queues, packet, to[node], (mini - airtime) * mini_s, arrivals[k], totals)
            elif packets.tries[packet] > max_retries:
                leave(queues, node)
                packets.fate[packet] = RETRIES_EXHAUSTED
            sending[node], spoiled[node], backoff[node] = False, False, -1
            left[node], queues.told[node] = time, queues.length[node]
            on_air -= 1

        created = enter_created(packets, queues, created, time + ROUNDING_S, totals)
        busy[:] = False
        for sender in range(n if on_air else 0):
            if sending[sender]:
                for node in range(n):
                    busy[node] |= links.linked[table, sender, node]
        started = False
        for node in range(n):
            if sending[node] or queues.length[node] == 0:
                continue
            packet = queues.ring[node, queues.first[node]]
            if backoff[node] < 0:
                window = min(window_min << min(packets.tries[packet], 30), window_max)
                backoff[node] = int(rng.random() * window)
            if busy[node]:
                continue
            if backoff[node] > 0:
                backoff[node] -= 1
                continue
            packet, to[node] = head_of_queue(packets, queues, links, table, node)
            if packet < 0:
                backoff[node] = -1
                continue
            if packets.tries[packet] == 0:
                turn = max(packets.ready[packet], left[node])
                packets.tried[packet] = time
                packets.parts[packet, QUEUE_WAIT] += turn - packets.ready[packet]
                packets.parts[packet, SLOT_WAIT] += time - turn
            packets.tries[packet] += 1
            packets.sent[packet] += 1
            sending[node], ends[node], started = True, mini + airtime, True
            on_air += 1
        if started:
            _mark_spoiled(links.linked[table], sending, to, spoiled)
        totals[SLOTS_USED] += on_air > 0
    return totals

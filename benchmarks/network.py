"""The fleet's network over a whole flight: fly, range, locate and carry, 50 nodes at 10 Hz."""

import time
from functools import partial

from fleetalign.cosim.run import generator
from fleetalign.network.fleet import CentrePath
from fleetalign.network.fleet_network import FleetNetwork, fly_network
from fleetalign.network.record import FixFate

from .harness import Harness, Row
from .material import SEED, Material

NETWORK_S = 560.0
LIMIT_S = 10.0


def rows(harness: Harness, material: Material) -> list[Row]:
    """Wall time of 560 s of network, or of what the flight holds of it, scaled to that."""
    flight, settings = material.flight, FleetNetwork()
    path = CentrePath(flight, flight.time[0], flight.time[-1])
    flown_s = min(NETWORK_S, float(flight.time[-1] - flight.time[0]), harness.size.network_s)
    start_s = float(flight.time[0])
    runs = {"ours": partial(_fates, path, start_s, start_s + flown_s, settings)}
    times = harness.times("network", runs, rounds=3, clock=time.perf_counter)
    fates = runs["ours"]()
    scale = NETWORK_S / flown_s
    best, median = times["ours"].best * scale, times["ours"].median * scale
    return [
        Row(
            f"{NETWORK_S:.0f} s of network, {settings.fleet.nodes} nodes, {settings.rate_hz:.0f} Hz",
            f"{best:.1f} s (median {median:.1f})",
            "",
            f"{NETWORK_S / best:.0f} times as fast as the network",
            f"under {LIMIT_S:.0f} s",
            best < LIMIT_S,
            f"`fly_network` over {flown_s:.0f} s of the flight, in proportion: {fates}.",
        )
    ]


def _fates(path: CentrePath, start_s: float, end_s: float, settings: FleetNetwork) -> str:
    """What became of the own ship's fixes."""
    _, record = fly_network(path, start_s, end_s, settings, partial(generator, SEED, 0))
    counts = {fate.name.lower(): int((record.fate == fate).sum()) for fate in FixFate}
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)

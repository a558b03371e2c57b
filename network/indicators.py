"""Indicators of a network's service: Gao et al., section 2.1.

Gao et al. name coverage rate, link consumption, time synchronism and accuracy, and leave the definition of
the first two to references that are not at hand. Coverage and accuracy are the localisation's. Ours of the
others:

- link consumption: transmissions for each packet delivered, with those of packets that did not arrive; beside
  it the share of slots in which a node sends;
- time synchronism: the share of delivered packets that took at most 50 ms, Gao et al.'s base line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .traffic import Deliveries

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

BASE_LINE_S = 0.05
"""Largest delay that Gao et al. allow."""


@dataclass(frozen=True)
class DelayStatistics:
    """Delays of delivered packets, s, and what they cost. NaN for what too few packets leave undefined."""

    sent: int
    delivered: int
    mean: float
    sd: float
    p50: float
    p95: float
    p99: float
    time_synchronism: float
    """Share of the delivered packets that took at most 50 ms."""
    lag1_correlation: float
    """Of the delays of one flow's packets, next to each other and both delivered, about the flow's mean."""
    sd_within: float
    """Of the delays of one flow about its mean, over all flows."""
    sd_between: float
    """Of the flows' mean delays."""
    mean_hops: float
    slot_wait: float
    """Mean, as are the other three parts: their sum is the mean delay."""
    queue_wait: float
    retry_wait: float
    carriage: float
    transmissions_per_packet: float
    """Link consumption: transmissions of all packets over packets delivered."""
    slot_use: float
    """Share of slots in which a node sent, by all traffic of the network."""


def delay_statistics(deliveries: Deliveries, chosen: Booleans | None = None) -> DelayStatistics:
    """Statistics of the packets that are ``chosen`` (p,), of all by default."""
    chosen = np.ones(len(deliveries.traffic), dtype=np.bool_) if chosen is None else chosen
    arrived = chosen & deliveries.delivered
    delay = deliveries.delay[arrived]
    flow = deliveries.traffic.flow
    within, means, lag1 = _by_flow(deliveries.delay[chosen], flow[chosen])
    return DelayStatistics(
        sent=int(chosen.sum()),
        delivered=len(delay),
        mean=_mean(delay),
        sd=float(delay.std()) if len(delay) else np.nan,
        p50=_percentile(delay, 50),
        p95=_percentile(delay, 95),
        p99=_percentile(delay, 99),
        time_synchronism=_mean(delay <= BASE_LINE_S),
        lag1_correlation=lag1,
        sd_within=within,
        sd_between=float(means.std()) if len(means) else np.nan,
        mean_hops=_mean(deliveries.hops[arrived]),
        slot_wait=_mean(deliveries.slot_wait[arrived]),
        queue_wait=_mean(deliveries.queue_wait[arrived]),
        retry_wait=_mean(deliveries.retry_wait[arrived]),
        carriage=_mean(deliveries.carriage[arrived]),
        transmissions_per_packet=(
            float(deliveries.transmissions[chosen].sum() / len(delay)) if len(delay) else np.nan
        ),
        slot_use=deliveries.slots_used / deliveries.slots if deliveries.slots else np.nan,
    )


def _percentile(values: Array, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else np.nan


def _mean(values: Array | Integers | Booleans) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _by_flow(delay: Array, flow: Integers) -> tuple[float, Array, float]:
    """Standard deviation within flows, means of flows, lag-1 correlation; delay is NaN for lost packets."""
    order = np.argsort(flow, kind="stable")
    delay, flow = delay[order], flow[order]
    here = np.isfinite(delay)
    if not here.any():
        return np.nan, np.empty(0), np.nan
    sums = np.bincount(flow[here], delay[here])
    counts = np.bincount(flow[here])
    means = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    about = np.full(len(delay), np.nan)
    about[here] = delay[here] - means[flow[here]]
    variance = float(np.mean(about[here] ** 2))
    pairs = here[1:] & here[:-1] & (flow[1:] == flow[:-1])
    # Delays that differ by rounding alone do not vary.
    if pairs.any() and variance > (1e-9) ** 2:
        lag1 = float(np.mean((about[1:] * about[:-1])[pairs])) / variance
    else:
        lag1 = np.nan
    return float(np.sqrt(variance)), means[counts > 0], lag1

"""Fig. 3 and Table 2 of Gao et al., done again: 500 s of flight at 50 m of ranging error.

Their axes x, y, z are taken for east, north, up, the order of Table 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..network.fleet import OWN_SHIP, CentrePath
from ..network.fleet_network import FleetNetwork, fly_network
from ..network.localization.bound import cramer_rao
from ..network.localization.problem import Array, NodeOutcome, RangeProblem
from ..network.record import NetworkRecord
from .network_scenery import fleet_ned
from .parallel import in_order
from .run import generator
from .still import mean_known

RANGE_SD_M = 50.0
BARO_SD_M = 11.0
"""Of the barometric altitude that Table 2 is set beside as well."""
NO_RANGE_RATE_MPS = 30.0
"""Standard deviation of range rates that say nothing of positions, and just hold the velocities: at 100 m/s
and 15 km their information on a position is a ten-thousandth of that of ranges of 50 m."""
_BOUND_EVERY_S = 10.0


@dataclass(frozen=True)
class Figure3:
    """500 s of flight at 50 m, by what the network measures; east, north, up."""

    time: Array
    """(k,) s from the start."""
    error: dict[str, Array]
    """(k, 3) m, of the own ship."""
    fleet_rmse: dict[str, Array]
    """(k, 3) m, over the nodes that are located and no anchors."""
    range: float
    """m, mean length of the own ship's links."""
    bound: Array
    """(3,) m, of the own ship from the ranges of one instant: root of the mean variance over the flight."""
    bound_with_baro: Array
    """(3,) m, the same with a barometric altitude."""
    link_radius: float
    """m"""


def flights(network: FleetNetwork) -> dict[str, FleetNetwork]:
    """The networks of Fig. 3, by what they measure; all with `RANGE_SD_M`, under DMDG."""
    radio = network.radio.model_copy(update={"range_sd_m": RANGE_SD_M, "altitude_sd_m": None})
    protocol = network.protocol.model_copy(update={"kind": "dmdg"})
    variants = {
        "ranges alone": {"range_rate_sd_mps": NO_RANGE_RATE_MPS},
        "ranges and altitude": {"range_rate_sd_mps": NO_RANGE_RATE_MPS, "altitude_sd_m": BARO_SD_M},
        "ranges and range rates": {},
        "ranges, range rates, altitude": {"altitude_sd_m": BARO_SD_M},
    }
    return {
        name: network.model_copy(update={"radio": radio.model_copy(update=change), "protocol": protocol})
        for name, change in variants.items()
    }


def figure_3(
    network: FleetNetwork, path: CentrePath, seed: int, duration_s: float, rate_hz: float
) -> Iterator[tuple[str, NetworkRecord]]:
    """A record for each of `flights`, from the path's start, the same fleet and the same noise for all."""
    start_s = float(path.time[0])
    end_s = min(start_s + duration_s, float(path.time[-1]))

    def work(item: tuple[str, FleetNetwork]) -> tuple[str, NetworkRecord]:
        name, variant = item
        variant = variant.model_copy(update={"rate_hz": rate_hz})
        return name, fly_network(path, start_s, end_s, variant, partial(generator, seed, 0))[1]

    return in_order(work, list(flights(network).items()))


def figure_3_of(records: dict[str, NetworkRecord], network: FleetNetwork) -> Figure3:
    """The curves of `figure_3`'s records of a network."""
    first = next(iter(records.values()))
    bounds, ranges = zip(*_bounds(first, network.fleet.anchor_position_sd_m), strict=True)
    bound, with_baro = np.sqrt(mean_known(bounds))
    return Figure3(
        time=first.time - first.time[0],
        error={name: _enu(record.error_n[:, OWN_SHIP]) for name, record in records.items()},
        fleet_rmse={name: _enu(_fleet_rmse(record), up=1.0) for name, record in records.items()},
        range=float(mean_known(ranges)),
        bound=bound,
        bound_with_baro=with_baro,
        link_radius=network.radio.link_radius_m,
    )


def _enu(ned: Array, up: float = -1.0) -> Array:
    return ned[:, [1, 0, 2]] * [1.0, 1.0, up]


def _fleet_rmse(record: NetworkRecord) -> Array:
    located = record.outcome == NodeOutcome.LOCATED
    square = np.sum(np.where(located[..., None], record.error_n**2, 0.0), axis=1)
    return np.sqrt(square / np.where(located.any(axis=1), located.sum(axis=1), np.nan)[:, None])


def _bounds(record: NetworkRecord, anchor_sd: float) -> Iterator[tuple[Array, float]]:
    """Variances (2, 3) of the own ship, ENU, without and with an altitude, and its mean range, over time."""
    last = -np.inf
    for s, t in enumerate(record.link_time):
        if t < last + _BOUND_EVERY_S:
            continue
        last = t
        x = fleet_ned(record.lla[int(np.argmin(np.abs(record.time - t)))])
        links = np.argwhere(np.tril(record.linked[s]))
        lengths = np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
        problem = RangeProblem(
            links, lengths, np.full(len(links), RANGE_SD_M), record.anchor, x, anchor_sd, curvature=0.0
        )
        high = replace(problem, height=-x[:, 2], height_sd=BARO_SD_M)
        variances = [np.diag(cramer_rao(p, x).cov[OWN_SHIP]) for p in (problem, high)]
        own = (links == OWN_SHIP).any(axis=1)
        yield np.array(variances)[:, [1, 0, 2]], float(lengths[own].mean()) if own.any() else np.nan


def table_2(figure: Figure3) -> dict[str, dict[str, list[float]]]:
    """The own ship's error east, north and up for each of `flights`: mean size, size of the mean, RMSE, m.

    ``relative`` is the mean size over the mean length of the own ship's links.
    """
    rows = {}
    for name, error in figure.error.items():
        size = mean_known(np.abs(error))
        rows[name] = {
            "relative": list(size / figure.range),
            "mean_size_m": list(size),
            "size_of_mean_m": list(np.abs(mean_known(error))),
            "rmse_m": list(np.sqrt(mean_known(error**2))),
        }
    return rows

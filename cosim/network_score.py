"""What the fleet's network made of itself, over all runs of a scenario."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..align.consistency import mean_band, nees
from ..network.indicators import BASE_LINE_S
from ..network.localization.problem import NodeOutcome
from ..network.record import Array, FixFate, NetworkRecord
from ..sins.units import MILLISECOND

MADE = (FixFate.DELIVERED, FixFate.NO_ROUTE, FixFate.LOST, FixFate.STILL_QUEUED)
"""Fates of fixes that the estimator gave; with the others there was nothing to send."""
_COUNTS = ("sent", "delivered", "queued", "transmissions", "slots_used", "slots")


@dataclass(frozen=True)
class NetworkScore:
    """All runs of the network. A fix is one of the own ship's; an epoch of a node is one node at one epoch.

    Attributes
    ----------
    own_error : (f, 6) errors of the fixes that were made, NED, m and m/s.
    own_cov : (6, 6) mean of the covariances that they state.
    own_nees : (runs,) of the last fix of each run, six degrees of freedom; NaN in runs without one.
    mean_nees : mean over all fixes, which are not independent within a run.
    own_delay, fleet_delay : (d,) and (p,) s, of the own ship's fixes and of all packets that arrived.
    fates : number of epochs by `FixFate`.
    coverage : share of the epochs of nodes that are no anchors whose nodes are located.
    position_rmse, position_sd : m, root mean square distance of located nodes that are no anchors from the
        truth, and what the estimator states for it.
    sent, delivered, queued : packets; the last were on their way when time ended. transmissions, slots :
        used and gone by.
    """

    runs: int
    own_error: Array
    own_cov: Array
    own_nees: Array
    mean_nees: float
    own_delay: Array
    fleet_delay: Array
    fates: dict[FixFate, int]
    coverage: float
    position_rmse: float
    position_sd: float
    sent: int
    delivered: int
    queued: int
    transmissions: int
    slots_used: int
    slots: int

    @property
    def summary(self) -> dict[str, Any]:
        """The block ``network`` of `summary.json`; what there is nothing to tell of is None."""
        fixes = sum(self.fates.values())
        known = np.isfinite(self.own_nees)
        variance = np.mean(self.own_error**2, axis=0) if len(self.own_error) else np.full(6, np.nan)
        stated = np.diag(self.own_cov)
        told = {
            "coverage": self.coverage,
            "position_rmse_m": self.position_rmse,
            "position_sd_m": self.position_sd,
            "own_fix": {
                "rmse_horizontal_m": np.sqrt(variance[:2].sum()),
                "sd_horizontal_m": np.sqrt(stated[:2].sum()),
                "rmse_vertical_m": np.sqrt(variance[2]),
                "sd_vertical_m": np.sqrt(stated[2]),
                "rmse_velocity_mps": np.sqrt(variance[3:].sum()),
                "sd_velocity_mps": np.sqrt(stated[3:].sum()),
            },
            "nees": np.mean(self.own_nees[known]) if known.any() else np.nan,
            "nees_band95": mean_band(6, int(known.sum())) if known.any() else None,
            "nees_all_epochs": self.mean_nees,
            "delay_ms": delay_figures(self.own_delay),
            "fleet_delay_ms": delay_figures(self.fleet_delay),
            "fates": {fate.name.lower(): count for fate, count in self.fates.items()},
            "fixes_delivered": _share(self.fates[FixFate.DELIVERED], fixes),
            "packets_delivered": _share(self.delivered, self.sent),
            "packets_still_queued": _share(self.queued, self.sent),
            "transmissions_per_packet": _share(self.transmissions, self.delivered),
            "slots_used": _share(self.slots_used, self.slots),
        }
        return plain(told)


def delay_figures(delay: Array) -> dict[str, Any]:
    """Mean, spread and percentiles, ms, and the share within `BASE_LINE_S`, of delays (d,), s."""
    if not len(delay):
        return dict.fromkeys(("mean", "sd", "p50", "p95", "p99", "within_50_ms"))
    p50, p95, p99 = np.percentile(delay, [50, 95, 99]) / MILLISECOND
    return {
        "mean": np.mean(delay) / MILLISECOND,
        "sd": np.std(delay) / MILLISECOND,
        "p50": p50,
        "p95": p95,
        "p99": p99,
        "within_50_ms": np.mean(delay <= BASE_LINE_S),
    }


def plain(content: Any) -> Any:
    """The same in what JSON can hold: NaN and infinity become None."""
    if isinstance(content, dict):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, np.ndarray | list | tuple):
        return [plain(value) for value in content]
    if isinstance(content, float | np.floating):
        return float(content) if np.isfinite(content) else None
    return content.item() if isinstance(content, np.generic) else content


def _share(part: float, whole: float) -> float:
    return part / whole if whole else np.nan


@dataclass
class NetworkScorer:
    """Gathers the records of runs one by one and keeps of each what a score needs."""

    _rows: list[tuple[Any, ...]] = field(default_factory=list)

    @property
    def runs(self) -> int:
        """Number of runs so far."""
        return len(self._rows)

    def add(self, record: NetworkRecord) -> None:
        """Take the record of one run."""
        made = np.isin(record.fate, MADE)
        error = np.hstack([record.error_n[:, 0], record.velocity_error_n[:, 0]])[made]
        cov = record.cov[made]
        # The own ship's covariance stands in its own axes, the error in those of the fleet's centre: a few
        # mrad between them, which a quadratic form does not feel.
        own_nees = nees(error, cov)
        arrived = record.delay[np.isfinite(record.delay)]
        located = (record.outcome == NodeOutcome.LOCATED) & ~record.anchor
        squares = [np.sum(x[located] ** 2) for x in (record.error_n, record.sd_n)]
        sums = np.array([located.sum(), (~record.anchor).sum() * len(record.time), *squares])
        fates = np.bincount(record.fate, minlength=len(FixFate))
        packets = np.array([getattr(record, name) for name in _COUNTS])
        self._rows.append(
            (error, cov.sum(axis=0), own_nees, arrived, record.fleet_delay, sums, fates, packets)
        )

    def score(self) -> NetworkScore:
        """The score of all runs so far. Raises ValueError if there are none."""
        if not self._rows:
            raise ValueError("no run of the network to score")
        errors, covs, runs_nees, own_delays, fleet_delays, sums, fates, packets = zip(
            *self._rows, strict=True
        )
        error, all_nees = np.concatenate(errors), np.concatenate(runs_nees)
        located, blind, square, stated = np.sum(sums, axis=0)
        counts = dict(zip(_COUNTS, np.sum(packets, axis=0).tolist(), strict=True))
        return NetworkScore(
            runs=len(self._rows),
            own_error=error,
            own_cov=np.sum(covs, axis=0) / len(error) if len(error) else np.full((6, 6), np.nan),
            own_nees=np.array([run[-1] if len(run) else np.nan for run in runs_nees]),
            mean_nees=float(np.mean(all_nees)) if len(all_nees) else np.nan,
            own_delay=np.concatenate(own_delays),
            fleet_delay=np.concatenate(fleet_delays),
            fates={fate: int(count) for fate, count in zip(FixFate, np.sum(fates, axis=0), strict=True)},
            coverage=_share(located, blind),
            position_rmse=float(np.sqrt(_share(square, located))),
            position_sd=float(np.sqrt(_share(stated, located))),
            **counts,
        )


def network_summary(records: Iterable[NetworkRecord]) -> dict[str, Any]:
    """The block ``network`` of `summary.json` for all runs of a scenario."""
    scorer = NetworkScorer()
    for record in records:
        scorer.add(record)
    return scorer.score().summary

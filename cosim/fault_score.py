"""What filters make of faults: who is believed, what the status says, and what it costs, run by run."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..aircraft.flight import Flight
from ..align.consistency import mean_band
from ..align.estimate import JUMP_SIGMAS, Array, Estimate, FixOutcome, NavStatus
from ..network.fleet_network import FleetNetwork
from ..network.record import FaultRecord
from ..sins import attitude, earth
from ..sins.imu import Imu
from .network_fault_score import mean_and_most, network_figures, share
from .outages import figures_of
from .papers import statistics
from .resampling import paired_ratios
from .run import Run
from .scenario import Scenario
from .score import FilterScore

AFTER_S = 30.0
"""After an outage, at which errors are told."""


def jumps(estimate: Estimate, truth: Flight, imu: Imu) -> tuple[int, int]:
    """Rows where the error moved by more than `JUMP_SIGMAS` standard deviations, the larger of the row before
    and of its own, and how many of them no flag tells.

    ``imu`` is what the filter was given. What vibration adds to the velocity is no correction, and is taken
    out; what held samples add to all is in the row's own deviations. All else moves by corrections, but for
    little.
    """
    rows = np.searchsorted(truth.time, estimate.time - 0.5 * truth.dt)
    position = earth.displacement_n(estimate.lla, truth.lla[rows])
    phi = attitude.misalignment(estimate.q_nb, truth.q_nb[rows])
    velocity = estimate.v_n - truth.v_n[rows]
    if imu.errors.vibration is not None:
        velocity -= attitude.rotate(estimate.q_nb, _felt(imu, imu.errors.vibration, estimate.time, truth.dt))
    errors = np.hstack([position, velocity, phi])
    with np.errstate(invalid="ignore"):
        sd = np.maximum(estimate.sd[:-1, :9], estimate.sd[1:, :9])
        moved = np.abs(np.diff(errors, axis=0)) > JUMP_SIGMAS * sd
    beyond = moved.any(axis=1)
    return int(beyond.sum()), int((beyond & ~estimate.jumped[1:]).sum())


def _felt(imu: Imu, vibration: Array, time: Array, dt: float) -> Array:
    """(m, 3) m/s, body, the vibration that is in the velocity at each ``time`` (m,): that of the last sample
    until then, without those whose clock has gone back."""
    in_order = imu.time == np.maximum.accumulate(imu.time)
    last = np.searchsorted(imu.time[in_order], time + 0.5 * dt) - 1
    return vibration[in_order][np.maximum(last, 0)]


@dataclass
class FaultScorer:
    """Gathers runs of one scenario with faults, one by one, for `rows`."""

    scenario: Scenario
    truth: Flight
    _counts: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])
    _told: dict[str, list[Array]] = field(default_factory=dict[str, list[Array]])
    _records: list[FaultRecord] = field(default_factory=list[FaultRecord])

    def add(self, run: Run) -> None:
        """Take in one run."""
        order = np.argsort(run.fixes.t_arrival, kind="stable")
        outlier = np.zeros(len(run.fixes), bool) if run.outlier is None else run.outlier[order]
        record = None if run.network is None else run.network.faults
        if record is not None:
            self._records.append(record)
        for name, estimate in run.estimates.items():
            counts = self._counts.setdefault(name, Counter())
            outcome = estimate.fix_outcome
            judged = outcome != FixOutcome.PENDING
            first = judged & (outcome != FixOutcome.DUPLICATE) & run.fixes.authentic[order]
            gated, used = outcome == FixOutcome.GATED, _used(outcome)
            counts["outliers"] += int((first & outlier).sum())
            counts["outliers_used"] += int((used & outlier).sum())
            counts["good"] += int((first & ~outlier).sum())
            counts["good_gated"] += int((gated & ~outlier).sum())
            counts["late"] += estimate.count(FixOutcome.LATE)
            counts["duplicates"] += estimate.count(FixOutcome.DUPLICATE)
            if record is not None:
                arrival = run.fixes.t_arrival[order]
                counts["forged_fused"] += int((used & np.isin(arrival, record.forged_arrival)).sum())
                counts["replayed_fused"] += int((used & np.isin(arrival, record.replayed_arrival)).sum())
            for kind, number in estimate.imu_samples.items():
                counts[f"imu_{kind.name.lower()}"] += number
            total, unflagged = jumps(estimate, self.truth, run.imu)
            counts["jumps"] += total
            counts["unflagged_jumps"] += unflagged
            self._told.setdefault(name, []).append(self._alone_after(estimate))

    def _alone_after(self, estimate: Estimate) -> Array:
        """(outages,) s from the begin of each to where the status says dead reckoning; NaN where it never
        does."""
        since = estimate.time - self.truth.time[0]
        alone = estimate.status == NavStatus.DEAD_RECKONING
        found = np.full(len(self.scenario.outages), np.nan)
        for i, outage in enumerate(self.scenario.outages):
            rows = np.flatnonzero(alone & (since >= outage.start_s) & (since < outage.end_s + 1.0))
            if len(rows):
                found[i] = since[rows[0]] - outage.start_s
        return found

    def rows(self, scores: Mapping[str, FilterScore], clean: Mapping[str, Array] | None) -> dict[str, Any]:
        """The block of one scenario in ``faults`` of `summary.json`.

        ``scores`` of its runs by filter; ``clean``, final errors (runs, 5) of the same runs without faults.
        """
        filters = {name: self._row(name, score, clean) for name, score in scores.items()}
        network = {"network": network_figures(self._records)} if self._records else {}
        return {"filters": filters, **network}

    def _row(self, name: str, score: FilterScore, clean: Mapping[str, Array] | None) -> dict[str, Any]:
        counts, told, kinds = self._counts[name], np.stack(self._told[name]), _attacks(self.scenario)
        independent = self.scenario.fixes.kind != "replay"
        ratios = None
        if clean is not None and name in clean:
            ratios = paired_ratios(score.errors[:, -1], clean[name])
        return {
            "outliers": counts["outliers"],
            "outliers_rejected": share(counts["outliers"] - counts["outliers_used"], counts["outliers"]),
            "good": counts["good"],
            "good_lost": share(counts["good_gated"], counts["good"]),
            "late": counts["late"],
            "duplicates": counts["duplicates"],
            "restarts": score.restarts,
            "outages": [
                {
                    "dead_reckoning_after_s": mean_and_most(told[:, i]),
                    **_over(score, outage.end_s, independent),
                }
                for i, outage in enumerate(self.scenario.outages)
            ],
            **_consistency(score, -1, independent),
            "jumps": counts["jumps"],
            "unflagged_jumps": counts["unflagged_jumps"],
            "over_clean": None if ratios is None else {k: _plain(v) for k, v in ratios.items()},
            "failed_runs": len(score.failures),
            "failures": dict(Counter(score.failures.values())),
            "imu_samples": {k.removeprefix("imu_"): n for k, n in counts.items() if k.startswith("imu_")},
            "forged_fused": counts["forged_fused"] if kinds & {"forged", "tampered"} else None,
            "replayed_fused": counts["replayed_fused"] if "replayed" in kinds else None,
        }


def _attacks(scenario: Scenario) -> set[str]:
    """Kinds of the attacks on packets."""
    fixes = scenario.fixes
    return {attack.kind for attack in fixes.faults.attacks} if isinstance(fixes, FleetNetwork) else set()


def _used(outcome: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (outcome == FixOutcome.FUSED) | (outcome == FixOutcome.INITIALIZED)


def _consistency(score: FilterScore, row: int, independent: bool) -> dict[str, Any]:
    """NEES of the misalignment at a row, and the band of so many independent runs as have one, or None."""
    known = int(np.isfinite(score.nees[:, row]).sum())
    (nees,) = _plain([score.mean_nees[row]])
    return {"nees": nees, "nees_band95": mean_band(3, known) if independent and known else None}


def _over(score: FilterScore, end_s: float, independent: bool) -> dict[str, Any]:
    """What the runs make of an outage: NEES at its end, and errors `AFTER_S` later, if there is so much."""
    end = max(int(np.searchsorted(score.time, end_s - 1e-6)) - 1, 0)
    later = int(np.searchsorted(score.time, end_s + AFTER_S - 1e-6))
    after = None
    if later < len(score.time):
        level = float(np.sqrt(np.mean(score.rms[later, :2] ** 2)))
        values = (level, float(score.rms[later, 2]), float(score.mean_nees[later]))
        after = dict(zip(("level_arcsec", "heading_arcmin", "nees"), _plain(values), strict=True))
    return {
        **_consistency(score, end, independent),
        "position_nees": figures_of(statistics.mean(score.position_nees[:, end])),
        "after_30_s": after,
    }


def _plain(values: Iterable[float]) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]

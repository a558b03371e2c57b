"""What befell one run of a filter, as columns of a campaign's rows: so few that they cost next to nothing."""

from typing import Any

import numpy as np
import pyarrow as pa

from ...align.estimate import Estimate, FixOutcome, NavStatus
from ..run import Run

FIELDS = (
    ("gated", pa.int32()),
    ("late", pa.int32()),
    ("unauthentic", pa.int32()),
    ("outliers_used", pa.int32()),
    ("dead_reckoning_s", pa.float64()),
    ("largest_jump_sd", pa.float64()),
    ("held_imu_samples", pa.int32()),
    ("quarantined", pa.int32()),
    ("honest_quarantined", pa.int32()),
)
"""Fixes that the gate refused, that came too late or from nobody known, and those made false
(`faults.packets`) that were believed; time without fixes; the largest jump over its own standard deviation,
as `Estimate.jump` has it; samples of the IMU that were held; nodes that the network left out at some time,
whether it asked them back or not, and those of them that had not lied. Null where it does not apply."""
NAMES = tuple(name for name, _ in FIELDS)
GREATEST = ("largest_jump_sd",)
"""Those of which the greatest tells more than the mean."""


def incidents(run: Run, estimate: Estimate, output_rate_hz: float) -> dict[str, Any]:
    """Values of `FIELDS`."""
    counts = np.bincount(estimate.fix_outcome, minlength=len(FixOutcome)).tolist()
    jumped = np.fmax.reduce(estimate.jump, initial=np.nan) if np.isfinite(estimate.fix_jump).any() else np.nan
    used = None
    if run.outlier is not None and run.outlier.any():
        # Outcomes are in the order of arrival.
        outcome = estimate.fix_outcome[run.outlier[np.argsort(run.fixes.t_arrival, kind="stable")]]
        used = int(np.count_nonzero((outcome == FixOutcome.FUSED) | (outcome == FixOutcome.INITIALIZED)))
    alone = np.count_nonzero(estimate.status == NavStatus.DEAD_RECKONING)
    left_out = None if run.network is None else run.network.faults
    caught = false = None
    if left_out is not None:
        without_cause = left_out.left_out_without_cause
        caught = int((np.isfinite(left_out.found_s) | without_cause).sum())
        false = int(without_cause.sum())
    return {
        "gated": counts[FixOutcome.GATED],
        "late": counts[FixOutcome.LATE],
        "unauthentic": counts[FixOutcome.UNAUTHENTIC],
        "outliers_used": used,
        "dead_reckoning_s": round(float(alone / output_rate_hz), 6),
        "largest_jump_sd": float(jumped) if np.isfinite(jumped) else None,
        "held_imu_samples": estimate.held_imu_samples,
        "quarantined": caught,
        "honest_quarantined": false,
    }

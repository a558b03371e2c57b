"""What a network makes of nodes that lie: who was found, when, and who without cause."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..align.estimate import Array
from ..network.record import FaultRecord


def network_figures(records: Iterable[FaultRecord]) -> dict[str, Any]:
    """What the network made of those that lie, over all runs: shares and times of quarantines."""
    found, lying, false, honest = [], 0, 0, 0
    for record in records:
        lies, caught = np.isfinite(record.lying_s), np.isfinite(record.quarantined_s)
        # Who was left out before the first lie was left out without cause.
        found_out = caught & (record.quarantined_s >= record.lying_s)
        lying += int(lies.sum())
        honest += int((~lies).sum())
        false += int((caught & ~found_out).sum())
        found += list((record.quarantined_s - record.lying_s)[found_out])
    return {
        "lying": lying,
        "quarantined": share(len(found), lying),
        "quarantined_after_s": mean_and_most(np.array(found, float)),
        "false_quarantines": false,
        "false_share": share(false, honest),
    }


def share(part: int, whole: int) -> float | None:
    """None of nothing."""
    return part / whole if whole else None


def mean_and_most(values: Array) -> list[float] | None:
    """Mean and greatest; None if one is missing, or all are."""
    return [float(values.mean()), float(values.max())] if len(values) and np.isfinite(values).all() else None

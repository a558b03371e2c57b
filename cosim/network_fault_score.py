"""What a network makes of nodes that lie: who was found, when, and who without cause."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..align.estimate import Array
from ..network.record import FaultRecord, QuarantineReason


def network_figures(records: Iterable[FaultRecord]) -> dict[str, Any]:
    """What the network made of those that lie, over all runs: shares and times of quarantines, which count
    though a node was asked back; and what was left of them at the end."""
    found, lying, honest = [], 0, 0
    kept = false = false_at_end = suspects = suspects_at_end = disturbed = 0
    for record in records:
        lies, found_s = np.isfinite(record.lying_s), record.found_s
        found_out = np.isfinite(found_s)
        lying += int(lies.sum())
        honest += int((~lies).sum())
        # Who was left out before the first lie was left out without cause.
        false += int(record.left_out_without_cause.sum())
        false_at_end += int(record.out_without_cause.sum())
        kept += int((found_out & np.isfinite(record.quarantined_s)).sum())
        suspects += int((record.suspected & ~lies).sum())
        suspects_at_end += int(((record.quarantined_for == QuarantineReason.START) & ~lies).sum())
        disturbed += len(record.disturbed_s) > 0
        found += list((found_s - record.lying_s)[found_out])
    return {
        "lying": lying,
        "quarantined": share(len(found), lying),
        "quarantined_after_s": mean_and_most(np.array(found, float)),
        "quarantined_at_end": share(kept, lying),
        "false_quarantines": false,
        "false_at_end": false_at_end,
        "honest_suspects": suspects,
        "honest_suspects_at_end": suspects_at_end,
        "disturbed_runs": disturbed,
        "false_share": share(false, honest),
    }


def share(part: int, whole: int) -> float | None:
    """None of nothing."""
    return part / whole if whole else None


def mean_and_most(values: Array) -> list[float] | None:
    """Mean and greatest; None if one is missing, or all are."""
    return [float(values.mean()), float(values.max())] if len(values) and np.isfinite(values).all() else None
